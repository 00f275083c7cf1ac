"""Loads of a running vehicle: steps at stops and on the way, limits, air-spring pressure, curves."""

from collections.abc import Callable

import numpy as np
import pytest

from sprung.model.identification.measurements.deviations import Deviation
from sprung.model.signals import Conditions, Deviating
from sprung.model.system import parse_system
from sprung.model.tracking.load_alarms import LoadLimit
from sprung.model.tracking.tracker import Tracker, TrackerSettings, TrackerState
from tests.tracker_windows import EPOCH, TrackedParameter, correlated, estimate

SECOND = 1_000_000_000
STD = np.repeat([0.004, 0.006, 0.02, 0.01], [8, 4, 8, 4])
TAKES = np.repeat([0.0, 1.0, 0.0, 0.5], [8, 4, 8, 4])  # of the parameters, were the load another than assumed
SEEN = 0.01  # standard deviation of the load that one window gives
EMPTY = 32000.0


def follow(most: float | None = None, least: float | None = None) -> Tracker:
    parameters = [TrackedParameter(f"element_{i}.{q}") for q in ("stiffness", "damping") for i in range(12)]
    limits = {"car": LoadLimit(EMPTY, least, most)}
    return Tracker(parameters, TrackerSettings(), [Deviation("car", "load", 0.15, -1)], limits=limits)


def ride(
    rng: np.random.Generator,
    tracker: Tracker,
    state: TrackerState,
    seconds: int,
    load: Callable[[int], float],
    first: int = 0,
    conditions: Callable[[int], Conditions | None] = lambda k: None,
    **changes: object,
) -> TrackerState:
    """Windows of a second, one after the other; `load`: logarithm of the loaded mass, by second."""
    covariance = correlated(rng, STD)
    root = np.linalg.cholesky(covariance)
    for k in range(first, first + seconds):
        carried = load(k) + SEEN * rng.normal()
        value = root @ rng.normal(size=24) + TAKES * (carried - load(k))
        found = Deviating(
            np.array([carried]), covariance, TAKES[:, None], np.array([[SEEN**-2]]), np.zeros(1), 300.0, False
        )
        both = covariance + SEEN**2 * np.outer(TAKES, TAKES)
        told = estimate(value, both, deviating=found, **changes)
        state = tracker.update(state, told, EPOCH + k * SECOND, conditions(k))
    return state


def constant(load: float) -> Callable[[int], float]:
    return lambda k: load


def pressure(load: float) -> Callable[[int], Conditions]:
    return lambda k: Conditions(pressure=(4.2e5 * float(np.exp(load)),))


def with_its_gauge_known(rng: np.random.Generator, tracker: Tracker) -> tuple[TrackerState, int]:
    """After four rides of a minute with a gauge in order, and when the next begins."""
    state, at = tracker.initial_state(), 0
    for load in (0.0, 0.2, -0.1, 0.1):
        state = ride(rng, tracker, state, 60, constant(load), at, pressure(load))
        at += 100
    return state, at


def worst(tracker: Tracker, state: TrackerState) -> float:
    mean, std = tracker.posterior(state)
    return float(np.abs(mean / std).max())


@pytest.mark.parametrize("step", [-0.3, 0.3])
@pytest.mark.parametrize("stop", [0, 40])
def test_a_step_of_the_load_raises_nothing_and_is_known_within_half_a_minute(step: float, stop: int) -> None:
    rng = np.random.default_rng(1)
    tracker, new = follow(), np.log1p(step)
    state = ride(rng, tracker, tracker.initial_state(), 60, lambda k: 0.0)
    largest = 0.0
    for k in range(60 + stop, 90 + stop):
        state = ride(rng, tracker, state, 1, lambda k: new, k)
        largest = max(largest, worst(tracker, state))
    value, std = tracker.loads(state)["car"]
    assert abs(value - new) < 0.02
    assert std < 0.01
    assert largest < 4.0
    assert state.alarms == ()
    assert tracker.health(state) == "ok"


def test_a_moment_that_looks_like_another_load_moves_neither_load_nor_springs() -> None:
    rng, tracker = np.random.default_rng(21), follow()
    state = ride(rng, tracker, tracker.initial_state(), 60, constant(0.1))
    before, used = tracker.loads(state)["car"], state.used
    level = tracker.posterior(state)[0]
    bent = ride(rng, tracker, state, 2, constant(0.4), 60)  # as where a curve begins
    assert bent.used == used and bent.rejected == 2
    assert tracker.loads(bent)["car"][0] == pytest.approx(before[0])
    assert np.abs(tracker.posterior(bent)[0] - level).max() < 1e-3
    straight = ride(rng, tracker, bent, 10, constant(0.1), 62)
    assert straight.rejected == 2
    assert tracker.loads(straight)["car"] == pytest.approx((0.1, 0.004), abs=0.01)


