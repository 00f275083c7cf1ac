"""Filters of sensors: frequency response, polynomials, free motion and the way back, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.laws import CATALOGUE, SensorLaw, SensorResponse
from sprung.model.laws.channel import FilterSection, high_pass_section, resonance_section
from sprung.model.signals import FloatArray

CORNER, FREQUENCY, RATIO = 0.3, 21.0, 0.04  # Hz, Hz, 1
SECTIONS = {
    "high-pass": high_pass_section(CORNER)[0],
    "second order": high_pass_section(CORNER, 0.9)[0],
    "resonance": resonance_section(FREQUENCY, RATIO)[0],
    "bracket": resonance_section(FREQUENCY, RATIO, of_base=True)[0],
}
LAWS = [
    pytest.param(form, id=f"{law.name} {variant}".strip())
    for law in CATALOGUE
    if isinstance(law, SensorLaw) and law.filters
    for variant, form in [("", law), *law.forms.items()]
]
VALUES = {"corner": CORNER, "frequency": FREQUENCY, "damping_ratio": 0.3}
sections = pytest.mark.parametrize("section", SECTIONS.values(), ids=SECTIONS)


def of_ratio(name: str, ratio: float) -> complex:
    """Frequency responses at multiples of the corner or the natural frequency, as textbooks have them."""
    r, z = 1j * ratio, RATIO
    return {
        "high-pass": r / (1 + r),
        "second order": r**2 / (1 + 2 * 0.9 * r + r**2),
        "resonance": 1 / (1 + 2 * z * r + r**2),
        "bracket": (1 + 2 * z * r) / (1 + 2 * z * r + r**2),
    }[name]


@pytest.mark.parametrize("name", SECTIONS)
def test_frequency_responses_are_those_of_textbooks(name: str) -> None:
    own = CORNER if SECTIONS[name].numerator[0] == 0 else FREQUENCY
    ratios = np.array([0.1, 0.7, 1.0, 1.4, 9.0])
    expected = [of_ratio(name, ratio) for ratio in ratios]
    np.testing.assert_allclose(SECTIONS[name].at(2j * np.pi * own * ratios), expected, rtol=1e-12)


@sections
def test_the_steady_response_to_a_polynomial_satisfies_the_filters_equation(section: FilterSection) -> None:
    polynomial = np.polynomial.Polynomial([0.4, -1.1, 0.7, 0.3])
    shown = sum(
        (c * polynomial.deriv(k) for k, c in enumerate(section.expanded(4)[1:], 1)), section.expanded(4)[0] * polynomial
    )
    left = sum((c * shown.deriv(k) for k, c in enumerate(section.denominator[1:], 1)), section.denominator[0] * shown)
    right = sum(
        (c * polynomial.deriv(k) for k, c in enumerate(section.numerator[1:], 1)), section.numerator[0] * polynomial
    )
    np.testing.assert_allclose((left - right).coef, 0.0, atol=1e-9)


@sections
def test_the_steady_response_to_a_free_motion_is_that_of_its_modes(section: FilterSection) -> None:
    A = np.array([[0.0, 1.0], [-40.0, -2.0]])
    values, vectors = np.linalg.eig(A)
    rows = section.of_matrix(np.array([1.0, 0.5]), A)
    np.testing.assert_allclose(rows @ vectors, np.array([1.0, 0.5]) @ vectors * section.at(values), rtol=1e-9)


@sections
def test_a_filter_left_alone_moves_with_its_poles(section: FilterSection) -> None:
    poles = np.roots(section.denominator[::-1])
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(section.companion())), np.sort_complex(poles))


@pytest.mark.parametrize("law", LAWS)
def test_a_sine_comes_out_as_the_response_says(law: SensorLaw) -> None:
    time, rate, s = np.arange(6000) / 200, 200.0, 2j * np.pi * 4.0
    p = tuple(VALUES[name] for name in law.names)
    assert law.response is not None
    (section,) = law.response(p).sections
    shown = law.distort(np.sin(2 * np.pi * 4.0 * time), p, rate)
    expected = (complex(section.at(np.array(s))) * np.exp(s * time)).imag
    np.testing.assert_allclose(shown[2000:4000], expected[2000:4000], atol=1e-3)


@pytest.mark.parametrize("law", LAWS)
def test_every_form_is_undone_but_for_what_a_high_pass_filter_swallows(law: SensorLaw) -> None:
    time = np.arange(600) / 100
    truth = np.sin(2 * np.pi * 3.3 * time) + 0.4 * np.cos(2 * np.pi * 11 * time + 1)
    p = tuple(VALUES[name] for name in law.names)
    assert law.response is not None
    (section,) = law.response(p).sections
    error = law.restore(law.distort(truth, p, 100.0), p, 100.0) - truth
    swallowed = section.order if section.numerator[0] == 0 else 0  # a constant, a line
    left = error - _fitted(time, error, swallowed)
    np.testing.assert_allclose(left[40:-40], 0.0, atol=5e-3)


def _fitted(time: FloatArray, series: FloatArray, terms: int) -> FloatArray:
    """The polynomial of so many terms in a series."""
    columns = np.vander(time, terms) if terms else np.zeros((len(time), 1))
    return np.asarray(columns @ np.linalg.lstsq(columns, series, rcond=None)[0])


@pytest.mark.parametrize("law", LAWS)
def test_an_absent_filter_changes_nothing(law: SensorLaw) -> None:
    assert law.response is not None
    assert law.response(law.absent) == SensorResponse()
    assert not law.delays and not any(law.slope()[:4])


@pytest.mark.parametrize("law", LAWS)
def test_filters_are_sought_within_what_a_record_shows(law: SensorLaw) -> None:
    assert law.trials is not None
    trials = law.trials(1 / 42, 30.0)
    assert all(law.admits(values) for values in trials)
    assert len(np.unique(trials, axis=0)) == len(trials) < 200
    assert law.trials(1 / 42, 1.5).shape[1] == len(law.parameters)
    if law.name == "high_pass":
        assert trials[:, 0].min() == pytest.approx(1 / 42)  # one period of the record
