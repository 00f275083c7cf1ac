"""CAN databases (DBC, KCD, SYM, ARXML), read by cantools within bounds.

cantools draws every bit of every message and needs up to 200 bytes of memory for each byte of a text, so that 80 bytes
of DBC could take gigabytes.
"""

from __future__ import annotations

from contextvars import ContextVar
from pathlib import Path

import cantools
from cantools.database import Database, Message

from sprung.model.text import first_line
from sprung.replay.account import UnreadableRecording

MOST_MESSAGE_BYTES = 4095  # in several frames (ISO 15765-2; 1785 of SAE J1939-21), which a database may describe, too
MOST_TEXT_BYTES = 8_000_000  # of DBC and SYM: 1.7 GB of memory at worst; whole cars have 1 to 3 MB
MOST_XML_BYTES = 64_000_000  # of KCD and ARXML
XML = (".kcd", ".arxml")


def load_database(path: Path, strict: bool = False) -> Database:
    """A cantools database; raises UnreadableRecording with one line.

    strict: refuse messages whose signals overlap or do not fit.
    """
    within = _BOUNDED.set(True)
    try:
        _check_size(path)
        database = cantools.database.load_file(path, strict=strict)
    except FileNotFoundError:
        raise UnreadableRecording(f"{path}: no such CAN database") from None
    except UnreadableRecording:
        raise
    except Exception as error:
        raise UnreadableRecording(f"{path}: not a CAN database that can be read: {first_line(error)}") from error
    finally:
        _BOUNDED.reset(within)
    if not isinstance(database, Database):
        raise UnreadableRecording(f"{path}: a diagnostics database, not one of CAN messages")
    return database


def _check_size(path: Path) -> None:
    """Refuse what is no file, and what is larger than any CAN database."""
    size, most = path.stat().st_size, MOST_XML_BYTES if path.suffix.lower() in XML else MOST_TEXT_BYTES
    if not path.is_file():
        raise UnreadableRecording(f"{path}: no file, and so no CAN database")
    if size > most:
        raise UnreadableRecording(
            f"{path}: {size / 1e6:.0f} MB, of which at most {most / 1e6:.0f} MB are read as a CAN database; "
            "leave out messages whose signals the system file does not name"
        )


def _check_message(message: Message) -> None:
    """Refuse a message that nothing can send."""
    if message.length > MOST_MESSAGE_BYTES:
        raise ValueError(f"message {message.name} of {message.length} bytes, which nothing sends so")
    for signal in message.signals:
        if signal.start + signal.length > 8 * MOST_MESSAGE_BYTES:
            raise ValueError(
                f"signal {signal.name}: {signal.length} bits from bit {signal.start} on, which no frame holds so"
            )


_BOUNDED: ContextVar[bool] = ContextVar("within `load_database`", default=False)
_REFRESH = Message.refresh


def _refresh(self: Message, strict: bool | None = None) -> None:
    """`Message.refresh`, which draws the bits, for messages that can be sent.

    cantools asks nobody before it draws, so that its method is replaced; other users of it get what they had: only
    `load_database` has bounds.
    """
    if _BOUNDED.get():
        _check_message(self)
    _REFRESH(self, strict)


Message.refresh = _refresh  # type: ignore[method-assign]  # see there
