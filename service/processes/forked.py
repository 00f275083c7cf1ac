"""Functions called in a process that was forked from this one: it has all that is loaded here, and shares its memory.

Threads of one interpreter do not run beside each other, and slow each other down where they call many short operations.
"""

from __future__ import annotations

import atexit
import gc
import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum, auto
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from sprung.service.processes.worker import tie

if sys.platform == "linux":
    import fcntl

log = logging.getLogger("sprung")
END_SECONDS = 2.0
PIPE_BYTES = 1 << 20  # of answers that wait to be taken: a vehicle's tracker is 130 kB


class ProcessEnded(RuntimeError):
    """The process is no more."""


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


@dataclass(frozen=True, slots=True)
class _OtherProcess:
    """The process, seen from here."""

    process: BaseProcess
    ask: Connection
    answers: Connection


class ForkedFunctions:
    """A process with some functions.  Make it before the first thread is started.

    `call` may be used from any thread; one call is worked on at a time.
    """

    def __init__(
        self, name: str, functions: Mapping[str, Callable[..., Any]], begin: Callable[[], None] | None = None
    ) -> None:
        """name: what it does, as in `identifies windows`; begin: called in the process before anything else."""
        self._name = name
        self._lock = threading.Lock()
        context = multiprocessing.get_context("fork")
        asked, ask = context.Pipe(duplex=False)
        answers, answer = context.Pipe(duplex=False)
        _widen(answer)
        process = context.Process(
            target=_work,
            args=(os.getpid(), functions, begin, (ask, answers), asked, answer),
            name=f"sprung-{name.split(maxsplit=1)[0]}",
            daemon=True,
        )
        process.start()
        asked.close()
        answer.close()
        self._there: _OtherProcess | None = _OtherProcess(process, ask, answers)
        atexit.register(self.close)  # before multiprocessing's own, which would wait for it

    @property
    def pid(self) -> int | None:
        """Of the process; None once it has ended."""
        return None if self._there is None else self._there.process.pid

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
        try:
            return through(there)
        except (EOFError, OSError):
            self._there = None
            there.process.join(END_SECONDS)
            log.error(
                "the process that %s ended (status %s); the service does that itself now, which is slower, until "
                "it is started again",
                self._name,
                there.process.exitcode,
            )
            raise ProcessEnded(self._name) from None

    def close(self) -> None:
        """End the process."""
        atexit.unregister(self.close)
        with self._lock:
            if self._there is not None:
                there, self._there = self._there, None
                there.ask.close()
                there.answers.close()
                there.process.join(END_SECONDS)
                there.process.kill()


def _widen(pipe: Connection) -> None:
    """Let the process go on with what comes next while an answer waits to be taken."""
    if sys.platform == "linux":
        with suppress(OSError):  # what users who are not root may have in all is bounded
            fcntl.fcntl(pipe.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)


def _work(
    parent: int,
    functions: Mapping[str, Callable[..., Any]],
    begin: Callable[[], None] | None,
    not_mine: Sequence[Connection],
    asked: Connection,
    answer: Connection,
) -> None:
    """The forked process."""
    tie(parent)
    for connection in not_mine:
        connection.close()
    for told_all in (signal.SIGINT, signal.SIGTERM):  # Ctrl-C and service managers tell the whole group; the parent,
        signal.signal(told_all, signal.SIG_IGN)  # which finishes what it accepted, decides
    if begin is not None:
        begin()
    gc.freeze()  # what the parent made is not looked through, so that its memory stays shared
    with suppress(EOFError, OSError):
        while True:
            function, given, named = asked.recv()
            for message in _answers(functions[function], given, named):
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
