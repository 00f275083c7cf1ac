"""Work that is done again while the machine or the store refuses it: a store that is locked, a disk that is full and
files that cannot be opened come back by themselves, and what was accepted is not given up for them."""

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
PASSING = (SQLAlchemyError, OSError, Busy, MemoryError)

Insist = Callable[[Callable[[], T]], T]


def passes(error: Exception) -> bool:
    """Whether it goes away by itself: the same is tried again."""
    return isinstance(error, PASSING) or str(error) == NO_THREAD


def insist(work: Callable[[], T], what: str, check: Callable[[], None]) -> T:
    """What `work` returns, tried as often as it takes; work that was half done may be done again.

    what: is at work, for the log; check: called while waiting, raises to give up.
    """
    retry = FIRST_RETRY
    while True:
        try:
            return work()
        except Exception as error:
            if not passes(error):
                raise
            log.error("%s: %s; trying again in %.1f s", what, message_of(error), retry)
        until = time.monotonic() + retry
        while time.monotonic() < until:
            check()
            time.sleep(min(LOOK_SECONDS, retry))
        retry = min(2.0 * retry, LAST_RETRY)


def message_of(error: Exception) -> str:
    """One line on what was refused."""
    strerror = error.strerror if isinstance(error, OSError) else None
    return strerror or first_line(error) or type(error).__name__
