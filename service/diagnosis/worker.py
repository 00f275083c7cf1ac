"""One diagnosis, as a task for a process of its own: a file in, a report and its folder out.

A diagnosis takes half a minute of both cores: apart, at low priority, requests and live windows go on meanwhile, and a
stop can interrupt it.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from sprung.replay.account import Account
from sprung.replay.record import Record
from sprung.service.diagnosis.task import IMPROVED, DiagnosisRequest, DiagnosisResult, Stage
from sprung.service.durable import sync_file, sync_folder
from sprung.service.monitoring.ring import Excerpt
from sprung.service.processes.threads import hand_over_often, one_thread_each
from sprung.service.processes.worker import Emit
from sprung.service.sources.opening import open_record

log = logging.getLogger("sprung.diagnosis")

SIGN_OF_LIFE_SECONDS = 2.0  # a stage may take longer
STAGE_SHARE, STAGE_SECONDS = 0.1, 20.0  # a stage's usual part of the whole, and how soon most of it is done


def run(request: DiagnosisRequest, emit: Emit[Stage]) -> DiagnosisResult:
    """Diagnose and write the report.  Raises ValueErrors of one line for files that cannot be used."""
    one_thread_each()  # candidates are fitted beside each other
    hand_over_often()
    from sprung.model.diagnosis.api import Options, diagnose
    from sprung.model.diagnosis.rules import RULES
    from sprung.model.work import WorkBudget
    from sprung.service.diagnosis.improved import write_improved
    from sprung.service.report.writing import write_report

    latest, begun = Stage(0.0, "reading"), time.monotonic()

    def show(share: float, text: str) -> None:
        nonlocal latest, begun
        begun = time.monotonic()
        latest = Stage(share, text)
        emit(latest)

    done = threading.Event()

    def live() -> None:
        while not done.wait(SIGN_OF_LIFE_SECONDS):
            emit(within(latest, time.monotonic() - begun))

    threading.Thread(target=live, daemon=True).start()
    try:
        show(0.0, "reading")
        work = WorkBudget(RULES.fit.work, time.monotonic() + request.search_seconds)
        options = Options(file=request.name, work=work)
        report = diagnose(request.system, _load(request), options, show)
        show(1.0, "writing the report")
        write_report(report, request.system, request.out)
        if request.system_text is not None:
            try:
                write_improved(request.out / IMPROVED, request.system_text, request.system, report)
            except (OSError, ValueError) as error:  # changed since the service began: the report stays good
                log.warning("the system file with the findings is not written: %s", error)
        return DiagnosisResult(report.verdict, report.to_dict())
    except ValueError as error:
        raise ValueError(str(error).replace(str(request.path), request.name)) from error
    finally:
        done.set()


def within(stage: Stage, seconds: float) -> Stage:
    """How far a stage probably is after so many seconds: how long stages take is not known, only that they move."""
    return replace(stage, share=min(0.99, stage.share + STAGE_SHARE * (1 - math.exp(-seconds / STAGE_SECONDS))))


def _load(request: DiagnosisRequest) -> Record:
    if request.path.suffix == ".npz":
        return load_excerpt(request.path)
    return open_record(request.path, request.system, request.dbc, request.start, signals=True)


def save_excerpt(path: Path, excerpt: Excerpt) -> None:
    """Write samples as an .npz that `load_excerpt` reads; whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.part")
    try:
        with open(part, "wb") as target:
            np.savez_compressed(target, start=excerpt.start, sample_rate=excerpt.sample_rate, values=excerpt.values)
        sync_file(part)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)  # of a disk that is full
    sync_folder(path.parent)


def load_excerpt(path: Path) -> Record:
    """Read what `save_excerpt` wrote."""
    with np.load(path, allow_pickle=False) as data:
        start, rate, values = int(data["start"]), float(data["sample_rate"]), data["values"]
    missing = np.isnan(values)
    lost = int(missing[:, ~missing.all(axis=0)].sum())
    return Record(start, rate, values, lost, None, (), Account())
