"""A damper of a vehicle that follows a measured temperature."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.benchmarks.sensitivity_cases import QUARTER_CAR as SYSTEM
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.system import parse_system
from tests.diagnosis_cases import DAMPING, FINE, simulate

SLOPE, BEGIN, CALLS = -0.015, 0.3, 4  # 1/K; s that the filter takes from the start; of the law in one step


def oil(t: np.ndarray | float) -> np.ndarray | float:
    return 20 * np.sin(2 * np.pi * t / 9.0)


@pytest.mark.slow
def test_a_damper_that_weakens_with_its_oil_is_found_with_its_slope() -> None:
    followed = SYSTEM.replace("damping: 2.0e+4}", "damping: 2.0e+4, depends_on: [oil]}")
    system = parse_system(f"{followed}signals: {{oil: {{csv: T, unit: K}}}}\n")
    count = 0

    def law(d: float, v: float) -> float:
        nonlocal count
        count += 1
        return SLOPE * float(oil((count - 1) // CALLS / (100.0 * FINE))) * DAMPING["secondary"] * v

    record = simulate(law, seconds=19.0)
    temperature = 300 + oil(BEGIN + np.arange(len(record.values)) / 100.0)
    record.values = np.column_stack([record.values, temperature])
    report = diagnose(system, record, Options())
    (finding,) = report.findings
    assert (finding.location, finding.effect) == ("secondary", "damping_by_oil")
    (slope,) = finding.parameters
    truth = SLOPE / (1 + SLOPE * (float(np.mean(temperature)) - 300))  # of the value at the mean
    assert slope.unit == "1/K"
    assert abs(slope.value - truth) < max(4 * slope.std, 0.01 * abs(truth))
