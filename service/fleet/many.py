"""Diagnoses of many recordings, each a piece of work of its own; started again, they go on where they stopped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sprung import __version__
from sprung.model.system import MANCHESTER, load_system
from sprung.service.can_database import database_of
from sprung.service.diagnosis.task import DiagnosisRequest
from sprung.service.diagnosis.worker import run
from sprung.service.durable import sync_file
from sprung.service.errors import UserError
from sprung.service.fleet.backfill import message_of
from sprung.service.fleet.recordings import FoundFile, list_recordings, local_copy
from sprung.service.fleet.tasks import Tasks, WorkLost
from sprung.service.settings import Settings

AHEAD = 4  # recordings a core that are handed over before their turn
DONE = "done.json"  # in a report's folder, written last: inputs and result of the diagnosis


@dataclass(frozen=True, slots=True)
class DiagnosedFile:
    """What a diagnosis came to."""

    path: str
    verdict: str  # empty where there is none
    findings: tuple[str, ...]  # a sentence each
    problem: str  # why there is none
    before: bool = False  # it was done in an earlier run


@dataclass(frozen=True, slots=True)
class DiagnosisOrder:
    """One recording, and where its report is to lie."""

    settings: Settings
    file: FoundFile
    out: Path
    key: str  # of recording, system file and version: another one, and it is diagnosed again


def diagnose_many(
    settings: Settings, place: str, out: Path, tasks: Tasks, cores: int
) -> Iterator[tuple[DiagnosedFile, int]]:
    """Diagnose every recording of a place; reports lie in `out`, a folder each, where workers can write to it.

    Each recording with the number of all, in the order of their names, as soon as it and those before it are done.
    Raises UserError for a place, a system file or a folder that cannot be used.
    """
    found = list_recordings(place)
    system = load_system(settings.system or MANCHESTER)  # reported once, not per recording
    if out.exists() and not out.is_dir():
        raise UserError(f"{out}: is no folder")
    out.mkdir(parents=True, exist_ok=True)
    root = place.partition("?")[0].rstrip("/")
    waiting: list[tuple[FoundFile, Any]] = []
    for file in found:
        folder = out.absolute() / file.path.removeprefix(root).strip("/")
        text = "\n".join([__version__, system.file.model_dump_json(), str(settings.dbc), file.id])
        order = DiagnosisOrder(settings, file, folder, hashlib.sha256(text.encode()).hexdigest()[:32])
        done = _done(order)
        waiting.append((file, tasks.submit(diagnose_file, order) if done is None else done))
        if len(waiting) > AHEAD * cores or tasks.at_once:
            yield _result(tasks, *waiting.pop(0)), len(found)
    for one in waiting:
        yield _result(tasks, *one), len(found)


def diagnose_file(order: DiagnosisOrder) -> DiagnosedFile:
    """Diagnose one recording and write its report.  Errors are reported per recording."""
    settings, file, out = order.settings, order.file, order.out
    try:
        system = load_system(settings.system or MANCHESTER)
        dbc = database_of(system, settings.dbc)
        with local_copy(file) as path:
            out.mkdir(parents=True, exist_ok=True)
            found = run(DiagnosisRequest(path, Path(file.path).name, system, dbc, out), lambda stage: None)
    except Exception as error:  # the others go on
        return _failed(file, message_of(error))
    findings: list[dict[str, Any]] = found.report.get("findings", [])
    sentences = tuple(str(one.get("sentence") or f"{one['effect']} at {one['location']}") for one in findings)
    diagnosed = DiagnosedFile(file.path, found.verdict, sentences, "")
    part = out / f"{DONE}.part"
    part.write_text(json.dumps({"key": order.key} | asdict(diagnosed)), encoding="utf-8")
    sync_file(part)
    part.replace(out / DONE)
    return diagnosed


def _done(order: DiagnosisOrder) -> DiagnosedFile | None:
    """What an earlier run has made of the same recording; None where there is none."""
    try:
        kept = json.loads((order.out / DONE).read_text(encoding="utf-8"))
        if kept["key"] != order.key:
            return None
        return DiagnosedFile(order.file.path, str(kept["verdict"]), tuple(kept["findings"]), "", before=True)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _result(tasks: Tasks, file: FoundFile, pending: Any) -> DiagnosedFile:
    if isinstance(pending, DiagnosedFile):
        return pending
    try:
        found: DiagnosedFile = tasks.result(pending)
    except WorkLost as error:
        return _failed(file, str(error))
    return found


def _failed(file: FoundFile, problem: str) -> DiagnosedFile:
    return DiagnosedFile(file.path, "", (), " ".join(problem.split())[:500])
