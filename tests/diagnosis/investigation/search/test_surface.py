"""The force of an unknown law as a surface: estimated, simulated and refitted, against the law that made it."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.fit.optimise import Fit, optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation.search.surface import with_surface
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.screening.families import UNNAMED
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.diagnosis.selection.starts import start_of
from sprung.model.signals import FloatArray
from tests.diagnosis_cases import problem_of, simulate

REACH = 3e-3  # m, over which the force of position-dependent damping grows


def law(d: float, v: float) -> float:
    """Damping that grows with the deflection, and a force that saturates: of no listed law, of no single shape."""
    return 2e4 * v * (d / REACH) ** 2 / (1 + (d / REACH) ** 2) + 400.0 * float(np.tanh(d / (0.5 * REACH)))


@pytest.fixture(scope="module")
def fitted() -> tuple[Problem, Fit]:
    """The best static shape of the screening beside the nominal structure, fitted."""
    problem = problem_of(simulate(law, seed=41, level=2.0))
    base = optimise(problem, Point(np.zeros(4), (), np.zeros(4)))
    shapes = [one for one in screen(problem, base, problem.system.catalogue).candidates if one.family is UNNAMED]
    best = next(one for one in shapes if one.location == "secondary")
    return problem, optimise(problem, start_of(base, best))


def without_spring_and_damper(fit: Fit, force: FloatArray) -> FloatArray:
    """A force along the secondary element's motion (4N,) without what its spring and damper may make of it."""
    element = fit.forward.system.elements.index("secondary")
    columns = np.column_stack([motion[:, element] for motion in fit.element_motion])
    return np.asarray(force - columns @ np.linalg.lstsq(columns, force, rcond=None)[0])


def test_a_surface_comes_closer_to_the_force_than_the_shape_that_was_screened(fitted: tuple[Problem, Fit]) -> None:
    problem, shape = fitted
    surface = with_surface(problem, shape)
    assert surface is not None and surface.chi_square < shape.chi_square
    element = surface.forward.system.elements.index("secondary")
    d, v = (motion[:, element] for motion in surface.element_motion)
    truth = without_spring_and_damper(surface, np.array([law(*one) for one in zip(d, v, strict=True)]))
    missed = {
        name: float(np.std(without_spring_and_damper(fit, fit.force_along(fit.point.terms[-1])) - truth))
        for name, fit in (("shape", shape), ("surface", surface))
    }
    assert missed["surface"] < 0.2 * np.std(truth) and missed["surface"] < missed["shape"]
