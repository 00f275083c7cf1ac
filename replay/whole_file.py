"""Files that are written whole or not at all: what a full disk cuts off never stands in the place of a good one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Where to write a file, of the same name, that takes the place of `path` once it is whole.

    Until then, and if it cannot be finished, `path` stays as it is.  A device or pipe is written directly, and so is a
    file in a folder that takes no other.  Errors: OSError that names `path` and says what stands there now.
    """
    there = path.resolve()
    if (there.exists() and not there.is_file()) or not os.access(there.parent, os.W_OK):
        yield path
        return
    try:
        with TemporaryDirectory(dir=there.parent, prefix=".sprung-") as folder:
            part = Path(folder) / path.name
            yield part
            if there.exists():
                shutil.copymode(there, part)
            part.replace(there)
    except OSError as error:  # of a full disk it has no file's name
        left = "what was there is as before" if there.exists() else "nothing is left"
        reason = f"cannot be written whole ({error.strerror or error}); {left}"
        raise OSError(error.errno or 0, reason, str(path)) from error
