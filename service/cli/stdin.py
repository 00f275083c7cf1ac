"""`-`: a recording from standard input, kept in a file for as long as it is read."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from sprung.service.errors import UserError

CALLED = Path("standard input")  # in messages
MAGIC = (  # how each kind of file begins; text is recognised by its first line
    (b"\x89MCAP", ".mcap"),
    (b"LOGG", ".blf"),
    (b"MDF ", ".mf4"),
    (b"PAR1", ".parquet"),
    (b"(", ".log"),
    (b"date ", ".asc"),
)


def spooled(path: Path, stack: ExitStack) -> Path:
    """The path itself; for `-`, a temporary file with what standard input holds, which ends with the stack.

    Errors that name this file within the stack name standard input instead.  Raises UserError when nothing comes.
    """
    if str(path) != "-":
        return path
    head = sys.stdin.buffer.read(8)
    if not head:
        raise UserError("-: standard input is empty; send a recording, as in `sprung replay - < ride.mcap`")
    suffix = next((suffix for magic, suffix in MAGIC if head.startswith(magic)), ".csv")
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sprung-")))
    kept = folder / f"stdin{suffix}"
    stack.enter_context(_named_as_sent(kept))
    with open(kept, "wb") as file:
        file.write(head)
        shutil.copyfileobj(sys.stdin.buffer, file)
    return kept


@contextmanager
def _named_as_sent(kept: Path) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        if str(kept) not in str(error):
            raise
        raise UserError(str(error).replace(str(kept), str(CALLED))) from error
