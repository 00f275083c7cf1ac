"""A force that no law of the catalogue explains, told as a formula."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.benchmarks.open_catalogue import OpenLaw, simulated
from sprung.benchmarks.sensitivity_cases import QUARTER_CAR as SYSTEM
from sprung.model.diagnosis.api import Options, Report, diagnose
from sprung.model.diagnosis.investigation.formula import trial as formula_trial
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import RULES
from sprung.model.diagnosis.selection.compete import Trial
from sprung.model.laws import CATALOGUE, ElementLaw
from sprung.model.laws.own import load_laws
from sprung.model.system import parse_system
from sprung.service.cli.export import export
from sprung.service.diagnosis.improved import improved_text
from sprung.service.diagnosis.own_laws import write_laws
from sprung.service.report.forces import force_figure
from tests.diagnosis_cases import STIFFNESS, MadeRecord, quarter_car, simulate
from tests.named_laws import element_law


@pytest.fixture(scope="module")
def told() -> Report:
    """A spring that stiffens with the rate."""
    record = simulate(lambda d, v: 3e6 * d * abs(v), seconds=15.0, seed=3)
    return diagnose(quarter_car(), record, Options())


def test_an_unlisted_force_is_a_formula_with_its_value(told: Report) -> None:
    (finding,) = told.findings
    assert told.verdict == "unknown_physics"
    assert (finding.location, finding.effect, finding.formula) == ("secondary", "formula", "a * d * abs(v)")
    (a,) = finding.parameters
    assert a.unit == "N s/m^2"
    assert a.value == pytest.approx(3e6, abs=5 * a.std)
    assert finding.to_dict()["formula"] == "a * d * abs(v)"


def test_a_formula_is_written_into_the_system_file_and_read_again(told: Report) -> None:
    system = quarter_car()
    again = parse_system(improved_text(SYSTEM, system, told))
    (placed,) = again.laws
    assert (
        isinstance(placed.law, ElementLaw)
        and placed.law.formula == "a * d * abs(v)"
        and placed.values[0] == pytest.approx(3e6, rel=0.05)
    )


@pytest.mark.slow
def test_a_stop_of_one_side_is_named_with_its_side() -> None:
    record = simulate(lambda d, v: -1.5e6 * max(-d - 0.002, 0.0), seconds=30.0, seed=3)
    report = diagnose(quarter_car(), record, Options())
    (finding,) = report.findings
    assert (finding.location, finding.effect) == ("secondary", "bump_stop")
    assert [p.value for p in finding.parameters] == pytest.approx([0.002, 1.5e6], rel=0.01)
    assert "of compression" in report.summary


@pytest.mark.slow
def test_a_spring_that_softens_and_stiffens_again_is_a_formula_and_no_bump_stop() -> None:
    """A stop leaves no more than noise may leave, and yet far more than the formula does."""
    record = simulate(lambda d, v: -6.44e4 * d / (1 + (d / 3.7e-3) ** 2), seconds=40.0, seed=3)
    (finding,) = diagnose(quarter_car(), record, Options()).findings
    assert (finding.location, finding.effect) == ("secondary", "formula")


def _trial(law: Any, gain: float, freedom: int, reduced: float = 0.9) -> Trial:
    """A trial whose evidence is its gain."""
    point = SimpleNamespace(terms=(Term(law, "secondary", tuple(1.0 for _ in law.parameters)),))
    nothing: Any = None
    fitted: Any = SimpleNamespace(point=point, reduced=reduced, count=10_000)
    return Trial(nothing, fitted, gain, gain, gain, freedom)


def _state() -> Any:
    return SimpleNamespace(
        options=Options(),
        problem=SimpleNamespace(rules=RULES, process_noise=False, work=None),
        fit=SimpleNamespace(reduced=2.0, count=10_000),
        system=quarter_car(),
        held=None,
    )


@pytest.mark.parametrize(
    ("gain", "freedom", "reduced", "leads"),
    [
        (180.0, 1, 0.9, True),  # the stop is weak, and a smooth spring says as much and more with one value
        (140.0, 1, 0.9, False),
        (180.0, 18, 0.9, False),  # a map of the force imitates any law
        (180.0, 1, 1.5, False),  # more than noise is left beside the stop: further laws may be there
    ],
)
def test_a_law_is_not_named_where_a_force_as_plain_is_likelier_even_without_a_single_formula(
    monkeypatch: pytest.MonkeyPatch, gain: float, freedom: int, reduced: float, leads: bool
) -> None:
    stop = element_law("bump_stop")
    named, unnamed = _trial(stop, 160.0, 2, reduced), _trial(replace(stop, named=False), gain, freedom)
    monkeypatch.setattr(formula_trial, "_formula", lambda state, leader: (None, "several formulas do as well"))
    monkeypatch.setattr(formula_trial, "_force_to_express", lambda state, plain: unnamed)
    trials, notes = formula_trial.with_formula(_state(), [named, unnamed], [named, unnamed])
    assert trials[0] is (unnamed if leads else named)
    assert bool(notes) == leads


@pytest.mark.parametrize(
    ("gain", "left", "expected"),
    [(1000.0, 0.0, None), (1020.0, 0.0, None), (1100.0, 0.0, "force"), (1020.0, 0.08, "stop")],
)
def test_a_named_law_is_questioned_where_a_free_force_says_more_or_what_is_left_follows_the_motion(
    monkeypatch: pytest.MonkeyPatch, gain: float, left: float, expected: str | None
) -> None:
    monkeypatch.setattr(formula_trial, "missing", lambda problem, fit: left)
    stop = element_law("bump_stop")
    leader, unnamed = _trial(stop, 1000.0, 2), _trial(replace(stop, named=False), gain, 18)
    led: dict[str | None, Trial | None] = {"force": unnamed, "stop": leader, None: None}
    assert formula_trial._force_to_express(_state(), [leader, unnamed]) is led[expected]


@pytest.mark.slow
def test_a_weak_quadratic_spring_is_one_unknown_force_and_no_stop() -> None:
    """Stops leave no more than noise may leave; a smooth force says a quarter more, with certainty."""
    report = diagnose(quarter_car(), simulate(lambda d, v: 8e5 * d * d, seconds=30.0, seed=3), Options())
    assert report.verdict == "unknown_physics"
    assert [(f.location, f.kind) for f in report.findings] == [("secondary", EffectKind.UNLISTED)]
    value = {one.name: one for one in report.augmented}["secondary.stiffness"]
    assert value.value == pytest.approx(STIFFNESS["secondary"], abs=3 * value.std)


def test_a_law_of_the_catalogue_stays_one() -> None:
    record = simulate(lambda d, v: 2e4 * v * abs(v), seconds=15.0, seed=4)
    assert {f.effect for f in diagnose(quarter_car(), record, Options()).findings} <= {"quadratic_damping"}


@pytest.mark.slow
def test_what_a_later_formula_explains_is_no_finding_of_its_own() -> None:
    """A hidden state that swings is first taken for a hanging mass; beside its formula that is idle, and goes."""
    law = OpenLaw("", lambda d, v, z: -65.0 * (z / 2.5e-3) ** 3, 0.12)
    values = {"stiffness": np.array([2.4e6, 4.3e5]), "damping": np.array([1.0e4, 2.0e4])}
    clean, _ = simulated(law, values, 30.0, 7, 1.0)
    noise = np.array([1e-5, 5e-4, 4e-3, 4e-3, 3e-2, 3e-2])
    record = MadeRecord(clean + noise * np.random.default_rng(8).standard_normal(clean.shape))
    report = diagnose(quarter_car(), record, Options())
    assert [(f.location, f.effect, f.formula) for f in report.findings] == [("secondary", "formula", "a * z**3")]


def test_a_formula_of_deflection_and_rate_is_drawn_as_a_map(told: Report) -> None:
    d, v = np.meshgrid(told.plot_data["finding.0.map_d"], told.plot_data["finding.0.map_v"])
    force, std = told.plot_data["finding.0.map_force"], told.plot_data["finding.0.map_std"]
    (a,) = told.findings[0].parameters
    assert force == pytest.approx(a.value * d * np.abs(v), rel=0.02)  # from the part that was fitted
    assert std == pytest.approx(a.std * np.abs(d * v), rel=0.5)
    figure = force_figure(told, 0)
    assert figure is not None and "a * d * abs(v)" in figure.axes[0].get_title(loc="left")


def test_a_formula_becomes_a_law_of_ones_own(told: Report, tmp_path: Path) -> None:
    path = tmp_path / "my_laws.py"
    assert write_laws(path, told) == 1
    (law,) = load_laws(path, tuple(one.name for one in CATALOGUE))
    assert isinstance(law, ElementLaw) and law.name == "secondary_law_1" and law.strength == 0 and law.listed
    other = simulate(lambda d, v: 2e6 * d * abs(v), seconds=15.0, seed=6)
    report = diagnose(replace(quarter_car(), catalogue=(*CATALOGUE, law)), other)
    assert report.verdict == "missing_physics"
    (finding,) = report.findings
    assert (finding.location, finding.effect) == ("secondary", "secondary_law_1")
    assert finding.parameters[0].value == pytest.approx(2e6, abs=5 * finding.parameters[0].std)


def test_a_formula_goes_into_every_export(told: Report, tmp_path: Path) -> None:
    system = parse_system(improved_text(SYSTEM, quarter_car(), told))
    for name in ("vehicle.mo", "vehicle.fmu", "tables"):
        export(system, tmp_path / name)
    assert "abs(v)" in (tmp_path / "vehicle.mo").read_text(encoding="utf-8")
    assert any((tmp_path / "tables").glob("*.csv"))
