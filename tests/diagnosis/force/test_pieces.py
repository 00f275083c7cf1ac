"""One contract for every piece: linear in its strengths, shapes that its law's values give back, the law's force."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.force.motion import ElementMotion, element_motion
from sprung.model.diagnosis.force.piece import HYSTERESIS, Piece
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.diagnosis.force.sizes import MotionSizes
from sprung.model.laws import ElementLaw, SpringDamper
from sprung.model.laws.along import force_along
from sprung.model.laws.base import RARE

STRENGTHS = (300.0, 500.0)
ELEMENT = SpringDamper(STRENGTHS[0], 900.0)  # within a clearance nothing of a spring is left: its strength is that


@pytest.fixture(scope="module")
def motion() -> ElementMotion:
    t = np.arange(2000) / 100.0
    sines = ((0.008, 0.7, 0.2), (0.004, 2.3, 1.1), (0.002, 4.7, 2.0))
    deflection = np.sum([size * np.sin(2 * np.pi * f * t + phase) for size, f, phase in sines], axis=0)
    return element_motion(deflection, None, 100.0)


def middle_shape(piece: Piece, motion: ElementMotion) -> tuple[float, ...]:
    """A trial shape within the limits."""
    seen = MotionSizes.of(motion)
    trials = piece.grid(seen)
    return tuple(trials[len(trials) // 2].tolist())


def strengths(piece: Piece) -> np.ndarray:
    return np.array([sign or 1 for sign in piece.signs]) * np.linspace(*STRENGTHS, len(piece.signs))


@pytest.mark.parametrize("piece", PIECES, ids=lambda piece: piece.key)
def test_trial_shapes_lie_within_the_limits_and_come_back_from_the_laws_values(
    piece: Piece, motion: ElementMotion
) -> None:
    seen = MotionSizes.of(motion)
    trials, limits = piece.grid(seen), piece.limits(seen)
    assert trials.shape[1] == len(piece.shapes) == len(limits)
    for column, (low, high) in zip(trials.T, limits, strict=True):
        assert low <= column.min() and column.max() <= high
    shape = middle_shape(piece, motion)
    if piece.acting is not None:  # a branch: its shape is that of the law that acts
        return
    again = piece.shape_of(piece.parameters(strengths(piece), shape, ELEMENT))
    assert again == pytest.approx(shape, rel=1e-9)


@pytest.mark.parametrize("piece", PIECES, ids=lambda piece: piece.key)
def test_columns_times_strengths_are_the_force_of_the_acting_law(piece: Piece, motion: ElementMotion) -> None:
    shape, sizes = middle_shape(piece, motion), strengths(piece)
    law, of = piece.acting or piece.law, piece.acting_parameters or piece.parameters
    if not isinstance(law, ElementLaw):  # an inertia: see below
        return
    follows = piece.kind is HYSTERESIS and law.path is not None
    along, stride = (motion.followed, motion.stride) if follows else (motion, 1)
    values, d = of(sizes, shape, ELEMENT), along.deflection - motion.middle
    force = force_along(law, values, d, along.rate, along.time, ELEMENT)[::stride]
    found = piece.columns(motion, shape) @ sizes
    assert np.abs(found - force).max() < 1e-6 * np.abs(force).max()
    assert np.abs(force).max() > 0.0


def test_an_inertia_goes_with_the_acceleration(motion: ElementMotion) -> None:
    piece = next(piece for piece in PIECES if piece.effect == "inerter")
    sines = ((0.008, 0.7, 0.2), (0.004, 2.3, 1.1), (0.002, 4.7, 2.0))  # of the fixture
    exact = sum(-size * (2 * np.pi * f) ** 2 * np.sin(2 * np.pi * f * motion.time + phase) for size, f, phase in sines)
    for seen in (motion, motion.every(3)):
        found = piece.columns(seen, ())[:, 0]
        inside = slice(len(found) // 20, -len(found) // 20)  # a differentiated motion has edges
        truth = np.interp(seen.time, motion.time, exact)
        assert np.abs(found - truth)[inside].max() < 0.01 * np.abs(exact).max()


@pytest.mark.parametrize("piece", PIECES, ids=lambda piece: piece.key)
def test_a_piece_costs_what_its_law_needs_and_searches_no_further_than_its_law_admits(
    piece: Piece, motion: ElementMotion
) -> None:
    assert piece.commoner == piece.law.prior_cost / RARE + piece.rarer
    stated = {spec.name: spec for spec in piece.law.parameters}
    for name, (low, high) in zip(piece.shapes, piece.limits(MotionSizes.of(motion)), strict=True):
        if name in stated:
            assert stated[name].low <= low < high <= stated[name].high
