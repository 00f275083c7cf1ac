"""Score tests on recordings where nothing is missing."""

import numpy as np

from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.screening.families import ELEMENT
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.laws import find_law
from tests.diagnosis_cases import problem_of, simulate


def test_scores_on_a_clean_recording_are_chi_square() -> None:
    laws = (find_law("cubic_stiffness"), find_law("quadratic_damping"), find_law("damper_asymmetry"))
    scores = []
    for seed in range(6):
        problem = problem_of(simulate(seed=10 + seed, seconds=12))
        fit = optimise(problem, Point(np.zeros(4), (), np.zeros(4)))
        candidates = screen(problem, fit, laws).candidates
        scores += [h.score for h in candidates if h.family is ELEMENT]
    assert np.mean(scores) < 2.5  # one-sided laws drop out when their sign is wrong
    assert np.max(scores) < 20
