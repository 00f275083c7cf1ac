"""Weather, load and speed: what they do to healthy parameters is learned, and hides no change beside it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from sprung.model.signals import Conditions, FloatArray, SampleBlock, Window
from sprung.model.system import parse_system
from sprung.model.tracking import weather
from sprung.model.tracking.tracker import Tracker, TrackerSettings, TrackerState
from sprung.replay.auxiliary import AuxiliaryMeans
from tests.tracker_windows import EPOCH, correlated, estimate

NAMES = [f"{e}.{q}" for q in ("stiffness", "damping") for e in (
    *(f"primary_{i}" for i in range(8)), *(f"secondary_{i}" for i in range(4)))]  # fmt: skip
STD = np.repeat([0.004, 0.006, 0.02, 0.01], [8, 4, 8, 4])
DAMPERS = slice(12, 24)
MINUTE = 60_000_000_000


@dataclass(frozen=True)
class One:
    name: str
    unit: str
    nominal: float


FILE = """
name: with a thermometer
sample_rate: 100
window: 100
temperature: {csv: T, unit: degC}
bodies: {car: {mass: 1000}}
inputs: {road: {kind: displacement, displacement: {csv: road}}}
elements: {spring: {upper: car, lower: road, stiffness: 40000, damping: 2000}}
sensors: {a: {kind: acceleration, body: car, csv: a}}
"""


def tracker() -> Tracker:
    nominal = np.repeat([1.22e6, 4.3e5, 4e3, 2e4], [8, 4, 8, 4])
    parameters = [One(n, "", float(v)) for n, v in zip(NAMES, nominal, strict=True)]
    return Tracker(parameters, TrackerSettings(window=60.0, hop=60.0, learning=600.0))


def day(
    rng: np.random.Generator,
    state: TrackerState,
    minutes: int,
    truth: Callable[[int], FloatArray],
    conditions: Callable[[int], Conditions | None],
    first: int = 0,
    every: int = 1,
) -> TrackerState:
    """Windows of a minute, each the mean of many."""
    follow, covariance = tracker(), correlated(rng, STD / 6)
    root = np.linalg.cholesky(covariance)
    for k in range(first, first + minutes, every):
        value = truth(k) + root @ rng.normal(size=24)
        state = follow.update(state, estimate(value, covariance), EPOCH + k * MINUTE, conditions(k))
    return state


def warm(k: int, slope: float = -0.002) -> tuple[float, FloatArray]:
    """Degrees, and what they do to dampers: a day's swing of 24 K."""
    degrees = 10.0 + 12.0 * np.sin(2 * np.pi * k / 1440)
    effect = np.zeros(24)
    effect[DAMPERS] = np.log1p(slope * (degrees - 20.0))
    return degrees, effect


def test_weather_that_is_measured_raises_nothing_and_its_slope_is_learned() -> None:
    rng = np.random.default_rng(1)
    slope, follow = -0.0027, tracker()
    state = day(rng, follow.initial_state(), 4320, lambda k: warm(k, slope)[1],
                lambda k: Conditions(temperature=warm(k)[0]), every=8)  # fmt: skip
    assert state.alarms == ()
    assert state.weather is not None and follow.weather is not None
    kinds = [k for k in range(4) if state.weather.kind_mean[k, 1] < -0.01]  # of dampers
    assert len(kinds) == 2
    middle, std = state.weather.kind_mean[kinds, 1], np.sqrt(state.weather.kind_covariance[kinds, 1, 1])
    assert np.all(std < 0.5 * follow.weather.kind_std[kinds, 1])
    assert np.all(np.abs(middle / weather.KELVIN - slope) < 3 * std / weather.KELVIN)


def test_unmeasured_weather_raises_nothing() -> None:
    rng = np.random.default_rng(2)
    state = day(rng, tracker().initial_state(), 2880, lambda k: warm(k)[1], lambda k: None, every=5)
    assert state.alarms == ()


@pytest.mark.parametrize("measured", [True, False])
def test_a_true_change_beside_the_weather_is_found_and_is_the_only_one(measured: bool) -> None:
    rng = np.random.default_rng(3)
    row, fault = 12 + 9, np.zeros(24)
    fault[row] = np.log(0.85)
    state = day(
        rng, tracker().initial_state(), 2000, lambda k: warm(k)[1] + fault * (k >= 1500),
        lambda k: Conditions(temperature=warm(k)[0]) if measured else None, every=5,
    )  # fmt: skip
    assert [alarm.parameter for alarm in state.alarms] == [NAMES[row]]
    assert state.alarms[0].change == pytest.approx(-0.15, abs=0.02)
    assert state.alarms[0].onset >= EPOCH + 1490 * MINUTE


