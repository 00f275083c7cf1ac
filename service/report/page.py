"""The report as one HTML page that needs nothing beside it: styles and pictures are inside."""

from __future__ import annotations

import base64
from collections.abc import Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from sprung.model.diagnosis.report.report import Report
from sprung.service.report import words
from sprung.service.report.links import BACK
from sprung.service.report.values import rows

TEMPLATES = Path(__file__).parent / "templates"


def inline(path: Path) -> str:
    """A PNG as a data address."""
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode("ascii")


def render(report: Report, pictures: Mapping[str, Path], narrow: Mapping[str, Path], laws: words.Laws) -> str:
    """The page; pictures are keyed as `writing.draw_pictures` names them, laws are those that were tried.

    narrow: those that are shown on phones instead.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=False)
    return environment.from_string((TEMPLATES / "report.html").read_text("utf-8")).render(
        report=report,
        title=words.VERDICTS[report.verdict],
        headline=words.headline(report, laws),
        style=Markup((TEMPLATES / "report.css").read_text("utf-8")),  # nosec B704: our own file
        back=Markup(BACK),  # nosec B704: a constant
        pictures={key: inline(path) for key, path in pictures.items()},
        narrow={key: inline(path) for key, path in narrow.items()},
        groups=_groups(report, pictures, laws),
        rows=rows(report),
        named={(f.location, f.effect) for f in report.findings},
        effect=partial(words.effect_words, laws=laws),
        quantity=words.quantity,
        probability=words.probability,
        number=words.number,
    )


def _groups(report: Report, drawn: Collection[str], laws: words.Laws) -> list[dict[str, Any]]:
    """The keys of the pictures of each finding, then the fit in time and frequency."""
    groups = []
    for number, finding in enumerate(report.findings):
        own = [key for key in (f"force_{number}", f"residual_{number}") if key in drawn]
        if own:
            title = f"{words.place_words(finding.location)}: {words.finding_words(finding, laws)}"
            groups.append({"title": title, "pictures": own, "note": ""})
    if "fit" in drawn:
        groups.append(
            {
                "title": "Measured against simulated, held-out part",
                "pictures": ["fit"],
                "note": "Free-running: the simulation sees the measured inputs only.",
            }
        )
    return groups
