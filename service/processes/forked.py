"""Functions called in a process that was forked from this one: it has all that is loaded here, and shares its memory.

Threads of one interpreter do not run beside each other, and slow each other down where they call many short operations.

A process that ends, or that does nothing any more, is replaced by one that imports everything anew: by then there are
threads here, whose locks nobody would release in a fork.
"""

from __future__ import annotations

import atexit
import gc
import logging
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from enum import Enum, auto
from multiprocessing import connection as connections
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from sprung.service.processes.worker import START_SECONDS, Tether, go_before_others, tie, without_program

if sys.platform == "linux":
    import fcntl

log = logging.getLogger("sprung")
END_SECONDS = 2.0
PIPE_BYTES = 1 << 20  # of answers that wait to be taken: a vehicle's tracker is 130 kB
LOOK_SECONDS = 1.0  # between two looks at a process
OOM_SCORE = 500  # the service goes on without it; processes that read files of strangers go first
STOPPED_SECONDS = 10.0  # by a signal, after which it is replaced
# of a process that is asked and neither runs nor waits for the disk: its threads wait for each other
IDLE_SECONDS = 60.0
PAUSES = (1.0, 60.0)  # s, the first and the longest between two processes that do not last
LASTING_SECONDS = 60.0  # after which a process has lasted


class ProcessEnded(RuntimeError):
    """The process is no more, or was replaced."""


class _Kind(Enum):
    """What a message of the process is."""

    PART = auto()  # of what a generator yields; another message follows
    LAST = auto()
    RAISED = auto()


def forks() -> bool:
    """Whether a process beside this one is of use, and can be forked: on Linux, with more than one processor, and
    before the first thread, whose locks nobody would release in the fork."""
    return sys.platform == "linux" and len(os.sched_getaffinity(0)) > 1 and threading.active_count() == 1


_NO_MORE = object()
_Given = tuple[Mapping[str, Callable[..., Any]], Callable[[], None] | None]  # functions, and what comes before them


@dataclass(frozen=True, slots=True)
class _OtherProcess:
    """The process, seen from here."""

    process: BaseProcess
    ask: Connection
    answers: Connection
    since: float  # monotonic s

    def end(self, seconds: float) -> None:
        """Close what leads there; it has some seconds to go by itself."""
        self.ask.close()
        self.answers.close()
        self.process.join(seconds)
        self.process.kill()
        self.process.join(END_SECONDS)


@dataclass(frozen=True, slots=True)
class ProcessStatus:
    """How a process is, for those who watch the service."""

    name: str  # what it does
    works: bool  # else the service does that itself, until another process has begun
    restarts: int


