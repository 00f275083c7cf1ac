"""`sprung diagnose`."""

from __future__ import annotations

import json
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.diagnosis.record.channels import TooLittleError
from sprung.model.diagnosis.report.report import Report
from sprung.model.laws import CATALOGUE
from sprung.model.laws.own import load_laws
from sprung.model.system import MANCHESTER, System, load_system
from sprung.replay.record import Record
from sprung.service.can_database import database_of
from sprung.service.cli import apart
from sprung.service.cli.console import errors, silent_stage, stages
from sprung.service.cli.start_time import start_time
from sprung.service.cli.stdin import CALLED, spooled
from sprung.service.cli.targets import check_file, check_folder
from sprung.service.diagnosis.improved import left_out, write_improved
from sprung.service.diagnosis.own_laws import write_laws
from sprung.service.diagnosis.worker import load_excerpt
from sprung.service.sources.loading import RecordRequest


@dataclass(frozen=True)
class DiagnoseOptions:
    """Options of one diagnosis."""

    out: Path | None = None  # folder of the page
    name: str | None = None  # of the recording, in the report
    start: str | None = None  # when time counts from 0
    write_system: Path | None = None
    laws: Path | None = None  # of a user's own
    write_laws: Path | None = None  # formulas as such


def run(file: Path, system_file: Path | None, dbc: Path | None, asked: DiagnoseOptions, json_lines: bool) -> int:
    """Diagnose one recording; 1 for any verdict but `consistent`, or when it could not be decided."""
    _check_targets(asked)
    catalogue = CATALOGUE
    if asked.laws is not None:
        catalogue += load_laws(asked.laws, tuple(law.name for law in CATALOGUE))
    system = load_system(system_file or MANCHESTER, catalogue)
    with ExitStack() as stack:
        record = load(spooled(file, stack), system, database_of(system, dbc), start_time(asked.start, [file]))
    if str(file) == "-":
        file = CALLED
    for problem in record.problems:
        print(f"sprung: {file}: {problem}", file=sys.stderr)
    try:
        report = _diagnose(system, record, asked.name or file.name, quiet=json_lines)
    except TooLittleError as error:
        print(f"sprung: {file}: {error}", file=sys.stderr)
        return 1
    if asked.out is not None:
        from sprung.service.report.writing import write_report  # matplotlib takes a second

        files = write_report(report, system, asked.out)
        if not json_lines:
            print(f"{files.page}")
    if asked.write_system is not None:
        source = (system_file or MANCHESTER).read_text(encoding="utf-8")
        write_improved(asked.write_system, source, system, report)
        missing = left_out(report)
        more = f"; not in it: {', '.join(missing)}" if missing else ""
        print(f"sprung: {asked.write_system}: the system with the findings{more}", file=sys.stderr)
    if asked.write_laws is not None:
        count = write_laws(asked.write_laws, report)
        result = (
            f"{count} of them, for --laws; give them names" if count else "no formula was found; nothing is written"
        )
        print(f"sprung: {asked.write_laws}: {result}", file=sys.stderr)
    if json_lines:
        print(json.dumps(report.to_dict(), allow_nan=False), flush=True)
    else:
        print(text(report))
    return 0 if report.verdict == "consistent" and not report.recording.lost else 1


def _check_targets(asked: DiagnoseOptions) -> None:
    """Files that cannot be written are reported before the work begins."""
    check_file(asked.write_system)
    check_file(asked.write_laws)
    check_folder(asked.out)


def load(file: Path, system: System, dbc: Path | None, start: int | None = None) -> Record:
    """A recording on one even grid; or an excerpt that the service saved."""
    if file.suffix == ".npz":
        return load_excerpt(file)
    channels = (*system.channels, *system.signals)
    return apart.load(RecordRequest(file, channels, system.sample_rate, dbc, system.time, start))


def _diagnose(system: System, record: Record, name: str, quiet: bool) -> Report:
    with stages(errors()) as show:
        return diagnose(system, record, Options(file=name), silent_stage if quiet else show)


def text(report: Report) -> str:
    """The report in a few lines."""
    lines = [f"{report.recording.file}: {report.verdict.replace('_', ' ')}"]
    if report.summary:
        lines.append(report.summary)
    several = len(report.findings) > 1
    for finding in report.findings:
        values = ", ".join(f"{p.name} {p.words()}" for p in finding.parameters)
        sentence = finding.sentence or f"{finding.location}: {finding.effect} ({values})"
        if sentence not in report.summary or (several and finding.advice):  # else it has been said
            lines.append(sentence)
        if finding.advice:
            lines.append(f"  {finding.advice}")
    left, noise = report.augmented_validation.nrmse, report.noise_floor.nrmse
    lines.append(
        f"error on samples that no fit saw: {100 * report.baseline_validation.nrmse:.1f} % before, "
        f"{100 * left:.1f} % with the findings, "
        + (f"{100 * noise:.1f} % is noise" if noise <= 1.05 * left else f"no more than noise ({100 * noise:.1f} %)")
    )
    used = [report.recording.used] if report.recording.used else []
    return "\n".join([*lines, *used, *report.changes, *report.advice]).replace("+-", "±")
