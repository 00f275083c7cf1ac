"""Pictures of the concealed-effects benchmark for docs/mismatch.md, from the folder that it has filled.

`python -m sprung.benchmarks.concealed_picture concealed-results docs/img/mismatch`
"""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes

from sprung.benchmarks.concealed import NAMED
from sprung.benchmarks.concealed_score import Score, confusion, detection_limit, oracle_threshold, score
from sprung.service.report import ink

VERDICTS = ("consistent", "missing_physics", "sensor_fault", "unknown_physics")


def finished(folder: Path) -> list[Score]:
    """Every diagnosed recording below a folder, judged."""
    out = []
    for labels in sorted(folder.glob("**/labels.json")):
        for name, truth in json.loads(labels.read_text(encoding="utf-8")).items():
            kept = (labels.parent / name).with_suffix(".full.json")
            if kept.exists():
                out.append(score(truth, json.loads(kept.read_text(encoding="utf-8")), NAMED))
    return out


def confusion_panel(axes: Axes, scores: list[Score]) -> None:
    """Said verdicts over true ones, counts."""
    table = confusion(scores)
    counts = np.array([[table.get(t, {}).get(s, 0) for s in VERDICTS] for t in VERDICTS])
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(shares, cmap="GnBu", vmin=0, vmax=1)
    for row, column in np.ndindex(counts.shape):
        dark = shares[row, column] > 0.6
        axes.text(
            column, row, str(counts[row, column]), ha="center", va="center", color="white" if dark else ink.MEASURED
        )
    words = [v.replace("_", "\n") for v in VERDICTS]
    axes.set_xticks(range(4), words, fontsize=8)
    axes.set_yticks(range(4), words, fontsize=8)
    axes.set_xlabel("said")
    axes.set_ylabel("true")
    axes.set_title("verdicts")
    axes.grid(False)


def detection_panel(axes: Axes, scores: list[Score], false_alarm_rate: float) -> None:
    """Found and placed, against the oracle's signal-to-noise ratio."""
    single = [s for s in scores if s.snr and s.truth != "consistent" and s.kind != "two"]
    snr = np.array([s.snr for s in single])
    hit = np.array([s.found for s in single], float)
    edges = np.geomspace(max(snr.min(), 0.5), snr.max() * 1.01, 9)
    shares = [(np.sqrt(a * b), hit[(snr >= a) & (snr < b)]) for a, b in itertools.pairwise(edges)]
    jitter = 0.03 * np.random.default_rng(0).normal(size=hit.size)
    axes.semilogx(snr, hit + jitter, ".", ms=5, color=ink.AFTER, alpha=0.6)
    axes.semilogx([x for x, h in shares if h.size], [h.mean() for _, h in shares if h.size], "o-", color=ink.MEASURED)
    threshold = oracle_threshold(false_alarm_rate)
    axes.axvline(threshold, color=ink.LAW, lw=1.6, label=f"oracle's limit, {threshold:.1f}")
    limit = detection_limit(snr.tolist(), (hit > 0).tolist())
    if limit is not None:
        axes.axvline(limit, color=ink.BEFORE, lw=1.6, ls="--", label=f"this tool's, {limit:.1f}")
    axes.set_xlabel("signal-to-noise ratio of the oracle that knows place and law")
    axes.set_ylabel("found and placed")
    axes.set_title("how weak may an effect be?")
    axes.set_ylim(-0.12, 1.12)
    axes.legend(fontsize=8, loc="lower right")


def main() -> None:
    """Draws what a folder holds."""
    folder, out = Path(sys.argv[1]), Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)
    scores = finished(folder)
    with rc_context(ink.RC):
        figure = ink.new_figure(10.0, 3.7)
        left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1, 1.5]})
        confusion_panel(left, scores)
        detection_panel(right, scores, 0.003)
        ink.save(figure, out / "concealed.png")
    print(f"{len(scores)} recordings -> {out / 'concealed.png'}")


if __name__ == "__main__":
    main()
