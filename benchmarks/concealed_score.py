"""Judging diagnoses against the truth: pure functions from labels and reports to figures.

A label is an entry of labels.json, a report the JSON of `sprung diagnose`.  Undefined figures are None.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from sprung.model.diagnosis.kinds import EffectKind

Truth = Mapping[str, Any]
Verdict = Mapping[str, Any]  # the JSON of a report


@dataclass(frozen=True)
class Score:
    """One recording, judged."""

    kind: str
    truth: str  # verdicts
    said: str
    verdict: bool
    located: bool | None  # every true place was found, and no other; None for clean recordings
    named: bool | None  # and every law has its right name
    detected: bool  # anything but "consistent"
    found: bool  # something is said of a true place, whatever else is said
    explained: float | None  # share of the excess error on held-out data
    parameter_z: tuple[float, ...]  # (value - truth) / std of the laws' parameters
    structure_z: tuple[float, ...]  # the same of stiffnesses and dampings, with the findings in place
    snr: float | None  # the oracle's


def same_place(said: str, true: str) -> bool:
    """A channel of an input may be called by the input's name."""
    return said == true or said == true.partition(".")[0] or said.partition(".")[0] == true


def explained(report: Verdict) -> float | None:
    """1 - (augmented - floor) / (baseline - floor) of the held-out mean squares; None without an excess."""
    mean_squares = []
    for key in ("augmented", "baseline"):
        value = report[key]["validation"]["nrmse"]
        mean_squares.append(math.nan if value is None else value**2)
    floor = report["noise_floor"]["nrmse"]
    if floor is None or not math.isfinite(sum(mean_squares)) or mean_squares[1] <= 1.02 * floor**2:
        return None
    found: float | None = 1 - (mean_squares[0] - floor**2) / (mean_squares[1] - floor**2)
    return found


def _matches(said: Mapping[str, Any], true: Mapping[str, Any], named_laws: Iterable[str]) -> bool:
    """The right name: the law's own; for a law that no catalogue holds `unknown`, or a formula."""
    if true["effect"] in set(named_laws):
        return bool(said["effect"] == true["effect"])
    return bool(said["kind"] == EffectKind.UNLISTED.value)


def _z(said: Mapping[str, Any], true: Mapping[str, Any]) -> list[float]:
    """Errors of a law's parameters; the smoothing of a friction's corner is not scored."""
    out = []
    for mine, value in zip(said["parameters"], true.get("parameters", []), strict=False):
        if mine["name"] != "smoothing" and mine["std"] and mine["value"] is not None:
            out.append((mine["value"] - value) / mine["std"])
    return out


def score(truth: Truth, report: Verdict, named_laws: Sequence[str]) -> Score:
    """Judges one report."""
    true, said = truth["findings"], report["findings"]
    pairs = [(t, s) for t in true for s in said if same_place(s["location"], t["location"])]
    places_right = len(said) == len(true) == len({t["location"] for t, _ in pairs})
    located = places_right if true else None
    named = (places_right and all(_matches(s, t, named_laws) for t, s in pairs)) if true else None
    parameter_z = [z for t, s in pairs if s["effect"] == t["effect"] for z in _z(s, t)]
    structure = []
    for p in report["augmented"]["parameters"] if said else report["baseline"]["parameters"]:
        element, _, quantity = p["name"].rpartition(".")
        if p["std"] and quantity in ("stiffness", "damping"):
            structure.append((p["value"] - truth[quantity][element]) / p["std"])
    return Score(
        kind=truth.get("kind", ""),
        truth=truth["verdict"],
        said=report["verdict"],
        verdict=truth["verdict"] == report["verdict"],
        located=located,
        named=named,
        detected=report["verdict"] != "consistent",
        found=bool(pairs),
        explained=explained(report) if said else None,
        parameter_z=tuple(parameter_z),
        structure_z=tuple(structure),
        snr=truth.get("oracle_snr"),
    )


