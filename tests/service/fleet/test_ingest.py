"""Estimates from elsewhere: one effect of many deliveries, in order of time, on every database."""

from __future__ import annotations

import random
import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from sqlalchemy import event

from sprung.model.system import System
from sprung.service.errors import UserError
from sprung.service.fleet.ingest import Ingest, due_windows
from sprung.service.fleet.message import Message, WindowEstimate, decode, encode
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.store import Store, open_store
from sprung.service.store.status import StatusFilter, fleet_page
from sprung.service.store.windows import known_windows
from sprung.service.times import NANOSECONDS
from tests.service_fakes import HOP, START, make_window

LATE = 10.0


@pytest.fixture
def store(any_store: Store) -> Store:
    """Whatever is said here holds on every database."""
    return any_store


class Clock:
    """A clock that stands until it is set."""

    def __init__(self) -> None:
        self.now = START + 10_000 * HOP

    def __call__(self) -> int:
        return self.now


def messages(engine: Engine, system: System, count: int, size: int, vehicle: str = "north-1") -> list[Message]:
    """A vehicle's windows as an edge would send them, `size` a message."""
    found = []
    for first in range(0, count, size):
        windows = [make_window(system, i, level=0.001 * i) for i in range(first, min(count, first + size))]
        estimates, _ = engine.identify(np.stack([w.values for w in windows]), starts=[w.start for w in windows])
        sent = [
            WindowEstimate(w.start, w.outcome, w.reason, w.repaired_samples, w.new_segment, e)
            for w, e in zip(windows, estimates, strict=True)
        ]
        found.append(Message(vehicle, engine.digest, tuple(sent)))
    return found


def alone(engine: Engine, tmp_path_factory: pytest.TempPathFactory, found: list[Message]) -> dict[str, object]:
    """The tracker after the same estimates in order, one process, SQLite."""
    store, compute = open_store(str(tmp_path_factory.mktemp("alone") / "x.db")), Compute(4)
    ingest = Ingest(Pipeline(engine, store, compute), 0.0, Clock())
    for message in found:
        ingest.take([message])
    state = ingest._pipeline.state(found[0].vehicle).to_dict()
    compute.close()
    store.close()
    return state


def test_messages_sent_twice_and_in_any_order_come_to_the_same(
    engine: Engine, system: System, pipeline: Pipeline, tmp_path_factory: pytest.TempPathFactory
) -> None:
    clock = Clock()
    ingest = Ingest(pipeline, LATE, clock)
    sent = messages(engine, system, 60, 5)
    shuffled = [*sent[:1], *sent]
    rng = random.Random(4)
    for first in range(1, len(shuffled) - 4, 4):  # within the bound of 20 windows
        part = shuffled[first : first + 4]
        rng.shuffle(part)
        shuffled[first : first + 4] = part
    for message in shuffled:
        ingest.take([decode(encode(message, "exact"))])
        if rng.random() < 0.4:
            ingest.take([message])
    clock.now += round(LATE * NANOSECONDS)
    ingest.sweep()
    assert pipeline.state("north-1").to_dict() == alone(engine, tmp_path_factory, sent)
    assert ingest.sweep() == 0


def test_windows_that_came_by_a_clock_that_was_set_back_do_not_wait_for_it(
    engine: Engine, system: System, pipeline: Pipeline
) -> None:
    """Behind a gap they wait for seconds, not until the clock is there again."""
    clock = Clock()
    ingest = Ingest(pipeline, LATE, clock)
    first, _, third, *_ = messages(engine, system, 15, 5)
    ingest.take([first])
    clock.now += 400 * 86_400 * NANOSECONDS
    assert ingest.take([third])[0].waiting == 5
    clock.now -= 400 * 86_400 * NANOSECONDS
    assert ingest.sweep() == 5
    assert ingest.sweep() == 0


