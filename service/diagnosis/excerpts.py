"""Samples of a vehicle among the uploads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sprung.service.diagnosis.worker import save_excerpt
from sprung.service.monitoring.ring import Excerpt
from sprung.service.store import work


@contextmanager
def kept_excerpt(uploads: Path, excerpt: Excerpt) -> Iterator[Path]:
    """A file of samples, which goes again where the store does not take the row that names it."""
    path = uploads / f"{work.new_id()}.npz"
    save_excerpt(path, excerpt)
    try:
        yield path
    except BaseException:
        path.unlink(missing_ok=True)
        raise
