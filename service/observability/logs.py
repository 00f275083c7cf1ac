"""Logs: one event a line, as text for people or as JSON for machines, with the request that it belongs to."""

from __future__ import annotations

import json
import logging
import sys
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any

from sprung.model.text import escaped

request_id: ContextVar[str] = ContextVar("request_id", default="")
PLAIN = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime"}


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
        if request_id.get():
            line["request"] = request_id.get()
        line |= {name: value for name, value in vars(record).items() if name not in PLAIN}
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class PlainLines(logging.Formatter):
    """Text for people; an event stays on its line, however many its message has (SQL errors have three)."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """Level and message."""
        line = " ".join(f"sprung: {record.levelname}: {record.message}".splitlines())
        return escaped(line)  # a terminal would obey them


TOLD = "sprung_told"  # attribute of an exception that is in the log already


def untold(record: logging.LogRecord) -> bool:
    """Whether an exception is not in the log yet: the server reports what the application has reported."""
    error = record.exc_info[1] if record.exc_info else None
    return not getattr(error, TOLD, False)


def set_up(form: str, level: str) -> None:
    """Log to stderr; form: text or json."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if form == "json" else PlainLines())
    handler.addFilter(untold)
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    logging.getLogger("sprung").setLevel(level.upper())
