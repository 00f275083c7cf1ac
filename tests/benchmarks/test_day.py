"""Months of service in estimate space: estimates are drawn as they state, and a hidden fault is found and named."""

from pathlib import Path

import numpy as np
import pytest
import torch

from sprung.benchmarks import day
from sprung.benchmarks.day import Pool, VehicleLife, library
from sprung.benchmarks.generator.ride import SYSTEM
from sprung.benchmarks.generator.timetable import Service, draw_timetable
from sprung.benchmarks.generator.vehicle import read_vehicle
from sprung.benchmarks.through import through
from sprung.model.identification.measurements.deviations import CARGO, deviations
from sprung.model.simulate.linear import LinearSimulator
from sprung.model.system import load_system
from sprung.service.monitoring.engine import load_engine
from sprung.service.settings import settings_with

CARRIED = np.array([0.2, -0.05, -0.02, 0.01, -0.02])


@pytest.fixture(scope="module")
def windows() -> list[Pool]:
    found = library(load_system(), 6, 3)
    prior = np.array([part.std for part in deviations(load_system()) if part.kind not in ("gain", "delay")])
    return [day.pool([found[k], found[k - 1]], prior) for k in range(len(found))]


def test_estimates_scatter_about_the_truth_as_they_state(windows: list[Pool]) -> None:
    system, rng = load_system(), np.random.default_rng(1)
    truth, off = rng.normal(0, 0.1, 24), np.zeros(len(deviations(system)))
    at = [part.kind in CARGO for part in deviations(system)]
    off[at] = CARRIED
    drawn = [day.drawn(rng, windows[0], truth, off) for _ in range(400)]
    said = [e.deviating for e in drawn if e.deviating is not None]
    assert len(said) == len(drawn)
    errors = np.array([e.log_ratio - d.cross @ (d.point - off) for e, d in zip(drawn, said, strict=True)]) - truth
    scores = errors / np.sqrt(np.diag(said[0].given))
    assert np.sqrt(np.mean(scores**2)) == pytest.approx(1.0, abs=0.1)
    loads = np.array([d.point[at] for d in said]) - CARRIED
    assert np.all(np.abs(loads.mean(axis=0)) < 4 * loads.std(axis=0) / np.sqrt(400))
    gains = [d.information @ (off - d.point) for d in said]
    slopes = np.array([d.score for d in said]) - gains  # at the true deviations: no slope on average
    spread = np.sqrt(np.diag(said[0].information) / 400)
    assert np.all(np.abs(slopes.mean(axis=0)) < 5 * spread + 1e-6)


def test_a_damper_that_loses_a_seventh_is_found_beside_weather_and_loads(
    windows: list[Pool], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(day, "SETTLED_DAYS", 0.5)
    life = day.live(load_system(), windows, 1.2, 5, measured=True, fault="secondary_1r.damping")
    assert life.isolated or life.found_after is None  # another alarm never comes first
    assert life.strangers == []


def test_a_drawn_load_gives_the_mass_matrix_of_the_generator() -> None:
    system, service = load_system(), Service()
    empty = system.mechanics.mass[:3]
    terms = day.boarded(np.random.default_rng(3), service, empty)
    rng = np.random.default_rng(3)
    load, place = rng.uniform(*service.load), rng.normal(0, service.off_centre)
    expected = np.diag(empty * (1 + load * np.array([1.0, *rng.uniform(*service.load_spread, 2)])))
    expected[2, 2] += abs(load) * empty[0] * place**2
    expected[0, 2] = expected[2, 0] = load * empty[0] * place
    aside = rng.normal(0, day.ASIDE)
    expected[1, 1] += abs(load) * empty[0] * aside**2
    expected[0, 1] = expected[1, 0] = load * empty[0] * aside
    x = torch.as_tensor(np.concatenate([np.zeros(24), terms]))[None]
    found = LinearSimulator(system).element_values(x).inertia[0, :3, :3].numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-6)


def test_every_window_of_a_day_goes_through_once_and_in_order() -> None:
    engine, vehicle = load_engine(settings_with({})), read_vehicle(SYSTEM)
    timetable = draw_timetable(vehicle, Service(dwell=(1.0, 2.0)), 42.0, 4)
    moments = list(through(engine, vehicle, timetable))
    np.testing.assert_allclose(np.diff([m.time for m in moments]), 0.5)
    assert len(moments) == (4200 - 100) // 50 + 1
    last = moments[-1].state
    assert last.used + last.rejected + last.idle == len(moments)


def test_vehicles_that_are_done_are_not_lived_again(
    windows: list[Pool], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(day, "library", lambda *_: [])
    monkeypatch.setattr(day.VehicleLives, "pools", windows)
    lived = []

    def live(_system: object, _windows: object, days: float, seed: int, **_: object) -> VehicleLife:
        lived.append(seed)
        return day.VehicleLife(days, 100, 0, [], 0, None, False)

    monkeypatch.setattr(day, "live", live)
    first = list(day.run(3, 0, 7, folder=tmp_path, part="1/2"))
    assert lived == [7000, 7002]
    assert first[0]["rides"] == 200
    again = list(day.run(3, 0, 7, folder=tmp_path))
    assert lived == [7000, 7002, 7001]
    assert again[0]["rides"] == 300
    list(day.run(3, 0, 8, folder=tmp_path, part="1/3"))
    assert lived[-1] == 8000  # another seed is another run
