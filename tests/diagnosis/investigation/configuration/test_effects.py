"""Kinds of wrong set-ups: what each undoes is what it says, and its words hold its value."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.benchmarks.sensitivity_cases import QUARTER_CAR
from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.investigation.configuration.changes import attached
from sprung.model.diagnosis.investigation.configuration.effects import (
    ELEMENT_POSITION,
    NODE_DELAY,
    ONE_GAIN,
    SENSOR_POSITION,
    SETUP_EFFECTS,
    SIGN_REVERSED,
    WRONG_SCALE,
    Hypothesis,
    SetupPlace,
)
from sprung.model.diagnosis.investigation.configuration.fitted import SetupFault
from sprung.model.diagnosis.investigation.configuration.response import Group
from sprung.model.diagnosis.investigation.configuration.structure import structure_hypotheses
from sprung.model.diagnosis.investigation.verdict import kind_of
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise
from sprung.model.diagnosis.report.compose import places_put_right
from sprung.model.diagnosis.report.findings import setup_finding
from sprung.model.diagnosis.rules import RULES
from sprung.model.laws import CATALOGUE
from sprung.model.laws.damping import COULOMB_FRICTION
from sprung.model.system import System, load_system, parse_system
from sprung.model.units import confusion
from tests.diagnosis_cases import quarter_car, simulate


def test_every_kind_is_a_fault_of_the_measurement_with_words_of_its_own() -> None:
    for effect in SETUP_EFFECTS:
        assert kind_of(effect) is EffectKind.FAULT and not effect.ordinary
        words = effect.describe(SetupPlace("a|b", detail="lower car"), "7")
        assert words.startswith("a and b: ") and ("7" in words) == (effect.parameter is not None)
    assert ONE_GAIN.ordinary


def test_a_scale_and_what_is_left_of_it_are_undone_one_after_the_other() -> None:
    system, record = quarter_car(), simulate(seconds=5)
    signals = prepare(system, record.values, 100.0).signals
    place = SetupPlace("car_a", Group((0,)))
    _, once = Hypothesis.of(WRONG_SCALE, place, 1.9, 0.0).undo(system, signals)
    _, twice = WRONG_SCALE.remainder(place, 0.05)(system, once)
    assert WRONG_SCALE.further(1.9, 0.05) == pytest.approx(1.995)
    np.testing.assert_allclose(twice.sensors[:, 0], signals.sensors[:, 0] / 1.995)
    np.testing.assert_array_equal(twice.sensors[:, 1:], signals.sensors[:, 1:])


def test_a_delay_is_taken_back_and_positions_move_in_the_file() -> None:
    system, record = quarter_car(), simulate(seconds=5)
    signals = prepare(system, record.values, 100.0).signals
    _, early = NODE_DELAY.undone(SetupPlace("car_a", Group((0,))), 0.03)(system, signals)
    lost = (signals.samples - early.samples) // 2
    middle = slice(50, 300)
    np.testing.assert_allclose(
        early.sensors[middle, 0],
        signals.sensors[lost + 3 :, 0][middle],
        atol=0.1 * float(np.std(signals.sensors[:, 0])),
    )
    train = load_system()
    sensor, element = train.sensors[0], train.elements[0]
    for effect, kind, name in ((SENSOR_POSITION, "sensors", sensor), (ELEMENT_POSITION, "elements", element)):
        moved, same = effect.undone(SetupPlace(name, axis=1), 0.25)(train, signals)
        assert same is signals and effect.name == "wrong_position"
        before, after = (getattr(one.file, kind)[name].position for one in (train, moved))
        assert after[1] - before[1] == pytest.approx(0.25) and after[0] == before[0]
    assert len({*SETUP_EFFECTS}) == len(SETUP_EFFECTS)  # hypotheses are sorted by them
    # the same as a law, which a system file can take over
    fault = SetupFault(ELEMENT_POSITION, SetupPlace(element, axis=1), 0.25, 0.01, 1.0, 0.1)
    (found,) = places_put_right([fault, replace(fault, effect=SENSOR_POSITION)])
    assert (found.location, found.effect, found.parameters[0].value) == (element, "wrong_position", 0.25)
    law = {"wrong_position": {"offset": 0.25, "variant": found.variant}}
    stated = train.file.elements | {element: train.file.elements[element].model_copy(update={"laws": (law,)})}
    whole = System(train.file.model_copy(update={"elements": stated})).whole_system
    np.testing.assert_allclose(whole.mechanics.H, moved.mechanics.H, atol=1e-12)


def test_a_changed_system_knows_the_laws_of_a_user_still() -> None:
    own = replace(COULOMB_FRICTION, name="squeak")
    text = QUARTER_CAR.replace("damping: 2.0e+4", "damping: 2.0e+4, laws: [{squeak: {force: 300, smoothing: 2e-3}}]")
    system = parse_system(text, catalogue=(*CATALOGUE, own))
    changed = attached(system, "secondary", "lower", "ground")
    assert [one.law for one in changed.laws] == [one.law for one in system.laws] == [own]


def test_an_element_is_never_taken_to_end_at_a_measured_force() -> None:
    text = QUARTER_CAR.replace("inputs:\n", "inputs:\n  push: {kind: force, body: car, csv: p, noise: 1.0}\n")
    system, record = parse_system(text), simulate(seconds=5)
    values = np.column_stack([np.random.default_rng(1).normal(0.0, 50.0, len(record.values)), record.values])
    signals = prepare(system, values, 100.0).signals
    problem, fit = baseline(system, signals, declared_noise(system, signals), signals.samples)
    wrong = structure_hypotheses(problem, fit, replace(RULES.setup, asked=-np.inf))
    ends = {one.site.detail for one in wrong if one.effect.name == "wrong_body"}
    assert ends and not any("push" in end for end in ends)


def test_what_has_no_value_is_not_undone_by_one() -> None:
    with pytest.raises(AssertionError, match="has no value"):
        SIGN_REVERSED.undone(SetupPlace("car_a"), 1.0)


def test_a_wrong_scale_says_which_units_it_would_be() -> None:
    system = quarter_car()
    for ratio, said in ((1 / 9.80665, "as of g taken for m/s^2"), (-1000.0, "as of mm/s^2 taken for m/s^2")):
        fault = SetupFault(WRONG_SCALE, SetupPlace("car_a|car_b"), ratio, 1e-4, 1.0, 0.1)
        assert said in setup_finding(system, fault).sentence
    fault = SetupFault(WRONG_SCALE, SetupPlace("car_a"), 0.5, 1e-4, 1.0, 0.1)
    assert "taken for" not in setup_finding(system, fault).sentence
    assert confusion(0.0254, "m") == "m taken for in" and confusion(1.0, "N") is None
