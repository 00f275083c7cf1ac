"""A force channel that a filter or a node delays: said of the channel, not of the component."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, sosfilt, sosfiltfilt

from sprung.model.diagnosis.force.motion import element_motion
from tests.diagnosis.component.test_component import RATE, C, K, laws, report

SHIFT = 4  # of the finer samples
FINER = 10


def random_motion(seconds: float = 20.0) -> tuple[np.ndarray, np.ndarray]:
    """Deflection and rate at ten times the rate of the record: random motion up to 6 Hz."""
    count = int(seconds * RATE * FINER)
    band = butter(3, [0.3, 6.0], "bandpass", fs=RATE * FINER, output="sos")
    d = sosfiltfilt(band, np.random.default_rng(4).standard_normal(count + 40_000))[20_000:-20_000]
    d *= 0.008 / d.std()
    return d, np.gradient(d, 1 / (RATE * FINER))


def test_a_force_that_comes_late_is_the_channels_fault_and_no_series_stiffness() -> None:
    d, v = random_motion()
    late = np.roll(K * d + C * v, 9 * SHIFT)[::FINER]
    found = report(late, d[::FINER], noise=2.0)
    assert found.verdict == "sensor_fault"
    (lag,) = [f for f in found.findings if f.effect != "preload"]
    assert (lag.location, lag.effect) == ("cell", "sensor_lag")
    (time,) = lag.parameters
    assert time.value == pytest.approx(9 * SHIFT / (RATE * FINER), abs=max(5 * time.std, 1e-4))
    assert found.unexplained.share == 0.0
    values = {p.name: p for p in found.augmented}
    assert values["damper.stiffness"].value == pytest.approx(K, rel=0.01)
    assert values["damper.damping"].value == pytest.approx(C, rel=0.01)


@pytest.mark.slow
def test_a_late_force_of_a_damper_with_friction_is_late_and_has_friction() -> None:
    d, v = random_motion()
    late = np.roll(K * d + C * v + 80 * np.tanh(v / 5e-3), 2 * SHIFT)[::FINER]
    found = report(late, d[::FINER], noise=2.0)
    said = {f.effect: f for f in found.findings if f.effect != "preload"}
    assert said.keys() == {"sensor_lag", "coulomb_friction"}, found.summary
    (time,), (force, *_) = said["sensor_lag"].parameters, said["coulomb_friction"].parameters
    assert time.value == pytest.approx(2 * SHIFT / (RATE * FINER), abs=max(3 * time.std, 1e-4))
    assert abs(force.value - 80) < 3 * force.std < 12


def test_a_filter_of_the_force_is_a_lag() -> None:
    d, v = random_motion()
    filtered = sosfilt(butter(4, 70.0, fs=RATE * FINER, output="sos"), K * d + C * v)[::FINER]
    found = report(filtered, d[::FINER], noise=2.0)
    assert [(f.location, f.effect) for f in found.findings if f.effect != "preload"] == [("cell", "sensor_lag")]


def test_a_filter_of_first_order_is_reported_with_its_time_constant_beside_true_values() -> None:
    """A delay in its place would leave the stiffness and damping per cents off."""
    d, v = random_motion()
    lag = 0.004
    filtered = sosfilt(butter(1, 1 / (2 * np.pi * lag), fs=RATE * FINER, output="sos"), K * d + C * v)[::FINER]
    found = report(filtered, d[::FINER], noise=2.0)
    (finding,) = [f for f in found.findings if f.effect != "preload"]
    assert finding.effect == "sensor_lag" and "first order" in finding.sentence
    assert finding.parameters[0].value == pytest.approx(lag, rel=0.03)
    values = {p.name: p.value for p in found.augmented}
    assert values["damper.stiffness"] == pytest.approx(K, rel=0.003)
    assert values["damper.damping"] == pytest.approx(C, rel=0.003)


def test_compressible_oil_is_not_called_late() -> None:
    d, v = random_motion()
    force, state, step, stiff = np.empty(len(d)), 0.0, 1 / (RATE * FINER), 3e5
    for i, rate in enumerate(v.tolist()):
        state += step * stiff * (rate - state / C)
        force[i] = state
    found = report((K * d + force)[::FINER], d[::FINER], noise=2.0)
    assert "series_stiffness" in (found.findings[0].family or found.findings[0].effect)


@pytest.mark.parametrize(
    "stiff", [pytest.param(1.5e5, marks=pytest.mark.slow), pytest.param(4e5, marks=pytest.mark.slow)]
)
def test_valves_behind_oil_that_gives_way_are_no_filter_of_the_cell(stiff: float) -> None:
    """Oil in series with valves filters their force nearly as a load cell does: the cell is not accused of it."""
    d, v = random_motion(4.0)
    force, state, step = np.empty(len(d)), 0.0, 1 / (RATE * FINER)
    knee = C * 0.04
    for i, rate in enumerate(v.tolist()):
        size = abs(state) if state > 0 else abs(state) / 0.6
        valve = np.sign(state) * (size / C if size < knee else 0.04 + (size - knee) / (0.3 * C))
        state += step * stiff * (rate - valve)
        force[i] = state
    found = report((K * d + force)[::FINER], d[::FINER], noise=2.0)
    assert "sensor_lag" not in [f.effect for f in found.findings], found.summary


def test_in_a_sine_test_a_lag_is_not_identifiable() -> None:
    t = np.arange(int(20 * RATE)) / RATE
    d, late = 0.01 * np.sin(2 * np.pi * 1.3 * t), 2 * np.pi * 1.3 * (t - 0.004)
    found = report(0.01 * (K * np.sin(late) + C * 2 * np.pi * 1.3 * np.cos(late)), d)
    assert laws(found) == []
    assert found.verdict == "consistent"
    damping = next(p for p in found.augmented if p.name == "damper.damping")
    assert abs(damping.value - C) < 3 * damping.std  # which a delay of the file's instruments would change as much


def test_a_delayed_motion_is_the_motion_of_then() -> None:
    t = np.arange(int(5 * RATE)) / RATE
    motion = element_motion(0.01 * np.sin(9 * t), None, RATE)
    late = motion.delayed(0.0037)
    inside = slice(100, -100)
    assert late.deflection[inside] == pytest.approx(0.01 * np.sin(9 * (t - 0.0037))[inside], abs=1e-6)
    assert late.rate[inside] == pytest.approx(0.09 * np.cos(9 * (t - 0.0037))[inside], abs=3e-5)
