"""Deviations of LuGre's friction contain the truth, with noise and sampling of the motion as of a test bench."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.benchmarks import naming
from sprung.benchmarks.naming_rigs import RIGS
from sprung.model.diagnosis.component.measured import component_records
from sprung.model.diagnosis.force.deviations import covariance, left_open, spread
from sprung.model.diagnosis.force.fit import ComponentModel, refined
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.diagnosis.rules import RULES

LUGRE = next(piece for piece in PIECES if piece.effect == "lugre")


def deviations(seed: int, motion: str) -> list[float]:
    """Errors of yield force and yield displacement over their stated deviations, fitted from near the truth."""
    random = np.random.default_rng([seed, 7, 3])
    drawn, rig = int(random.integers(2**31)), RIGS["lugre"]
    d = naming.moved(motion, random)
    force = naming.forces(rig, d, drawn, naming.levels(random))
    again = np.random.default_rng(drawn)
    again.uniform(size=3)  # spring, damper and preload of the bench
    truth = rig.made(again).truth
    record = naming.measured(d, force, None, random)
    task = component_records(naming.BENCH, record.values, naming.RATE, RULES)[0].task
    fit = refined(task, ComponentModel((LUGRE,), ((truth["yield_displacement"], 0.03, 0.5),)))
    full, names = covariance(fit)
    stated = spread(fit, 0, full + left_open(fit), names)[1]
    found = fit.quoted(0)
    return [(found[name][0] - truth[name]) / std for name, std in zip(found, stated, strict=True)]


@pytest.mark.slow
def test_twelve_frictions_lie_within_their_deviations() -> None:
    errors = np.abs([deviations(seed, motion) for seed in range(501, 507) for motion in ("random", "sine")])
    assert np.mean(errors < 2) >= 0.9 and np.max(errors) < 3.5, errors
