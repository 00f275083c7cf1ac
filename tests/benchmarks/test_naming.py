"""Simulated rigs under sine, sweep, random and earthquake-like motion: named with their values or unknown."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.benchmarks.naming import MOTIONS, forces, judged, levels, moved
from sprung.benchmarks.naming_rigs import RIGS

SEED = 20_261


def tried(name: str, motion: str) -> dict[str, object]:
    return judged(RIGS[name], motion, [SEED, list(RIGS).index(name), MOTIONS.index(motion)])


@pytest.mark.parametrize(
    ("name", "motion"),
    [
        ("nothing", "sine"),
        ("stribeck", "quake"),
        ("fluid damper", "random"),
        pytest.param("lugre", "sine", marks=pytest.mark.slow),
        pytest.param("friction_backlash", "sweep", marks=pytest.mark.slow),
    ],
)
def test_what_is_there_is_named(name: str, motion: str) -> None:
    line = tried(name, motion)
    assert line["judged"] == "right", line


@pytest.mark.slow
@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("name", RIGS)
def test_no_rig_is_called_something_else_or_clear(name: str, motion: str) -> None:
    line = tried(name, motion)
    assert line["judged"] in ("right", "unknown"), line


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["one-sided stop", "stops at unequal travel", "progressive stop", "valve beside a stop", "spring off centre"],
)
def test_stops_and_springs_lie_within_their_deviations(name: str) -> None:
    line = tried(name, "random")
    values = line["values"]
    assert isinstance(values, dict) and values, line
    assert all(abs(value - truth) < 3 * std for truth, value, std in values.values()), values


def test_steel_starts_along_its_spring_and_ends_near_its_yield_force() -> None:
    random = np.random.default_rng(1)
    step = RIGS["steel after Menegotto and Pinto"].made(random).step
    path = np.linspace(0, 0.02, 4001)
    force = np.array([step(x, 0.1, 5e-5) for x in path.tolist()])
    again = np.random.default_rng(1)
    k, slip, b = again.uniform(2e5, 5e5), again.uniform(500, 1500), again.uniform(0.02, 0.06)
    assert force[20] / path[20] == pytest.approx(k, rel=0.01)
    assert force[-1] == pytest.approx(slip + b * k * (path[-1] - slip / k), rel=0.02)


@pytest.mark.parametrize(
    "name", ["self-centring", "steel after Menegotto and Pinto", "rubber after Berg", "oil that cavitates"]
)
def test_a_rig_that_no_catalogue_has_takes_energy_and_gives_none(name: str) -> None:
    """Over a whole number of cycles of a steady sine; spring and damper of the bench taken out."""
    rig, d = RIGS[name], 0.01 * np.sin(2 * np.pi * np.arange(4000) / 200)
    signal = levels(np.random.default_rng(0))
    loop = forces(rig, d, 7, signal) - forces(RIGS["nothing"], d, 7, signal)
    last = slice(2000, 3001)
    assert np.trapezoid(loop[last], d[last]) > 0


@pytest.mark.slow
def test_what_a_single_loop_shows_is_not_put_down_to_several_laws() -> None:
    line = tried("magneto-rheological after Kwok", "sine")
    assert line["verdict"] == "unknown_physics", line


def test_a_curve_with_a_damper_that_the_deflection_makes_stronger_is_no_cubic_spring_by_one_loop() -> None:
    line = tried("smooth spring", "sine")
    assert line["verdict"] == "unknown_physics", line


@pytest.mark.parametrize("name", ["lugre", "bouc_wen"])
def test_a_memory_is_integrated_along_its_way(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rig, d, signal = RIGS[name], moved("random", np.random.default_rng(4)), levels(np.random.default_rng(0))
    coarse = forces(rig, d, 7, signal)
    monkeypatch.setattr("sprung.benchmarks.naming.FINER", 64)
    loop = coarse - forces(RIGS["nothing"], d, 7, signal)
    assert np.std(coarse - forces(rig, d, 7, signal)) < 2e-3 * np.std(loop)


def test_the_motions_stay_within_the_travel() -> None:
    for motion in MOTIONS:
        d = moved(motion, np.random.default_rng(2))
        assert 0.018 < np.abs(d).max() <= 0.02 + 1e-12
