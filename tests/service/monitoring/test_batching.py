"""Windows that come at once: identified in one batch, tracked in one transaction, each answered for itself."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import Connection
from sqlalchemy.exc import OperationalError

from sprung.model.system import System
from sprung.service.api.problems import ApiProblem
from sprung.service.core import Core, build_core
from sprung.service.errors import NO_THREAD, Busy
from sprung.service.monitoring import batching
from sprung.service.monitoring.batching import AnsweredWindow, AskedWindow
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.processed import FoldedWindows, WindowsToFold
from sprung.service.settings import Settings
from sprung.service.store.windows import known_starts
from sprung.service.times import NANOSECONDS
from tests.service_fakes import FakeExaminer

START = 1_790_000_000 * NANOSECONDS


@pytest.fixture
def running(core: Core) -> Iterator[Core]:
    yield core
    core.close()


def asked(core: Core, system: System, vehicle: str, second: int) -> AskedWindow:
    values = np.full((system.window, len(system.channels)), 0.01)
    return AskedWindow(values, core.pipeline.engines.shared, vehicle, start=START + second * NANOSECONDS)


def ready(one: AskedWindow) -> Callable[[], AskedWindow]:
    return lambda: one


def at_once(core: Core, reads: list[Callable[[], AskedWindow]]) -> list[AnsweredWindow | BaseException]:
    """Answers to windows that all wait when the numerics become free."""
    release = threading.Event()
    core.compute.submit(release.wait)

    async def together() -> list[AnsweredWindow | BaseException]:
        waiting = [asyncio.ensure_future(core.batcher.ask(read)) for read in reads]
        while core.batcher.waiting + sum(one.done() for one in waiting) < len(reads):
            await asyncio.sleep(0.005)
        release.set()
        return await asyncio.gather(*waiting, return_exceptions=True)

    return asyncio.run(together())


def stored(core: Core, vehicle: str, seconds: range) -> set[int]:
    with core.store.read() as connection:
        starts = [START + second * NANOSECONDS for second in seconds]
        found = known_starts(connection, vehicle, core.pipeline.model_id, starts)
    return {(start - START) // NANOSECONDS for start in found}


def test_lasting_faults_of_a_vehicle_are_told_to_those_who_examine_its_windows(
    engine: Engine, data_dir: Path, system: System
) -> None:
    examiner = FakeExaminer(system)
    core = build_core(Settings(data_dir=data_dir), replace(engine, identifier=examiner))
    for second in range(8):
        at_once(core, [ready(asked(core, system, "a", second))])
    at_once(core, [ready(asked(core, system, vehicle, 8)) for vehicle in "ab"])
    core.close()
    assert examiner.told[6:8] == [examiner.faults] * 2
    assert sorted(examiner.told[8:]) == [(), examiner.faults]  # the two that came at once, in any order


def test_windows_of_several_vehicles_are_tracked_in_one_transaction(
    running: Core, system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    transactions: list[None] = []
    real = running.store.write

    def counted() -> AbstractContextManager[Connection]:
        transactions.append(None)
        return real()

    monkeypatch.setattr(running.store, "write", counted)
    wanted = [asked(running, system, f"v{n % 3}", n // 3) for n in range(12)]
    answers = at_once(running, [ready(one) for one in wanted])
    assert len(transactions) == 1
    for one, answer in zip(wanted, answers, strict=True):
        assert isinstance(answer, AnsweredWindow)
        assert answer.asked is one
        assert answer.record is not None
        assert (answer.record.start, answer.record.tracked) == (one.start, True)
    assert all(stored(running, f"v{n}", range(4)) == set(range(4)) for n in range(3))


def test_a_window_that_comes_twice_at_once_or_again_is_stored_once_and_answered_each_time(
    running: Core, system: System
) -> None:
    def one() -> AskedWindow:
        return asked(running, system, "v", 7)

    first = at_once(running, [one, one])
    again = at_once(running, [one, lambda: asked(running, system, "v", 8)])
    records = [answer.record for answer in (*first, *again) if isinstance(answer, AnsweredWindow)]
    assert [record.start for record in records if record is not None] == [START + s * NANOSECONDS for s in (7, 7, 7, 8)]
    assert stored(running, "v", range(10)) == {7, 8}
    assert running.pipeline.state("v").used == 2


def test_windows_of_a_vehicle_with_a_model_of_its_own_hold_up_nobody(running: Core, system: System) -> None:
    shared = running.pipeline.engines.shared
    own = replace(asked(running, system, "slow", 0), served=replace(shared, version=1))
    release = threading.Event()
    running.beside.submit(release.wait)

    async def both() -> tuple[AnsweredWindow, bool, AnsweredWindow]:
        slow = asyncio.ensure_future(running.batcher.ask(ready(replace(own, start=None))))
        while not running.batcher.waiting:
            await asyncio.sleep(0.005)
        quick = await running.batcher.ask(ready(asked(running, system, "quick", 0)))
        waited = not slow.done()
        release.set()
        return quick, waited, await slow

    quick, waited, slow = asyncio.run(both())
    assert waited and quick.record is not None and slow.asked.vehicle == "slow"


def test_vehicles_with_models_of_their_own_take_turns_of_about_the_same_time(
    running: Core, system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared = running.pipeline.engines.shared
    seconds = {"slow": 10.0, "quick": 0.1}  # a window
    order: list[str] = []
    own = running.batcher._beside
    assert own is not None

    def estimated(batch: Sequence[Any]) -> None:
        for request in batch:
            order.append(request.sent.vehicle)
            request.answer = Busy("identified")
        served = batch[0].sent.served
        running.pipeline.pace.note(served, len(batch), seconds[order[-1]] * len(batch))

    monkeypatch.setattr(own, "_estimate", estimated)
    models = {name: replace(shared, version=1, model_id=100 + i) for i, name in enumerate(seconds)}
    windows = [
        replace(asked(running, system, name, second), served=models[name], start=None)
        for name, count in (("slow", 4), ("quick", 12))
        for second in range(count)
    ]
    release = threading.Event()
    running.beside.submit(release.wait)

    async def all_of_them() -> None:
        waiting = [asyncio.ensure_future(running.batcher.ask(ready(one))) for one in windows]
        while own.waiting < len(windows):
            await asyncio.sleep(0.005)
        release.set()
        await asyncio.gather(*waiting, return_exceptions=True)

    asyncio.run(all_of_them())
    first = order[0]
    assert order.count("slow") == 4 and order.count("quick") == 12
    # a window each until it is known how long they take, then eight quick ones beside one slow one
    turns = [(who, len(list(group))) for who, group in groupby(order)]
    expected = [("slow", 1), ("quick", 1), ("slow", 1), ("quick", 8), ("slow", 1), ("quick", 3), ("slow", 1)]
    assert turns == (expected if first == "slow" else turns) and max(n for who, n in turns if who == "slow") == 1


def test_one_vehicle_with_a_model_of_its_own_leaves_places_for_others(running: Core, system: System) -> None:
    own = running.batcher._beside
    assert own is not None
    own._limit = 8
    mine = replace(running.pipeline.engines.shared, version=1)
    slow = replace(asked(running, system, "slow", 0), served=mine, start=None)
    other = replace(slow, vehicle="other")
    release = threading.Event()
    running.beside.submit(release.wait)

    async def ask() -> tuple[list[AnsweredWindow | BaseException], AnsweredWindow]:
        many = [asyncio.ensure_future(running.batcher.ask(ready(slow))) for _ in range(8)]
        while own.waiting + sum(one.done() for one in many) < len(many):
            await asyncio.sleep(0.005)
        one = asyncio.ensure_future(running.batcher.ask(ready(other)))
        while own.waiting < 5:
            await asyncio.sleep(0.005)
        release.set()
        return await asyncio.gather(*many, return_exceptions=True), await one

    answers, answer = asyncio.run(ask())
    assert sum(isinstance(one, Busy) for one in answers) == 4 and answer.asked.vehicle == "other"


def test_windows_gather_while_the_tracker_is_busy_and_those_for_no_tracker_do_not_wait(
    running: Core, system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    windows: list[int] = []
    identified = running.batcher._estimate

    def counted(batch: Any) -> Any:
        windows.append(len(batch))
        return identified(batch)

    monkeypatch.setattr(running.batcher, "_estimate", counted)

    async def ask() -> list[AnsweredWindow]:
        def sent(second: int) -> asyncio.Future[AnsweredWindow]:
            return asyncio.ensure_future(running.batcher.ask(lambda: asked(running, system, "v", second)))

        with running.store.write():  # nobody else stores meanwhile
            first = [sent(0)]
            while len(windows) < 1:
                await asyncio.sleep(0.005)
            first.append(sent(1))
            while len(windows) < 2:
                await asyncio.sleep(0.005)
            later = [sent(second) for second in range(2, 7)]
            while running.batcher.waiting < len(later):
                await asyncio.sleep(0.005)
            await asyncio.sleep(0.05)
            assert windows == [1, 1]
            only = asked(running, system, "v", 9)
            only = AskedWindow(only.values, only.served)
            answered = await asyncio.wait_for(running.batcher.ask(lambda: only), 30)
            assert answered.record is None
            later += [sent(7), sent(8)]
        return await asyncio.gather(*first, *later)

    answers = asyncio.run(ask())
    assert [answer.record is not None and answer.record.tracked for answer in answers] == [True] * 9
    assert stored(running, "v", range(9)) == set(range(9))


def test_a_body_that_is_refused_costs_only_itself(running: Core, system: System) -> None:
    def wrong() -> AskedWindow:
        raise ApiProblem(422, "no window")

    answers = at_once(running, [wrong, lambda: asked(running, system, "v", 1)])
    assert isinstance(answers[0], ApiProblem)
    assert isinstance(answers[1], AnsweredWindow)


def test_a_vehicle_that_cannot_be_tracked_costs_only_itself(
    running: Core, system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = running.pipeline.fold_all

    def failing(
        connection: Connection, asked: Sequence[WindowsToFold], recording_id: str | None = None
    ) -> list[FoldedWindows]:
        if any(one.vehicle == "sick" for one in asked):
            raise FloatingPointError("no posterior")
        return real(connection, asked, recording_id)

    monkeypatch.setattr(running.pipeline, "fold_all", failing)
    answers = at_once(running, [partial(asked, running, system, v, 1) for v in ("a", "sick", "b")])
    assert isinstance(answers[1], FloatingPointError)
    assert stored(running, "a", range(2)) == stored(running, "b", range(2)) == {1}
    assert stored(running, "sick", range(2)) == set()


def test_a_store_that_takes_nothing_is_told_to_all_after_one_try(
    running: Core, system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries: list[None] = []

    def locked() -> AbstractContextManager[Connection]:
        tries.append(None)
        raise OperationalError("BEGIN IMMEDIATE", None, Exception("database is locked"))

    with monkeypatch.context() as patched:
        patched.setattr(running.store, "write", locked)
        answers = at_once(running, [partial(asked, running, system, f"v{n}", 1) for n in range(3)])
    assert len(tries) == 1
    assert all(isinstance(answer, OperationalError) for answer in answers)
    later = at_once(running, [lambda: asked(running, system, "v0", 1)])
    assert isinstance(later[0], AnsweredWindow)


def test_more_than_may_wait_are_refused_before_they_are_read(running: Core, system: System) -> None:
    running.batcher._limit = 2
    read: list[None] = []

    def one() -> AskedWindow:
        read.append(None)
        return asked(running, system, "v", len(read))

    answers = at_once(running, [one] * 5)
    assert sum(isinstance(answer, Busy) for answer in answers) == 3
    assert len(read) == 2


@pytest.mark.parametrize("where", ["identify", "hand over", "track"])
def test_a_shortage_of_memory_is_told_to_who_waits_and_nobody_waits_for_ever(
    running: Core, system: System, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """Before, no window was answered any more, and the service had to be ended by force."""

    def short(*given: Any, **more: Any) -> Any:
        raise RuntimeError(NO_THREAD) if where == "hand over" else MemoryError

    with monkeypatch.context() as patch:
        if where == "identify":
            patch.setattr("sprung.service.monitoring.batching.np.stack", short)
        elif where == "hand over":
            patch.setattr(running.batcher._tracker, "submit", short)
        else:
            patch.setattr(batching, "_found", short)
        answers = at_once(running, [ready(asked(running, system, vehicle, 0)) for vehicle in "ab"])
    assert all(isinstance(answer, MemoryError | RuntimeError) for answer in answers)
    answers = at_once(running, [ready(asked(running, system, vehicle, 0)) for vehicle in "ab"])
    assert all(isinstance(answer, AnsweredWindow) for answer in answers)
    assert stored(running, "a", range(2)) == {0}
