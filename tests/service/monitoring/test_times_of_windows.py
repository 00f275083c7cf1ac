"""A wrong clock costs no vehicle its monitoring, and a vehicle that is not monitored is not called well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.signals import Window
from sprung.model.system import System
from sprung.model.tracking.state import TrackerState
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.store import Store
from tests.service_fakes import HOP, START, make_window
from tests.tracker_windows import EPOCH, constant, correlated, make_tracker, step, windows

YEAR = 31_557_600 * 10**9
HOUR = 3600 * 10**9
NOW = START + 30 * 86_400 * 10**9


@pytest.fixture
def piped(engine: Engine, store: Store, compute: Compute) -> Pipeline:
    return Pipeline(engine, store, compute, clock=lambda: NOW)


def stream(system: System, count: int, shift: int, first: int = 0) -> list[Window]:
    made = [make_window(system, first + i, level=0.05) for i in range(count)]
    return [replace(w, start=w.start + shift, new_segment=i == 0 and shift != 0) for i, w in enumerate(made)]


@pytest.mark.parametrize("shift", [-HOUR, -5 * HOP, -HOP // 2, -50 * YEAR])
def test_windows_after_a_clock_that_stepped_back_are_tracked(piped: Pipeline, system: System, shift: int) -> None:
    before = [make_window(system, i, level=0.05) for i in range(20)]
    after = [w for w in stream(system, 20, shift, first=20) if w.start not in {b.start for b in before}]
    after[0] = replace(after[0], new_segment=True)
    batch = piped.process("a", [*before, *after])
    assert batch.late == 0
    assert batch.state.used == 20 + len(after)
    assert piped.process("a", [make_window(system, 400)]).late == 0


def test_a_recording_from_the_future_does_not_make_its_vehicle_deaf(piped: Pipeline, system: System) -> None:
    piped.process("a", [replace(w, new_segment=False) for w in stream(system, 10, 14 * YEAR)])
    batch = piped.process("a", [make_window(system, i, level=0.05) for i in range(20)])
    assert batch.late == 0
    assert batch.state.used == 30
    older = piped.process("a", [make_window(system, -5)])
    assert older.late == 1  # late against a clock that may be right is late


def test_a_new_segment_is_followed_the_same_after_a_restart(
    engine: Engine, store: Store, compute: Compute, system: System
) -> None:
    whole = [*(make_window(system, i, level=0.05) for i in range(20)), *stream(system, 20, -HOUR, first=20)]
    for until in (7, 20, 21, 30, 40):  # as if the process had been killed and the file read again
        state = Pipeline(engine, store, compute, clock=lambda: NOW).process("a", whole[:until]).state
    at_once = Pipeline(engine, store, compute, clock=lambda: NOW).process("b", whole).state
    assert state.to_dict() == at_once.to_dict()


def test_a_change_under_way_is_found_though_the_clock_steps_back() -> None:
    rng = np.random.default_rng(11)
    tracker, covariance = make_tracker(), correlated(rng)
    state = tracker.update_many(tracker.initial_state(), windows(rng, constant(np.zeros(24)), 90, covariance))
    changed = windows(rng, step(24, 3, -0.05, 0.0), 90, covariance)
    for number, (estimate, time) in enumerate(changed):
        later = time + 90 * 10**9 - (HOUR if number >= 2 else 0)  # the clock is set just after the change began
        if number == 2:
            state = tracker.rebase(state, later)
        state = tracker.update(state, estimate, later)
    assert [alarm.parameter for alarm in state.active] == ["element_3.stiffness"]
    assert abs((state.active[0].onset - (EPOCH + 90 * 10**9 - HOUR)) * 1e-9) < 20
    assert state.used == 360


def test_rebasing_to_a_later_time_changes_nothing() -> None:
    tracker = make_tracker(3)
    state = tracker.initial_state()
    assert tracker.rebase(state, 5) is state
    state = replace(state, time=100)
    assert tracker.rebase(state, 101) is state


def test_a_vehicle_of_which_nothing_can_be_used_is_not_called_well() -> None:
    rng = np.random.default_rng(4)
    tracker, covariance = make_tracker(), correlated(rng)
    nothing = tracker.initial_state()
    assert tracker.health(nothing) == "check_function"
    missed = tracker.missed(nothing)
    assert tracker.health(missed) == "check_function"
    well = tracker.update_many(nothing, windows(rng, constant(np.zeros(24)), 60, covariance))
    assert tracker.health(well) == "ok"
    state = well
    for count in range(40):
        assert tracker.health(state) == ("ok" if count < 28 else "check_function")
        state = tracker.missed(state)
    assert tracker.health(TrackerState.from_dict(state.to_dict())) == "check_function"
    older = {name: part for name, part in well.to_dict().items() if name != "coverage"}
    assert tracker.health(TrackerState.from_dict(older)) == "ok"


def test_dropped_windows_reach_the_health_of_a_vehicle(piped: Pipeline, system: System) -> None:
    batch = piped.process("a", [make_window(system, i, outcome="dropped") for i in range(5)])
    assert piped.engine.tracker.health(batch.state) == "check_function"
    again = piped.process("a", [make_window(system, i, outcome="dropped") for i in range(5)])
    assert again.state.coverage.windows == 5
    batch = piped.process("a", [make_window(system, 5 + i, level=0.05) for i in range(40)])
    assert piped.engine.tracker.health(batch.state) == "ok"
