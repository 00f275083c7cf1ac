"""`sprung bench concealed`: effects hidden by an independent generator, against the tool that sees only files.

Recordings are drawn from sealed seeds (`benchmarks.generator`), written as files, diagnosed through the public door
and judged by `benchmarks.concealed_score`.  Everything is kept in a folder and taken up again where it stopped: the
recordings with their labels, one JSON per diagnosis.  Sets: `strong` and `effects` (every kind, laws strong and down to
weak), `limit` (the same from weak down to hidden in the noise), `clean` (healthy vehicles and plain parameter changes).
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from sprung import model
from sprung.benchmarks.concealed_score import Score, explained, rate, score, summary
from sprung.benchmarks.generator import draw_cases, read_vehicle, write_set
from sprung.benchmarks.generator.laws import LAWS
from sprung.benchmarks.sindy import compare
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.laws import CATALOGUE
from sprung.model.system import MANCHESTER, System, load_system
from sprung.replay.record import load_record

NAMED = tuple(law.name for law in CATALOGUE)
WEAK_KINDS = [*LAWS, "flexible_mode", "external_force", "mass_change", "sensor_gain", "sensor_lag", "sensor_bias"]
QUIET_KINDS = ["clean", "clean", "clean", "clean", "k_scale", "c_scale"]

ABLATIONS: dict[str, Options] = {
    "full": Options(),
    "no projection": Options(project=False),
    "no multiplicity correction": Options(multiplicity=False),
    "no held-out check": Options(held_out=False),
}

Figures = Iterator[dict[str, Any]]


def run(
    count: int = 36,
    clean: int = 200,
    seed: int = 2026,
    ablate: int = 36,
    pysindy: int = 36,
    seconds: float = 60.0,
    false_alarm_rate: float = 0.003,
    out: Path = Path("concealed-results"),
) -> Figures:
    """Yields the figures of each set, of the ablations and of PySINDy.

    `count` recordings in each set with effects, `clean` without; `ablate` and `pysindy` say on how many of each set
    those run.
    """
    system = load_system(MANCHESTER)
    sets = {
        "strong": _recordings(out / "strong", count, seed, None, 0.0, seconds),
        "effects": _recordings(out / "effects", count, seed + 1, None, 1.0, seconds),
        "limit": _recordings(out / "limit", count, seed + 2, WEAK_KINDS, 2.0, seconds),
        "clean": _recordings(out / "clean", clean, seed + 3, QUIET_KINDS, 1.0, seconds),
    }
    everything: list[Score] = []
    walls: list[float] = []
    for name, folder in sets.items():
        scores = []
        for file, truth in _labels(folder).items():
            report = _diagnosed(system, folder / file, "full")
            walls.append(report["wall_seconds"])
            scores.append(score(truth, report, NAMED))
            yield _line(name, file, truth, report, scores[-1])
        everything += scores
        if scores:
            yield {"set": name, **summary(scores, false_alarm_rate)}
    yield {"set": "all", "median_wall_seconds": sorted(walls)[len(walls) // 2], **summary(everything, false_alarm_rate)}
    yield from _by_kind(everything)
    yield from _ablations(system, sets, ablate, false_alarm_rate)
    if pysindy:
        chosen = {
            name: [(folder / f, t) for f, t in list(_labels(folder).items())[:pysindy]] for name, folder in sets.items()
        }
        yield from compare(read_vehicle(MANCHESTER), system, chosen)


def _line(name: str, file: str, truth: dict[str, Any], report: dict[str, Any], s: Score) -> dict[str, Any]:
    """One recording's result."""
    return {
        "set": name,
        "file": file,
        "kind": s.kind,
        "snr": s.snr,
        "said": s.said,
        "right": s.verdict,
        "located": s.located,
        "named": s.named,
        "explained": s.explained,
        "true": [(f["location"], f["effect"]) for f in truth["findings"]],
        "found": [(f["location"], f["effect"]) for f in report["findings"]],
    }


def _recordings(
    folder: Path, count: int, seed: int, kinds: list[str] | None, weak: float, seconds: float, batch: int = 36
) -> Path:
    """Makes what is not there yet, a batch at a time; the n-th recording does not depend on the count.

    Seeds and lengths have folders of their own: reports kept beside recordings would be taken for those of others.
    """
    vehicle = read_vehicle(MANCHESTER)
    folder = folder / f"seed-{seed}-{seconds:g}s"
    for first in range(0, count, batch):
        part = folder / f"part-{first // batch:02d}"
        wanted = min(batch, count - first)
        if len(_labels(part)) >= wanted:
            continue
        cases = draw_cases(vehicle, batch, seed * 1000 + first // batch, kinds, weak)[:wanted]
        write_set(vehicle, cases, part, seconds, ("mcap",), batch, _progress(f"making {part}"))
    return folder


def _labels(folder: Path) -> dict[str, Any]:
    """Labels of a set, file names relative to its folder; empty where nothing was made."""
    found: dict[str, Any] = {}
    for path in sorted(folder.glob("**/labels.json")):
        at = path.parent.relative_to(folder)
        found |= {str(at / name): truth for name, truth in json.loads(path.read_text(encoding="utf-8")).items()}
    return found


def _progress(what: str) -> Callable[[str], None]:
    def show(text: str) -> None:
        print(f"\r{what}: {text}   ", end="", file=sys.stderr, flush=True)

    return show


@cache
def engine_digest() -> str:
    """Tells one state of the diagnosis from another, so that results of an older one are not taken for new."""
    hashed = hashlib.sha256()
    for folder in ("laws", "simulate", "diagnosis"):
        for source in sorted((Path(model.__file__).parent / folder).rglob("*.py")):
            hashed.update(source.read_bytes())
    return hashed.hexdigest()[:12]


def _diagnosed(system: System, file: Path, variant: str) -> dict[str, Any]:
    """The report's JSON, from the cache beside the recording where the present engine has put it there."""
    kept = file.with_suffix(f".{variant.replace(' ', '-')}.json")
    if kept.exists():
        report: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8"))
        if report.get("engine") == engine_digest():
            return report
    begun = time.perf_counter()
    record = load_record(file, system.channels, system.sample_rate)
    report = diagnose(system, record, options=replace(ABLATIONS[variant], file=file.name)).to_dict()
    report |= {"wall_seconds": time.perf_counter() - begun, "engine": engine_digest()}
    partial = kept.with_suffix(".part")
    partial.write_text(json.dumps(report), encoding="utf-8")
    partial.replace(kept)
    _progress("diagnosed")(f"{file.name} {variant}: {report['verdict']}, {report['wall_seconds']:.1f} s")
    return report


def _by_kind(scores: list[Score]) -> Figures:
    """Rates for every kind of effect."""
    for kind in sorted({s.kind for s in scores}):
        mine = [s for s in scores if s.kind == kind]
        yield {
            "kind": kind,
            "recordings": len(mine),
            "verdict": rate(s.verdict for s in mine),
            "located": rate(s.located for s in mine),
            "named": rate(s.named for s in mine),
        }


def _ablations(system: System, sets: dict[str, Path], ablate: int, false_alarm_rate: float) -> Figures:
    """What each part is worth: the same recordings without it."""
    chosen = [(folder / f, t) for folder in sets.values() for f, t in list(_labels(folder).items())[:ablate]]
    for variant in ABLATIONS if ablate else ():
        scores, shares = [], []
        for file, truth in chosen:
            report = _diagnosed(system, file, variant)
            scores.append(score(truth, report, NAMED))
            shares.append(explained(report))
        yield {"ablation": variant, **summary(scores, false_alarm_rate)}
