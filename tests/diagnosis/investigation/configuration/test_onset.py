"""The sign of a force by the first motion it causes: two modes in closed form, and structures unlike the file's."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.api import diagnose
from sprung.model.diagnosis.investigation.configuration.onset import begins_backwards, driving_point
from sprung.model.diagnosis.rules import RULES
from sprung.model.system import parse_system
from tests.diagnosis.investigation.configuration.test_forces import TOWER, ShakerTest, tower

RATE, SAMPLES = 100.0, 8000
OMEGA = 2 * np.pi * np.fft.rfftfreq(SAMPLES, 1 / RATE)


def push(seed: int, band: float = 25.0) -> np.ndarray:
    """Random force (T,), up to a frequency in Hz."""
    spectrum = np.fft.rfft(np.random.default_rng(seed).standard_normal(SAMPLES))
    return np.fft.irfft(spectrum / (1 + (OMEGA / (2 * np.pi * band)) ** 8), SAMPLES)


def answer(damping: float, force: np.ndarray, late: float = 0.0) -> np.ndarray:
    """Velocity (T,) of a point with modes at 3 and 8 Hz, by its mobility; noise 3 %."""
    natural = 2 * np.pi * np.array([[3.0], [8.0]])
    mobility = np.sum(1j * OMEGA / (natural**2 - OMEGA**2 + 2j * damping * natural * OMEGA), axis=0)
    velocity = np.fft.irfft(mobility * np.exp(-1j * OMEGA * late) * np.fft.rfft(force), SAMPLES)
    return velocity + 0.03 * np.std(velocity) * np.random.default_rng(5).standard_normal(SAMPLES)


def backwards(force: np.ndarray, velocity: np.ndarray) -> bool:
    return begins_backwards(force, velocity, 0.3, RULES.setup)


@pytest.mark.parametrize("damping", [0.005, 0.05, 0.5])
def test_the_response_to_a_reversed_force_begins_backwards(damping: float) -> None:
    force = push(1)
    velocity = answer(damping, force)
    assert not backwards(force, velocity)
    assert backwards(-force, velocity) and backwards(force, -velocity)


@pytest.mark.parametrize("damping", [0.005, 0.05])
@pytest.mark.parametrize("late", [0.02, 0.06, 0.1, 0.17, 0.33])
def test_a_delay_of_half_a_period_is_no_reversed_sign(late: float, damping: float) -> None:
    force = push(2)
    assert not backwards(force, answer(damping, force, late))


def test_noise_and_a_single_frequency_have_no_beginning() -> None:
    assert not any(backwards(push(seed), push(seed + 100)) for seed in range(20))
    time = np.arange(SAMPLES) / RATE
    assert not backwards(np.sin(30 * time), -np.sin(30 * time + 0.3))


@pytest.mark.parametrize("resonance", [15.0, 20.0, 40.0])
def test_a_force_below_every_resonance_shows_no_beginning(resonance: float) -> None:
    """A spring's velocity leads its force: within a band it is as large before an impulse as it is after."""
    force, natural = push(3, band=10.0), 2 * np.pi * resonance
    mobility = 1j * OMEGA / (natural**2 - OMEGA**2 + 0.1j * natural * OMEGA)
    velocity = np.fft.irfft(mobility * np.fft.rfft(force), SAMPLES)
    assert not backwards(force, velocity)


def test_a_driving_point_has_a_motion_sensor_at_the_only_force() -> None:
    system = parse_system(TOWER)
    assert driving_point(system.mechanics) == 2
    assert (
        driving_point(
            parse_system(
                TOWER.replace("a3: {kind: acceleration, body: f3", "a3: {kind: acceleration, body: f2")
            ).mechanics
        )
        is None
    )


ANOTHER = TOWER.replace("s3: {upper: f3, lower: f2", "s3: {upper: f3, lower: f1")  # not as it was simulated


@pytest.mark.parametrize(
    ("column", "place"),
    [pytest.param(0, "shaker", marks=pytest.mark.slow), pytest.param(3, "a3", marks=pytest.mark.slow)],
)
def test_a_reversed_sign_is_named_although_the_structure_is_another(column: int, place: str) -> None:
    values = tower()
    values[:, column] *= -1
    report = diagnose(parse_system(ANOTHER), ShakerTest(values))
    assert (report.findings[0].effect, report.findings[0].location) == ("sign_reversed", place)
    assert "backwards" in report.findings[0].sentence