class ForkedFunctions:
    """A process with some functions.  Make it before the first thread is started.

    `call` may be used from any thread; one call is worked on at a time.
    """

    def __init__(
        self, name: str, functions: Mapping[str, Callable[..., Any]], begin: Callable[[], None] | None = None
    ) -> None:
        """name: what it does, as in `identifies windows`; begin: called in the process before anything else.  Both
        functions and `begin` can be pickled."""
        self._name = name
        self._lock = threading.RLock()  # of who asks
        self._given = pickle.dumps((dict(functions), begin))  # as they are now: they change as they are used
        self._restarts = 0
        self._generation = 0
        self._asked_since: float | None = None  # monotonic s, of what is sent or waited for
        self._closing = threading.Event()
        context = multiprocessing.get_context("fork")
        asked, ask, answers, answer = _pipes()
        process = context.Process(
            target=_forked,
            args=(os.getpid(), (functions, begin), (ask, answers), asked, answer),
            name=self._process_name,
            daemon=True,
        )
        process.start()
        asked.close()
        answer.close()
        self._there: _OtherProcess | None = _OtherProcess(process, ask, answers, time.monotonic())
        self._pause = PAUSES[0] / 2  # s, before it was started last
        self._due = 0.0  # monotonic s, from when on another one may be started
        self._looked = _Looked()
        atexit.register(self.close)  # before multiprocessing's own, which would wait for it

    @property
    def pid(self) -> int | None:
        """Of the process; None while there is none."""
        process = self.process
        return None if process is None else process.pid

    @property
    def status(self) -> ProcessStatus:
        """How it is now."""
        return ProcessStatus(self._name, self._there is not None, self._restarts)

    @property
    def process(self) -> BaseProcess | None:
        """None while there is none."""
        there = self._there
        return None if there is None else there.process

    @contextmanager
    def undisturbed(self) -> Iterator[int]:
        """Several calls of this thread to one and the same process: nobody else's come between, and no other process
        takes its place.  Yields its number: one that has another number knows nothing of what this one was told."""
        with self._lock:
            yield self._generation

    def call(self, function: str, *given: Any, **named: Any) -> Any:
        """What the function returns; raises what it raises if that is a ValueError, else a RuntimeError.

        Raises ProcessEnded when the process is no more, which is logged the first time.
        """
        with self._lock:
            self._transfer(lambda there: there.ask.send((function, given, named)))
            answer, kind = self._receive()
        if kind is _Kind.RAISED:
            raise answer
        return answer

    def each(self, function: str, *given: Any, **named: Any) -> Generator[Any, None, None]:
        """What the function, a generator, yields, while the process is already at what comes next.

        As `call`; other calls wait until it is exhausted or closed.
        """
        with self._lock:
            self._transfer(lambda there: there.ask.send((function, given, named)))
            parts = iter(self._part, _NO_MORE)
            try:
                yield from parts
            except GeneratorExit:  # what nobody wants any more must not be taken for the answer to the next call
                with suppress(Exception):
                    deque(parts, maxlen=0)
                raise

    def _part(self) -> Any:
        answer, kind = self._receive()
        if kind is _Kind.RAISED:
            raise answer
        return answer if kind is _Kind.PART else _NO_MORE

    def _receive(self) -> tuple[Any, _Kind]:
        answer: tuple[Any, _Kind] = self._transfer(lambda there: there.answers.recv())
        return answer

    def _transfer(self, through: Callable[[_OtherProcess], Any]) -> Any:
        """Send or receive."""
        there = self._there
        if there is None:
            raise ProcessEnded(self._name)
        self._asked_since = time.monotonic()
        try:
            return through(there)
        except (EOFError, OSError):
            self._lose(there)
            raise ProcessEnded(self._name) from None
        finally:
            self._asked_since = None

    def _lose(self, there: _OtherProcess) -> None:
        """The process is no more; whoever asks it needs the lock."""
        if self._there is there:
            self._there = None
            there.end(END_SECONDS)
            log.error(
                "the process that %s ended (status %s); the service does that itself, which is slower, until another "
                "one has begun",
                self._name,
                there.process.exitcode,
            )

    def look(self) -> None:
        """Replace the process if it has ended, or does nothing any more.  For one and the same thread, which lives on:
        the kernel ends a process with the thread that started it."""
        there = self._there
        if there is None:
            if time.monotonic() >= self._due:
                self._try_to_replace()
        elif not there.process.is_alive():
            with self._lock:
                self._lose(there)
            lasted = time.monotonic() - there.since > LASTING_SECONDS
            self._pause_longer(PAUSES[0] if lasted else 2 * self._pause)
        elif why := self._looked.trouble(there.process.pid or 0, self._asked_since):
            log.error("the process that %s %s; it is ended", self._name, why)
            there.process.kill()

    def _pause_longer(self, seconds: float) -> None:
        """Before the next process."""
        self._pause = min(seconds, PAUSES[1])
        self._due = time.monotonic() + self._pause

    def _try_to_replace(self) -> None:
        try:
            self._replace()
        except Exception as error:  # whatever it was, of memory, of files or of its own: it is tried again
            if self._closing.is_set():
                return
            log.error("the process that %s cannot be started yet: %s", self._name, error)
            self._pause_longer(2 * self._pause)

    def _replace(self) -> None:
        """Start another process and wait until it has begun.  Raises RuntimeError where it does not, or OSError."""
        if self._closing.is_set():
            return
        context = multiprocessing.get_context("spawn")
        asked, ask, answers, answer = _pipes()
        process = context.Process(
            target=_spawned,
            args=(Tether(os.getpid()), self._given, asked, answer),  # the tether first: see there
            name=self._process_name,
            daemon=True,
        )
        with closing(asked), closing(answer), ExitStack() as unless_begun:
            unless_begun.enter_context(closing(ask))
            unless_begun.enter_context(closing(answers))
            with without_program():
                process.start()
            unless_begun.pop_all()
        there = _OtherProcess(process, ask, answers, time.monotonic())
        try:
            self._await(there)
        except BaseException:
            there.end(0.0)
            raise
        with self._lock:
            if self._closing.is_set():
                there.end(0.0)
                return
            self._there = there
            self._generation += 1
            self._restarts += 1
        log.warning("the process that %s runs again", self._name)

    def _await(self, there: _OtherProcess) -> None:
        until = there.since + START_SECONDS
        while not there.answers.poll(LOOK_SECONDS):
            if self._closing.is_set() or time.monotonic() > until:
                raise RuntimeError(f"it did not begin within {time.monotonic() - there.since:.0f} s")
        try:
            there.answers.recv()
        except EOFError:
            raise RuntimeError("it ended before it had begun") from None

    @property
    def _process_name(self) -> str:
        return f"sprung-{self._name.split(maxsplit=1)[0]}"

    def close(self) -> None:
        """End the process."""
        atexit.unregister(self.close)
        with self._lock:
            self._closing.set()
            there, self._there = self._there, None
            if there is not None:
                there.end(END_SECONDS)


