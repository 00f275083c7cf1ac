"""Elements with a linear memory: rubber, a damper behind a spring; truth from the exact response at every frequency."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sprung.benchmarks.sensitivity_cases import QUARTER_CAR
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.laws import SpringDamper
from sprung.model.laws.along import force_along
from sprung.model.system import parse_system
from sprung.service.diagnosis.improved import improved_text, left_out
from tests.diagnosis_cases import DAMPING, STIFFNESS, MadeRecord, quarter_car
from tests.named_laws import element_law

SIZE, ORDER = 6.0e4, 0.4
K, C = STIFFNESS["secondary"], DAMPING["secondary"]


def ride(
    of: Callable[[np.ndarray], np.ndarray],
    seconds: float = 30.0,
    seed: int = 3,
    below: Callable[[np.ndarray], np.ndarray] = lambda s: STIFFNESS["primary"] + s * DAMPING["primary"],
) -> MadeRecord:
    """Steady running on a road of random phases, 0.5 to 18 Hz; dynamic stiffness of secondary and primary at s."""
    rng = np.random.default_rng(seed)
    f = np.linspace(0.5, 18, 160)
    s = 2j * np.pi * f
    w = 6e-4 / f * np.exp(1j * rng.uniform(0, 2 * np.pi, len(f)))
    upper, lower = of(s), below(s)
    system = np.array([[8000 * s**2 + upper, -upper], [-upper, 1300 * s**2 + upper + lower]])
    car, bogie = np.linalg.solve(system.transpose(2, 0, 1), np.stack([0 * f, lower * w], axis=1)[..., None])[..., 0].T
    wave = np.exp(2j * np.pi * np.arange(int(seconds * 100))[:, None] / 100 * f)
    shown = np.column_stack([np.real(wave @ x) for x in (w, s * w, *[s**2 * car] * 2, *[s**2 * bogie] * 2)])
    return MadeRecord(shown + rng.standard_normal(shown.shape) * np.array([1e-5, 5e-4, 4e-3, 4e-3, 3e-2, 3e-2]))


def test_the_branches_follow_the_power_beside_a_spring_and_a_damper() -> None:
    """Over the band of a suspension, what a spring and a damper take up apart."""
    law, time = element_law("fractional_stiffness"), np.arange(0, 80, 0.002)
    frequency = np.array([0.5, 1.0, 2.0, 4.0, 8.0, 16.0])
    error = []
    for f in frequency:
        d = np.sin(2 * np.pi * f * time)
        force = force_along(law, (1.0, 0.3), d, np.gradient(d, time), time, SpringDamper(1.0, 1.0))
        late = time >= 40
        wave = np.exp(-2j * np.pi * f * time[late])
        error.append(np.sum(force[late] * wave) / np.sum(d[late] * wave) - (1j * f) ** 0.3)
    own = np.concatenate(
        [np.real(error) - np.mean(np.real(error)), np.imag(error) - frequency * _slope(frequency, error)]
    )
    assert np.sqrt(np.mean(own**2)) < 0.03


def _slope(frequency: np.ndarray, error: list[complex]) -> float:
    return float(frequency @ np.imag(error) / (frequency @ frequency))


def test_a_stiffness_that_grows_with_the_frequency_is_named_with_its_power() -> None:
    report = diagnose(quarter_car(), ride(lambda s: K + C * s + SIZE * (s / (2 * np.pi)) ** ORDER), Options())
    assert report.verdict == "missing_physics"
    (finding,) = report.findings
    assert (finding.location, finding.effect) == ("secondary", "fractional_stiffness")
    values = {p.name: p for p in finding.parameters}
    assert values["order"].value == pytest.approx(ORDER, abs=max(0.05, 4 * values["order"].std))
    assert report.unexplained.share < 0.05


@pytest.mark.slow
def test_a_damper_that_gives_way_much_is_no_late_node() -> None:
    report = diagnose(quarter_car(), ride(lambda s: K + C * s / (1 + C * s / 1.5e6), seed=5), Options())
    (finding,) = report.findings
    assert (finding.location, finding.effect) == ("secondary", "series_stiffness")
    assert finding.parameters[0].value == pytest.approx(1.5e6, rel=0.02)


@pytest.mark.slow
def test_springs_that_lose_the_same_at_every_frequency_are_named_together() -> None:
    """Not by parts that imitate them one by one: a mass that hangs, springs in series."""
    power = 0.06  # of the frequency: the loss factor is tan(pi power / 2) at all of them

    def spring(stiffness: float) -> Callable[[np.ndarray], np.ndarray]:
        return lambda s: stiffness * (s / (2 * np.pi)) ** power

    report = diagnose(quarter_car(), ride(spring(K), seed=4, below=spring(STIFFNESS["primary"])), Options())
    assert report.verdict == "missing_physics"
    (finding,) = report.findings
    assert (finding.location, finding.effect) == ("primary|secondary", "structural_damping")
    loss = finding.parameters[0]
    assert loss.value == pytest.approx(np.tan(np.pi * power / 2), rel=0.05)
    assert abs(loss.value - np.tan(np.pi * power / 2)) < 3 * loss.std
    assert left_out(report) == ["structural damping at primary and secondary"]
    written = parse_system(improved_text(QUARTER_CAR, quarter_car(), report)).parameters
    assert [one.nominal for one in written] == pytest.approx([one.value for one in report.baseline], rel=1e-4)
