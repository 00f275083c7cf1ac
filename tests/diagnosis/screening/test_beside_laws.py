"""Cars: stops on one side, other masses beside a damper that blows off, and laws behind a high-pass filter."""

from typing import Any

import numpy as np
import pytest
import yaml

from sprung.benchmarks import cars
from sprung.benchmarks.setup_rigs import SYSTEMS
from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.laws import CATALOGUE
from sprung.model.laws.bodies import MASS_CHANGE
from sprung.model.system import System, parse_system


@pytest.fixture(autouse=True)
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cars, "MASSES", 0.0)
    monkeypatch.setattr(cars, "GAINS", 0.0)


def effect(file: str, law: str) -> cars.Effect:
    return next(one for one in cars.EFFECTS if (one.file, one.law) == (file, law))


def with_its_law(one: cars.Effect) -> dict[str, Any]:
    """The content of the system file with the law of an effect."""
    content: dict[str, Any] = yaml.safe_load((SYSTEMS / one.file).read_text())
    content["elements"][one.place]["laws"] = [{one.law: dict(one.values or {})}]
    return content


def without_force(one: cars.Effect, mass: float) -> System:
    """The quarter car with another mass, no load cell, and every stiffness and damping unknown."""
    content = with_its_law(one)
    content["bodies"]["sprung"]["mass"] = mass
    content["elements"]["tyre"]["damping"] = 100.0
    del content["sensors"]["load"]
    return as_system(content)


def as_system(content: dict[str, Any]) -> System:
    return parse_system(yaml.safe_dump(content, sort_keys=False))


def fitted(one: cars.Effect, system: System | None = None, seconds: float = 25.0) -> tuple[Problem, Fit]:
    """A structure, the nominal one without another, fitted to a car's recording."""
    nominal, values = cars.recorded(one, np.random.default_rng(3), seconds)
    system = system or nominal
    signals = prepare(system, values[:, : len(system.channels)], system.sample_rate).signals
    return baseline(system, signals, declared_noise(system, signals), int(0.7 * signals.samples))


def test_a_stop_in_compression_alone_is_the_strongest_of_all_laws() -> None:
    problem, fit = fitted(effect(cars.QUARTER, "bump_stop"))
    named = [one for one in screen(problem, fit, CATALOGUE).candidates if one.term.law.named]
    best = max(named, key=lambda one: one.strength())
    assert best.term.key == ("strut", "bump_stop", "compression")
    assert best.term.parameters[0] == pytest.approx(0.016, rel=0.25)


def test_the_score_of_another_mass_beside_a_strongly_nonlinear_law_contains_the_reaction_of_that_law() -> None:
    one = effect(cars.QUARTER, "damper_blowoff")
    problem, fit = fitted(one, without_force(one, mass=297.0))
    found = {
        candidate.location: candidate.term.parameters[0]
        for candidate in screen(problem, fit, (MASS_CHANGE,)).candidates
    }
    assert found["sprung"] == pytest.approx(300 / 297, abs=0.002)
    assert found["unsprung"] == pytest.approx(297 / 300, abs=0.004)  # only their ratio shows


def test_the_force_of_a_law_passes_the_filter_that_all_signals_passed() -> None:
    # a damper that is harder in extension pulls the body down slowly, which high-passed signals do not show
    one = effect(cars.HUBS, "damper_asymmetry")
    problem, fit = fitted(one, as_system(with_its_law(one)), seconds=40.0)
    assert problem.part.grid.cutoff > 0
    assert fit.reduced < 1.15


def test_a_car_without_effect_has_the_noise_that_is_declared_at_every_sensor() -> None:
    # the slopes of integrated accelerations at the ends of the record must not show as noise
    one = effect(cars.HUBS, "")
    system, values = cars.recorded(one, np.random.default_rng([61107, 4]), 50.0)
    signals = prepare(system, values, system.sample_rate).signals
    declared = declared_noise(system, signals)
    problem, _ = baseline(system, signals, declared, int(0.7 * signals.samples))
    np.testing.assert_allclose(problem.noise.sensors, declared.sensors, rtol=0.08)


def test_a_load_cell_shows_the_mean_of_a_law_that_its_element_has() -> None:
    one = effect(cars.QUARTER, "damper_asymmetry")
    problem, fit = fitted(one, as_system(with_its_law(one)))
    cell = problem.part.sensors[0, list(problem.system.sensors).index("load")]
    mean_of_law = fit.forces.force.mean() * np.sqrt(problem.part.grid.samples) if fit.forces is not None else 0.0
    assert abs(mean_of_law) > 20 * abs(cell)  # beside it the spring's, so that the sum is none
    assert fit.reduced < 1.15
