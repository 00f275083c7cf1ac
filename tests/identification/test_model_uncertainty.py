"""Masses that are not quite those of the system file: what is stated contains them."""

import numpy as np
import pytest

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.identify import Identifier
from sprung.model.identification.model_uncertainty import model_uncertainty, sampling_uncertainty
from sprung.model.system import System, load_system, parse_system
from sprung.service.monitoring.engine import make_tracker
from tests.strut import TEXT

QUARTER_CAR = """
name: quarter car
sample_rate: 100
window: 100
bodies:
  sprung: {{mass: 300.0}}
  unsprung: {{mass: {mass}}}
inputs:
  road: {{kind: support, displacement: {{csv: z, noise: 1.0e-5}}, velocity: {{csv: v, noise: 1.0e-3}}}}
elements:
  tyre: {{upper: unsprung, lower: road, stiffness: 1.8e+5}}
  strut: {{upper: sprung, lower: unsprung, stiffness: 2.0e+4, damping: 1500.0}}
sensors:
  body: {{kind: acceleration, body: sprung, csv: a1, noise: 0.01}}
  wheel: {{kind: acceleration, body: unsprung, csv: a2, noise: 0.05}}
"""


def quarter_car(mass: float | str) -> System:
    return parse_system(QUARTER_CAR.format(mass=mass))


def test_with_an_unknown_load_all_forces_scale_with_the_axle() -> None:
    system = quarter_car(40.0)
    assert system.doubtful_masses == {"unsprung": 0.03}
    found = model_uncertainty(system, loads=True)
    assert np.sqrt(np.diag(found.parameters)) == pytest.approx(0.03, rel=0.02)
    assert np.sqrt(found.deviations[-1, -1]) == pytest.approx(0.03, rel=0.05)


def test_windows_of_a_heavier_axle_are_within_what_is_stated() -> None:
    runs = simulate_runs(quarter_car(41.6), np.zeros((12, 3)), 100, np.random.default_rng(5))
    estimates = Identifier(quarter_car(40.0)).identify(runs.values)
    told = Identifier(quarter_car("{value: 40.0, fixed: true}")).identify(runs.values)
    score = np.array([e.log_ratio / np.sqrt(np.diag(e.covariance)) for e in estimates])
    plain = np.array([e.log_ratio / np.sqrt(np.diag(e.covariance)) for e in told])
    assert np.abs(score).max() < 3
    assert np.abs(plain).max() > 6  # the mass is taken for certain


def test_a_tracker_states_it_but_not_in_changes() -> None:
    system = quarter_car(40.0)
    certain = make_tracker(quarter_car("{value: 40.0, fixed: true}"))
    doubtful = make_tracker(system)
    runs = simulate_runs(system, np.zeros((80, 3)), 100, np.random.default_rng(6))
    estimates = Identifier(system).examine(runs.values, np.arange(80) % 4 == 0)
    windows = [(e, 10**18 + k * 10**9) for k, e in enumerate(estimates)]
    state = doubtful.update_many(doubtful.initial_state(), windows)
    assert (doubtful.posterior(state)[1] > 0.029).all()
    assert (certain.posterior(state)[1] < 0.01).all()
    assert all(p.drift_std is not None and p.drift_std < 0.01 for p in doubtful.report(state))
    (_, std), (_, sure) = doubtful.loads(state)["sprung"], certain.loads(state)["sprung"]
    assert std > 0.029
    assert sure < 0.01


def test_a_heavier_axle_is_no_gain_of_a_sensor_of_the_strut_s_force() -> None:
    """The axle is 4 % heavier; forces that are measured are not those of the file's masses."""
    text = TEXT.format(law="", sensor="")
    axles = {
        kind: text.replace("mass: 45", f"mass: {mass}")
        for kind, mass in (("true", "46.8"), ("doubtful", "45"), ("certain", "{value: 45, fixed: true}"))
    }
    true, system, certain = (parse_system(axles[kind]) for kind in ("true", "doubtful", "certain"))
    runs = simulate_runs(true, np.zeros((60, len(true.parameters))), 200, np.random.default_rng(8))
    estimates = Identifier(system).examine(runs.values, np.arange(60) % 4 == 0)
    windows = [(e, 10**18 + k * 10**9) for k, e in enumerate(estimates)]
    told = {}
    for name, one in (("doubtful", system), ("certain", certain)):
        tracker = make_tracker(one)
        state = tracker.update_many(tracker.initial_state(), windows)
        mean, std = tracker.posterior(state)
        told[name] = tracker.sensors(state), float(np.abs(mean / std).max())
    assert told["doubtful"][0] == ()
    assert told["doubtful"][1] < 3
    assert [(f.channel, f.kind) for f in told["certain"][0]] == [("strut_f", "gain")]


