"""Identifying in a process of its own, so that it and tracking run beside each other.

Threads of one interpreter do not: identification is some thousand short operations a batch, each of which waits for the
interpreter's lock.  Measured with 100 vehicles and a window a second on two cores: both took twice the processor time
that they take alone.
"""

from __future__ import annotations

import gc
import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from sprung.model.identifier import Identifies, StageTimes
from sprung.model.signals import Estimate, FloatArray
from sprung.service.worker import tie

log = logging.getLogger("sprung.engine")
END_SECONDS = 2.0


@contextmanager
def apart(identifier: Identifies) -> Iterator[Identifies]:
    """The same in a process of its own where that is of use: on Linux, with more than one processor.

    Enter it before the first thread is started: the process is forked, and shares the memory of this one.
    """
    if sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2:
        yield identifier
        return
    with closing(IdentifierApart(identifier)) as found:
        yield found


class IdentifierApart:
    """Identifies windows in a forked process; in this one from when that has died.  One thread at a time is served."""

    def __init__(self, identifier: Identifies) -> None:
        self.digest = identifier.digest
        self.times = StageTimes()
        self._here = identifier
        self._lock = threading.Lock()
        context = multiprocessing.get_context("fork")
        mine, theirs = context.Pipe()
        process = context.Process(
            target=_work, args=(os.getpid(), identifier, mine, theirs), name="sprung-identify", daemon=True
        )
        process.start()
        theirs.close()
        self._there: tuple[BaseProcess, Connection] | None = (process, mine)

    def identify(self, windows: FloatArray, start: FloatArray | None = None, *, states: bool = False) -> list[Estimate]:
        """As that of the identifier."""
        return self._ask("identify", windows, start, states=states)

    @property
    def examine(self) -> Callable[..., list[Estimate]] | None:
        """That of the identifier, where it has one."""
        return partial(self._ask, "examine") if hasattr(self._here, "examine") else None

    @property
    def pid(self) -> int | None:
        """Of the process; None once it has died."""
        return None if self._there is None else self._there[0].pid

    def close(self) -> None:
        """End the process."""
        with self._lock:
            if self._there is not None:
                process, connection = self._there
                self._there = None
                connection.close()
                process.join(END_SECONDS)
                process.kill()

    def _ask(self, what: str, *given: Any, **named: Any) -> list[Estimate]:
        with self._lock:
            if self._there is not None:
                process, connection = self._there
                try:
                    connection.send((what, given, named))
                    answer, self.times = connection.recv()
                except (EOFError, OSError):
                    self._there = None
                    process.join(END_SECONDS)
                    log.error(
                        "the process that identifies windows ended (status %s); they are identified beside the rest "
                        "now, which is slower, until the service is started again",
                        process.exitcode,
                    )
                else:
                    if isinstance(answer, BaseException):
                        raise answer
                    found: list[Estimate] = answer
                    return found
            found = getattr(self._here, what)(*given, **named)
            self.times = self._here.times
            return found


def _work(parent: int, identifier: Identifies, not_mine: Connection, connection: Connection) -> None:
    """The forked process."""
    tie(parent)
    not_mine.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the whole group; the parent decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    gc.freeze()  # what the parent made is not looked through, so that its memory stays shared
    with suppress(EOFError, OSError):
        while True:
            what, given, named = connection.recv()
            try:
                answer: Any = getattr(identifier, what)(*given, **named)
            except ValueError as error:  # of windows that cannot be identified; its class matters
                answer = error
            except Exception as error:
                log.exception("windows could not be identified")
                answer = RuntimeError(f"{type(error).__name__}: {error}")
            connection.send((answer, identifier.times))