def rate(flags: Iterable[bool | None]) -> float | None:
    """Share of True among the defined."""
    known = [flag for flag in flags if flag is not None]
    return sum(known) / len(known) if known else None


def rate_bound(hits: int, tries: int, level: float = 0.95) -> float | None:
    """Clopper-Pearson upper bound of a rate."""
    if tries == 0:
        return None
    return 1.0 if hits == tries else float(stats.beta.ppf(level, hits + 1, tries - hits))


def confusion(scores: Iterable[Score]) -> dict[str, dict[str, int]]:
    """Counts of said verdicts for every true one."""
    table: dict[str, Counter[str]] = {}
    for s in scores:
        table.setdefault(s.truth, Counter())[s.said] += 1
    return {truth: dict(counts) for truth, counts in table.items()}


def detection_limit(snr: Sequence[float], detected: Sequence[bool]) -> float | None:
    """The oracle's signal-to-noise ratio at which half of the effects are found.

    A logistic curve over log snr, fitted by maximum likelihood with a weak prior on its slope; None unless both
    outcomes occur.
    """
    x, y = np.log(np.maximum(snr, 1e-3)), np.asarray(detected, float)
    if y.size < 4 or y.min() == y.max():
        return None
    best, figure = None, np.inf
    for slope in np.geomspace(0.7, 20, 40):
        for middle in np.linspace(x.min(), x.max(), 200):
            t = slope * (x - middle)
            cost = float(np.sum(np.logaddexp(0, t) - y * t)) + 0.5 * (np.log(slope / 4) / 1.0) ** 2
            if cost < figure:
                best, figure = middle, cost
    return None if best is None else float(np.exp(best))


def oracle_threshold(false_alarm_rate: float) -> float:
    """Signal-to-noise ratio that the oracle needs for even odds: two-sided, one degree of freedom."""
    return float(stats.norm.isf(false_alarm_rate / 2))


def summary(scores: Sequence[Score], false_alarm_rate: float) -> dict[str, Any]:
    """The figures of one set of recordings."""
    clean = [s for s in scores if s.truth == "consistent"]
    real = [s for s in scores if s.truth != "consistent"]
    z = np.array([z for s in real for z in s.parameter_z])
    structure = np.array([z for s in scores for z in s.structure_z])
    shares = np.array([s.explained for s in real if s.explained is not None])
    single = [s for s in real if s.snr is not None and s.kind != "two"]
    limit = detection_limit([s.snr or 0.0 for s in single], [s.found for s in single])
    threshold = oracle_threshold(false_alarm_rate)
    visible = [s for s in real if s.snr is None or s.snr >= 2 * threshold]
    alarms = sum(s.detected for s in clean)
    return {
        "recordings": len(scores),
        "verdict": rate(s.verdict for s in scores),
        "located": rate(s.located for s in real),
        "named": rate(s.named for s in real),
        "visible": len(visible),
        "verdict_visible": rate(s.verdict for s in visible),
        "located_visible": rate(s.located for s in visible),
        "named_visible": rate(s.named for s in visible),
        "clean": len(clean),
        "false_alarms": alarms,
        "false_alarm_rate": rate(s.detected for s in clean),
        "false_alarm_rate_95": rate_bound(alarms, len(clean)),
        "explained_median": float(np.median(shares)) if shares.size else None,
        "explained_min": float(shares.min()) if shares.size else None,
        "explained_above_0.95": float((shares >= 0.95).mean()) if shares.size else None,
        "law_parameters_within_3_std": float((np.abs(z) < 3).mean()) if z.size else None,
        "structure_within_3_std": float((np.abs(structure) < 3).mean()) if structure.size else None,
        "limit_snr": limit,
        "oracle_limit_snr": threshold,
        "limit_ratio": None if limit is None else limit / threshold,
        "confusion": confusion(scores),
    }
