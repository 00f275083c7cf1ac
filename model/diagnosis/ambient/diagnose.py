"""Diagnosis of recordings without measured inputs (output-only): the structure, not its excitation.

Without inputs there is no simulation; the spectra of the sensors in windows are compared instead.  Parameters are
identified on the first part of the recording, and the power spectra of the rest are compared with the model's.  Errors
are square roots of the share of power at other frequencies than the model's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.ambient.compose import compose_unforced
from sprung.model.diagnosis.ambient.judgement import errors_of, judged, pool
from sprung.model.diagnosis.ambient.windows import (
    all_windows,
    with_known,
)
from sprung.model.diagnosis.fit.memory import FitMemory
from sprung.model.diagnosis.investigation.state import Options, Progress, Recorded
from sprung.model.diagnosis.record.channels import Prepared, TooLittleError
from sprung.model.diagnosis.report.report import (
    Report,
)
from sprung.model.system import System


def diagnose_unforced(
    system: System, prepared: Prepared, record: Recorded, options: Options, progress: Progress
) -> Report:
    """Diagnose a recording of sensors alone.

    Errors: `TooLittleError` if no window is informative.
    """
    signals = prepared.signals
    rules, memory = options.rules.ambient, options.memory or FitMemory()
    windows, note = all_windows(
        system, signals, options.rules, memory, lambda share: progress(0.05 + 0.5 * share, "windows")
    )
    if not windows:
        seconds = min(system.window, signals.samples) / system.sample_rate
        raise TooLittleError(
            f"no input is measured and no window of {seconds:g} s is informative: it must hold some ten periods of the "
            "lowest mode, above the sensors' noise; lengthen `window`, or measure what excites the structure"
        )
    progress(0.6, "means over all windows")
    split = signals.start + options.rules.record.fitted * signals.samples / signals.sample_rate
    first = [w for w in windows if w.end <= split] or windows
    pooled = pool(first if len(first) >= rules.independent else windows, rules)
    held = [w for w in windows if w.begin >= split - 1e-9]
    notes = [note] if note else []
    if not held:
        held = windows[-1:]
        notes.append("the recording is too short for a held-out part: the fit was judged on the same window")
    progress(0.8, "validation on the last part")
    shared = with_known(system, signals, held, pooled.log_ratio, options.rules.ambient_window, memory) or held
    varying = bool(np.any(pooled.varying))
    errors, band = errors_of(shared, held if varying else shared, rules)
    progress(0.95, "report")
    judgement = judged(prepared, system, pooled, errors, band, options)
    report = compose_unforced(system, prepared, record, options, windows, pooled, judgement)
    progress(1.0, "done")
    return replace(report, advice=(*prepared.notes, *notes, *report.advice))
