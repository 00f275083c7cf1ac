"""Faults of measurements without filters: series, spectra and screening follow from one response."""

import numpy as np
import pytest

from sprung.model.laws import CATALOGUE, SensorLaw
from sprung.model.laws.channel import SensorResponse
from sprung.model.signals import FloatArray
from tests.named_laws import sensor_law

LAWS = [
    pytest.param(form, id=f"{law.name} {variant}".strip())
    for law in CATALOGUE
    if isinstance(law, SensorLaw) and law.response is not None and not law.filters
    for variant, form in [("", law), *law.forms.items()]
]
VALUES = {"gain": 0.87, "time": 0.0075, "offset": 0.4, "delay": -0.002}


def signal(time: FloatArray) -> FloatArray:
    return np.sin(2 * np.pi * 3.3 * time) + 0.4 * np.cos(2 * np.pi * 11 * time + 1) + 0.2 * time


def response(law: SensorLaw, *p: float) -> SensorResponse:
    assert law.response is not None
    return law.response(p)


@pytest.mark.parametrize("law", LAWS)
def test_a_sine_comes_out_as_the_response_says(law: SensorLaw) -> None:
    time, frequency = np.arange(1000) / 200, 4.0
    p = tuple(VALUES[name] for name in law.names)
    r = response(law, *p)
    s = 2j * np.pi * frequency
    factor = r.gain * np.exp(-s * r.delay) / (1 + s * r.lag)
    expected = (factor * np.exp(s * time)).imag + r.offset
    shown = law.distort(np.sin(2 * np.pi * frequency * time), p, 200.0)
    np.testing.assert_allclose(shown[100:-100], expected[100:-100], atol=5e-3)


@pytest.mark.parametrize("law", LAWS)
def test_every_form_is_undone(law: SensorLaw) -> None:
    time = np.arange(600) / 100
    p = tuple(VALUES[name] for name in law.names)
    restored = law.restore(law.distort(signal(time), p, 100.0), p, 100.0)
    np.testing.assert_allclose(restored[40:-40], signal(time)[40:-40], atol=5e-3)


@pytest.mark.parametrize("law", LAWS)
def test_none_of_the_fault_changes_nothing(law: SensorLaw) -> None:
    assert response(law, *law.absent) == SensorResponse()


@pytest.mark.parametrize("law", LAWS)
def test_two_faults_after_each_other_combine(law: SensorLaw) -> None:
    first, second = VALUES[law.names[0]], 1.1 * VALUES[law.names[0]]
    rest = law.absent[1:]
    both = response(law, law.combined(first, second), *rest)
    one, other = response(law, first, *rest), response(law, second, *rest)
    assert both.gain == pytest.approx(one.gain * other.gain)
    for quantity in ("lag", "delay", "offset"):
        assert getattr(both, quantity) == pytest.approx(getattr(one, quantity) + getattr(other, quantity))


def test_sensor_lag_is_a_delay_and_its_first_order_forms_have_names() -> None:
    law = sensor_law("sensor_lag")
    assert response(law, 0.01) == SensorResponse(delay=0.01)
    assert list(law.forms) == ["first order", "first order and delay"]


def test_a_stuck_sensor_cannot_be_restored() -> None:
    with pytest.raises(ValueError, match="nothing is left"):
        sensor_law("sensor_stuck").restore(np.zeros(4), (), 100.0)
