"""Work in a process of its own: what it says arrives, and nothing it does outlives or takes down its parent."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from sprung.model.system import load_system
from sprung.service.errors import UserError
from sprung.service.processes.worker import ProcessLimits, Worker, WorkerFailed, WorkerKilled
from tests import service_slow, service_tasks
from tests.service_tasks import count, misbehave

EASY = ProcessLimits(silence_seconds=60, seconds=60)


def alive(pid: int) -> bool:
    """Whether a process runs (a zombie does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def gone(pid: int, seconds: float = 10.0) -> bool:
    deadline = time.monotonic() + seconds
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.02)
    return not alive(pid)


def test_messages_arrive_in_order_and_then_the_result() -> None:
    worker: Worker[int, str] = Worker(count, 50, EASY, "the work")
    assert list(worker.messages()) == list(range(50))
    assert worker.result == "done"
    assert gone(worker.pid)


def test_the_program_that_starts_a_worker_is_not_run_again(tmp_path: Path) -> None:
    script = tmp_path / "script.py"  # without `if __name__ == "__main__"`
    script.write_text(
        "import sys\n"
        "print('program')\n"
        "from sprung.service.processes.worker import ProcessLimits, Worker\n"
        "from tests.service_tasks import count\n"
        "worker = Worker(count, 3, ProcessLimits(silence_seconds=60, seconds=60), 'the work')\n"
        "print(*worker.messages(), worker.result, sys.modules['__main__'].__file__ == __file__)\n"
    )
    path = os.pathsep.join(filter(None, [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, check=True, env=os.environ | {"PYTHONPATH": path}
    )
    assert done.stdout.splitlines() == ["program", "0 1 2 done True"]


@pytest.mark.parametrize(
    ("how", "error", "told"),
    [
        ("refuse", UserError, "line 3 is no number"),
        ("break", WorkerFailed, "a mistake of ours"),
        ("full", OSError, "^.Errno 28. No space left on device$"),  # without the path, which is of the service's own
        ("crash", UserError, r"the process of the work was ended by SIGSEGV \(signal 11\): it crashed"),
        (
            "killed",
            WorkerKilled,
            r"was ended by SIGKILL \(signal 9\): the machine was out of memory, or it was ended from",
        ),
        ("exhaust", UserError, "the work took more than 1 s of processor time"),
        ("leave", UserError, r"the process of the work ended without an answer \(status 7\)"),
    ],
)
def test_every_end_is_reported_for_what_it_was(how: str, error: type[Exception], told: str) -> None:
    worker: Worker[int, str] = Worker(
        misbehave, how, replace(EASY, cpu_seconds=1 if how == "exhaust" else 60), "the work"
    )
    with pytest.raises(error, match=told) as caught:
        list(worker.messages())
    assert gone(worker.pid) and isinstance(caught.value, WorkerKilled) == (how == "killed")


@pytest.mark.skipif(sys.platform != "linux", reason="the bound is one of Linux")
def test_memory_is_bounded() -> None:
    worker: Worker[int, str] = Worker(
        misbehave, "devour", ProcessLimits(60, 60, memory_bytes=1_000_000_000), "the work"
    )
    with pytest.raises(UserError, match=r"more memory than the 1\.0 GB"):
        list(worker.messages())


@pytest.mark.parametrize(
    ("how", "limits", "told"),
    [
        ("hang", ProcessLimits(silence_seconds=0.3, seconds=60), "made no progress for 0 s"),
        ("spin", ProcessLimits(silence_seconds=60, seconds=4), "took longer than 4 s"),
    ],
)
def test_time_is_bounded(how: str, limits: ProcessLimits, told: str) -> None:
    begun = time.monotonic()
    worker: Worker[int, str] = Worker(misbehave, how, limits, "the work")
    with pytest.raises(UserError, match=told):
        list(worker.messages())
    assert time.monotonic() - begun < 30
    assert gone(worker.pid)


def test_giving_up_ends_the_process() -> None:
    worker: Worker[int, str] = Worker(misbehave, "hang", EASY, "the work")
    calls = 0

    def check() -> None:
        nonlocal calls
        calls += 1
        if calls > 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(worker.messages(check))
    assert gone(worker.pid)


def test_a_slow_start_is_no_silence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPRUNG_TEST_NOTE", str(tmp_path / "pid"))
    monkeypatch.setenv("SPRUNG_TEST_IMPORT", "1.0")
    worker: Worker[str, str] = Worker(service_slow.answer, "yes", ProcessLimits(0.5, 0.9), "the work")
    assert list(worker.messages()) == []
    assert worker.result == "yes"


def ended_by(end: Callable[[int], None], note: Path, program: str = service_tasks.__file__) -> int:
    """The worker of a parent that is ended while it works."""
    root = str(Path(__file__).parents[3])  # a program finds the packages of its own folder alone
    parent = subprocess.Popen([sys.executable, program, str(note)], env=os.environ | {"PYTHONPATH": root})
    deadline = time.monotonic() + 60
    while not (note.exists() and note.read_text()):
        assert time.monotonic() < deadline and parent.poll() is None
        time.sleep(0.05)
    end(parent.pid)
    parent.wait(20)
    return int(note.read_text())


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_a_worker_does_not_outlive_its_parent(tmp_path: Path, how: signal.Signals) -> None:
    pid = ended_by(lambda parent: os.kill(parent, how), tmp_path / "pid")
    assert gone(pid)


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel is asked on Linux")
def test_a_worker_that_still_imports_does_not_outlive_its_parent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPRUNG_TEST_NOTE", str(tmp_path / "pid"))
    monkeypatch.setenv("SPRUNG_TEST_IMPORT", "100")
    pid = ended_by(lambda parent: os.kill(parent, signal.SIGKILL), tmp_path / "pid", service_slow.__file__)
    assert gone(pid)


def test_a_system_travels_to_another_process() -> None:
    system = load_system()
    copy = pickle.loads(pickle.dumps(system))
    assert copy.digest == system.digest and copy.laws == system.laws
