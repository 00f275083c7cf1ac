"""Tasks that misbehave, for the tests of worker processes: a new process imports them from here."""

from __future__ import annotations

import errno
import os
import signal
import sys
import time
from pathlib import Path

from sprung.service.processes.worker import Emit, ProcessLimits, Worker


def count(to: int, emit: Emit[int]) -> str:
    """Says 0, 1, ... and returns a word."""
    for number in range(to):
        emit(number)
    return "done"


def misbehave(how: str, emit: Emit[int]) -> str:
    """Does what it is told."""
    emit(os.getpid())
    if how == "refuse":
        raise ValueError("line 3 is\nno number")
    if how == "full":
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/var/lib/sprung/reports/x.part/page.html")
    if how == "break":
        raise KeyError("a mistake of ours")
    if how == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    if how == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if how == "exhaust":
        while True:
            pass
    if how == "leave":
        os._exit(7)
    if how == "devour":
        return str(len(bytearray(3_000_000_000)))
    if how == "hang":
        time.sleep(600)
    if how == "spin":
        while True:
            emit(0)
            time.sleep(0.01)
    return "fine"


if __name__ == "__main__":  # a parent that is killed: starts a worker, writes down its process, waits
    from tests import service_tasks

    worker: Worker[int, str] = Worker(service_tasks.misbehave, "hang", ProcessLimits(600, 600), "the work")
    for pid in worker.messages():
        Path(sys.argv[1]).write_text(str(pid))
