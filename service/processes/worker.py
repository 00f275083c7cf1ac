"""Work in a process of its own, through a typed interface: one request in, messages and one result out.

What may hang, exhaust memory or take down its interpreter runs here: reading files of strangers, and diagnoses.  The
process is ended with its parent, however that ends, and can be ended at any moment.
"""

from __future__ import annotations

import ctypes
import errno
import logging
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any, Generic, TypeVar

from sprung.service.errors import UserError
from sprung.service.processes.imports import python_can_alone

log = logging.getLogger("sprung.worker")

Request = TypeVar("Request")
Message = TypeVar("Message")
Result = TypeVar("Result")
Emit = Callable[[Message], None]
Task = Callable[[Request, Emit[Message]], Result]  # a function of a module: the new process imports it by name

POLL_SECONDS = 0.1
START_SECONDS = 600.0  # to import what a task needs: seconds of work, minutes where the machine has no time
END_SECONDS = 5.0  # a process that was killed is gone long before
PR_SET_PDEATHSIG = 1
SHORTAGES = (errno.ENOSPC, errno.EDQUOT, errno.EMFILE, errno.ENFILE)  # of the machine, for a while
FROM_OUTSIDE = ("SIGKILL", "SIGTERM", "SIGHUP", "SIGQUIT")  # nothing that runs in a process sends itself these
_starting = threading.Lock()


class WorkerFailed(RuntimeError):
    """The work failed with an error that is not meant for users; the message is its traceback."""


class WorkerKilled(UserError):
    """The process was ended from outside, or for want of memory: the same work may succeed another time."""


@dataclass(frozen=True, slots=True)
class ProcessLimits:
    """What a process may use, once it has begun with its task."""

    silence_seconds: float  # without any message
    seconds: float  # in all, waiting for the parent included
    memory_bytes: int | None = None  # private memory; None: as much as there is
    cpu_seconds: int | None = None  # of processor time
    niceness: int = 10  # how far it stands back behind others


@dataclass(frozen=True, slots=True)
class _Begun:
    """Everything is imported."""


@dataclass(frozen=True, slots=True)
class _SentMessage:
    message: Any


@dataclass(frozen=True, slots=True)
class _Done:
    result: Any


@dataclass(frozen=True, slots=True)
class _Refused:
    reason: str  # one line for the user


@dataclass(frozen=True, slots=True)
class _Short:
    """Of what the machine lacks, as of room on its disk: the same may succeed later."""

    number: int  # errno
    reason: str


@dataclass(frozen=True, slots=True)
class _Broken:
    text: str  # a traceback


class Worker(Generic[Message, Result]):
    """One run of a task.  Iterate `messages`, then read `result`; `kill` may be called from any thread."""

    def __init__(
        self, task: Task[Request, Message, Result], request: Request, limits: ProcessLimits, what: str
    ) -> None:
        """what: names the work in errors, as in `the diagnosis`."""
        self._limits = limits
        self._what = what
        self._result: Result | None = None
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(
            target=_run,
            args=(Tether(os.getpid()), task, request, theirs, limits),  # the tether first: see there
            name="sprung-worker",
            daemon=True,
        )
        self._started = time.monotonic()
        self._begun: float | None = None
        with without_program():
            self._process.start()
        theirs.close()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid or 0

    @property
    def result(self) -> Result:
        """What the task returned; `messages` must have ended."""
        assert self._result is not None, "the worker has not finished"
        return self._result

    def messages(self, check: Callable[[], None] = lambda: None) -> Iterator[Message]:
        """The task's messages, as they come; ends when the task is done.

        check: called ten times a second, may raise to give up; the process is then ended.
        Raises UserError for input that cannot be used, for limits that are exceeded and for a process that died, as
        WorkerKilled where that may have come from outside; OSError where the machine lacks something, as of room on its
        disk; WorkerFailed for an error of the program.
        """
        try:
            while True:
                match self._next(check):
                    case _Begun():
                        self._begun = time.monotonic()
                    case _SentMessage(message):
                        yield message
                    case _Done(result):
                        self._result = result
                        return
                    case _Refused(reason):
                        raise UserError(reason)
                    case _Short(number, reason):
                        raise OSError(number, reason)
                    case _Broken(text):
                        raise WorkerFailed(text)
        finally:
            self.kill()

    def kill(self) -> None:
        """End the process now, if it still runs."""
        if self._process.is_alive():
            self._process.kill()
        self._process.join(END_SECONDS)

    def _next(self, check: Callable[[], None]) -> Any:
        """The next thing said; silence counts only while the parent waits for it."""
        silent_since = time.monotonic()
        try:
            while True:
                check()
                if self._begun is not None and time.monotonic() - self._begun > self._limits.seconds:
                    raise UserError(f"{self._what} took longer than {self._limits.seconds:.0f} s")
                if self._connection.poll(POLL_SECONDS):
                    return self._connection.recv()
                if self._begun is None:
                    if time.monotonic() - self._started > START_SECONDS:
                        raise UserError(f"the process of {self._what} did not begin within {START_SECONDS:.0f} s")
                elif time.monotonic() - silent_since > self._limits.silence_seconds:
                    raise UserError(f"{self._what} made no progress for {self._limits.silence_seconds:.0f} s")
        except (EOFError, OSError, pickle.UnpicklingError):
            check()
            raise self._death() from None

    def _death(self) -> UserError:
        """What is known of the end of the process."""
        self._process.join(END_SECONDS)
        code = self._process.exitcode
        if code is None or code >= 0:
            return UserError(f"the process of {self._what} ended without an answer (status {code})")
        name = signal.Signals(-code).name if -code in set(signal.Signals) else "a signal"
        if name == "SIGXCPU":
            return UserError(f"{self._what} took more than {self._limits.cpu_seconds} s of processor time")
        told = f"the process of {self._what} was ended by {name} (signal {-code})"
        if name in FROM_OUTSIDE:
            return WorkerKilled(f"{told}: the machine was out of memory, or it was ended from outside")
        return UserError(f"{told}: it crashed")


