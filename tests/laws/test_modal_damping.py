"""Damping of modes: closed forms, the frame that it refers to, and its place in a system file."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.laws.in_place import all_in_place
from sprung.model.laws.structure import MODAL_DAMPING, elastic_modes, frame_of, sites_of
from sprung.model.mechanics import Mechanics, state_matrix
from sprung.model.schema import SystemFileError
from sprung.model.system import load_system, parse_system

BUILDING = """
name: building
sample_rate: 100
window: 100
bodies:
  first: {mass: 900, laws: [{modal_damping: {mode_1: 0.03, mode_2: {value: 0.01, std: 0.001}}}]}
  second: {mass: 1000}
  roof: {mass: 700}
inputs: {table: {kind: support, displacement: {csv: d, noise: 1e-5}, velocity: {csv: v, noise: 1e-3}}}
elements:
  s1: {upper: first, lower: table, stiffness: 3.0e6, damping: {value: 0.0, fixed: true}}
  s2: {upper: second, lower: first, stiffness: 2.5e6, damping: {value: 0.0, fixed: true}}
  s3: {upper: roof, lower: second, stiffness: 2.0e6, damping: {value: 0.0, fixed: true}}
sensors: {a: {kind: acceleration, body: roof, csv: a, noise: 0.01}}
"""
RATIOS = (0.03, 0.01, 0.02)


def damped(mechanics: Mechanics, text: str = BUILDING) -> Mechanics:
    file = parse_system(text).file
    return MODAL_DAMPING.modify(mechanics, sites_of(file, "first|second|roof"), (*RATIOS, *[0.0] * 9), "")


def test_every_mode_has_its_ratio_and_keeps_its_frequency() -> None:
    mechanics = parse_system(BUILDING).mechanics
    omegas, _ = elastic_modes(mechanics)
    found = damped(mechanics)
    H = found.H
    A = state_matrix(found.mass, (H.T * found.stiffness) @ H, (H.T * found.damping) @ H)
    values = np.linalg.eigvals(A)
    values = values[values.imag > 0][np.argsort(np.abs(values[values.imag > 0]))]
    np.testing.assert_allclose(np.abs(values), omegas, rtol=1e-9)
    np.testing.assert_allclose(-values.real / np.abs(values), RATIOS, rtol=1e-9)


def test_quoted_are_frequencies_and_ratios_with_all_dampers() -> None:
    """Against the eigenvalues, with dampers between the storeys of up to 2 % beside the ratios."""
    text = BUILDING.replace("damping: {value: 0.0, fixed: true}", "damping: 2.0e+3")
    found = damped(parse_system(text).mechanics, text)
    assert MODAL_DAMPING.quoted is not None
    quoted = MODAL_DAMPING.quoted(found)
    for number, mode in enumerate(found.modes(("first", "second", "roof")), 1):
        assert quoted[f"frequency_of_mode_{number}"][0] == pytest.approx(mode.frequency, rel=1e-3)
        assert quoted[f"damping_ratio_of_mode_{number}"][0] == pytest.approx(mode.damping_ratio, rel=1e-2)


def test_bodies_on_a_single_support_are_damped_relative_to_it() -> None:
    mechanics = parse_system(BUILDING).mechanics
    found = damped(mechanics)
    np.testing.assert_array_equal(frame_of(mechanics), [1.0])
    np.testing.assert_allclose(found.H.sum(axis=1) + found.G[:, 0], 0.0, atol=1e-12)


def test_bodies_on_several_supports_are_damped_relative_to_the_ground() -> None:
    np.testing.assert_array_equal(frame_of(load_system().mechanics), np.zeros(8))


def test_a_system_file_names_the_modes_that_have_one() -> None:
    system = parse_system(BUILDING)
    (law,) = system.laws
    assert (law.location, law.values) == ("first|second|roof", (0.03, 0.01, *[0.0] * 10))
    assert law.fixed == (False, False, *[True] * 10)
    placed = all_in_place(system.file, system.mechanics, system.laws)
    assert placed.added == ("first|second|roof.modal_damping.1", "first|second|roof.modal_damping.2")


def test_laws_of_all_springs_have_no_place_in_a_system_file() -> None:
    with pytest.raises(SystemFileError, match="this law does not belong here"):
        parse_system(BUILDING.replace("modal_damping: {mode_1: 0.03", "structural_damping: {loss_factor: 0.03"))
