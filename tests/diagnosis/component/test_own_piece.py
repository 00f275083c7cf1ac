"""Pieces that are derived from what a law declares: their force is the law's own, in whatever it is linear."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.component.own import observed, own_piece, own_pieces
from sprung.model.diagnosis.force.motion import ElementMotion
from sprung.model.diagnosis.force.sizes import MotionSizes
from sprung.model.laws import ElementLaw, Motion, SpringDamper, find_law

TIME = np.arange(400) / 100.0
MOTION = ElementMotion.of(TIME, 0.01 * np.sin(7 * TIME), 0.07 * np.cos(7 * TIME), 0.0, 0.0)
ELEMENT = SpringDamper(4e4, 1.5e3)
SEEN = observed(MOTION, ELEMENT)


def force_of(law: ElementLaw, values: tuple[float, ...]) -> np.ndarray:
    motion = Motion(MOTION.deflection - MOTION.middle, MOTION.rate, MOTION.time, ())
    return np.asarray(law.force(motion, values, ELEMENT), dtype=float)


def law_named(name: str) -> ElementLaw:
    law = find_law(name)
    assert isinstance(law, ElementLaw)
    return law


@pytest.mark.parametrize("name", ["quadratic_damping", "damper_asymmetry", "cubic_stiffness", "coulomb_friction"])
def test_strength_times_column_is_the_force_of_the_law_at_the_parameters_of_the_piece(name: str) -> None:
    law = law_named(name)
    piece = own_piece(law, SEEN)
    assert piece is not None and len(piece.signs) == 1
    shape = tuple(float(value) for value in piece.grid(MotionSizes.of(MOTION))[0])
    strength = np.array([37.0])
    values = piece.parameters(strength, shape, ELEMENT)
    column = piece.columns(MOTION, shape)
    np.testing.assert_allclose(column[:, 0] * strength[0], force_of(law, values), rtol=1e-9, atol=1e-9)
    assert piece.shape_of(values) == pytest.approx(shape)


def test_the_strength_of_a_law_that_is_never_negative_keeps_its_sign() -> None:
    one_sided, either = own_piece(law_named("quadratic_damping"), SEEN), own_piece(law_named("cubic_stiffness"), SEEN)
    assert one_sided is not None and one_sided.signs == (1,)
    assert either is not None and either.signs == (0,)


def test_shapes_are_sought_about_their_typical_size_and_within_what_the_law_admits() -> None:
    law = law_named("coulomb_friction")
    piece = own_piece(law, SEEN)
    assert piece is not None
    sizes = MotionSizes.of(MOTION)
    for name, (low, high) in zip(piece.shapes, piece.limits(sizes), strict=True):
        spec = next(one for one in law.parameters if one.name == name)
        typical = abs(spec.typical(SEEN))
        assert spec.low <= low < typical < high <= spec.high
        assert high <= typical * sizes.reach * (1 + 1e-9) and low >= typical / sizes.reach * (1 - 1e-9)


def test_a_law_that_is_linear_in_nothing_or_follows_both_values_of_the_element_is_no_piece() -> None:
    quadratic = law_named("quadratic_damping")
    bent = replace(quadratic, name="bent", force=lambda m, p, e: np.sin(p[0]) * np.asarray(m.rate))
    both = replace(quadratic, name="both", force=lambda m, p, e: p[0] * e.stiffness * e.damping * np.asarray(m.rate))
    assert own_piece(bent, SEEN) is None and own_piece(both, SEEN) is None
    notes: list[str] = []
    elsewhere = replace(quadratic, name="elsewhere", at=("spring",))
    pieces = own_pieces((quadratic, bent, elsewhere), "damper", SEEN, notes)
    assert [piece.effect for piece in pieces] == ["quadratic_damping"]
    assert len(notes) == 1 and "not searched here: bent:" in notes[0]  # a law of another element is not missed
