"""The independent generator of recordings, against closed forms and through the product's readers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from sprung.benchmarks.generator import draw_cases, make_recordings, read_vehicle, track, write_set
from sprung.benchmarks.generator.draw import FAULTS
from sprung.benchmarks.generator.exact import exact_response
from sprung.benchmarks.generator.files import WRITERS
from sprung.benchmarks.generator.integrate import SAMPLE_RATE, STEP_RATE, WARM_UP, BatchMotion, PlantBatch, Slot
from sprung.benchmarks.generator.laws import LAWS
from sprung.benchmarks.generator.make import _integrated, make_with_each_missing
from sprung.benchmarks.several_laws import drawn
from sprung.model.diagnosis.rules import RULES
from sprung.model.system import MANCHESTER, MANCHESTER_DBC, load_system
from sprung.replay.record import load_record

VEHICLE = read_vehicle(MANCHESTER)


def plant(slots: list[Slot], batch: int = 1) -> PlantBatch:
    def tile(values: np.ndarray) -> np.ndarray:
        return np.repeat(values[:, None], batch, 1)

    zeros = np.zeros((4, batch))
    return PlantBatch(tile(VEHICLE.stiffness), tile(VEHICLE.damping), tile(VEHICLE.inertia), zeros, zeros, slots)


def test_the_vehicle_has_the_published_modes() -> None:
    motion, matrix = BatchMotion(VEHICLE, plant([])), np.zeros((20, 20))
    for column in range(20):
        state = np.zeros((20, 1))
        state[column] = 1.0
        matrix[:, column] = motion(state, np.zeros(0), np.zeros((16, 1)), 0.0)[0][:, 0]
    rigid = np.r_[0:9, 10:19]  # the elastic mode is off
    frequency = np.sort(np.abs(np.linalg.eigvals(matrix[np.ix_(rigid, rigid)])))[::2] / (2 * np.pi)
    published = [0.81, 1.08, 1.31, 7.41, 7.43, 9.17, 9.19, 11.71, 11.71]
    assert frequency == pytest.approx(published, abs=0.006)


def test_the_rails_have_the_erri_spectrum_and_the_velocity_is_the_derivative() -> None:
    speed, seconds = 45.0, 120.0
    w, v = track.wheels(
        np.random.default_rng(3), seconds, speed, track.LOW_TRACK, VEHICLE.input_position, VEHICLE.input_side
    )
    frequency, power = signal.welch(w[:, 0], track.RATE, nperseg=8192)
    inside = (frequency > 1.0) & (frequency < 15.0)
    wanted = track.errib176(2 * np.pi * frequency[inside] / speed, track.LOW_TRACK) * 2 * np.pi / speed
    assert np.mean(power[inside] / wanted) == pytest.approx(1.0, abs=0.12)
    central = (w[2:] - w[:-2]) * track.RATE / 2
    assert np.abs(central - v[1:-1]).max() < 0.02 * np.abs(v).max()


def test_a_rear_wheel_sees_what_the_front_wheel_saw_a_wheelbase_earlier() -> None:
    speed = 2560.0 / 64  # 2.56 m of wheelbase are 64 samples of 1 ms
    w, _ = track.wheels(
        np.random.default_rng(4), 10.0, speed, track.LOW_TRACK, VEHICLE.input_position, VEHICLE.input_side
    )
    assert w[64:, 2] == pytest.approx(w[:-64, 0], abs=1e-9)
    assert 0.3 < np.corrcoef(w[:, 0], w[:, 1])[0, 1] < 0.7


@pytest.mark.parametrize("name", list(LAWS))
def test_a_law_acts_on_its_own_element_and_column_alone(name: str) -> None:
    law, rng = LAWS[name], np.random.default_rng(5)
    p = law.draw(rng, 0.1, 4.3e5, 2e4, 2.5e-3, 0.026)
    slots = [Slot(1, 8, name, p)]
    plain, hidden = BatchMotion(VEHICLE, plant([], 2)), BatchMotion(VEHICLE, plant(slots, 2))
    state = np.zeros((20, 2))
    state[0], state[10] = -8e-3, 0.1  # the car lies low and rises
    memory = np.full(1, 2e-4 if name == "bouc_wen" else 0.0)
    support = np.zeros((16, 2))
    difference = hidden(state, memory, support, 20.0)[0] - plain(state, np.zeros(0), support, 20.0)[0]
    assert np.abs(difference[:, 0]).max() == 0
    assert np.abs(difference[10:19, 1]).max() > 1e-6
    assert difference[16:19, 1] == pytest.approx(0.0, abs=1e-12)  # bogie 2 does not touch secondary_1l


def test_two_laws_at_one_element_add_up() -> None:
    laws = [Slot(0, 8, "coulomb_friction", [320.0, 1e-3]), Slot(0, 8, "cubic_stiffness", [1e9])]
    state = np.zeros((20, 1))
    state[0], state[10] = -8e-3, 0.5
    support = np.zeros((16, 1))
    plain = BatchMotion(VEHICLE, plant([]))(state, np.zeros(0), support, 0.0)[0]
    each = [BatchMotion(VEHICLE, plant([law]))(state, np.zeros(1), support, 0.0)[0] - plain for law in laws]
    both = BatchMotion(VEHICLE, plant(laws))(state, np.zeros(2), support, 0.0)[0] - plain
    assert min(np.abs(one).max() for one in each) > 1e-3
    assert both == pytest.approx(each[0] + each[1], rel=1e-9)


def test_several_laws_are_three_to_five_the_first_two_at_one_element() -> None:
    cases = [drawn(VEHICLE, np.random.default_rng([7, number])) for number in range(12)]
    for case in cases:
        places = [place for place, _, _ in case.effects]
        names = [law for _, law, _ in case.effects]
        assert places[0] == places[1] and names[0] != names[1]
        assert len(set(places)) == len(places) - 1
    assert {len(case.effects) for case in cases} == {3, 4, 5}
    assert RULES.acceptance.findings > 5  # one more than there are, to see that there is none


@pytest.mark.slow
def test_each_law_beside_others_is_seen_as_far_as_they_leave_it() -> None:
    case = draw_cases(VEHICLE, 1, 22, ["cubic_stiffness"], 0.0)[0]
    place, law, (k3,) = case.effects[0]
    elsewhere = next(element for element in VEHICLE.elements if element != place)
    pair = replace(case, effects=[(place, law, [0.02 * k3]), (elsewhere, law, [0.02 * k3])])
    _, ratios = make_with_each_missing(VEHICLE, pair, 40.0)
    alone = next(iter(make_recordings(VEHICLE, [replace(pair, effects=pair.effects[:1])], seconds=40.0))).snr
    assert alone is not None
    assert 0.3 * alone < ratios[0] < 1.05 * alone


def test_a_constant_force_of_friction_decelerates_the_car_by_force_over_mass() -> None:
    motion = BatchMotion(VEHICLE, plant([Slot(0, 8, "coulomb_friction", [320.0, 1e-3])]))
    plain = BatchMotion(VEHICLE, plant([]))
    state = np.zeros((20, 1))
    state[10] = 0.5  # the car rises
    rates = [m(state, np.zeros(n), np.zeros((16, 1)), 0.0)[0] for m, n in ((motion, 1), (plain, 0))]
    assert float((rates[0] - rates[1])[10, 0]) == pytest.approx(-320.0 / 32000)


def test_a_seed_draws_the_same_cases_and_whole_rounds_hold_every_kind() -> None:
    first, again, other = (draw_cases(VEHICLE, 36, seed) for seed in (9, 9, 10))
    assert [c.findings() for c in first] == [c.findings() for c in again]
    assert [c.stiffness for c in first] != [c.stiffness for c in other]
    kinds = {c.kind for c in first}
    assert set(LAWS) | set(FAULTS) | {"flexible_mode", "external_force", "mass_change", "two", "clean"} <= kinds
    verdicts = {c.kind: c.verdict() for c in first}
    assert verdicts["clean"] == verdicts["k_scale"] == verdicts["c_scale"] == "consistent"
    assert verdicts["force_ripple"] == "unknown_physics" and verdicts["sensor_lag"] == "sensor_fault"


@pytest.mark.parametrize("suffix", ["mcap", "blf", "asc", "log"])
def test_files_give_back_what_was_written(tmp_path: Path, suffix: str) -> None:
    system = load_system()
    order = [c.name for c in system.channels]
    names = [f"{w}.{q}" for q in ("displacement", "velocity") for w in VEHICLE.inputs] + list(VEHICLE.sensors)
    values = np.random.default_rng(6).normal(size=(50, 28)) * np.r_[np.full(8, 2e-3), np.full(8, 0.03), np.ones(12)]
    path = tmp_path / f"made.{suffix}"
    WRITERS[suffix](path, VEHICLE, values, "made")
    record = load_record(path, system.channels, 100.0, dbc=MANCHESTER_DBC)
    back = record.values[:, [order.index(name) for name in names]]
    quantum = np.r_[np.full(8, 1e-6), np.full(8, 2e-5), np.full(4, 5e-4), np.full(8, 2e-3)]
    assert record.lost == 0
    assert (np.abs(back - values).max(axis=0) <= 0.51 * quantum).all()


def test_a_set_is_written_with_labels_in_the_published_form(tmp_path: Path) -> None:
    cases = draw_cases(VEHICLE, 2, 3, ["sensor_gain", "coulomb_friction"])
    labels = json.loads(write_set(VEHICLE, cases, tmp_path, seconds=0.5).read_text())
    assert len(labels) == 2
    for name, entry in labels.items():
        assert (tmp_path / name).stat().st_size > 1000
        assert entry["verdict"] in {"missing_physics", "sensor_fault"}
        assert set(entry["stiffness"]) == set(VEHICLE.elements)
        assert {"location", "effect", "parameters"} == set(entry["findings"][0])


@pytest.mark.slow
def test_the_oracle_sees_nothing_on_clean_recordings_and_counts_strength_linearly() -> None:
    clean = draw_cases(VEHICLE, 2, 21, ["clean"])
    weak = draw_cases(VEHICLE, 1, 22, ["cubic_stiffness"], 0.0)[0]
    place, law, (k3,) = weak.effects[0]
    cases = [*clean, *(replace(weak, effects=[(place, law, [share * k3])]) for share in (0.02, 0.01))]
    assert STEP_RATE >= 2000
    made = [r.snr or 0.0 for r in make_recordings(VEHICLE, cases, seconds=40.0)]
    assert max(made[:2]) < 1.5
    assert made[2] / made[3] == pytest.approx(2.0, rel=0.05)


@pytest.mark.slow
def test_the_integrator_agrees_with_the_exact_response_of_a_linear_vehicle() -> None:
    case = draw_cases(VEHICLE, 1, 23, ["clean"])[0]
    integrated, _ = next(_integrated(VEHICLE, [case], 20.0, None))
    exact = exact_response(VEHICLE, case, 30.0)[int(WARM_UP * SAMPLE_RATE) :]
    settled = slice(1200, 1900)
    error = np.abs(integrated[settled] - exact[settled]).max(axis=0)
    noise = np.concatenate([VEHICLE.input_noise.ravel(), VEHICLE.sensor_noise])
    assert (error < 0.05 * noise).all()


def test_rubber_of_the_first_power_is_a_damper() -> None:
    (case,) = draw_cases(VEHICLE, 1, 11, ["clean"])
    size = 2e4
    rubber = replace(case, rubber=("primary_12l", size, 1.0))
    damping = case.damping | {"primary_12l": case.damping["primary_12l"] + size / (2 * np.pi)}
    exact = exact_response(VEHICLE, replace(case, damping=damping), 20.0)
    assert exact_response(VEHICLE, rubber, 20.0) == pytest.approx(exact, rel=1e-9, abs=1e-12)
    assert rubber.findings() == [
        {"location": "primary_12l", "effect": "fractional_stiffness", "parameters": [size, 1.0]}
    ]
