"""Inputs that are lost, or of which nothing comes: what they showed is left out of the likelihood, and everything else
is identified as well as its deviation says."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.fault_isolation.contradictions import Contradictions
from sprung.model.identification.identify import Identifier
from sprung.model.identification.measurements.deviations import deviations
from sprung.model.identification.refinement.refine import Refined, Refiner
from sprung.model.signals import FloatArray
from sprung.model.system import BUNDLED, System, load_system
from sprung.model.tracking.tracker import Tracker, TrackerSettings, TrackerState
from tests.tracker_windows import EPOCH

SECOND = 1_000_000_000
WHEEL = ("wheel_11r.displacement", "wheel_11r.velocity")
ON_IT = {"primary_11r.stiffness", "primary_11r.damping"}


def frozen(system: System, values: FloatArray, channels: tuple[str, ...], at: float | None) -> FloatArray:
    """Windows (B, T, C) in which some channels stand still, at a value or at their mean."""
    out, names = values.copy(), [channel.name for channel in system.channels]
    for channel in channels:
        column = names.index(channel)
        out[:, :, column] = values[:, :, column].mean() if at is None else at
    return out


def without(system: System, values: FloatArray, lost: tuple[str, ...]) -> Refined:
    """Windows refined without some channels of inputs."""
    refiner = Refiner(replace(system, lost=frozenset(lost)), values.shape[1])
    return refiner.refine(frozen(system, values, lost, 0.0))


@cache
def drawn(file: str) -> tuple[System, FloatArray, FloatArray]:
    """A system, 32 windows of it, and the log-ratios of each."""
    system = load_system(BUNDLED / file)
    rng = np.random.default_rng(21)
    truth = np.log(rng.uniform(0.8, 1.2, (32, len(system.parameters))))
    return system, simulate_runs(system, truth, system.window, rng).values, truth


@pytest.mark.parametrize(
    ("file", "lost", "blind"),
    [
        ("manchester.yaml", WHEEL, ON_IT),
        ("manchester.yaml", WHEEL[:1], set()),  # the other channel is enough
        ("manchester.yaml", WHEEL[1:], set()),
        ("axleboxes.yaml", ("wheel_22l.acceleration",), {"primary_22l.stiffness", "primary_22l.damping"}),
    ],
)
def test_errors_are_as_stated_and_only_elements_on_a_lost_support_are_not_identifiable(
    file: str, lost: tuple[str, ...], blind: set[str]
) -> None:
    system, values, truth = drawn(file)
    found = without(system, values, lost)
    names = np.array([p.name for p in system.parameters])
    seen = ~np.isin(names, list(blind))
    assert found.converged.mean() > 0.95
    assert not found.identifiable[:, ~seen].any()
    assert found.identifiable[:, seen].mean() > 0.98
    std = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    errors = ((found.log_ratio - truth) / std)[:, seen][found.identifiable[:, seen]]
    assert 0.85 < np.sqrt(np.mean(errors**2)) < 1.15
    assert np.median(found.chi_square) == pytest.approx(1.0, abs=0.08)  # what is lost counts among what is fitted


def test_what_a_lost_input_shows_does_not_matter() -> None:
    system, values, _ = drawn("manchester.yaml")
    refiner = Refiner(replace(system, lost=frozenset(WHEEL)), system.window)
    still, wild = (refiner.refine(frozen(system, values[:4], WHEEL, at)) for at in (0.0, 1e3))
    np.testing.assert_array_equal(still.log_ratio, wild.log_ratio)


def test_a_lost_input_costs_what_it_determined_and_hardly_more() -> None:
    """The other bogie is known as well as before; nothing is known better without an input."""
    system, values, truth = drawn("manchester.yaml")
    lost, whole = without(system, values[:8], WHEEL), Refiner(system).refine(values[:8], truth[:8])
    ratio = np.sqrt(
        np.diagonal(lost.covariance, axis1=1, axis2=2) / np.diagonal(whole.covariance, axis1=1, axis2=2)
    ).mean(axis=0)
    other = np.array(["primary_2" in p.name for p in system.parameters])
    assert np.all(ratio[other] < 1.2)
    assert np.all(ratio > 0.95)


def test_sensors_that_contradict_each_other_are_found_beside_a_lost_input() -> None:
    system, values, _ = drawn("manchester.yaml")
    wrong = values[:2].copy()
    wrong[..., 20] *= -1
    wrong[..., :2] = np.nan
    right = values[:2].copy()
    right[..., :2] = np.nan
    contradictions = Contradictions(Refiner(system).calibration, np.arange(28))
    assert contradictions.contradicted(wrong).all()
    assert not contradictions.contradicted(right).any()


def followed(
    tracker: Tracker, identifier: Identifier, state: TrackerState, values: FloatArray, first: int
) -> TrackerState:
    """State after windows that follow each other, from number `first` on, in batches as in the service."""
    for at in range(0, len(values), 8):
        windows = values[at : at + 8]
        known = [tracker.known_faults(state)] * len(windows)
        for k, estimate in enumerate(identifier.examine(windows, np.arange(len(windows)) % 2 == 0, known)):
            state = tracker.update(state, estimate, EPOCH + (first + at + k) * SECOND)
    return state


@pytest.mark.parametrize(
    ("at", "kind"),
    [
        (None, "frozen"),
        pytest.param(np.nan, "silent", marks=pytest.mark.slow),
        pytest.param(4.0, "frozen", marks=pytest.mark.slow),
    ],
)
def test_a_vehicle_stays_monitored_while_a_wheel_is_lost(at: float | None, kind: str) -> None:
    """Frozen at its mean, far off, or silent: the wheel is named, a damper of the other bogie found, and nothing else
    accused."""
    system, rng = load_system(), np.random.default_rng(5)
    identifier, tracker = Identifier(system), Tracker(system.parameters, TrackerSettings(), deviations(system))
    names = [p.name for p in system.parameters]
    healthy = np.log(rng.uniform(0.9, 1.1, 24))
    weak = healthy.copy()
    weak[names.index("primary_22l.damping")] += np.log(0.75)

    def ride(truth: FloatArray, windows: int) -> FloatArray:
        return simulate_runs(system, np.tile(truth, (windows, 1)), system.window, rng).values

    state = followed(tracker, identifier, tracker.initial_state(), ride(healthy, 60), 0)
    assert state.alarms == () and not tracker.lost(state)
    state = followed(tracker, identifier, state, frozen(system, ride(healthy, 20), WHEEL, at), 60)
    state = followed(tracker, identifier, state, frozen(system, ride(weak, 80), WHEEL, at), 80)

    kinds = {(a.kind, a.parameter) for a in state.alarms}
    assert kinds == {("change", "primary_22l.damping"), *(("sensor", f"{channel}.{kind}") for channel in WHEEL)}
    assert state.coverage.monitored
    report = {r.name: r for r in tracker.report(state)}
    assert {name for name, r in report.items() if not r.identifiable} == ON_IT
    assert {r.lost_with for name, r in report.items() if name in ON_IT} == {"|".join(WHEEL)}
    assert all(r.lost_with is None for name, r in report.items() if name not in ON_IT)
    for i, name in enumerate(names):
        if name not in ON_IT:
            assert abs(report[name].log_ratio - weak[i]) < 3 * report[name].log_std, name
    change = report["primary_22l.damping"]
    assert change.drift is not None and change.drift_std is not None
    assert abs(change.drift + 0.25) < 3 * change.drift_std
    state = TrackerState.from_dict(state.to_dict())

    assert {(f.channel, f.kind) for f in tracker.sensors(state)} == {(channel, kind) for channel in WHEEL}
    state = followed(tracker, identifier, state, ride(weak, 40), 160)  # repaired
    assert {(a.kind, a.parameter) for a in state.active} == {("change", "primary_22l.damping")}
    assert {(a.kind, a.parameter) for a in state.alarms} == kinds
    assert not tracker.lost(state)
    level, std = tracker.posterior(state)
    assert np.abs((level - weak) / std).max() < 3


def test_windows_are_refined_with_the_inputs_that_each_of_them_has() -> None:
    """The same as if windows that lack the same were refined alone."""
    system, values, _ = drawn("manchester.yaml")
    mixed = values[:6].copy()
    mixed[1, :, 2:4] = np.nan
    mixed[4, :, 2:4] = np.nan
    mixed[3, :, [10, 20]] = np.nan  # an input and a sensor
    identifier = Identifier(system)
    found = identifier.identify(mixed, states=True)
    for rows in ([0, 2, 5], [1, 4], [3]):
        alone = identifier.identify(mixed[rows], states=True)
        for row, other in zip(rows, alone, strict=True):
            np.testing.assert_allclose(found[row].log_ratio, other.log_ratio, atol=1e-9)
            np.testing.assert_allclose(found[row].outputs, other.outputs, atol=1e-6)  # type: ignore[arg-type]
    np.testing.assert_allclose(found[1].log_ratio, without(system, values[1:2], WHEEL).log_ratio[0], atol=1e-3)
    shown = np.asarray(found[1].outputs)
    noise = np.array([channel.noise for channel in system.channels[16:]])
    assert np.all(
        (shown - values[1, :, 16:]).std(axis=0) < 12 * noise
    )  # with the motion that the sensors tell, within the band


def test_a_contradiction_is_found_in_windows_that_lack_an_input() -> None:
    """A reversed sensor beside a silent wheel: both are named, and the window is used."""
    system, values, truth = drawn("manchester.yaml")
    wrong = values[:4].copy()
    wrong[..., 20] *= -1
    wrong[..., 2:4] = np.nan
    found = Identifier(system).examine(wrong, np.ones(4, dtype=bool))
    seen = np.array([p.name not in ON_IT for p in system.parameters])
    for estimate, true in zip(found, truth, strict=False):
        assert {(f.channel, f.kind) for f in estimate.faults} == {
            (system.channels[20].name, "inverted"),
            *((channel, "silent") for channel in WHEEL),
        }
        assert estimate.adequate
        std = np.sqrt(np.diag(estimate.covariance))
        assert np.all(
            np.abs(estimate.log_ratio - true)[seen & estimate.identifiable] < 4.5 * std[seen & estimate.identifiable]
        )


def test_a_gain_is_found_in_windows_that_lack_an_input() -> None:
    system, values, _ = drawn("manchester.yaml")
    wrong = values[:4].copy()
    wrong[..., 22] *= 1.2
    wrong[..., 2:4] = np.nan
    for estimate in Identifier(system).examine(wrong, np.ones(4, dtype=bool)):
        gains = [f for f in estimate.faults if f.kind == "gain"]
        assert [f.channel for f in gains] == [system.channels[22].name]
        assert gains[0].value == pytest.approx(1.2, abs=0.06)
        assert estimate.adequate


def test_the_stated_misfit_of_a_window_without_an_input_is_that_of_what_the_sensors_leave() -> None:
    system, values, _ = drawn("manchester.yaml")
    silent = values[:6].copy()
    silent[:, :, 2:4] = np.nan
    for lossy, whole in zip(Identifier(system).identify(silent), Identifier(system).identify(values[:6]), strict=True):
        assert lossy.nrmse < 3 * whole.nrmse
        assert np.all(lossy.per_sensor < whole.per_sensor + 0.12)  # beyond the band nothing is told of a lost input


@pytest.mark.parametrize(
    ("silent", "known"),
    [
        (("wheel_1", "bogie1"), ("primary_2", "secondary_2")),  # everything that one node sends
        (("wheel_1", "bogie1_1"), ("primary_2", "secondary")),
        (("wheel_1",), ("primary_2", "secondary")),
    ],
)
def test_what_a_dead_node_measured_is_unknown_and_all_else_as_certain_as_stated(
    silent: tuple[str, ...], known: tuple[str, ...]
) -> None:
    system, values, truth = drawn("manchester.yaml")
    some = values.copy()
    some[:, :, [c.name.startswith(silent) for c in system.channels]] = np.nan
    found = Identifier(system).examine(some, np.ones(len(some), dtype=bool))
    seen = np.array([p.name.startswith(known) for p in system.parameters])
    assert np.mean([e.adequate for e in found]) > 0.9
    assert not any(e.identifiable[~seen].any() for e in found)
    assert np.mean([e.identifiable[seen].mean() for e in found]) > 0.98
    errors = np.array([(e.log_ratio - t) / np.sqrt(np.diag(e.covariance)) for e, t in zip(found, truth, strict=True)])
    shown = np.array([e.identifiable for e in found])
    assert 0.8 < np.sqrt(np.mean(errors[shown] ** 2)) < 1.2
