"""Deviations contain what a model leaves open: laws that look alike, a force of no law, a part that was not fitted."""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.force.deviations import covariance, left_open, moved_in_common
from sprung.model.diagnosis.force.fit import NO_LAWS, ComponentFit, ComponentTask, refined
from sprung.model.diagnosis.force.low_valve import low_valve
from sprung.model.diagnosis.force.motion import element_motion
from sprung.model.diagnosis.force.piece import Piece
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.signals import FloatArray

RATE, K, C = 100.0, 2e4, 900.0
T = np.arange(2000) / RATE
PARTS = ((0.008, 0.7, 0.2), (0.005, 1.9, 1.1), (0.002, 4.7, 2.0))  # m, Hz, phase
D: FloatArray = sum((size * np.sin(2 * np.pi * f * T + at) for size, f, at in PARTS), np.zeros(len(T)))
V = np.gradient(D, T)


def task(force: FloatArray, noise: float = 0.5) -> ComponentTask:
    random = np.random.default_rng(4)
    motion = element_motion(D + 1e-7 * random.standard_normal(len(D)), None, RATE)
    measured = K * D + C * V + force + noise * random.standard_normal(len(D))
    return ComponentTask(motion, measured, int(0.7 * len(D)), noise=noise)


def piece(effect: str, numbers: int) -> Piece:
    return next(one for one in PIECES if one.effect == effect and len(one.law.parameters) == numbers)


def deviations(fit: ComponentFit, full: FloatArray) -> dict[str, float]:
    return dict(zip(("preload", "stiffness", "damping"), np.sqrt(np.diag(full)), strict=False))


def test_what_is_left_of_a_force_that_no_law_explains_is_in_the_deviations() -> None:
    saturates = 0.3 * C * (0.05 * np.arctan(V / 0.05) - V)  # damping C at the smallest rates
    for force, left in ((saturates, True), (0.0 * V, False)):
        fit = refined(task(force), NO_LAWS)
        chance = deviations(fit, covariance(fit)[0])["damping"]
        whole = deviations(fit, covariance(fit)[0] + left_open(fit))["damping"]
        assert bool(abs(fit.element.damping - C) > 4 * chance) is left
        assert abs(fit.element.damping - C) < 3 * whole
        assert bool(whole > 4 * chance) is left


def test_a_law_that_looks_alike_is_in_the_deviations() -> None:
    turns = 0.3 * float(np.std(V))
    fit = refined(task(40 * np.clip(V / turns, -1, 1), noise=8.0), NO_LAWS.plus(piece("coulomb_friction", 2), (turns,)))
    other = low_valve(fit, 0)
    assert other is not None
    differs = abs(other.element.damping - fit.element.damping)
    assert deviations(fit, left_open(fit))["damping"] < 0.5 * differs
    assert deviations(fit, left_open(fit, [moved_in_common(other, fit)]))["damping"] > 0.99 * differs
