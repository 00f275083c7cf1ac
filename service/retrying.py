"""Retries after transient errors, with growing pauses: a locked store, a full disk, files that cannot be opened.

These pass by themselves, and what was accepted is not given up for them.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TypeVar

from sqlalchemy.exc import SQLAlchemyError

from sprung.model.text import first_line
from sprung.service.errors import NO_THREAD, Busy

log = logging.getLogger("sprung.trouble")
T = TypeVar("T")
FIRST_RETRY, LAST_RETRY = 0.5, 30.0  # s, doubled from try to try
LOOK_SECONDS = 0.1  # between two looks whether to give up
TRANSIENT = (SQLAlchemyError, OSError, Busy, MemoryError)

Retry = Callable[[Callable[[], T]], T]


def is_transient(error: Exception) -> bool:
    """Whether it goes away by itself: the same is tried again."""
    return isinstance(error, TRANSIENT) or str(error) == NO_THREAD


def retry(work: Callable[[], T], what: str, check: Callable[[], None]) -> T:
    """What `work` returns, tried as often as it takes; work that was half done may be done again.

    what: is at work, for the log; check: called while waiting, raises to give up.
    """
    pause = FIRST_RETRY
    while True:
        try:
            return work()
        except Exception as error:
            if not is_transient(error):
                raise
            log.error("%s: %s; trying again in %.1f s", what, message_of(error), pause)
        until = time.monotonic() + pause
        while time.monotonic() < until:
            check()
            time.sleep(min(LOOK_SECONDS, pause))
        pause = min(2.0 * pause, LAST_RETRY)


def message_of(error: Exception) -> str:
    """One line on what was refused."""
    strerror = error.strerror if isinstance(error, OSError) else None
    return strerror or first_line(error) or type(error).__name__
