"""Input and output of a diagnosis process; light, since both sides load it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sprung.model.system import System

IMPROVED = "system.yaml"  # in the report's folder: the system file with the findings


@dataclass(frozen=True, slots=True)
class DiagnosisRequest:
    """What to diagnose."""

    path: Path
    name: str  # of the recording, in the report
    system: System
    dbc: Path | None
    out: Path  # folder for page, pictures and report; made when absent
    system_text: str | None = None  # source of the system: findings are written into a copy
    search_seconds: float = math.inf  # time limit of the search
    start: int | None = None  # ns since 1970, when the recording began if its times count from 0


@dataclass(frozen=True, slots=True)
class Stage:
    """How far it is."""

    share: float  # 0..1
    text: str


@dataclass(frozen=True, slots=True)
class DiagnosisResult:
    """What it came to."""

    verdict: str
    report: dict[str, Any]  # as `sprung diagnose --json` prints it
