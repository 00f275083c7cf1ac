"""`sprung bench paper-report`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sprung.benchmarks.paper_report.document import refresh
from sprung.benchmarks.paper_report.kept import ARCHIVE, opened
from sprung.service.errors import UserError

PLACES = {  # kinds of places by the set of kept rows that they are written from
    "core": ("rows", "explained", "against", "printed", "noisy", "poor", "tuned", "compared", "targets"),
    "variants": ("variants",),
}


def run(data: Path | None = None, document: Path | None = None, *, only: str | None = None) -> Iterator[dict[str, Any]]:
    """One dict per place of the document that was written: its marker, how many rows, their seeds, whether it changed.

    data: folder of the budget, "runs/paper/quick"; by default the rows kept in docs/;
    document: this checkout's docs/paper.md by default;
    only: kinds of places, or single ones ("variants", "variants pendulum"), several between commas; no pictures then.
    """
    page = document or ARCHIVE.parent / "paper.md"
    places = None if only is None else [part.strip() for part in only.split(",")]
    try:
        if data is not None:
            yield from _summary(refresh(data, page, places), only)
            return
        refreshed = []
        for kept, kinds in PLACES.items():
            wanted = [place for place in places or kinds if place.partition(" ")[0] in kinds]
            if wanted:
                with opened(kept) as folder:
                    refreshed += refresh(folder, page, wanted)
        yield from _summary(refreshed, only)
    except (ValueError, OSError) as error:
        raise UserError(f"bench paper-report: {error}") from error


def _summary(written: list[dict[str, Any]], only: str | None) -> list[dict[str, Any]]:
    """What was written, if anything was."""
    if not written:
        raise UserError(f"bench paper-report: no rows for any place{f' of {only}' if only else ''} of the document")
    return written