class Watch:
    """A thread that replaces processes when they end, or do nothing any more.  Make it after the last fork."""

    def __init__(self, processes: Sequence[ForkedFunctions]) -> None:
        self._processes = processes
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sprung-watch", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave the processes alone; those that it has started end."""
        self._closing.set()
        self._thread.join(END_SECONDS)

    def _run(self) -> None:
        while not self._closing.is_set():
            there = [one for forked in self._processes if (one := forked.process) is not None]
            connections.wait([one.sentinel for one in there], LOOK_SECONDS)
            for forked in self._processes:
                forked.look()


@dataclass(slots=True)
class _Looked:
    """What was seen of a process, look by look."""

    seen: tuple[int, int] = (0, 0)  # process, ticks of processor time
    since: float = 0.0  # monotonic s, from when on it has done nothing

    def trouble(self, pid: int, asked_since: float | None) -> str:
        """Why it will not go on by itself; empty where it may.  asked_since: monotonic s; None: it has no task."""
        now, states, ticks = time.monotonic(), *_threads_of(pid)
        if self.seen != (pid, ticks) or states & set("RD"):
            self.seen, self.since = (pid, ticks), now
        if "T" in states:
            return f"was stopped by a signal {STOPPED_SECONDS:.0f} s ago" if now - self.since > STOPPED_SECONDS else ""
        idle = asked_since is not None and now - max(self.since, asked_since) > IDLE_SECONDS
        return f"was asked and has done nothing for {IDLE_SECONDS:.0f} s" if idle else ""


def _threads_of(pid: int) -> tuple[set[str], int]:
    """States of a process's threads, one letter each, and ticks of processor time that they took."""
    states, ticks = set(), 0
    with suppress(OSError, ValueError, IndexError):  # it ends
        for task in Path(f"/proc/{pid}/task").iterdir():
            fields = (task / "stat").read_text().rsplit(")", 1)[1].split()
            states.add(fields[0])
            ticks += int(fields[11]) + int(fields[12])
    return states, ticks


def _pipes() -> tuple[Connection, Connection, Connection, Connection]:
    """Two pipes to another process, for what is asked and what is answered, each by its ends to read and to write."""
    asked, ask = multiprocessing.Pipe(duplex=False)
    answers, answer = multiprocessing.Pipe(duplex=False)
    _widen(answer)
    return asked, ask, answers, answer


def _widen(pipe: Connection) -> None:
    """Let the process go on with what comes next while an answer waits to be taken."""
    if sys.platform == "linux":
        with suppress(OSError):  # what users who are not root may have in all is bounded
            fcntl.fcntl(pipe.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)


def _forked(parent: int, given: _Given, not_mine: Sequence[Connection], asked: Connection, answer: Connection) -> None:
    """The forked process."""
    tie(parent)
    for connection in not_mine:
        connection.close()
    _work(given, asked, answer)


def _spawned(_parent: object, pickled: bytes, asked: Connection, answer: Connection) -> None:
    """One that takes its place."""
    given: _Given = pickle.loads(pickled)  # of this program
    _work(given, asked, answer, announced=True)


def _work(given: _Given, asked: Connection, answer: Connection, announced: bool = False) -> None:
    """Answer what is asked, for as long as there is somebody who may ask.  announced: it is said when this begins."""
    functions, begin = given
    go_before_others(OOM_SCORE)
    for told_all in (signal.SIGINT, signal.SIGTERM):  # Ctrl-C and service managers tell the whole group; the parent,
        signal.signal(told_all, signal.SIG_IGN)  # which finishes what it accepted, decides
    if begin is not None:
        begin()
    gc.freeze()  # what the parent made is not looked through, so that its memory stays shared
    with suppress(EOFError, OSError):
        if announced:
            answer.send(None)
        while True:
            function, args, named = asked.recv()
            for message in _answers(functions[function], args, named):
                answer.send(message)


def _answers(
    function: Callable[..., Any], given: tuple[Any, ...], named: Mapping[str, Any]
) -> Iterator[tuple[Any, _Kind]]:
    """What is sent back of a call: parts, if it is a generator, and a last one."""
    try:
        answer = function(*given, **named)
        if isinstance(answer, Generator):
            for part in answer:
                yield part, _Kind.PART
            answer = None
        yield answer, _Kind.LAST
    except ValueError as error:  # of what cannot be used: the caller wants to know which
        yield error, _Kind.RAISED
    except Exception as error:
        log.exception("a call of %s failed", function)
        yield RuntimeError(f"{type(error).__name__}: {error}"), _Kind.RAISED
