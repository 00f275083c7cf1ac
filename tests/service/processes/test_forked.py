"""Functions in a forked process, and trackers and identification there."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identifier import UnusableWindow
from sprung.model.system import MANCHESTER, System, parse_system
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import Engine, engine_like, one_thread_an_operation, seconds_of_a_window
from sprung.service.monitoring.following import FollowingApart, follow
from sprung.service.monitoring.identifier_processes import IdentifierApart, identifying_processes, placed_in
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.monitoring.processed import WindowsToFold
from sprung.service.processes import forked
from sprung.service.processes.forked import ForkedFunctions, ProcessEnded, Watch
from sprung.service.store import Store, open_store
from tests.service_fakes import make_window

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux only"),
    pytest.mark.filterwarnings("ignore:This process:DeprecationWarning"),  # a test runner has threads, which do nothing
]


def _double(value: int) -> int:
    if value < 0:
        raise UnusableWindow("a negative one")
    return 2 * value if value else 1 // value


def _doubles(values: list[int]) -> Iterator[int]:
    for value in values:
        yield _double(value)


@pytest.fixture
def watch() -> Iterator[Callable[..., None]]:
    """Begins to watch processes; for as long as a test takes."""
    with ExitStack() as stack:

        def begin(*processes: ForkedFunctions) -> None:
            stack.enter_context(closing(Watch(processes)))

        yield begin


@pytest.fixture
def doubling() -> Iterator[ForkedFunctions]:
    functions: dict[str, Callable[..., Any]] = {"double": _double, "pid": os.getpid, "doubles": _doubles}
    with closing(ForkedFunctions("doubles", functions)) as doubles:
        yield doubles


def _in_eight_threads() -> float:
    numbers, together = torch.ones(100_000), threading.Barrier(8)

    def add(one: float) -> float:
        together.wait()
        return float((numbers + one).sum())

    with ThreadPoolExecutor(8) as pool:
        return sum(pool.map(add, [1.0] * 8))


def test_threads_of_the_process_may_use_torch_at_the_same_moment() -> None:
    """Without its beginning every third process fails."""
    one_thread_an_operation()
    torch.ones(100_000) + 1.0
    for _ in range(20):
        with closing(ForkedFunctions("adds", {"add": _in_eight_threads}, one_thread_an_operation)) as adding:
            assert adding.call("add") == 8 * 200_000


def test_functions_run_in_another_process(doubling: ForkedFunctions) -> None:
    assert doubling.call("double", 21) == 42
    assert doubling.call("pid") == doubling.pid != os.getpid()


def test_it_goes_before_the_service_when_memory_runs_out(doubling: ForkedFunctions) -> None:
    assert doubling.call("double", 1) == 2  # it has begun
    score = Path(f"/proc/{doubling.pid}/oom_score_adj").read_text()
    assert int(score) > int(Path("/proc/self/oom_score_adj").read_text())


def test_what_a_function_raises_is_raised_here(doubling: ForkedFunctions) -> None:
    with pytest.raises(UnusableWindow, match="a negative one"):
        doubling.call("double", -1)
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        doubling.call("double", 0)
    assert doubling.call("double", 2) == 4


def test_what_a_generator_yields_comes_one_by_one(doubling: ForkedFunctions) -> None:
    assert list(doubling.each("doubles", [1, 2, 3])) == [2, 4, 6]
    assert list(doubling.each("doubles", [])) == []
    each = doubling.each("doubles", [4, -1, 5])
    assert next(each) == 8
    with pytest.raises(UnusableWindow, match="a negative one"):
        next(each)
    assert doubling.call("double", 6) == 12


def test_parts_that_nobody_takes_are_no_answer_to_the_next_call(doubling: ForkedFunctions) -> None:
    with closing(doubling.each("doubles", list(range(1, 50)))) as each:
        assert next(each) == 2
    assert doubling.call("double", 100) == 200


def test_a_process_that_is_killed_between_parts(doubling: ForkedFunctions) -> None:
    assert doubling.pid is not None
    with closing(doubling.each("doubles", list(range(1, 100_000)))) as each:
        assert next(each) == 2
        os.kill(doubling.pid, signal.SIGKILL)
        with pytest.raises(ProcessEnded):
            list(each)


def test_a_killed_process_is_reported_once(doubling: ForkedFunctions, caplog: pytest.LogCaptureFixture) -> None:
    assert doubling.pid is not None
    os.kill(doubling.pid, signal.SIGKILL)
    for _ in range(2):
        with pytest.raises(ProcessEnded):
            doubling.call("double", 1)
    assert [r.message for r in caplog.records if "the process that doubles ended (status -9)" in r.message]
    assert len(caplog.records) == 1 and doubling.pid is None


def _until(there: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not there():
        assert time.monotonic() < deadline, "it does not come to that"
        time.sleep(0.02)


def test_a_killed_process_is_replaced_without_being_asked(
    doubling: ForkedFunctions, watch: Callable[..., None], caplog: pytest.LogCaptureFixture
) -> None:
    watch(doubling)
    for restarts in (1, 2):
        before = doubling.pid
        assert before is not None and doubling.status.works
        os.kill(before, signal.SIGKILL)
        _until(lambda count=restarts: doubling.status.restarts == count)  # type: ignore[misc]
        assert doubling.call("double", 4) == 8 and doubling.call("pid") == doubling.pid != before
        with pytest.raises(UnusableWindow, match="a negative one"):
            doubling.call("double", -1)
    told = [record.message for record in caplog.records]
    assert [("ended (status -9)" in line, "runs again" in line) for line in told] == [(True, False), (False, True)] * 2


def test_a_process_that_is_stopped_is_replaced_and_who_asks_does_not_wait_for_ever(
    doubling: ForkedFunctions, watch: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forked, "STOPPED_SECONDS", 1.0)
    watch(doubling)
    assert doubling.pid is not None
    os.kill(doubling.pid, signal.SIGSTOP)
    begun = time.monotonic()
    with pytest.raises(ProcessEnded):
        doubling.call("double", 1)
    assert time.monotonic() - begun < 20.0
    _until(lambda: doubling.status.works)
    assert doubling.call("double", 2) == 4


def test_a_process_whose_threads_wait_for_each_other_is_replaced_and_one_at_work_is_not(
    watch: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forked, "IDLE_SECONDS", 1.5)
    functions: dict[str, Callable[..., Any]] = {"wait": _for_ever, "work": _seconds_of_work}
    with closing(ForkedFunctions("waits", functions)) as waiting:
        watch(waiting)
        assert waiting.call("work", 4.0) == 4.0
        with pytest.raises(ProcessEnded):
            waiting.call("wait")
        time.sleep(3.0)  # nobody asks anything: that is no reason
        _until(lambda: waiting.status.restarts == 1)
        time.sleep(3.0)
        assert waiting.call("work", 0.1) == 0.1 and waiting.status.restarts == 1


def _for_ever() -> None:
    threading.Event().wait()


def _seconds_of_work(seconds: float) -> float:
    begun = time.process_time()
    while time.process_time() - begun < seconds:
        pass
    return seconds


def test_closing_does_not_wait_for_a_process_that_is_just_being_started(
    doubling: ForkedFunctions, watch: Callable[..., None]
) -> None:
    watch(doubling)
    assert doubling.pid is not None
    os.kill(doubling.pid, signal.SIGKILL)
    _until(lambda: doubling.pid is None)
    time.sleep(1.2)
    begun = time.monotonic()
    doubling.close()
    assert time.monotonic() - begun < 5.0


def test_it_ends_with_the_process_that_made_it(tmp_path: Path) -> None:
    told = tmp_path / "pid"
    maker = os.fork()
    if maker == 0:
        told.write_text(str(ForkedFunctions("waits", {}).pid))
        os._exit(0)
    os.waitpid(maker, 0)
    pid, deadline = int(told.read_text()), time.monotonic() + 10
    while Path(f"/proc/{pid}").exists() and "Z" not in Path(f"/proc/{pid}/stat").read_text().split()[2]:
        assert time.monotonic() < deadline, "it is still there"
        time.sleep(0.02)


def test_it_is_not_ended_by_what_tells_its_parent_to_finish(doubling: ForkedFunctions) -> None:
    assert doubling.call("double", 1) == 2 and doubling.pid is not None
    os.kill(doubling.pid, signal.SIGTERM)
    assert doubling.call("double", 3) == 6


def test_an_interpreter_that_forgets_to_close_it_ends_all_the_same() -> None:
    code = (
        "from sprung.service.processes.forked import ForkedFunctions\n"
        "forked = ForkedFunctions('waits', {'abs': abs})\n"
        "print(forked.call('abs', -7))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr, done.returncode) == ("7\n", "", 0)


def test_calls_of_several_threads_get_their_own_answers(doubling: ForkedFunctions) -> None:
    wrong: list[int] = []

    def ask(first: int) -> None:
        wrong.extend(n for n in range(first, first + 200) if doubling.call("double", n) != 2 * n)

    threads = [threading.Thread(target=ask, args=(1000 * k + 1,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_an_identifier_apart_answers_as_it_does_here(engine: Engine, system: System) -> None:
    shared, own = identifying_processes(engine.identifier, system)
    apart = IdentifierApart(engine.identifier, partial(shared.call, "ask"))
    values = np.stack([make_window(system, n).values for n in range(3)])
    with closing(shared), closing(own):
        there = replace(engine, identifier=apart)
        assert there.digest == engine.digest
        here, _ = engine.identify(values)
        for _ in range(2):  # the second time the process is gone
            found, _ = there.identify(values)
            for one, other in zip(here, found, strict=True):
                np.testing.assert_array_equal(one.log_ratio, other.log_ratio)
                np.testing.assert_array_equal(one.covariance, other.covariance)
            if shared.pid is not None:
                os.kill(shared.pid, signal.SIGKILL)


def test_identifiers_that_take_the_place_of_others_come_to_the_same(
    engine: Engine, system: System, watch: Callable[..., None]
) -> None:
    shared, own = identifying_processes(engine.identifier, system)
    values = np.stack([make_window(system, n).values for n in range(3)])
    with closing(shared), closing(own):
        there = replace(engine, identifier=IdentifierApart(engine.identifier, partial(shared.call, "ask")))
        here, _ = engine.identify(values, starts=[0, 1, 2])
        for process in (shared, own):
            assert process.pid is not None
            os.kill(process.pid, signal.SIGKILL)
        watch(shared, own)
        _until(lambda: shared.status.works and shared.status.restarts == own.status.restarts == 1)
        assert own.pid is not None and shared.pid is not None
        assert os.getpriority(os.PRIO_PROCESS, own.pid) > os.getpriority(os.PRIO_PROCESS, shared.pid)
        found, _ = there.identify(values, starts=[0, 1, 2])
        for one, other in zip(here, found, strict=True):
            np.testing.assert_array_equal(one.log_ratio, other.log_ratio)
            np.testing.assert_array_equal(one.covariance, other.covariance)


def test_a_vehicles_own_model_is_identified_apart_and_behind_the_others(engine: Engine, system: System) -> None:
    shared, own = identifying_processes(engine.identifier, system)
    with closing(shared), closing(own):
        served = replace(engine, place=placed_in(own))
        other = parse_system(MANCHESTER.read_text().replace("mass: 32000", "mass: 33000"))
        here = engine_like(served, other)
        there = here.placed()
        assert isinstance(there.identifier, IdentifierApart) and there.digest == here.digest != engine.digest
        assert shared.pid is not None and own.pid is not None
        assert os.getpriority(os.PRIO_PROCESS, own.pid) > os.getpriority(os.PRIO_PROCESS, shared.pid)
        os.kill(shared.pid, signal.SIGKILL)  # not needed for it
        runs = simulate_runs(other, np.zeros((2, len(other.parameters))), other.window, np.random.default_rng(1))
        begun = time.thread_time()
        found, _ = there.identify(runs.values)
        taken = time.thread_time() - begun
        wanted, _ = here.identify(runs.values)
        for one, another in zip(wanted, found, strict=True):
            np.testing.assert_array_equal(one.log_ratio, another.log_ratio)
        assert taken < time.thread_time() - begun - taken
        assert seconds_of_a_window(here) > 0.0


@pytest.mark.parametrize(("vehicles", "watched"), [(1, False), (10, False), (10, True)])
def test_trackers_apart_come_to_the_same(
    engine: Engine, system: System, tmp_path: Path, watch: Callable[..., None], vehicles: int, watched: bool
) -> None:
    """With room for one vehicle in the process, and for all; it is killed on the way, and replaced where it is watched:
    the other one knows no vehicle."""
    states = {}
    for name in ("here", "apart"):
        following = FollowingApart(engine, vehicles) if name == "apart" else None
        store, compute = open_store(f"sqlite:///{tmp_path}/{name}.db"), Compute(4)
        pipeline = Pipeline(engine, store, compute, clock=lambda: 0, follow=following or follow)
        for part in range(4):
            for vehicle in ("a", "b"):
                pipeline.process(vehicle, [make_window(system, 10 * part + n) for n in range(10)])
            if part == 1:
                _relearn(pipeline, store)
            if part == 2 and following is not None and following.forked.pid is not None:
                os.kill(following.forked.pid, signal.SIGKILL)
                if watched:
                    watch(following.forked)
                    _until(lambda process=following.forked: process.status.restarts == 1)  # type: ignore[misc]
        states[name] = [pipeline.state(vehicle).to_dict() for vehicle in ("a", "b")]
        if following is not None:
            following.forked.close()
        compute.close()
        store.close()
    assert states["here"] == states["apart"]


def _relearn(pipeline: Pipeline, store: Store) -> None:
    """The state changes on this side only."""
    with store.write() as connection:
        batch = pipeline.relearn("a", None, connection)
    pipeline.publish(batch)


def test_a_vehicle_that_fails_leaves_the_others_as_they_were(engine: Engine, system: System, tmp_path: Path) -> None:
    """Of a batch that failed nothing is stored, so that nothing of it may be remembered."""
    windows = [make_window(system, n) for n in range(6)]
    following = FollowingApart(engine, 10)
    store, compute = open_store(f"sqlite:///{tmp_path}/store.db"), Compute(4)
    pipeline = Pipeline(engine, store, compute, clock=lambda: 0, follow=following)
    with closing(following.forked), closing(store), closing(compute):
        pipeline.process("a", windows[:3])
        with store.write() as connection:
            at = pipeline.hold_all(connection, ["a"])["a"]
        (estimate,), _ = engine.identify(windows[3].values[None])
        told = WindowsToFold("a", windows[3:4], [estimate], at)
        wrong = WindowsToFold(
            "b",
            windows[:1],
            [replace(estimate, log_ratio=np.zeros(1))],
            replace(at, state=engine.tracker.initial_state()),
        )
        later = replace(told, windows=windows[5:6])
        with pytest.raises(ValueError, match="the tracker has 24"):
            list(following([later, wrong], 0))
        (again,) = following([told], 0)
        (here,) = follow([told], 0)
        assert again.followed.state.to_dict() == here.followed.state.to_dict()
