"""Values that engineers quote of a component test, against closed forms of a damper with friction."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.component.words import (
    finding_of,
    late_finding,
    leftover_words,
    preload_finding,
    unknown_finding,
)
from sprung.model.diagnosis.force.fit import NO_LAWS, ComponentFit, ComponentTask, fitted
from sprung.model.diagnosis.force.motion import ElementMotion
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.diagnosis.force.ranking import Ranked, Step
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.report.report import Finding, LawParameter
from sprung.model.laws.basis import UNKNOWN

K, C, FRICTION, PRELOAD = 4.0e4, 1.5e3, 60.0, 25.0  # N/m, N s/m, N, N
TRAVEL, OMEGA, RATE = 0.02, 2 * np.pi * 1.25, 400.0  # m, rad/s, Hz
SMOOTHING = 1e-3  # m/s: sharp, so that a loop is a rectangle
COULOMB = next(piece for piece in PIECES if piece.effect == "coulomb_friction" and len(piece.shapes) == 1)


@pytest.fixture(scope="module")
def fit() -> ComponentFit:
    """Ten cycles of a sine without noise, fitted by the law that made its force."""
    t = np.arange(int(8 * RATE)) / RATE
    d, v = TRAVEL * np.sin(OMEGA * t), TRAVEL * OMEGA * np.cos(OMEGA * t)
    force = PRELOAD + K * d + C * v + FRICTION * np.tanh(v / SMOOTHING)
    task = ComponentTask(ElementMotion.of(t, d, v, 0.0, 0.0), force, len(t) // 2)
    return fitted(task, NO_LAWS.plus(COULOMB, (SMOOTHING,)))


def step_of(fit: ComponentFit) -> Step:
    base = fitted(fit.task, NO_LAWS)
    return Step(Ranked(fit, 100.0, 90.0, 50.0), Ranked(base, 0.0, 0.0, 50.0), (), 1e-6)


def found(fit: ComponentFit, alike: tuple[str, ...] = ()) -> Finding:
    sigma = np.array([1.0, 1e-4]), np.array([1.0])
    return finding_of("damper", fit, fitted(fit.task, NO_LAWS), 0, step_of(fit), sigma, alike)


def test_a_loop_dissipates_what_viscous_damping_and_friction_do(fit: ComponentFit) -> None:
    quoted = {one.name: one for one in found(fit).quoted}
    exact = np.pi * C * OMEGA * TRAVEL**2 + 4 * FRICTION * TRAVEL
    assert quoted["loop_area"].value == pytest.approx(exact, rel=2e-3)
    assert quoted["loop_area"].std < 1e-3 * exact  # every loop is the same


def test_forces_at_data_sheet_rates_are_those_in_the_middle_of_the_travel_without_preload(fit: ComponentFit) -> None:
    quoted = {one.name: one.value for one in found(fit).quoted}
    for rate in (0.05, 0.1):
        extension, compression = quoted[f"force_extension_{rate:g}"], quoted[f"force_compression_{rate:g}"]
        assert extension == pytest.approx(-compression, rel=0.05)
        assert extension == pytest.approx(C * rate + FRICTION, rel=0.08)
    assert "force_extension_0.2" not in quoted  # TRAVEL * OMEGA is 0.16 m/s


def test_a_finding_states_its_force_and_what_fits_as_well(fit: ComponentFit) -> None:
    alone, beside = found(fit), found(fit, ("dahl_friction", COULOMB.effect))
    assert alone.family is None and alone.advice is None and "60" in alone.sentence
    assert beside.family == f"{COULOMB.effect} or dahl_friction"
    assert "coulomb friction or dahl friction fit almost equally well" in beside.sentence and beside.advice


def test_what_is_left_is_named_with_its_size_and_its_frequencies(fit: ComponentFit) -> None:
    task = fit.task
    hum = 3.0 * np.sin(2 * np.pi * 20.0 * task.motion.time)
    base = fitted(ComponentTask(task.motion, task.force + hum, task.split), fit.model)
    words = leftover_words("damper", base, 100.0)
    assert "2.1" in words and "N rms at damper" in words and "at 20 to 20 Hz" in words


def test_a_preload_is_a_nuisance_and_an_unnamed_force_names_what_comes_closest(fit: ComponentFit) -> None:
    assert preload_finding("damper", PRELOAD, 0.5).kind is EffectKind.NUISANCE
    step = step_of(fit)
    unknown = unknown_finding("damper", step, (step,), mapped=True)
    assert unknown.effect == UNKNOWN and unknown.kind is EffectKind.UNLISTED
    assert "coulomb friction would come closest" in unknown.sentence and "map is reported" in unknown.sentence


@pytest.mark.parametrize(("seconds", "way"), [(4e-3, "later"), (-4e-3, "earlier")])
def test_a_late_force_is_said_in_milliseconds_and_a_filter_with_its_corner(
    fit: ComponentFit, seconds: float, way: str
) -> None:
    time = LawParameter("time", seconds, 1e-4, "s")
    late = late_finding("cell", "damper", time, step_of(fit), (), filters=False)
    assert "comes 4 " in late.sentence and f" ms {way} than" in late.sentence
    assert late.kind is EffectKind.FAULT and late.parameters[0].value == seconds
    if seconds > 0:
        words = late_finding("cell", "damper", time, step_of(fit), (), filters=True).sentence
        assert f"({1 / (2 * np.pi * seconds):.3g} Hz)" in words
