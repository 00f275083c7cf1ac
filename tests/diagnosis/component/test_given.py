"""Laws of the system file in a component test: held, estimated, or said to be ignored; and what is found of them."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.component.given import given_model, identified_laws
from sprung.model.diagnosis.force.deviations import covariance
from sprung.model.diagnosis.force.fit import ComponentTask, fitted, refined
from sprung.model.diagnosis.force.motion import element_motion
from sprung.model.laws import observe
from sprung.model.laws.placed import PlacedLaw
from sprung.model.system import System, parse_system

RIG = """
name: rig
sample_rate: 100
window: 100
bodies: {{}}
inputs:
  top: {{kind: displacement, displacement: {{csv: x, noise: 1.0e-6}}}}
elements:
  damper: {{upper: top, lower: ground, stiffness: 2.0e4, damping: 900{laws}}}
sensors:
  cell: {{kind: force, element: damper, csv: F, noise: 1.0}}
"""
TIME = np.arange(2000) / 100
MOVED = 0.008 * np.sin(2 * np.pi * 0.7 * TIME) + 0.004 * np.sin(2 * np.pi * 2.3 * TIME + 1.1)
RATE = np.gradient(MOVED, 0.01)
SEEN = observe(MOVED, RATE, 100.0, 2e4, 900.0)


def rig(laws: str) -> System:
    return parse_system(RIG.format(laws=f", laws: [{{{laws}}}]" if laws else ""))


@pytest.mark.parametrize(
    ("laws", "estimated", "held", "noted"),
    [
        ("", [], [], 0),
        ("coulomb_friction: {force: 50, smoothing: 0.01}", ["coulomb_friction"], [], 0),
        ("bump_stop: {gap: {value: 0.01, fixed: true}, stiffness: {value: 5.0e4, fixed: true}}", [], ["bump_stop"], 0),
        ("coulomb_friction: {force: 50, smoothing: {value: 0.01, fixed: true}}", ["coulomb_friction"], [], 1),
    ],
)
def test_laws_of_the_file_are_estimated_unless_all_their_values_are_fixed(
    laws: str, estimated: list[str], held: list[str], noted: int
) -> None:
    notes: list[str] = []
    model, kept = given_model(rig(laws), "damper", SEEN, notes)
    assert [piece.effect for piece in model.pieces] == estimated
    assert [placed.law.name for placed in kept] == held and all(isinstance(one, PlacedLaw) for one in kept)
    assert len(notes) == noted
    assert given_model(rig(laws), "another", SEEN, notes)[0].pieces == ()


def test_what_is_found_is_in_the_form_of_the_file_with_the_sign_of_the_force() -> None:
    """60 N of friction and a preload of 40 N, read by a load cell the wrong way round."""
    force = 2e4 * MOVED + 900 * RATE + 60 * np.tanh(RATE / 0.01) + 40
    motion = element_motion(MOVED, None, 100.0)
    noise = np.random.default_rng(2).standard_normal(len(force))
    model, _ = given_model(rig("coulomb_friction: {force: 50, smoothing: 0.01}"), "damper", SEEN, [])
    task = ComponentTask(motion, force + noise, 1400)
    fit = refined(task, fitted(task, model).model)
    full, names = covariance(fit)
    found = identified_laws(fit, "damper", 1, full, names, -1.0)
    assert [law.effect for law in found] == ["coulomb_friction", "preload"]
    friction = found[0].parameters[0]
    assert friction.value == pytest.approx(60, abs=4 * friction.std) and friction.std < 3.0
    assert found[1].parameters[0].value == pytest.approx(-40, abs=2.0)
