"""A train's day: it stands, crawls and runs on; sensors fail; nothing of this is a change of a spring."""

import numpy as np
import pytest

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.identify import Identifier
from sprung.model.signals import FloatArray
from sprung.model.system import System, load_system
from sprung.model.tracking import inflation
from sprung.model.tracking.rules import TRACKING_RULES
from sprung.model.tracking.tracker import Tracker, TrackerState
from tests.tracker_windows import EPOCH, constant, correlated, estimate, make_tracker, windows

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def system() -> System:
    return load_system()


def standing(system: System, seconds: int, level: float, rng: np.random.Generator) -> FloatArray:
    """Windows of nothing but noise, `level` times what the system file says."""
    noise = level * np.array([channel.noise for channel in system.channels])
    return noise * rng.standard_normal((seconds, system.window, len(noise)))


def running(
    system: System, seconds: int, rng: np.random.Generator, speed: tuple[float, float] = (40.0, 50.0)
) -> FloatArray:
    return simulate_runs(system, np.zeros((seconds, len(system.parameters))), system.window, rng, speed=speed).values


@pytest.mark.parametrize("level", [0.3, 0.7, 1.0, 1.5])
def test_a_stop_at_a_station_raises_nothing_and_is_uninformative(system: System, level: float) -> None:
    rng = np.random.default_rng(int(10 * level))
    parts = [running(system, 40, rng), standing(system, 40, level, rng), running(system, 15, rng)]
    estimates = Identifier(system).identify(np.concatenate(parts))
    assert not any(e.informative for e in estimates[40:80])
    assert all(e.informative and e.adequate for e in estimates[:40] + estimates[80:])
    tracker = Tracker(system.parameters)
    state = tracker.initial_state()
    for k, e in enumerate(estimates):
        state = tracker.update(state, e, EPOCH + k * SECOND)
        assert tracker.health(state) == "ok"
    assert state.alarms == ()
    assert state.idle == 40
    assert state.used == 55
    assert state.fit.statistic == 0.0


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0, 3.0, 5.0])
def test_a_crawling_train_does_not_ask_for_a_check(system: System, speed: float) -> None:
    rng = np.random.default_rng(3)
    estimates = Identifier(system).identify(running(system, 30, rng, (speed, 1.0001 * speed)))
    tracker = Tracker(system.parameters)
    state = tracker.initial_state()
    for k, e in enumerate(estimates):
        state = tracker.update(state, e, EPOCH + k * SECOND)
        assert state.fit.misfit_since is None
    assert state.alarms == ()
    assert state.idle + state.used + state.rejected == 30
    assert state.rejected <= 1


def test_doors_and_passengers_of_a_standing_train_are_not_a_misfit(system: System) -> None:
    rng = np.random.default_rng(5)
    windows = standing(system, 10, 1.0, rng)
    pushed = 0.05 * np.sin(2 * np.pi * 1.1 * np.arange(system.window) / system.sample_rate)
    windows[:, :, 16:20] += pushed[:, None] * rng.uniform(0.3, 1, (10, 1, 4))  # the car is rocked from inside
    assert not any(e.informative for e in Identifier(system).identify(windows))


def test_a_moving_train_whose_sensor_is_wrong_is_still_a_misfit(system: System) -> None:
    rng = np.random.default_rng(6)
    windows = running(system, 5, rng)
    windows[:, :, 20] *= -1
    for e in Identifier(system).identify(windows):
        assert e.informative
        assert not e.adequate


def test_the_noise_floor_is_fixed_although_one_parameter_is_never_identified() -> None:
    rng = np.random.default_rng(7)
    tracker = make_tracker()
    state = tracker.initial_state()
    told = np.arange(24) != 5
    covariance = correlated(rng)
    stream = windows(rng, constant(np.zeros(24)), 500, covariance)
    for k, (e, time) in enumerate(stream):
        level = 0.5 * np.exp(0.65 * k / len(stream))  # the residual nearly doubles, slowly
        blind = estimate(e.log_ratio, covariance, identifiable=told, chi_square=level * np.exp(0.05 * rng.normal()))
        state = tracker.update(state, blind, time)
    assert state.fit.windows == TRACKING_RULES.misfit.windows
    assert [alarm.kind for alarm in state.alarms] == ["misfit"]


def test_relearning_one_parameter_leaves_the_noise_floor_as_it_is() -> None:
    rng = np.random.default_rng(8)
    tracker = make_tracker()
    stream = windows(rng, constant(np.zeros(24)), 80, correlated(rng))
    state = tracker.update_many(tracker.initial_state(), stream[:80])
    floor = state.fit.windows, state.fit.mean
    state = tracker.update_many(tracker.relearn(state, [tracker.names[3]]), stream[80:])
    assert (state.fit.windows, state.fit.mean) == floor


def test_a_parameter_seen_every_other_minute_is_not_compared_across_it() -> None:
    running = inflation.start((2,))
    everything, one = np.ones(2, dtype=bool), np.array([True, False])
    variance = np.full(2, 1e-4)
    running = inflation.update(running, np.zeros(2), variance, everything, time=0, window=10)
    for k in range(1, 12):
        running = inflation.update(running, np.zeros(2), variance, one, time=10 * k, window=10)
    before = running.square[0]
    running = inflation.update(running, np.full(2, 0.5), variance, everything, time=120, window=10)
    assert running.square[0] > before + 0.1  # a true contradiction of neighbours
    assert running.square[1] == 1.0  # two minutes apart: a drift, for all one knows


def test_a_state_of_the_first_format_is_taken_over() -> None:
    rng = np.random.default_rng(9)
    tracker = make_tracker(3)
    state = tracker.update_many(
        tracker.initial_state(), windows(rng, constant(np.zeros(3)), 5, correlated(rng, np.full(3, 0.01)))
    )
    old = state.to_dict() | {"format": 1, "anchored": state.last}
    del old["idle"], old["scatter"]["anchored"]
    again = TrackerState.from_dict(old)
    assert again.used == state.used
    assert np.array_equal(again.belief.mean, state.belief.mean)
    assert np.all(again.inflation.anchored == state.last)