def test_a_clock_that_steps_back_leaves_no_load_in_dispute() -> None:
    rng, tracker = np.random.default_rng(22), follow()
    state = ride(rng, tracker, tracker.initial_state(), 61, lambda k: 0.1 if k < 60 else 0.4)
    assert state.rejected == 1
    back = tracker.rebase(state, EPOCH - 3600 * SECOND)
    moved = ride(rng, tracker, back, 10, constant(0.4), -3600)
    assert tracker.loads(moved)["car"][0] == pytest.approx(0.4, abs=0.02)


def test_more_than_the_car_may_carry_is_an_alarm_until_it_is_let_down() -> None:
    rng = np.random.default_rng(2)
    tracker = follow(most=6000.0)
    state = ride(rng, tracker, tracker.initial_state(), 60, lambda k: np.log1p(0.1))
    assert state.alarms == ()
    state = ride(rng, tracker, state, 30, lambda k: np.log1p(0.25), 100)
    (alarm,) = state.active
    assert (alarm.kind, alarm.parameter) == ("load", "car.load")
    assert alarm.change == pytest.approx(0.25 - 6000 / EMPTY, abs=0.01)
    assert tracker.health(state) == "maintenance_required"
    state = ride(rng, tracker, state, 30, lambda k: np.log1p(0.1), 200)
    assert state.active == ()


def test_less_than_the_least_is_an_alarm_too() -> None:
    rng = np.random.default_rng(3)
    tracker = follow(least=1000.0)
    state = ride(rng, tracker, tracker.initial_state(), 60, lambda k: 0.0)
    assert [a.parameter for a in state.active] == ["car.load"]
    (alarm,) = state.active
    assert alarm.change is not None and alarm.change < 0


def test_pressure_determines_the_load_at_once_when_its_constant_is_known() -> None:
    rng = np.random.default_rng(4)
    tracker = follow()
    state, at = with_its_gauge_known(rng, tracker)
    assert state.cargo is not None and state.cargo.constant[0] == pytest.approx(np.log(4.2e5), abs=0.02)
    state = ride(rng, tracker, state, 1, lambda k: 0.25, at, pressure(0.25))
    value, std = tracker.loads(state)["car"]
    assert value == pytest.approx(0.25, abs=0.03)
    assert std < 0.01  # a window alone gives SEEN
    assert state.cargo is not None and state.cargo.prior_variance[0] < 0.02**2


def test_a_gauge_that_is_stuck_falsifies_no_load_for_long_and_is_soon_not_accepted() -> None:
    rng = np.random.default_rng(6)
    tracker = follow()
    wrong: list[bool] = []
    state, at = with_its_gauge_known(rng, tracker)
    for load in (0.25, -0.2, 0.2, -0.25, 0.15):
        for k in range(at, at + 60):
            state = ride(rng, tracker, state, 1, constant(load), k, pressure(0.1))
            value, std = tracker.loads(state)["car"]
            wrong.append(abs(value - load) > 4 * std)
        at += 100
    assert sum(wrong[:60]) <= 5
    assert sum(wrong[60:]) == 0
    assert state.alarms == ()
    assert state.cargo is not None and state.cargo.scatter[0] > 0.05**2


def test_windows_that_do_not_fit_in_a_measured_curve_are_passed_over() -> None:
    rng = np.random.default_rng(5)
    tracker = follow()
    state = ride(rng, tracker, tracker.initial_state(), 60, lambda k: 0.0)
    bent = ride(
        rng, tracker, state, 40, lambda k: 0.0, 60, lambda k: Conditions(lateral=1.2), adequate=False, chi_square=9.0
    )
    assert bent.active == ()
    assert bent.idle == 40
    assert tracker.health(bent) == "check_function"  # nobody has watched for 40 s
    straight = ride(rng, tracker, state, 40, lambda k: 0.0, 60, adequate=False, chi_square=9.0)
    assert [a.kind for a in straight.active] == ["misfit"]


