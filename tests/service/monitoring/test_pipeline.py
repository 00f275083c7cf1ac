"""Windows through the pipeline: once, in order, across restarts, threads and processes."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import func, select

from sprung.model.signals import Window
from sprung.model.system import System
from sprung.service.errors import Busy
from sprung.service.monitoring.compute import Compute, Priority
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.store import Store, fleet, open_store, status
from sprung.service.store.schema import windows
from tests.service_fakes import HOP, START, FakeExaminer, FakeIdentifier, hold, make_window


@pytest.fixture
def store(any_store: Store) -> Store:
    """Whatever is said here holds on every database."""
    return any_store


def count(store: Store, table: object) -> int:
    with store.read() as connection:
        return connection.execute(select(func.count()).select_from(table)).scalar_one()  # type: ignore[arg-type]


def test_estimates_reach_store_and_tracker(pipeline: Pipeline, store: Store, system: System) -> None:
    batch = pipeline.process("a", [make_window(system, i, level=0.05) for i in range(20)])
    mean, _ = pipeline.engine.tracker.posterior(batch.state)
    np.testing.assert_allclose(mean, 0.05, atol=1e-3)
    assert count(store, windows) == 20
    assert all(record.posterior is not None for record in batch.records)
    assert set(batch.seconds) == {"estimate", "refine", "track", "store"}


def test_the_same_windows_again_are_neither_identified_nor_tracked(
    pipeline: Pipeline, store: Store, system: System, identifier: FakeIdentifier
) -> None:
    batch = [make_window(system, i, level=0.01 * i) for i in range(10)]
    first = pipeline.process("a", batch)
    again = pipeline.process("a", batch)
    assert identifier.identified == 10
    assert count(store, windows) == 10
    assert again.fresh == []
    assert again.state.to_dict() == first.state.to_dict()
    for old, new in zip(first.records, again.records, strict=True):
        assert old.start == new.start
        assert old.posterior is not None and new.posterior is not None
        np.testing.assert_array_equal(old.posterior.log_ratio, new.posterior.log_ratio)


def test_a_restart_goes_on_where_it_stopped(engine: Engine, tmp_path: Path, system: System) -> None:
    stream = [make_window(system, i, level=0.002 * i) for i in range(60)]
    in_one_go = _run(engine, tmp_path / "one.db", [stream])
    interrupted = _run(engine, tmp_path / "two.db", [stream[:23], stream[:40], stream])
    assert interrupted == in_one_go


def _run(engine: Engine, path: Path, sessions: list[list[Window]]) -> dict[str, object]:
    state: dict[str, object] = {}
    for session in sessions:
        store, compute = open_store(str(path)), Compute(4)
        pipeline = Pipeline(engine, store, compute)
        for first in range(0, len(session), 7):
            state = pipeline.process("a", session[first : first + 7]).state.to_dict()
        compute.close()
        store.close()
    return state


def test_windows_older_than_the_trackers_are_stored_but_not_tracked(pipeline: Pipeline, system: System) -> None:
    after = pipeline.process("a", [make_window(system, i) for i in range(10, 20)]).state
    late = pipeline.process("a", [make_window(system, 3, level=0.5)])
    assert late.late == 1
    assert not late.records[0].tracked
    assert late.state.to_dict() == after.to_dict()


def test_lasting_faults_of_a_vehicle_are_told_to_those_who_examine_its_windows(
    engine: Engine, store: Store, compute: Compute, system: System
) -> None:
    examiner = FakeExaminer(system)
    pipeline = Pipeline(replace(engine, identifier=examiner), store, compute)
    pipeline.process("a", [make_window(system, i) for i in range(8)])
    pipeline.process("b", [make_window(system, 0)])
    pipeline.process("a", [make_window(system, 8)])
    assert examiner.told == [()] * 9 + [examiner.faults]


def test_windows_are_identified_anew_where_those_before_them_tell_of_other_faults(
    engine: Engine, store: Store, compute: Compute, system: System
) -> None:
    """However far identifying is ahead of tracking, and also after a start: a replay always comes to the same."""
    examiner = FakeExaminer(system)
    pipeline = Pipeline(replace(engine, identifier=examiner), store, compute)
    first = pipeline.identify("a", [make_window(system, i) for i in range(8)])
    second = pipeline.identify("a", [make_window(system, i) for i in (8, 9)])
    pipeline.keep(first)
    batch = pipeline.keep(second)
    assert [record.start for record in batch.records] == [START + 8 * HOP, START + 9 * HOP]
    assert examiner.told == [()] * 10 + [examiner.faults] * 2
    examiner.told.clear()
    Pipeline(replace(engine, identifier=examiner), store, compute).process("a", [make_window(system, 10)])
    assert examiner.told == [(), examiner.faults]
    assert count(store, windows) == 11


def test_dropped_windows_are_counted_and_are_uninformative(
    pipeline: Pipeline, store: Store, system: System, identifier: FakeIdentifier
) -> None:
    batch = pipeline.process("a", [make_window(system, 0), make_window(system, 1, outcome="dropped")])
    assert identifier.identified == 1
    assert [r.outcome for r in batch.records] == ["used", "dropped"]
    assert batch.records[1].solved is None and batch.records[1].reason == "gap"
    assert batch.late == 0
    with store.read() as connection:
        assert status.fleet_row(connection, "a").windows == {  # type: ignore[union-attr]
            "used": 1,
            "repaired": 0,
            "dropped": 1,
            "uninformative": 0,
            "unfitting": 0,
        }


def test_vehicles_do_not_touch_each_other(pipeline: Pipeline, system: System) -> None:
    pipeline.process("a", [make_window(system, i, level=0.1) for i in range(10)])
    pipeline.process("b", [make_window(system, i, level=-0.1) for i in range(10)])
    mean, _ = pipeline.engine.tracker.posterior(pipeline.state("a"))
    np.testing.assert_allclose(mean, 0.1, atol=2e-3)


def test_two_processes_replaying_one_file_feed_the_tracker_once(
    engine: Engine, store: Store, system: System, tmp_path: Path
) -> None:
    stream = [make_window(system, i, level=0.002 * i) for i in range(80)]
    expected = _run(engine, tmp_path / "alone.db", [stream])
    errors: list[BaseException] = []

    def replay() -> None:
        url = store.engine.url.render_as_string(hide_password=False)
        other, compute = open_store(url), Compute(4)
        try:
            mine = Pipeline(engine, other, compute)
            for first in range(0, len(stream), 5):
                mine.process("a", stream[first : first + 5])
        except BaseException as error:
            errors.append(error)
        finally:
            compute.close()
            other.close()

    threads = [threading.Thread(target=replay) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    compute = Compute(4)
    assert Pipeline(engine, store, compute).state("a").to_dict() == expected
    compute.close()
    assert count(store, windows) == 80


def test_alarms_of_the_tracker_reach_the_store(pipeline: Pipeline, store: Store, system: System) -> None:
    pipeline.process("a", [make_window(system, i) for i in range(80)])  # learning takes 30 s
    batch = pipeline.process("a", [make_window(system, i, level=0.2) for i in range(80, 140)])
    assert batch.state.active
    with store.read() as connection:
        stored = fleet.list_alarms(connection, fleet.WantedAlarms("a"), 100)
    assert {a.parameter for a in stored} == {a.parameter for a in batch.state.active}
    assert all(a.change == pytest.approx(np.expm1(0.2), abs=0.01) for a in stored)
    assert all(abs(a.onset - (START + 80 * HOP)) < 4 * 10**9 for a in stored)


def test_requests_overtake_recordings() -> None:
    compute, release, order = Compute(8), threading.Event(), []
    first = compute.submit(release.wait)
    batch = compute.submit(lambda: order.append("batch"), Priority.BATCH)
    request = compute.submit(lambda: order.append("request"), Priority.REQUEST)
    release.set()
    for future in (first, batch, request):
        future.result(timeout=5)
    compute.close()
    assert order == ["request", "batch"]


def test_a_full_queue_refuses_and_closing_finishes_what_was_accepted() -> None:
    compute, release, done = Compute(2), threading.Event(), []
    started = threading.Event()
    compute.submit(lambda: hold(started, release))
    started.wait(5)
    for number in range(2):
        compute.submit(lambda number=number: done.append(number))  # type: ignore[misc]
    with pytest.raises(Busy):
        compute.submit(lambda: None)
    release.set()
    compute.close()
    assert done == [0, 1]
    with pytest.raises(Busy):
        compute.submit(lambda: None)


def test_an_error_of_the_numerics_reaches_whoever_waits() -> None:
    compute = Compute(2)
    with pytest.raises(ZeroDivisionError):
        compute.run(lambda: 1 / 0)
    assert compute.run(lambda: 2) == 2
    compute.close()


def test_a_crowd_of_new_vehicles_asks_the_others_seldom(
    pipeline: Pipeline, system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What others have learned of the weather is read again when there are a tenth more of them."""
    asked = 0
    read = fleet.latest_trackers

    def counted(*arguments: object) -> list[fleet.TrackerRow]:
        nonlocal asked
        asked += 1
        return read(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(fleet, "latest_trackers", counted)
    for number in range(45):
        pipeline.process(f"v-{number}", [make_window(system, 0)])
    assert 10 < asked < 30
