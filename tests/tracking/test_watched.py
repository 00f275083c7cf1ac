"""Whether a vehicle is watched: windows that cannot be used are no peace, whatever the reason."""

import numpy as np
import pytest

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.identify import Identifier
from sprung.model.signals import Conditions, FloatArray, MeasurementFault
from sprung.model.system import System, load_system
from sprung.model.tracking.tracker import Tracker, TrackerState
from tests.tracker_windows import EPOCH, constant, correlated, estimate, make_tracker, windows

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def system() -> System:
    return load_system()


@pytest.fixture(scope="module")
def running(system: System) -> FloatArray:
    rng = np.random.default_rng(1)
    return simulate_runs(system, np.zeros((12, len(system.parameters))), system.window, rng, speed=(40.0, 50.0)).values


def learned() -> tuple[Tracker, TrackerState, FloatArray]:
    rng = np.random.default_rng(2)
    tracker, covariance = make_tracker(), correlated(np.random.default_rng(3))
    state = tracker.update_many(tracker.initial_state(), windows(rng, constant(np.zeros(24)), 40, covariance))
    assert tracker.health(state) == "ok"
    return tracker, state, covariance


@pytest.mark.parametrize(
    ("changes", "conditions"),
    [
        ({"informative": False}, Conditions(speed=30.0)),
        ({"adequate": False, "chi_square": 9.0}, Conditions(lateral=0.7)),
        ({"identifiable": np.zeros(24, dtype=bool)}, None),
    ],
)
def test_a_moving_vehicle_whose_windows_are_of_no_use_is_not_watched(
    changes: dict[str, object], conditions: Conditions | None
) -> None:
    tracker, state, covariance = learned()
    for k in range(40):
        told = estimate(np.zeros(24), covariance, **changes)
        state = tracker.update(state, told, EPOCH + (100 + k) * SECOND, conditions)
    assert tracker.health(state) == "check_function"
    assert state.alarms == ()


@pytest.mark.parametrize("conditions", [None, Conditions(speed=0.0), Conditions(speed=2.0)])
def test_a_standing_vehicle_need_not_be_watched(conditions: Conditions | None) -> None:
    tracker, state, covariance = learned()
    still = estimate(np.zeros(24), covariance, informative=False)
    for k in range(40):
        state = tracker.update(state, still, EPOCH + (100 + k) * SECOND, conditions)
    assert tracker.health(state) == "ok"


def test_a_vehicle_that_runs_too_slowly_to_be_identified_is_watched_for_a_while_only() -> None:
    tracker, state, covariance = learned()
    noisy = estimate(np.zeros(24), covariance, informative=False, running=True)
    held = round(tracker.settings.holding)
    for _ in range(1, held):
        state = tracker.update(state, noisy, (state.time or 0) + SECOND)
    assert tracker.health(state) == "ok"  # nothing fails within less than two minutes
    crawled = state
    for _ in range(40):
        state = tracker.update(state, noisy, (state.time or 0) + SECOND)
        crawled = tracker.update(crawled, noisy, state.time or 0, Conditions(speed=2.0))
    assert tracker.health(state) == "check_function"
    assert tracker.health(crawled) == "ok"


@pytest.mark.parametrize("running", [False, True])
def test_a_silent_channel_does_not_say_that_a_vehicle_runs(running: bool) -> None:
    """Standing, or too slow to be identified for less than two minutes."""
    tracker, state, covariance = learned()
    silent = (MeasurementFault("bogie1_1l", "silent", 0.0),)
    told = estimate(np.zeros(24), covariance, informative=False, running=running, faults=silent)
    for _ in range(40):
        state = tracker.update(state, told, (state.time or 0) + SECOND)
    assert state.coverage.monitored
    assert [alarm.parameter for alarm in state.active] == ["bogie1_1l.silent"]


def test_inputs_that_all_repeat_their_last_values_are_no_standstill(system: System, running: FloatArray) -> None:
    inputs, frozen = len(system.inputs), running.copy()
    frozen[:, :, :inputs] = running[:, :1, :inputs]
    examined = Identifier(system).examine(np.concatenate([running, frozen, running]), np.zeros(36, dtype=bool))
    tracker = Tracker(system.parameters)
    state = tracker.initial_state()
    for k, told in enumerate(examined[:24]):
        state = tracker.update(state, told, EPOCH + k * SECOND)
    (alarm,) = state.active
    assert alarm.parameter is not None
    assert (alarm.kind, alarm.parameter.rpartition(".")[2]) == ("sensor", "frozen")
    assert alarm.parameter.count("|") == inputs - 1
    assert tracker.health(state) == "check_function"
    for k, told in enumerate(examined[24:]):
        state = tracker.update(state, told, EPOCH + (24 + k) * SECOND)
    assert state.active == ()


def test_coarse_inputs_of_a_standing_vehicle_are_no_fault(system: System) -> None:
    rng = np.random.default_rng(4)
    noise = np.array([channel.noise for channel in system.channels])
    still = noise * rng.standard_normal((3, system.window, len(noise)))
    still[:, :, : len(system.inputs)] = 0.0  # less than a step of the converter
    still[:, :, len(system.inputs)] *= 30  # somebody works on the car
    examined = Identifier(system).examine(still, np.zeros(3, dtype=bool))
    assert not any(told.informative or told.faults for told in examined)


@pytest.mark.parametrize(("speed", "watched"), [(7.0, True), (30.0, False)])
def test_a_vehicle_that_is_too_slow_is_watched_for_a_while_and_one_without_its_channels_is_not(
    speed: float, watched: bool
) -> None:
    tracker, state, covariance = learned()
    lost = tuple(MeasurementFault(f"wheel_{k}", "silent", 0.0) for k in range(4)) if not watched else ()
    nothing = np.zeros(24, dtype=bool)
    told = estimate(np.zeros(24), covariance, informative=False, running=True, identifiable=nothing, faults=lost)
    for k in range(60):
        state = tracker.update(state, told, EPOCH + (40 + k) * SECOND, Conditions(speed=min(speed, 9.0)))
    assert state.coverage.monitored == watched
    assert tracker.health(state) == ("ok" if watched else "check_function")
