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
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from sprung.service.worker import tie

log = logging.getLogger("sprung")
END_SECONDS = 2.0


class ProcessEnded(RuntimeError):
    """The process is no more."""


def forks() -> bool:
    """Whether a process beside this one is of use, and can be forked: on Linux, with more than one processor, and
    before the first thread, whose locks nobody would release in the fork."""
    return sys.platform == "linux" and len(os.sched_getaffinity(0)) > 1 and threading.active_count() == 1


class ForkedFunctions:
    """A process with some functions.  Make it before the first thread is started.

    `call` may be used from any thread; one call is worked on at a time.
    """

    def __init__(self, name: str, functions: Mapping[str, Callable[..., Any]]) -> None:
        """name: what it does, as in `identifies windows`."""
        self._name = name
        self._lock = threading.Lock()
        context = multiprocessing.get_context("fork")
        mine, theirs = context.Pipe()
        process = context.Process(
            target=_work,
            args=(os.getpid(), functions, mine, theirs),
            name=f"sprung-{name.split(maxsplit=1)[0]}",
            daemon=True,
        )
        process.start()
        theirs.close()
        self._there: tuple[BaseProcess, Connection] | None = (process, mine)
        atexit.register(self.close)  # before multiprocessing's own, which would wait for it

    @property
    def pid(self) -> int | None:
        """Of the process; None once it has ended."""
        return None if self._there is None else self._there[0].pid

    def call(self, function: str, *given: Any, **named: Any) -> Any:
        """What the function returns; raises what it raises if that is a ValueError, else a RuntimeError.

        Raises ProcessEnded when the process is no more, which is logged the first time.
        """
        with self._lock:
            if self._there is None:
                raise ProcessEnded(self._name)
            process, connection = self._there
            try:
                connection.send((function, given, named))
                answer, raised = connection.recv()
            except (EOFError, OSError):
                self._there = None
                process.join(END_SECONDS)
                log.error(
                    "the process that %s ended (status %s); the service does that itself now, which is slower, until "
                    "it is started again",
                    self._name,
                    process.exitcode,
                )
                raise ProcessEnded(self._name) from None
        if raised:
            raise answer
        return answer

    def close(self) -> None:
        """End the process."""
        atexit.unregister(self.close)
        with self._lock:
            if self._there is not None:
                process, connection = self._there
                self._there = None
                connection.close()
                process.join(END_SECONDS)
                process.kill()


def _work(parent: int, functions: Mapping[str, Callable[..., Any]], not_mine: Connection, mine: Connection) -> None:
    """The forked process."""
    tie(parent)
    not_mine.close()
    for told_all in (signal.SIGINT, signal.SIGTERM):  # Ctrl-C and service managers tell the whole group; the parent,
        signal.signal(told_all, signal.SIG_IGN)  # which finishes what it accepted, decides
    gc.freeze()  # what the parent made is not looked through, so that its memory stays shared
    with suppress(EOFError, OSError):
        while True:
            function, given, named = mine.recv()
            try:
                answer: tuple[Any, bool] = functions[function](*given, **named), False
            except ValueError as error:  # of what cannot be used: the caller wants to know which
                answer = error, True
            except Exception as error:
                log.exception("a call of %s failed", function)
                answer = RuntimeError(f"{type(error).__name__}: {error}"), True
            mine.send(answer)