@pytest.mark.parametrize("lost", [np.nan, -273.15])
def test_a_temperature_that_is_lost_on_a_cold_day_accuses_no_damper(lost: float) -> None:
    rng, cold = np.random.default_rng(15), np.zeros(24)
    cold[DAMPERS] = np.log1p(0.002 * 45.0)
    system = parse_system(FILE)
    state = day(
        rng, tracker().initial_state(), 160, lambda k: cold * min(k / 100, 1),
        lambda k: system.conditions(np.array([20.0 - 45.0 * min(k / 100, 1) if k < 120 else lost])),
    )  # fmt: skip
    assert state.alarms == ()
    assert state.weather is not None and state.weather.warmth[0] == pytest.approx(-2.5)


def test_oil_that_leaves_all_dampers_at_once_is_one_message() -> None:
    rng = np.random.default_rng(4)
    lost = np.zeros(24)
    lost[DAMPERS] = np.log(0.88)
    state = day(rng, tracker().initial_state(), 160, lambda k: lost * np.clip((k - 100) / 10, 0, 1), lambda k: None)
    assert [alarm.parameter for alarm in state.active] == ["*.damping"]
    assert state.active[0].change == pytest.approx(-0.12, abs=0.02)


def test_a_damper_that_is_still_followed_to_the_common_change_has_no_alarm_of_its_own() -> None:
    rng, follow = np.random.default_rng(6), tracker()
    gone = np.zeros(24)
    gone[DAMPERS] = np.log(0.8)
    state = day(rng, follow.initial_state(), 60, lambda k: np.zeros(24), lambda k: None)
    state = day(rng, state, 10, lambda k: gone, lambda k: None, first=60)
    assert [alarm.parameter for alarm in state.active] == ["*.damping"]
    first, mean, active = DAMPERS.start, state.belief.mean.copy(), state.changes.active.copy()
    for share, alone in ((0.4, []), (2.0, [NAMES[first]])):
        mean[first], active[first] = share * np.log(0.8), -1
        late = replace(
            state, belief=replace(state.belief, mean=mean.copy()), changes=replace(state.changes, active=active)
        )
        alarms = follow._alarms.updated(late, follow._fusion.drift(late), None, state.time or 0)
        assert [alarm.parameter for alarm in alarms if alarm.closed is None] == ["*.damping", *alone]


def test_a_damper_that_stays_worn_does_not_keep_the_alarm_of_all_open() -> None:
    rng = np.random.default_rng(14)
    lost, worn = np.zeros(24), np.zeros(24)
    lost[DAMPERS], worn[13] = np.log(0.88), np.log(0.75)
    state = day(rng, tracker().initial_state(), 160, lambda k: lost * np.clip((k - 100) / 10, 0, 1), lambda k: None)
    assert [alarm.parameter for alarm in state.active] == ["*.damping"]
    state = day(rng, state, 160, lambda k: worn + lost * np.clip((230 - k) / 10, 0, 1), lambda k: None, first=160)
    assert [alarm.parameter for alarm in state.active] == [NAMES[13]]


def test_a_kind_alone_is_named_by_what_its_names_share() -> None:
    rng = np.random.default_rng(5)
    lost = np.zeros(24)
    lost[12:20] = np.log(0.88)
    state = day(rng, tracker().initial_state(), 160, lambda k: lost * np.clip((k - 100) / 10, 0, 1), lambda k: None)
    assert [alarm.parameter for alarm in state.active] == ["primary_*.damping"]


def test_a_step_soon_after_the_baseline_was_learned_is_alarmed_in_time() -> None:
    """What windows of a ride have in common is in the baseline, too, which is therefore not uncertain at once."""
    follow, second = Tracker(tracker().parameters), 1_000_000_000
    for vehicle in range(12):
        rng = np.random.default_rng([11, vehicle])
        covariance = correlated(rng, 0.85 * STD)
        root, index = np.linalg.cholesky(covariance), 12 + vehicle % 8
        state, step = follow.initial_state(), np.zeros(24)
        for k in range(70):
            step[index] = 0.05 if k >= 40 else 0.0
            window = estimate(step + root @ rng.standard_normal(24), covariance)
            state = follow.update(state, window, EPOCH + k * second)
        assert [alarm.parameter for alarm in state.active] == [NAMES[index]]


def test_what_windows_of_a_ride_have_in_common_is_another_after_a_stop() -> None:
    rng, follow, second = np.random.default_rng(12), Tracker(tracker().parameters), 1_000_000_000
    covariance = correlated(rng, STD)
    root = np.linalg.cholesky(covariance)

    def ride(state: TrackerState, seconds: range) -> TrackerState:
        for k in seconds:
            window = estimate(root @ rng.standard_normal(24), covariance)
            state = follow.update(state, window, EPOCH + k * second)
        return state

    def spread(state: TrackerState) -> float:
        assert state.weather is not None
        return float(np.sqrt(state.weather.doubt.max()))

    riding = ride(follow.initial_state(), range(50))
    assert 0.0 < spread(riding) < 0.0015
    later = ride(riding, range(50, 300))
    assert spread(riding) < spread(later) < 0.005
    assert spread(ride(riding, range(80, 81))) == pytest.approx(0.005, rel=0.02)
    state = riding.to_dict()
    del state["weather"]["shared"]  # as an earlier version has kept it: nothing is known to be shared
    assert spread(ride(TrackerState.from_dict(state), range(50, 51))) == pytest.approx(0.005, rel=0.02)


