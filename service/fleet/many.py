"""Diagnoses of many recordings, each a piece of work of its own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sprung.model.system import MANCHESTER, MANCHESTER_DBC, load_system
from sprung.service.diagnosing import run
from sprung.service.diagnosis_task import DiagnosisRequest
from sprung.service.errors import UserError
from sprung.service.fleet.backfill import KINDS, FoundFile, list_files, local_copy
from sprung.service.fleet.tasks import Tasks
from sprung.service.settings import Settings


@dataclass(frozen=True, slots=True)
class DiagnosedFile:
    """What a diagnosis came to."""

    path: str
    verdict: str  # empty where there is none
    findings: tuple[str, ...]  # a sentence each
    problem: str  # why there is none


def diagnose_many(settings: Settings, place: str, out: Path, tasks: Tasks) -> Iterator[DiagnosedFile]:
    """Diagnose every recording of a place; reports lie in `out`, a folder each, where workers can write to it."""
    found = list_files(place)
    if not found:
        raise UserError(f"{place}: no recordings ({' '.join(KINDS)})")
    out.mkdir(parents=True, exist_ok=True)
    root = place.partition("?")[0].rstrip("/")
    pending = [
        tasks.submit(diagnose_file, settings, file, out.absolute() / file.path.removeprefix(root).strip("/"))
        for file in found
    ]
    for one in pending:
        yield tasks.result(one)


def diagnose_file(settings: Settings, file: FoundFile, out: Path) -> DiagnosedFile:
    """Diagnose one recording and write its report."""
    try:
        system = load_system(settings.system or MANCHESTER)
        dbc = settings.dbc or (MANCHESTER_DBC if settings.system is None else None)
        with local_copy(file) as path:
            out.mkdir(parents=True, exist_ok=True)
            found = run(DiagnosisRequest(path, Path(file.path).name, system, dbc, out), lambda stage: None)
    except (ValueError, OSError) as error:
        return DiagnosedFile(file.path, "", (), (str(error) or type(error).__name__).splitlines()[0])
    told: list[dict[str, Any]] = found.report.get("findings", [])
    sentences = tuple(str(one.get("sentence") or f"{one['effect']} at {one['location']}") for one in told)
    return DiagnosedFile(file.path, found.verdict, sentences, "")
