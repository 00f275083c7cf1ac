"""A force that no law of the catalogue explains, told as a formula."""

from __future__ import annotations

import numpy as np
import pytest
from diagnosis_cases import SYSTEM, MadeRecord, quarter_car, simulate

from sprung.benchmarks.open_catalogue import OpenLaw, simulated
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.system import parse_system
from sprung.service.improved import improved_text


@pytest.fixture(scope="module")
def told():
    """A spring that stiffens with the rate."""
    record = simulate(lambda d, v: 3e6 * d * abs(v), seconds=15.0, seed=3)
    return diagnose(quarter_car(), record, Options())


def test_an_unlisted_force_is_a_formula_with_its_value(told):
    (finding,) = told.findings
    assert told.verdict == "unknown_physics"
    assert (finding.location, finding.effect, finding.formula) == ("secondary", "formula", "a * d * abs(v)")
    (a,) = finding.parameters
    assert a.unit == "N s/m^2"
    assert a.value == pytest.approx(3e6, abs=5 * a.std)
    assert finding.to_dict()["formula"] == "a * d * abs(v)"


def test_a_formula_is_written_into_the_system_file_and_read_again(told):
    system = quarter_car()
    again = parse_system(improved_text(SYSTEM, system, told))
    (placed,) = again.laws
    assert placed.law.formula == "a * d * abs(v)" and placed.values[0] == pytest.approx(3e6, rel=0.05)


@pytest.mark.slow
def test_a_stop_of_one_side_is_a_formula_and_no_bump_stop():
    record = simulate(lambda d, v: -1.5e6 * max(-d - 0.002, 0.0), seconds=30.0, seed=3)
    (finding,) = diagnose(quarter_car(), record, Options()).findings
    assert finding.formula == "a * max(-d - L, 0)"
    assert [p.value for p in finding.parameters] == pytest.approx([-1.5e6, 0.002], rel=0.01)


def test_a_law_of_the_catalogue_stays_one():
    record = simulate(lambda d, v: 2e4 * v * abs(v), seconds=15.0, seed=4)
    assert {f.effect for f in diagnose(quarter_car(), record, Options()).findings} <= {"quadratic_damping"}


@pytest.mark.slow
def test_what_a_later_formula_explains_is_no_finding_of_its_own():
    """A hidden state that swings is first taken for a hanging mass; beside its formula that is idle, and goes."""
    law = OpenLaw("", lambda d, v, z: -65.0 * (z / 2.5e-3) ** 3, 0.12)
    values = {"stiffness": np.array([2.4e6, 4.3e5]), "damping": np.array([1.0e4, 2.0e4])}
    clean, _ = simulated(law, values, 30.0, 7, 1.0)
    noise = np.array([1e-5, 5e-4, 4e-3, 4e-3, 3e-2, 3e-2])
    record = MadeRecord(clean + noise * np.random.default_rng(8).standard_normal(clean.shape))
    report = diagnose(quarter_car(), record, Options())
    assert [(f.location, f.effect, f.formula) for f in report.findings] == [("secondary", "formula", "a * z**3")]
