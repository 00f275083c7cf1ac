"""A mismatch report as a page and its pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from matplotlib.figure import Figure

from sprung.model.diagnosis.report.report import Finding, Report
from sprung.model.system import System
from sprung.replay.whole_file import written_whole
from sprung.service.report import drawing, forces, ink, signals, values, words
from sprung.service.report.page import render


@dataclass(frozen=True)
class ReportFiles:
    """What was written."""

    page: Path
    data: Path
    pictures: dict[str, Path]


def findings_by_place(findings: Sequence[Finding], laws: words.Laws) -> dict[str, str]:
    """What stands beside every located place; several findings of one place share its label."""
    places = dict[str, list[str]]()
    for found in findings:
        places.setdefault(found.location, []).append(words.finding_words(found, laws))
    return {place: "; ".join(said) for place, said in places.items()}


def draw_pictures(report: Report, system: System, folder: Path) -> dict[str, Path]:
    """Every picture for which the report has the arrays, as PNG files in `folder`."""
    findings = findings_by_place(report.findings, system.catalogue)
    figures = {
        "system": drawing.draw_system(system, findings, report.localization),
        "sensors": signals.sensor_figure(report),
        "locations": values.location_figure(report),
    }
    return _saved(figures | _panelled(report, system, narrow=False), folder)


def _panelled(report: Report, system: System, *, narrow: bool) -> dict[str, Figure | None]:
    """The pictures of several panels; narrow: below each other, for phones."""
    units = tuple(channel.unit for channel in system.channels[len(system.inputs) :])
    figures = {
        "fit": signals.fit_figure(report, system.sensors, units, system.sample_rate, narrow=narrow),
        "parameters": values.parameter_figure(report, narrow=narrow),
    }
    for number in range(len(report.findings)):
        figures[f"force_{number}"] = forces.force_figure(report, number, narrow=narrow)
        figures[f"residual_{number}"] = forces.residual_figure(report, number, narrow=narrow)
    return figures


def _saved(figures: Mapping[str, Figure | None], folder: Path) -> dict[str, Path]:
    return {key: ink.save(figure, folder / f"{key}.png") for key, figure in figures.items() if figure is not None}


def write_report(report: Report, system: System, folder: Path) -> ReportFiles:
    """Writes report.html, report.json and the pictures into `folder`, which is made if absent.

    >>> import pathlib, sprung
    >>> rig = sprung.load_system("rig.yaml")
    >>> report = sprung.diagnose(rig, sprung.load_record("rig.csv", rig))
    >>> files = sprung.write_report(report, rig, pathlib.Path("report"))
    >>> files.page.name, "fit" in files.pictures
    ('report.html', True)
    """
    folder.mkdir(parents=True, exist_ok=True)
    pictures = draw_pictures(report, system, folder)
    page, data = folder / "report.html", folder / "report.json"
    with TemporaryDirectory() as kept:
        narrow = _saved(_panelled(report, system, narrow=True), Path(kept))
        with written_whole(page) as part:
            part.write_text(render(report, pictures, narrow, system.catalogue), encoding="utf-8")
    with written_whole(data) as part:
        part.write_text(json.dumps(report.to_dict(), indent=1, allow_nan=False), encoding="utf-8")
    return ReportFiles(page, data, pictures)


__all__ = ["ReportFiles", "draw_pictures", "write_report"]