FILE = """
name: measured beside
sample_rate: 100
window: 100
speed: {csv: v, unit: km/h}
temperature: {csv: T, unit: K}
yaw_rate: {csv: turn, unit: deg/s}
bodies: {car: {mass: 1000, load: {min: 0, max: 300, pressure: {csv: p, unit: bar}}}}
inputs: {road: {kind: displacement, displacement: {csv: road}}}
elements: {spring: {upper: car, lower: road, stiffness: 40000, damping: {value: 2000, fixed: true}}}
sensors: {a: {kind: acceleration, body: car, csv: a}}
"""


def test_a_system_file_says_where_conditions_are_measured() -> None:
    system = parse_system(FILE)
    assert [c.name for c in system.auxiliary] == ["speed", "temperature", "yaw_rate", "car.pressure"]
    gains = np.array([[c.gain, c.offset] for c in system.auxiliary])
    conditions = system.conditions(np.array([20.0, 5.0, 0.05, 3e5]))
    assert conditions.speed == 20.0
    assert conditions.lateral == pytest.approx(1.0)
    assert conditions.curving
    assert conditions.pressure == (3e5,)
    assert gains[1].tolist() == [1.0, -273.15]
    plain = "\n".join(line for line in FILE.split("\n") if not line.startswith(("speed", "temp", "yaw")))
    assert parse_system(plain).digest == system.digest  # how it runs makes no other vehicle
    assert not parse_system(plain).conditions(None).curving


def test_windows_without_what_they_say_of_loads_are_not_moved_by_the_load_again() -> None:
    """As a vehicle sends them: loads are refined with every window; every second one says what it knows of them."""
    rng = np.random.default_rng(6)
    tracker, load = follow(), np.log(1.2)
    covariance = correlated(rng, STD)
    root = np.linalg.cholesky(covariance)
    both = covariance + SEEN**2 * np.outer(TAKES, TAKES)
    state = tracker.initial_state()
    for k in range(60):
        carried = load + SEEN * rng.normal()
        value = root @ rng.normal(size=24) + TAKES * (carried - load)
        found = Deviating(
            np.array([carried]), covariance, TAKES[:, None], np.array([[SEEN**-2]]), np.zeros(1), 300.0, True
        )
        told = estimate(value, both, deviating=found if k % 2 == 0 else None)
        state = tracker.update(state, told, EPOCH + k * SECOND)
    assert tracker.loads(state)["car"][0] == pytest.approx(load, abs=0.01)
    assert worst(tracker, state) < 4.0
    assert np.abs(tracker.posterior(state)[0]).max() < 0.02


def test_after_a_stop_the_load_is_that_of_the_ride_before_until_a_window_determines_the_new_one() -> None:
    rng, tracker = np.random.default_rng(8), follow()
    state = ride(rng, tracker, tracker.initial_state(), 60, constant(0.1))
    assert tracker.loads_as_of(state) is None
    stood = ride(rng, tracker, state, 30, constant(0.3), first=60, informative=False)
    assert tracker.loads_as_of(stood) == EPOCH + 59 * SECOND
    assert tracker.loads(stood) == tracker.loads(state)
    rides = ride(rng, tracker, stood, 2, constant(0.3), first=90)
    assert tracker.loads_as_of(rides) is None
    assert abs(tracker.loads(rides)["car"][0] - 0.3) < 0.05


def test_a_run_that_does_not_determine_the_load_yet_leaves_that_of_the_run_before_with_its_time() -> None:
    rng, tracker = np.random.default_rng(14), follow()
    state = ride(rng, tracker, tracker.initial_state(), 60, constant(np.log1p(0.2)))
    assert tracker.loads_as_of(state) is None
    before, covariance = tracker.loads(state)["car"], correlated(rng, 100 * STD)
    vague = Deviating(np.zeros(1), covariance, TAKES[:, None], np.array([[0.3**-2]]), np.zeros(1), 300.0, False)
    state = tracker.update(state, estimate(np.zeros(24), covariance, deviating=vague), EPOCH + 100 * SECOND)
    assert tracker.loads(state)["car"] == pytest.approx(before)
    assert tracker.loads_as_of(state) == EPOCH + 59 * SECOND
    again = TrackerState.from_dict(state.to_dict())
    assert (tracker.loads(again), tracker.loads_as_of(again)) == (tracker.loads(state), tracker.loads_as_of(state))
    state = ride(rng, tracker, state, 20, constant(0.0), 101)
    assert abs(tracker.loads(state)["car"][0]) < 0.02
    assert tracker.loads_as_of(state) is None
