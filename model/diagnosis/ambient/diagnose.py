"""The diagnosis of recordings without measured inputs: what a structure is made of, not what excites it.

Nothing can be simulated from its inputs here.  What is compared is the spectrum of the sensors in windows: identified
parameters fitted to the first part of the recording, powers of the rest against the model's.  Errors are square roots
of the share of power that the model puts at other frequencies than measured.
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


def diagnose_unforced(system: System, prepared: Prepared, record: Recorded, options: Options, tell: Progress) -> Report:
    """Diagnose a recording of sensors alone.

    Errors: `TooLittleError` where no window tells anything.
    """
    signals = prepared.signals
    rules, memory = options.rules.ambient, options.memory or FitMemory()
    windows, note = all_windows(system, signals, rules, memory, lambda share: tell(0.05 + 0.5 * share, "windows"))
    if not windows:
        seconds = min(system.window, signals.samples) / system.sample_rate
        raise TooLittleError(
            f"no input is measured and no window of {seconds:g} s tells anything: it must hold some ten periods of the "
            "lowest mode, above the sensors' noise; lengthen `window`, or measure what excites the structure"
        )
    tell(0.6, "what all windows say together")
    split = signals.start + options.rules.record.fitted * signals.samples / signals.sample_rate
    first = [w for w in windows if w.end <= split] or windows
    pooled = pool(first if len(first) >= rules.independent else windows, rules)
    held = [w for w in windows if w.begin >= split - 1e-9]
    notes = [note] if note else []
    if not held:
        held = windows[-1:]
        notes.append("the recording is too short to hold a part back: what was fitted was judged on the same window")
    tell(0.8, "the last part under what the first part told")
    shared = with_known(system, signals, held, pooled.log_ratio, memory) or held
    varying = bool(np.any(pooled.varying))
    errors, band = errors_of(shared, held if varying else shared, rules)
    tell(0.95, "report")
    said = judged(prepared, system, pooled, errors, band, options)
    report = compose_unforced(system, prepared, record, options, windows, pooled, said)
    tell(1.0, "done")
    return replace(report, advice=(*prepared.notes, *notes, *report.advice))
