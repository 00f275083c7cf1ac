"""Logs: one event a line, as text for people or as JSON for machines, with the request that it belongs to."""

from __future__ import annotations

import errno
import json
import logging
import re
import sys
from asyncio import CancelledError
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any

from sprung.model.text import escaped

request_id: ContextVar[str] = ContextVar("request_id", default="")
PLAIN = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime"}
WORD = re.compile(r"[^\s\"=]+")


class JsonLines(logging.Formatter):
    """`{"time", "level", "logger", "event", "request", ...}`; what was given as `extra` stands beside."""

    def format(self, record: logging.LogRecord) -> str:
        """One line."""
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, tz=UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "event": record.getMessage(),
        }
        line |= _beside(record)
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class PlainLines(logging.Formatter):
    """Text for people; an event stays on its line, however many its message has (SQL errors have three)."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """Level and message, then what was given as `extra`, and the request."""
        line = " ".join(f"sprung: {record.levelname}: {record.message}".splitlines())
        line += "".join(f" {name}={_plain(value)}" for name, value in _beside(record).items())
        return escaped(line)  # a terminal would obey them


def _beside(record: logging.LogRecord) -> dict[str, Any]:
    """The request that an event belongs to, and what was given as `extra`."""
    request = {"request": request_id.get()} if request_id.get() else {}
    return request | {name: value for name, value in vars(record).items() if name not in PLAIN}


def _plain(value: Any) -> str:
    """A value of a line of text; between quotation marks where it could be taken for more than one."""
    if isinstance(value, float):
        return f"{value:.4g}"
    text = str(value)
    return text if WORD.fullmatch(text) else json.dumps(text)


SHORTAGES = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOBUFS)  # of the machine
LOGGED = "sprung_logged"  # attribute of an exception that is in the log already


def untold(record: logging.LogRecord) -> bool:
    """Whether an exception is not in the log yet: the server reports what the application has reported."""
    error = record.exc_info[1] if record.exc_info else None
    return not getattr(error, LOGGED, False)


def foreseen(record: logging.LogRecord) -> bool:
    """Whether an exception is to be logged, and in a line where it is no fault of the program: connections that are not
    accepted for want of files or memory; requests that are given up at the end are counted by the server."""
    error = record.exc_info[1] if record.exc_info else None
    if isinstance(error, OSError) and error.errno in SHORTAGES and record.name == "asyncio":
        record.msg, record.args, record.exc_info = f"no connection is accepted: {error.strerror}", None, None
    elif isinstance(error, MemoryError) and record.name == "asyncio":
        record.msg, record.args, record.exc_info = (
            "a connection is dropped: there is no memory for what it sends",
            None,
            None,
        )
    return not isinstance(error, CancelledError)


def set_up(form: str, level: str) -> None:
    """Log to stderr; form: text or json."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if form == "json" else PlainLines())
    handler.addFilter(untold)
    handler.addFilter(foreseen)
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    logging.captureWarnings(True)  # which would be no lines of that form
    logging.getLogger("python_multipart").setLevel(logging.ERROR)  # what strangers send wrong would fill the log
    logging.getLogger("sprung").setLevel(level.upper())
