"""Second laws at an element compete with the wider form of the first: friction and valve, or friction by the rate."""

import numpy as np
import pytest

from sprung.model.diagnosis.api import diagnose
from tests.diagnosis_cases import DAMPING, quarter_car, simulate

FRICTION, KNEE, RATIO = 300.0, 0.02, 0.4
FAST, SLOW, TURNS = 600.0, 200.0, 0.03


def _friction_and_valve(d: float, v: float) -> float:
    return FRICTION * np.tanh(v / 1e-3) + (RATIO - 1) * DAMPING["secondary"] * (v - min(max(v, -KNEE), KNEE))


def _friction_by_the_rate(d: float, v: float) -> float:
    return float(np.tanh(v / 1e-3) * (FAST + (SLOW - FAST) * np.exp(-abs(v) / TURNS)))


@pytest.mark.slow
def test_plain_friction_beside_a_valve_is_told_as_both() -> None:
    report = diagnose(quarter_car(), simulate(_friction_and_valve, seconds=12, seed=2))
    found = {finding.effect: {p.name: p for p in finding.parameters} for finding in report.findings}
    assert found.keys() == {"coulomb_friction", "damper_blowoff"}
    assert found["coulomb_friction"].keys() == {"force", "smoothing"}
    assert found["coulomb_friction"]["force"].value == pytest.approx(FRICTION, rel=0.05)
    assert found["damper_blowoff"]["knee"].value == pytest.approx(KNEE, rel=0.1)
    assert found["damper_blowoff"]["ratio"].value == pytest.approx(RATIO, abs=0.05)


@pytest.mark.slow
def test_friction_that_changes_with_the_rate_is_not_told_as_two_laws() -> None:
    report = diagnose(quarter_car(), simulate(_friction_by_the_rate, seconds=12, seed=5))
    (finding,) = report.findings
    values = {p.name: p.value for p in finding.parameters}
    assert finding.effect == "coulomb_friction"
    assert values["force"] == pytest.approx(FAST, rel=0.1) and values["slow_force"] == pytest.approx(SLOW, rel=0.1)
