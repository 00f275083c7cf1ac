"""Faults of input channels, told by what measures the same support a second time."""

import numpy as np
import pytest
import yaml

from sprung.benchmarks.sensitivity_cases import QUARTER_CAR
from sprung.model.diagnosis.api import diagnose
from sprung.model.diagnosis.investigation.measurements.inputs import best_input_fault, compensate, nominal
from sprung.model.diagnosis.investigation.state import Options
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import Noise, Part, declared_noise
from sprung.model.laws import find_law
from sprung.model.laws.channel import SensorResponse, passed
from sprung.model.system import System, parse_system
from tests.diagnosis_cases import problem_of, quarter_car, simulate

VELOCITY = 1  # column of the wheel's
CHANNELS = {"displacement": ("d", 1e-5), "velocity": ("v", 5e-4), "acceleration": ("w", 3e-2)}
FAULTS = {
    "sensor_gain": (SensorResponse(gain=0.93), 0.93),
    "sensor_lag": (SensorResponse(delay=0.004), 0.004),
    "sensor_bias": (SensorResponse(offset=0.005), 0.005),
}
HALF = 200  # samples, of the differentiator


def _part(seed: int) -> tuple[Part, Noise]:
    problem = problem_of(simulate(seed=seed, seconds=6))
    return problem.part, problem.noise


def test_the_mean_of_a_velocity_is_that_of_its_displacement_within_the_stated_deviation() -> None:
    away = []
    for seed in range(8):
        part, noise = _part(seed)
        away.append(float(part.rate_offset[0] / np.sqrt(noise.rate_offset_variance(part)[0])))
    assert np.std(away) < 2
    assert np.max(np.abs(away)) < 4


def test_a_constant_offset_of_a_velocity_is_named_though_no_sensor_sees_it() -> None:
    record = simulate(seed=5, seconds=20)
    record.values[:, VELOCITY] += 4e-3
    report = diagnose(quarter_car(), record)
    assert report.verdict == "sensor_fault"
    (found,) = report.findings
    assert (found.location, found.effect) == ("wheel.velocity", "sensor_bias")
    assert found.parameters[0].unit == "m/s"
    assert found.parameters[0].value == pytest.approx(4e-3, abs=5 * found.parameters[0].std)


def _differentiated(series: np.ndarray, rate: float) -> np.ndarray:
    """Derivative (T - 2 HALF,) of a band-limited series (T,)."""
    n = np.arange(-HALF, HALF + 1)
    taps = np.divide((-1.0) ** n, n, out=np.zeros(len(n)), where=n != 0) * np.kaiser(len(n), 10)
    return np.convolve(series, taps, mode="valid") * rate


def _measured_by(
    quantities: tuple[str, ...], faulty: str = "", response: SensorResponse | None = None
) -> tuple[System, np.ndarray, float]:
    """The quarter car on a wheel that is measured by some quantities, one of them perhaps wrong."""
    clean, rng = simulate(seed=7, seconds=16, noise=0.0), np.random.default_rng(70)
    values, rate = clean.values[HALF:-HALF], clean.sample_rate
    motions = {"displacement": values[:, 0], "velocity": values[:, 1]}
    motions["acceleration"] = _differentiated(clean.values[:, 1], rate)
    file = yaml.safe_load(QUARTER_CAR)
    file["inputs"]["wheel"] = {"kind": "support"} | {
        q: {"csv": CHANNELS[q][0], "noise": CHANNELS[q][1]} for q in quantities
    }
    columns = []
    for quantity in quantities:
        shown = motions[quantity]
        if quantity == faulty and response is not None:
            shown = passed(shown, response, rate)
        columns.append(shown + CHANNELS[quantity][1] * rng.standard_normal(len(shown)))
    sensors = values[:, 2:] + rng.standard_normal((len(values), 4)) * np.array([4e-3, 4e-3, 3e-2, 3e-2])
    return parse_system(yaml.safe_dump(file, sort_keys=False)), np.column_stack([*columns, sensors]), rate


@pytest.mark.parametrize(
    ("quantities", "faulty", "effect"),
    [
        (("displacement", "acceleration"), "acceleration", "sensor_gain"),
        (("displacement", "acceleration"), "displacement", "sensor_lag"),
        (("velocity", "acceleration"), "velocity", "sensor_gain"),
        (("velocity", "acceleration"), "acceleration", "sensor_lag"),
        (("displacement", "velocity", "acceleration"), "velocity", "sensor_bias"),
        (("displacement", "velocity", "acceleration"), "acceleration", "sensor_gain"),
        (("displacement", "velocity", "acceleration"), "", ""),
        (("displacement", "acceleration"), "", ""),
    ],
)
def test_a_wrong_channel_is_distinguished_from_others(quantities: tuple[str, ...], faulty: str, effect: str) -> None:
    response, value = FAULTS.get(effect, (None, 0.0))
    system, values, rate = _measured_by(quantities, faulty, response)
    signals, options = prepare(system, values, rate).signals, Options()
    laws = tuple(find_law(effect) for effect in FAULTS)
    declared = declared_noise(system, signals)
    start = nominal(system, signals, declared, signals.samples, options, laws)
    candidate = best_input_fault(start.screening, 1e-3)
    if not effect:
        assert candidate is None
        return
    assert candidate is not None
    fault, right = compensate(system, start, candidate, declared, options)
    assert (fault.term.location, fault.term.law.name) == (f"wheel.{faulty}", effect)
    assert fault.term.parameters[0] == pytest.approx(value, rel=0.02)
    again = nominal(system, right, declared, signals.samples, options, laws)
    assert best_input_fault(again.screening, 1e-3) is None


def test_the_zero_of_an_accelerometer_beside_a_displacement_is_no_fault() -> None:
    quantities = ("displacement", "acceleration")
    system, values, rate = _measured_by(quantities, "acceleration", SensorResponse(offset=9.81))
    signals = prepare(system, values, rate).signals
    found = nominal(system, signals, declared_noise(system, signals), signals.samples, Options())
    assert best_input_fault(found.screening, 1e-3) is None
