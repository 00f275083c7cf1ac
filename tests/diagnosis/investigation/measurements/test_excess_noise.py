"""Which channels count as noisier than their peers."""

from dataclasses import replace

import numpy as np
import pytest

from sprung.benchmarks.shaken import building
from sprung.model.diagnosis.api import diagnose
from sprung.model.diagnosis.investigation.diagnose import begun
from sprung.model.diagnosis.investigation.measurements.excess_noise import (
    is_what_is_left,
    outliers,
    reaching_sensors,
    upper_ratio,
)
from sprung.model.diagnosis.investigation.measurements.floor import bounded, realised_floor
from sprung.model.diagnosis.investigation.state import NoiseFault, Options
from sprung.model.diagnosis.record.signals import declared_noise
from sprung.model.diagnosis.rules import RULES
from sprung.model.diagnosis.selection.holdout import FreeRun
from sprung.model.signals import FloatArray
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import load_system
from tests.diagnosis_cases import MadeRecord, quarter_car, simulate

NAMES = ["a", "b", "c", "d", "e"]
EVERY = np.ones(5, dtype=bool)
RULE = RULES.noise


def test_chance_hardly_ever_makes_an_outlier() -> None:
    random, bins, found = np.random.default_rng(1), 400, 0
    for _ in range(500):
        level = np.sqrt(np.mean(random.exponential(1.0, (bins, 5)), axis=0))
        found += len(outliers(NAMES, level, EVERY, bins, RULE))
    assert found == 0


@pytest.mark.parametrize("usual", [0.5, 1.0, 3.0])
def test_a_noisy_channel_is_found_whatever_all_have_in_common(usual: float) -> None:
    ratio = usual * np.array([1.01, 0.99, 1.5, 1.0, 1.02])
    (found,) = outliers(NAMES, ratio, EVERY, 400, RULE)
    assert found.location == "c" and found.ratio == pytest.approx(1.5 * usual)
    assert found.usual == pytest.approx(1.005 * usual)
    assert found.sigmas == pytest.approx(np.log(1.5 / 1.005) * np.sqrt(800))
    assert found.p_value < 1e-6


def test_what_ends_with_the_band_is_no_noise_and_two_channels_cannot_be_told_apart() -> None:
    ratio = np.array([1.0, 1.0, 2.0, 1.0, 1.0])
    assert not outliers(NAMES, ratio, EVERY & (ratio < 2), 400, RULE)
    assert not outliers(["a", "b"], ratio[1:3], EVERY[:2], 400, RULE)


def test_a_significant_ratio_that_no_workshop_would_mind_is_none() -> None:
    assert not outliers(NAMES, np.array([1.0, 1.0, 0.99 * RULE.least, 1.0, 1.0]), EVERY, 1e6, RULE)
    assert not outliers(NAMES, np.array([1.0, 1.0, 1.5, 1.0, 1.0]), EVERY, 20, RULE)  # and one of few bins


def test_a_level_that_is_not_what_a_free_run_leaves_is_the_misfit_of_another_structure() -> None:
    error = np.array([1.0, 1.0, 1.0, 1.0])
    assert is_what_is_left(np.array([0.1, 0.9, 1.2, 60.0]), error, RULE).tolist() == [False, True, True, False]


def test_resonances_of_a_wrong_structure_are_not_taken_for_noise() -> None:
    rig = building(8, "bending", 3, 20.0)
    state = begun(rig.system, rig, Options(), lambda share, what: None)
    declared = declared_noise(state.system, state.prepared.signals).sensors
    residual = np.abs(state.fit.spectrum[state.problem.part.grid.band.stop :])
    assert np.max(np.sqrt(np.mean(residual**2, axis=0)) / declared) > 10  # the fitted model is far off there
    ratio = upper_ratio(state, declared)  # a bound: some motion goes on above the band
    assert np.all(ratio > 0.9) and np.all(ratio < 2)


