"""The form of a sensor's error, in words."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import pytest

from sprung.model.diagnosis.investigation.measurements.error_form import cut_off, form_of
from sprung.model.signals import FloatArray

RANDOM = np.random.default_rng(5)
NOISE = 0.03 * RANDOM.standard_normal(1800)
TIME = np.arange(1800) / 100
MOTION, OTHER_MOTION = RANDOM.standard_normal((2, 1800))


def _form(error: FloatArray, others: Mapping[str, FloatArray] = MappingProxyType({}), true: FloatArray = MOTION) -> str:
    return form_of(true, true + error, others, 100.0, "m/s^2")


@pytest.mark.parametrize("frequency", [3.3333, 16.7, 40.0])
@pytest.mark.parametrize("amplitude", [0.3, 0.02])
def test_a_tone_is_told_with_frequency_and_amplitude_even_below_the_noise(frequency: float, amplitude: float) -> None:
    form = _form(amplitude * np.sin(2 * np.pi * frequency * TIME + 1) + NOISE)
    found, size = (float(word) for word in form.split()[3::3][:2])
    assert form.startswith("a tone at") and abs(found - frequency) < 0.06 and abs(size / amplitude - 1) < 0.15


def test_noise_is_no_tone_and_no_copy() -> None:
    form = _form(NOISE, {"other": MOTION})
    assert form.startswith("most of it at")


def test_a_step_or_a_drift_is_no_tone() -> None:
    for error in (0.3 * (TIME > 9) - 0.15, 0.2 * (TIME / 18) ** 2 - 0.07):
        assert _form(error + NOISE).startswith("most of it at")


def test_an_offset_is_told() -> None:
    assert _form(-0.25 + NOISE) == "off by -0.25 m/s^2"


def test_a_copy_is_told_with_the_nearest_source() -> None:
    others = {"near": MOTION, "far": MOTION + 3 * RANDOM.standard_normal(1800)}
    assert _form(-0.2 * MOTION + 0.1 * NOISE, others, true=OTHER_MOTION) == "-0.2 times what near shows"


def test_a_part_of_its_own_motion_is_a_gain_that_was_not_the_same_before() -> None:
    assert _form(0.06 * MOTION + 0.1 * NOISE) == "its gain comes to 1.06"


def test_an_error_of_moments_is_told_with_their_share() -> None:
    error = NOISE / 100
    error[200:218] += 5.0
    assert "within 0.89 % of the time" in _form(error)


def test_only_a_level_that_repeats_more_than_its_neighbour_is_cut_off() -> None:
    motion = np.random.default_rng(8).standard_normal(5000)
    assert cut_off(np.clip(motion, -10, 1.7)) == pytest.approx(1.7)
    assert cut_off(np.clip(motion, -1.2, 10)) == pytest.approx(1.2)
    assert cut_off(motion) is None
    assert cut_off(np.round(motion, 1)) is None and cut_off(np.round(motion)) is None
    assert cut_off(np.zeros(100)) is None
