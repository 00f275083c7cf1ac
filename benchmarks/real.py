"""`sprung bench real --data DIR [--out DIR]`: measured records of other people's rigs, diagnosed and beside references.

For every known record in DIR (benchmarks/real_records.py): the verdict, the laws with their values, the held-out error
before and after, the noise floor, what is left unexplained; beside a linear and a plain Bouc-Wen model fitted by SciPy
to the same first 70 % and judged on the same rest.  Errors are rms over the force's deviation.  `--out` draws the
measured and modelled loops of the held-out part, the force that a slide misses, frequencies over time.  Without
measured inputs: natural frequencies over time beside the spectral peaks, and beside what was measured of the cause and
no diagnosis saw.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from sprung.benchmarks.emps import force_errors, identified
from sprung.benchmarks.real_picture import frequencies, loops, missing_force
from sprung.benchmarks.real_records import MeasuredRecord, records
from sprung.benchmarks.real_reference import bouc_wen, linear
from sprung.model.diagnosis.api import DiagnosisError, Options, Report, diagnose
from sprung.model.diagnosis.component.measured import component_records
from sprung.model.signals import FloatArray

HALF, PADDED = 0.5, 16  # of the first natural frequency, where peaks are sought from; finer bins
SURE = 0.02  # deviation over the frequency up to which a window counts
MOST_REFERENCE = 12_000  # samples that the references are fitted on; more only take longer


def run(data: Path, out: Path | None = None) -> Iterator[dict[str, Any]]:
    """Yields one line per record."""
    for record in records(data):
        began = time.process_time()
        line: dict[str, Any] = {"record": record.name, "seconds": len(record.values) / record.sample_rate}
        try:
            report = diagnose(record.system, record, Options(file=record.name))
        except DiagnosisError as error:
            yield line | {"verdict": None, "refused": str(error)}
            continue
        line |= said(report) | {"cpu_seconds": round(time.process_time() - began, 1)}
        if record.component:
            line["reference"] = references(record)
            best = min(line["reference"].values())
            line["met"] = line["held_out"] <= best or report.verdict == "unknown_physics"
        if record.independent is not None and report.track:
            peaks, beside = peaks_and_independent(record, report)
            line["track"] = followed(report, peaks, beside)
            if out is not None:
                line["picture"] = str(frequencies(report, record.name, out, peaks, beside))
        if record.system.name == "emps":  # columns force and position
            found = identified(report.to_dict(), "augmented")
            line["force_rmse"] = force_errors(record.values, record.sample_rate, found)
            if out is not None:
                line["picture"] = str(missing_force(report, record.name, out))
        if out is not None and record.component:
            line["picture"] = str(loops(report, record.name, out))
        yield line


def said(report: Report) -> dict[str, Any]:
    """What a report says, in short."""
    return {
        "verdict": report.verdict,
        "laws": {
            f"{f.location}: {f.effect}": {p.name: [p.value, p.std] for p in (*f.parameters, *f.quoted)}
            for f in report.findings
        },
        "held_out_before": report.baseline_validation.nrmse,
        "held_out": report.augmented_validation.nrmse,
        "floor": report.noise_floor.nrmse,
        "unexplained": report.unexplained.share,
        "where": report.unexplained.where,
    }


def peaks_and_independent(record: MeasuredRecord, report: Report) -> tuple[FloatArray, FloatArray]:
    """Spectral peak (Hz) of every window of a report, and the median of the independent measurement in it."""
    assert record.independent is not None
    low, high = HALF * report.track[0].frequency[0], 2 * report.track[0].frequency[0]
    peaks, beside = [], []
    for point in report.track:
        at = slice(round(point.begin * record.sample_rate), round(point.end * record.sample_rate))
        series = record.values[at, 0] - record.values[at, 0].mean()
        power = np.abs(np.fft.rfft(series * np.hanning(len(series)), PADDED * len(series)))
        frequency = np.fft.rfftfreq(PADDED * len(series), 1 / record.sample_rate)
        inside = (frequency > low) & (frequency < high)
        peaks.append(float(frequency[inside][np.argmax(power[inside])]))
        beside.append(float(np.median(record.independent[at])))
    return np.array(peaks), np.array(beside)


def followed(report: Report, peaks: FloatArray, independent: FloatArray) -> dict[str, Any]:
    """The lowest natural frequency of every window and its spectral peak, beside the independent measurement."""
    found = np.array([point.frequency[0] for point in report.track])
    sure = np.array([p.adequate and p.deviation[0] < SURE * p.frequency[0] for p in report.track])
    one, other, rank = found[sure], peaks[sure], independent[sure]
    return {
        "windows": len(found),
        "sure": len(one),
        "lowest_hz": float(one.min()),
        "highest_hz": float(one.max()),
        "median_difference_to_peak": float(np.median(np.abs(one / other - 1))),
        "rank_correlation_with_independent": float(spearmanr(one, rank)[0]),
        "peaks_rank_correlation_with_independent": float(spearmanr(other, rank)[0]),
    }


def references(record: MeasuredRecord) -> dict[str, float]:
    """Held-out errors of the models by SciPy, on the samples that the diagnosis used."""
    (one,) = component_records(record.system, record.values, record.sample_rate)
    task = one.task.every(max(1, len(one.task.force) // MOST_REFERENCE))
    displacement = np.interp(task.motion.time, np.arange(len(record.values)) / record.sample_rate, record.values[:, 0])
    rate = np.gradient(displacement, task.motion.time)
    held = task.force[task.split :]
    found = {}
    for name, model in (("linear", linear), ("bouc_wen", bouc_wen)):
        error = held - model(displacement, rate, task.force, task.split)[task.split :]
        found[name] = float(np.sqrt(np.mean(error**2)) / np.std(held))
    return found
