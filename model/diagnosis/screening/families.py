"""Families of candidates with a common score test, one entry each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sprung.model.diagnosis.rules import ScreeningRules


def _nothing(rules: ScreeningRules) -> float:
    return 0.0


@dataclass(frozen=True)
class Family:
    """One family of score tests.  Multiple testing is corrected within a family, then over the families."""

    name: str
    freedom: int | None = 1  # of the chi-square of its score; None: one per parameter of the candidate
    # score that the best of its many trials reaches by chance, and by which a candidate of it counts for less
    look_elsewhere: Callable[[ScreeningRules], float] = _nothing
    rank: int = 1  # faults of the inputs (0) come before all that is simulated from them


ELEMENT = Family("law")
UNNAMED = Family("unnamed", freedom=None, look_elsewhere=lambda rules: rules.of_shapes)
HARMONIC = Family("harmonics", look_elsewhere=lambda rules: rules.of_lines)
LINE = Family("line", freedom=2, look_elsewhere=lambda rules: rules.of_lines)
MODE = Family("mode")
MASS = Family("mass")
PART = Family("part")
STRUCTURE = Family("structure", freedom=None, look_elsewhere=lambda rules: rules.of_places)
SENSOR = Family("sensor")
FILTER = Family("filter", look_elsewhere=lambda rules: rules.of_places)
INPUT = Family("input", rank=0)  # channels of supports, compensated before anything else
FORCE = Family("force", rank=0)  # measured forces, fitted as a law is