class Tether:
    """Ties a new process to its parent as soon as this is unpickled there, before a task's imports take their time."""

    def __init__(self, parent: int) -> None:
        self._parent = parent

    def __reduce__(self) -> tuple[Callable[[int], int], tuple[int]]:
        return tie, (self._parent,)


def tie(parent: int) -> int:
    """Have the kernel end this process, one of Sprung's own, with its parent, where it can; returns the parent."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before we asked
        os._exit(1)
    python_can_alone()
    return parent


@contextmanager
def without_program() -> Iterator[None]:
    """A new process imports the module of its task, and not the program of this one as well: that may be Ray's, which
    takes a second, or a script of somebody who uses Sprung, which would run again."""
    with _starting:
        program = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = program


def _run(
    _parent: object, task: Task[Any, Any, Any], request: Any, connection: Connection, limits: ProcessLimits
) -> None:
    """The new process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the whole group; the parent decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _end_with_pipe(connection)
    be_modest(limits)
    sending = threading.Lock()

    def say(thing: Any) -> None:
        with sending:
            connection.send(thing)

    say(_Begun())
    try:
        say(_Done(task(request, lambda message: say(_SentMessage(message)))))
    except MemoryError:
        say(_Refused(f"it needs more memory than the {(limits.memory_bytes or 0) / 1e9:.1f} GB that are allowed"))
    except (ValueError, OSError) as error:  # what every folder raises for input that cannot be used
        log.debug("refused", exc_info=True)
        if isinstance(error, OSError) and error.errno in SHORTAGES:
            say(_Short(error.errno, error.strerror or os.strerror(error.errno)))
        else:
            say(_Refused(" ".join(str(error).split())[:500] or type(error).__name__))
    except Exception:
        say(_Broken(traceback.format_exc()))


def _end_with_pipe(lifeline: Connection) -> None:
    """End this process when its parent has gone, on platforms where the kernel does not see to it."""

    def watch() -> None:
        with suppress(EOFError, OSError):
            lifeline.recv()  # the parent never sends: this returns when its end is closed
        os._exit(1)

    threading.Thread(target=watch, name="sprung-lifeline", daemon=True).start()


def carried_out(task: Task[Request, None, Result], request: Request, limits: ProcessLimits | None, what: str) -> Result:
    """What a task returns that tells nothing on its way: done in a process of its own, or here where limits are None.

    Raises as `Worker.messages`, or as the task itself.
    """
    if limits is None:
        return task(request, lambda _message: None)
    worker: Worker[None, Result] = Worker(task, request, limits, what)
    for _ in worker.messages():
        pass
    return worker.result


def go_before_others(score: int) -> None:
    """Let the kernel end this process, rather than the service, when memory runs out; score: up to 1000, the first."""
    with suppress(OSError), open("/proc/self/oom_score_adj", "w", encoding="ascii") as target:
        target.write(str(score))


def be_modest(limits: ProcessLimits) -> None:
    """Low priority, first to go when memory runs out, and bounds of the kernel's where the platform has them."""
    with suppress(OSError, AttributeError):
        os.nice(limits.niceness)
    go_before_others(900)
    with suppress(ImportError, ValueError, OSError):
        import resource

        if limits.memory_bytes is not None:
            resource.setrlimit(resource.RLIMIT_DATA, (limits.memory_bytes, limits.memory_bytes))
        if limits.cpu_seconds is not None:
            # beyond it SIGXCPU, which says what it was; the second bound, that of SIGKILL, is never reached
            resource.setrlimit(resource.RLIMIT_CPU, (limits.cpu_seconds, limits.cpu_seconds + 60))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # which SIGXCPU would write
