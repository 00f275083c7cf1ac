"""Score the diagnosis on a folder of recordings with labels.json.

`python -m sprung.benchmarks.labelled_cases DIR [FILE...]`

One line per recording: V verdict, L located, N named, then what was said.  Places and names count as right when the
set of findings equals the label's; the effects of an unknown verdict are called `unknown`, or expressed by a `formula`.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.report.report import Report
from sprung.model.system import MANCHESTER_DBC, System, load_system
from sprung.replay.record import load_record


def run(folder: Path, files: list[str]) -> Iterator[dict[str, Any]]:
    """Diagnose every labelled recording of a folder (or those named) and compare."""
    labels = json.loads((folder / "labels.json").read_text())
    system = load_system()
    for name in files or sorted(n for n in labels if "verdict" in labels[n]):
        record = load_record(folder / name, system.channels, system.sample_rate, dbc=MANCHESTER_DBC)
        start = time.process_time()
        report = diagnose(system, record, Options(file=name))
        yield {"file": name, **compare(report, labels[name], system), "cpu_seconds": time.process_time() - start}


def compare(report: Report, label: dict[str, Any], system: System) -> dict[str, Any]:
    """Verdict, places, names, errors of parameters in standard deviations."""
    unknown = label["verdict"] == "unknown_physics"
    truth = {(f["location"], "unknown" if unknown else f["effect"]) for f in label["findings"]}
    said = {(f.location, "unknown" if f.kind is EffectKind.UNLISTED else f.effect) for f in report.findings}
    return {
        "verdict": report.verdict == label["verdict"],
        "located": {place for place, _ in truth} == {place for place, _ in said},
        "named": truth == said,
        "said": sorted(said),
        "truth": sorted(truth),
        "explained": report.explained,
        "law_errors": _law_errors(report, label),
        "baseline_errors": _element_errors(report, label, system),
    }


def _law_errors(report: Report, label: dict[str, Any]) -> list[float]:
    """(value - truth) / std of every parameter of the laws that were named rightly."""
    errors = []
    for truth in label["findings"]:
        for finding in report.findings:
            if (finding.location, finding.effect) == (truth["location"], truth["effect"]):
                pairs = zip(finding.parameters, truth.get("parameters") or [], strict=False)
                errors += [(p.value - t) / p.std for p, t in pairs if p.std > 0]
    return [round(e, 2) for e in errors]


def _element_errors(report: Report, label: dict[str, Any], system: System) -> float | None:
    """Root mean square error of the nominal parameters of the final model, in standard deviations."""
    if "stiffness" not in label:
        return None
    truth = [label[p.quantity][p.element] for p in system.parameters]
    errors = [(a.value - t) / a.std for a, t in zip(report.augmented, truth, strict=True)]
    return float(np.sqrt(np.mean(np.square(errors))))


def main() -> None:
    total = {"verdict": 0, "located": 0, "named": 0}
    count = 0
    for line in run(Path(sys.argv[1]), sys.argv[2:]):
        count += 1
        for key in total:
            total[key] += bool(line[key])
        print(json.dumps(line), flush=True)
    print(json.dumps({"recordings": count, **total}))


if __name__ == "__main__":
    main()