def test_stated_doubt_makes_no_other_vehicle() -> None:
    stated = quarter_car("{value: 40.0, std: 2.0}")
    assert stated.doubtful_masses == {"unsprung": pytest.approx(0.05)}
    assert stated.digest == quarter_car(40.0).digest
    assert quarter_car("{value: 40.0, std: 0}").doubtful_masses == {}
    assert load_system().doubtful_masses == {}  # wheels are measured, bogies pitch


PITCHING = """
name: bogie
sample_rate: 100
window: 100
bodies:
  car: {{mass: 16000.0}}
  bogie: {{mass: {mass}, pitch_inertia: {pitch}}}
inputs:
  front: {{kind: support, displacement: {{csv: z1, noise: 1.0e-5}}, velocity: {{csv: v1, noise: 5.0e-4}}}}
  rear: {{kind: support, displacement: {{csv: z2, noise: 1.0e-5}}, velocity: {{csv: v2, noise: 5.0e-4}}}}
elements:
  first: {{upper: bogie, lower: front, position: [{arm}, 0.0], stiffness: 2.44e+6, damping: 8.0e+3}}
  second: {{upper: bogie, lower: rear, position: [-1.28, 0.0], stiffness: 2.44e+6, damping: 8.0e+3}}
  strut: {{upper: car, lower: bogie, stiffness: 8.6e+5, damping: 4.0e+4}}
sensors:
  body: {{kind: acceleration, body: car, csv: a1, noise: 0.004}}
  leading: {{kind: acceleration, body: bogie, position: [1.28, 0.0], csv: a2, noise: 0.03}}
  trailing: {{kind: acceleration, body: bogie, position: [-1.28, 0.0], csv: a3, noise: 0.03}}
"""


def bogie(mass: float = 2615.0, pitch: float = 1476.0, arm: float = 1.28) -> System:
    return parse_system(PITCHING.format(mass=mass, pitch=pitch, arm=arm))


@pytest.mark.parametrize("off", [{"mass": 2667.0, "pitch": 1432.0}, {"pitch": 1432.0}, {"arm": 1.305}])
def test_bodies_that_are_not_quite_those_of_the_file_blind_no_tracker(off: dict[str, float]) -> None:
    """2 % of a bogie, 3 % of its inertia, 25 mm of a spring's place: windows go on fitting, no sensor is accused."""
    system, true = bogie(), bogie(**off)
    tracker = make_tracker(system)
    runs = simulate_runs(true, np.zeros((80, len(true.parameters))), 100, np.random.default_rng(9))
    estimates = Identifier(system).examine(runs.values, np.arange(80) % 2 == 0)
    assert np.mean([e.adequate for e in estimates]) > 0.9
    state = tracker.update_many(tracker.initial_state(), [(e, 10**18 + k * 10**9) for k, e in enumerate(estimates)])
    mean, std = tracker.posterior(state)
    assert np.abs(mean / std).max() < 3
    assert tracker.sensors(state) == ()
    assert std.max() < 0.03
    told = {one.what: one for one in tracker.body_constants(state)}
    if "pitch" in off:
        apart = off["pitch"] / 1476.0 / (off.get("mass", 2615.0) / 2615.0) - 1
        assert told["pitch inertia over mass"].change == pytest.approx(apart, abs=0.015)


def test_what_is_fixed_or_stated_is_not_doubted_beside() -> None:
    certain = parse_system(QUARTER_CAR.format(mass="{value: 40.0, fixed: true}"))
    assert model_uncertainty(certain, loads=True, tracked=True).none


def test_a_stiff_stop_is_known_no_better_than_sampling_follows_it() -> None:
    def stated(stiffness: str, rate: int) -> float:
        law = f"damping: 1500.0, laws: [{{bump_stop: {{gap: 0.01, stiffness: {stiffness}}}}}]"
        text = QUARTER_CAR.format(mass=40.0).replace("damping: 1500.0", law)
        system = parse_system(text.replace("sample_rate: 100", f"sample_rate: {rate}"))
        names, std = [p.name for p in system.tracked], np.sqrt(sampling_uncertainty(system))
        (at,) = np.flatnonzero(std)
        assert names[at] == "strut.bump_stop.stiffness"
        tracker = make_tracker(system)
        assert tracker.posterior(tracker.initial_state())[1][at] >= std[at]
        return std[at]

    assert stated("5.0e+5", 100) == pytest.approx(0.0056, rel=0.05)  # 19 Hz on 40 kg
    assert stated("5.0e+5", 200) < 0.0005 and stated("2.0e+4", 100) < 0.0001