def test_what_windows_have_in_common_alarms_nothing_while_it_changes() -> None:
    follow, second = Tracker(tracker().parameters), 1_000_000_000
    for vehicle in range(2):
        rng = np.random.default_rng([13, vehicle])
        covariance = correlated(rng, STD)
        root, shared = np.linalg.cholesky(covariance), 0.005 * rng.standard_normal(24)
        state = follow.initial_state()
        for k in range(400):
            shared = np.exp(-1 / 600) * shared + 0.005 * np.sqrt(-np.expm1(-2 / 600)) * rng.standard_normal(24)
            window = estimate(shared + root @ rng.standard_normal(24), covariance)
            state = follow.update(state, window, EPOCH + k * second)
        assert state.alarms == ()


def test_what_was_learned_survives_a_restart_bit_for_bit() -> None:
    rng = np.random.default_rng(6)
    state = day(rng, tracker().initial_state(), 300, lambda k: warm(k)[1], lambda k: Conditions(temperature=warm(k)[0]))
    again = TrackerState.from_dict(state.to_dict())
    one, other = (
        day(np.random.default_rng(7), s, 20, lambda k: warm(k)[1], lambda k: Conditions(20.0, 5.0), 300)
        for s in (state, again)
    )
    assert one.to_dict() == other.to_dict()


def test_a_state_without_weather_goes_on_and_begins_to_learn_it() -> None:
    rng = np.random.default_rng(8)
    old = day(rng, tracker().initial_state(), 100, lambda k: np.zeros(24), lambda k: None).to_dict()
    for key in ("weather", "cargo"):
        del old[key]
    state = day(rng, TrackerState.from_dict(old | {"format": 2}), 20, lambda k: np.zeros(24), lambda k: None, 100)
    assert state.weather is not None
    assert state.used == 120
    assert state.alarms == ()


def test_the_fleet_teaches_a_new_vehicle_its_slopes() -> None:
    rng = np.random.default_rng(9)
    slope, others = -0.003, []
    for _ in range(3):
        state = day(rng, tracker().initial_state(), 2880, lambda k: warm(k, slope)[1],
                    lambda k: Conditions(temperature=warm(k)[0]), every=12)  # fmt: skip
        others.append(state)
    prior = weather.pooled(tracker().weather, [s.weather for s in others if s.weather is not None])
    taught = tracker().initial_state_from(others).weather
    assert taught is not None and np.array_equal(taught.kind_mean, prior.kind_mean)
    dampers = prior.kind_mean[:, 1] < -0.01
    assert np.allclose(prior.kind_mean[dampers, 1] / weather.KELVIN, slope, atol=4e-4)
    assert np.all(prior.kind_std[dampers, 1] < tracker().weather.kind_std[dampers, 1])
    assert np.array_equal(prior.kind_mean[:, 2:], tracker().weather.kind_mean[:, 2:])  # of load and speed nothing


def test_a_repaired_damper_keeps_its_slope_and_learns_its_level() -> None:
    rng = np.random.default_rng(10)
    follow = tracker()
    state = day(rng, follow.initial_state(), 400, lambda k: warm(k)[1], lambda k: Conditions(temperature=warm(k)[0]))
    new = follow.relearn(state, [NAMES[15]])
    assert new.weather is not None and state.weather is not None
    assert new.weather.mean[15, 1] == state.weather.mean[15, 1]
    assert new.weather.mean[15, 0] == 0.0


def test_slow_signals_are_taken_beside_the_windows() -> None:
    beside = AuxiliaryMeans(2, 1)
    second = 1_000_000_000
    block = SampleBlock(
        np.array([0, 1, 2, 3, 4]) * second,
        np.array([0, 2, 1, 2, 2], dtype=np.int32),
        np.array([1.0, 10, 2, 20, np.nan]),
    )
    left = beside.keep(block)
    assert left.channel.tolist() == [0, 1]
    assert beside.to(Window(0, 1.0, np.zeros((2, 2)))).auxiliary == [10.0]
    assert beside.to(Window(second, 1.0, np.zeros((3, 2)))).auxiliary == [15.0]
    assert beside.to(Window(10 * second, 1.0, np.zeros((3, 2)))).auxiliary == [20.0]
    silent = beside.to(Window(90 * second, 1.0, np.zeros((3, 2)))).auxiliary
    assert silent is not None and np.isnan(silent)