def test_many_vehicles_are_folded_with_the_statements_of_one(
    engine: Engine, system: System, pipeline: Pipeline, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """And come to the same as each alone, two messages of one vehicle among them."""
    ingest = Ingest(pipeline, 0.0, Clock())
    one = messages(engine, system, 24, 4)
    names = [f"north-{number}" for number in range(12)]
    statements: list[str] = []
    event.listen(pipeline.store.engine, "before_cursor_execute", lambda *told: statements.append(told[2]))
    counts = []
    for some in (["north-0"], names):
        for message in one[:4] if some == names else one[:2]:
            statements.clear()
            ingest.take([replace(message, vehicle=name) for name in some])
            counts.append(len(statements))
    assert counts[-1] <= counts[1] + 2  # of one vehicle that is known, and of twelve
    ingest.take([replace(message, vehicle=name) for message in one[4:] for name in names])
    expected = alone(engine, tmp_path_factory, one)
    assert all(pipeline.state(name).to_dict() == expected for name in names)
    with pipeline.store.read() as connection:
        lines = {row.id: row.windows for row in fleet_page(connection, StatusFilter(), "id", 50)}
    assert lines.keys() == set(names) and all(sum(counted.values()) >= 24 for counted in lines.values())


def test_what_is_reported_of_a_message(engine: Engine, system: System, pipeline: Pipeline) -> None:
    ingest = Ingest(pipeline, LATE, Clock())
    first, second, third = messages(engine, system, 60, 20)
    told = ingest.take([first])[0]
    assert (told.folded, told.waiting, told.known) == (0, 20, 0)  # nothing is known of what came before
    assert ingest.take([second])[0].folded == 40  # the start of the first is 10 s before: nothing earlier will come
    again = ingest.take([second])[0]
    assert (again.folded, again.waiting, again.known) == (0, 0, 20)
    both = ingest.take([third, replace(third, vehicle="north-2")])
    assert [t.vehicle for t in both] == ["north-1", "north-2"]
    assert both[0].folded == 20


def test_a_window_later_than_the_bound_is_stored_but_not_tracked(
    engine: Engine, system: System, pipeline: Pipeline, store: Store
) -> None:
    clock = Clock()
    ingest = Ingest(pipeline, LATE, clock)
    sent = messages(engine, system, 60, 10)
    for message in (sent[0], *sent[2:]):
        ingest.take([message])
    clock.now += round(LATE * NANOSECONDS)
    ingest.sweep()
    before = pipeline.state("north-1").to_dict()
    assert ingest.take([sent[1]])[0].folded == 10
    assert pipeline.state("north-1").to_dict() == before
    with store.read() as connection:
        found = known_windows(connection, "north-1", pipeline.model_id, [w.start for w in sent[1].windows])
    assert len(found) == 10 and not any(record.tracked for record in found.values())


def test_a_clock_that_steps_back_does_not_stop_the_tracker(engine: Engine, system: System, pipeline: Pipeline) -> None:
    ingest = Ingest(pipeline, 0.0, Clock())
    sent = messages(engine, system, 40, 20)
    ingest.take([sent[1]])
    stepped = replace(sent[0], windows=(replace(sent[0].windows[0], new_segment=True), *sent[0].windows[1:]))
    assert ingest.take([stepped])[0].folded == 20
    assert pipeline.state("north-1").used == 40


def test_deliveries_at_once_are_folded_once(
    engine: Engine, system: System, pipeline: Pipeline, store: Store, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Three receivers with connections of their own, each given every message."""
    sent = messages(engine, system, 60, 6)
    url = store.engine.url.render_as_string(hide_password=False)
    errors: list[BaseException] = []
    clock = Clock()

    def receive() -> None:
        other, compute = open_store(url), Compute(4)
        try:
            ingest = Ingest(Pipeline(engine, other, compute), LATE, clock)
            for message in sent:
                ingest.take([message])
        except BaseException as error:
            errors.append(error)
        finally:
            compute.close()
            other.close()

    threads = [threading.Thread(target=receive) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    clock.now += round(LATE * NANOSECONDS)
    Ingest(pipeline, LATE, clock).sweep()
    assert pipeline.state("north-1").to_dict() == alone(engine, tmp_path_factory, sent)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"model": "another"}, "same system file and weights"),
        ({"start": 0}, "before the year 2000"),
        ({"start": 2**62}, "in the future"),
        ({"width": 3}, "3 parameters"),
    ],
)
def test_messages_that_cannot_be_folded_are_refused_and_leave_nothing(
    engine: Engine, system: System, pipeline: Pipeline, change: dict[str, object], said: str
) -> None:
    good = messages(engine, system, 2, 2)[0]
    window = good.windows[1]
    assert window.estimate is not None
    bad = replace(good, model=str(change.get("model", good.model)))
    if "start" in change:
        bad = replace(bad, windows=(replace(window, start=change["start"]),))  # type: ignore[arg-type]
    if "width" in change:
        narrow = replace(window.estimate, log_ratio=np.zeros(3), covariance=np.eye(3))
        bad = replace(bad, windows=(replace(window, estimate=narrow),))
    with pytest.raises(UserError, match=said):
        Ingest(pipeline, 0.0, Clock()).take([replace(good, vehicle="other"), bad])
    assert pipeline.state("other").used == 0


def test_of_two_estimates_of_one_window_in_a_message_the_first_counts_and_the_other_is_known(
    engine: Engine, system: System, pipeline: Pipeline
) -> None:
    good = messages(engine, system, 3, 3)[0]
    taken = Ingest(pipeline, 0.0, Clock()).take([replace(good, windows=(*good.windows, good.windows[1]))])
    assert (taken[0].folded, taken[0].waiting, taken[0].known) == (3, 0, 1)


def test_windows_of_one_vehicle_that_cannot_be_folded_hold_up_no_other(
    engine: Engine, system: System, pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    ingest = Ingest(pipeline, LATE, clock)
    for vehicle in ("a", "b"):
        first, _, third = messages(engine, system, 3, 1, vehicle)
        ingest.take([first])
        ingest.take([third])
    clock.now += round(LATE * NANOSECONDS) + 1
    real = ingest._fold_due

    def failing(connection: Any, sent: Any, held: Any, now: int) -> Any:
        if sent[0].vehicle == "a":
            raise np.linalg.LinAlgError("singular")
        return real(connection, sent, held, now)

    monkeypatch.setattr(ingest, "_fold_due", failing)
    before = {vehicle: pipeline.state(vehicle).used for vehicle in "ab"}
    assert ingest.sweep() > 0
    assert pipeline.state("a").used == before["a"] and pipeline.state("b").used > before["b"]


def test_windows_wait_behind_a_gap_only() -> None:
    received = {start: 100 for start in (5, 6, 9, 10)}
    assert due_windows(received, 4, 1.01, 20, 101) == [5, 6]
    assert due_windows(received, 4, 1.01, 4, 101) == [5, 6]
    assert due_windows(received | {14: 101}, 4, 1.01, 4, 101) == [5, 6, 9, 10]
    assert due_windows(received, 4, 1.01, 20, 120) == [5, 6, 9, 10]
    assert due_windows({3: 100}, 4, 1.01, 20, 101) == [3]
    assert due_windows({}, 4, 1.01, 20, 101) == []
