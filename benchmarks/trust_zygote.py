"""Processes that begin at once: forked from one that has imported everything, so that a kill costs no imports.

The parent has no threads and has opened nothing of Sprung's; what is killed is its child, a process like any other.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from runpy import run_module
from typing import Any

PR_SET_PDEATHSIG = 1
CODE = "from sprung.benchmarks.trust_zygote import main"
WARM = (  # what commands need: loaded before anything is forked
    *(f"sprung.service.{name}" for name in ("backup", "housekeeping", "main", "store")),
    *(f"sprung.service.cli.{name}" for name in ("app", "replay", "serve")),
)
GO, DONE = "step-begun", "step-done"  # files that a step makes in its folder


def end_with_parent() -> None:
    """In a new process: end when the one that made it does, however that ends."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


class Zygote:
    """The parent of all that is killed."""

    def __init__(self, warm: bool = True) -> None:
        """warm: with everything imported that commands need."""
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"{CODE}; main({warm})"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=end_with_parent,  # noqa: PLW1509 (one system call)
        )

    def command(self, *arguments: str, out: Path | None = None) -> Forked:
        """A command of Sprung's, with what it prints appended to a file."""
        return self._forked({"arguments": arguments, "out": str(out or os.devnull)})

    def step(self, code: str, folder: Path) -> Forked:
        """Python that works in a folder; it calls `go()` when it begins."""
        return self._forked({"code": code, "folder": str(folder), "out": os.devnull})

    def close(self) -> None:
        """End; children end with it."""
        self._process.kill()
        self._process.communicate()

    def _forked(self, wanted: dict[str, Any]) -> Forked:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(wanted) + "\n")
        self._process.stdin.flush()
        return Forked(int(self._process.stdout.readline()))


class Forked:
    """A child of the zygote."""

    def __init__(self, pid: int) -> None:
        self.pid = pid

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return alive(self.pid)

    def kill(self) -> None:
        """SIGKILL, and wait for its end."""
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        self.wait(30.0)

    def wait(self, seconds: float = 600.0) -> bool:
        """Until it has ended; whether it has."""
        deadline = time.monotonic() + seconds
        while self.alive and time.monotonic() < deadline:
            time.sleep(0.005)
        return not self.alive


def alive(pid: int) -> bool:
    """Whether a process runs (one that nobody has asked after does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def warm_up() -> None:
    """Import what commands need."""
    for name in WARM:
        import_module(name)


def main(warm: bool) -> None:
    """The zygote: a line of JSON in, a process number out."""
    if warm:
        warm_up()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # children that have ended are gone at once
    for line in sys.stdin:
        wanted = json.loads(line)
        pid = os.fork()
        if pid == 0:
            _child(wanted)
        print(pid, flush=True)


def _child(wanted: dict[str, Any]) -> None:
    end_with_parent()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # it has children of its own
    out = os.open(wanted["out"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(out, 1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    status = 1
    try:
        if "code" in wanted:
            os.chdir(wanted["folder"])
            exec(wanted["code"], {"go": Path(GO).touch})
            Path(DONE).touch()
            status = 0
        else:
            sys.argv = ["sprung", *wanted["arguments"]]
            run_module("sprung", run_name="__main__")  # the command, as a process of its own would run it
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    finally:
        os._exit(status)