def test_what_a_floor_takes_for_noise_is_no_more_than_a_declaration_may_be_wrong_by() -> None:
    """Friction and stops shake sensors at all frequencies, as a broken instrument would."""
    rig = building(3, "as stated", 3, 20.0)
    declared = np.array([sensor.noise for sensor in rig.system.file.sensors.values()])
    shaken = rig.values.copy()
    shaken[:, -len(declared)] += 100 * declared[0] * np.random.default_rng(1).standard_normal(len(shaken))
    state = begun(rig.system, replace(rig, values=shaken), Options(), lambda share, what: None)
    name = state.signals.sensor_names[0]
    most = RULES.noise.misdeclared * RULES.verdict.slack
    assert state.problem.noise.sensors[0] > 50 * declared[0]
    assert bounded(state).sensors[0] == pytest.approx(most * declared[0])
    assert bounded(state, [NoiseFault(name, 100.0, 1.0, 1.0, 50.0, 0.0)]).sensors[0] > 50 * declared[0]


def test_an_instrument_that_is_quiet_in_the_held_out_part_was_not_noisy_before() -> None:
    """An earthquake's end: what shook a sensor at all frequencies has stopped."""
    rig = building(3, "as stated", 3, 30.0)
    declared = rig.system.file.sensors["a1"].noise
    shaken, begins = rig.values.copy(), int(0.68 * len(rig.values))
    shaken[:begins, 1] += 8 * declared * np.random.default_rng(1).standard_normal(begins)
    state = begun(rig.system, replace(rig, values=shaken), Options(), lambda share, what: None)
    assert state.problem.noise.sensors[0] > 6 * declared
    assert bounded(state).sensors[0] < 3 * declared


def test_a_floor_is_at_most_the_error_that_contains_it() -> None:
    measured, errors = np.ones((2000, 3)), np.array([0.5, 1.01, 3.0])
    run = FreeRun(measured, measured, errors, None)  # type: ignore[arg-type]  # the point is not read
    assert realised_floor(np.ones(3), run).tolist() == [0.5, 1.01, 1.0]


def _computed_road(seconds: float) -> tuple[FloatArray, FloatArray]:
    """Displacements and velocities (T, 8) of eight wheels without any noise, some on a rougher track than others."""
    rng = np.random.default_rng(44)
    time, frequency = np.arange(int(100 * seconds)) / 100, np.linspace(0.3, 30.0, 200)
    heights, rates = [], []
    for rough in (0.2, 1.0, 0.3, 2.5, 0.2, 0.4, 1.5, 0.3):
        size = 4e-4 / frequency * np.where(frequency > 15, rough, 1.0)
        angle = 2 * np.pi * frequency * time[:, None] + rng.uniform(0, 2 * np.pi, 200)
        heights.append(np.sin(angle) @ size)
        rates.append(np.cos(angle) @ (2 * np.pi * frequency * size))
    return np.column_stack(heights), np.column_stack(rates)


def test_motions_without_noise_are_no_faulty_channels() -> None:
    """Displacement and velocity of simulated wheels agree up to their interpolation, which differs with the track."""
    system = load_system()
    height, rate = _computed_road(20.0)
    names = [channel.name for channel in system.inputs]
    road = np.empty((len(height), len(names)))
    road[:, [n.endswith(".displacement") for n in names]] = height
    road[:, [n.endswith(".velocity") for n in names]] = rate
    rng = np.random.default_rng(45)
    sensors = simulate_ride(system, road, noise=rng).sensors
    report = diagnose(system, MadeRecord(np.column_stack([road, sensors])))
    assert report.findings == () and report.verdict == "consistent"

    shown = road + rng.standard_normal(road.shape) * [channel.noise for channel in system.inputs]
    state = begun(system, MadeRecord(np.column_stack([shown, sensors])), Options(), lambda share, what: None)
    assert reaching_sensors(state).all()


@pytest.mark.parametrize(("begins", "level"), [(1000, 0.06), (1250, 0.1), (1250, 0.2)])
def test_noise_that_begins_on_the_way_is_neither_part_of_an_all_clear_nor_physics(begins: int, level: float) -> None:
    record = simulate(seed=76)
    record.values[begins:, 4] += level * np.random.default_rng(1).standard_normal(len(record.values) - begins)
    report = diagnose(quarter_car(), record)
    (finding,) = report.findings
    assert report.verdict == "sensor_fault" and finding.location == quarter_car().channels[4].name
    assert finding.effect in ("sensor_noise", "sensor_error")  # as more or less of the fitted part has it
