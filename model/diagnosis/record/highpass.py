"""High-pass filter for recordings whose supports are measured by acceleration alone.

Over a recording, integrated acceleration noise drifts by metres.  Filtering all signals alike preserves their linear
relation, and forces of nonlinear laws are filtered as well (`Grid.law_transform`): a damper that is harder in extension
pulls the body down slowly, which filtered signals do not show.  So everything well below the slowest mode is removed:
there bodies follow their supports, elements hardly deflect, and nothing is identifiable.  Transients of the filter at
both ends are cut off.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import butter, sosfiltfilt

from sprung.model.diagnosis.record.signals import Signals
from sprung.model.diagnosis.record.spectra import HIGH_PASS_ORDER
from sprung.model.diagnosis.rules import RecordRules
from sprung.model.mechanics import DISPLACEMENT, VELOCITY
from sprung.model.schema import GROUND, SupportInput
from sprung.model.signals import FloatArray
from sprung.model.system import System


def carries_everything(system: System, support: str) -> bool:
    """Whether all bodies rest on a single support: they drift with it, which no sensor observes."""
    others = [n for n, source in system.file.inputs.items() if isinstance(source, SupportInput) and n != support]
    grounded = any(GROUND in (element.upper, element.lower) for element in system.file.elements.values())
    absolute = np.isin(system.mechanics.sensor_kind, (DISPLACEMENT, VELOCITY)).any()
    return not (others or grounded or absolute)


def slowest_mode(system: System, held: float) -> float:
    """Frequency of the slowest mode above `held`, Hz, below which modes count as rigid-body motion."""
    return min(mode.frequency for mode in system.mechanics.modes(system.bodies) if mode.frequency > held)


def passed(system: System, signals: Signals, rules: RecordRules) -> tuple[Signals, float]:
    """Signals without the drift of integrated accelerations, and the filter's cutoff, Hz; 0 if none is needed."""
    alone = signals.integrated & signals.accelerated & np.isnan(signals.velocity[0])
    if not alone.any() or carries_everything(system, signals.support_names[0]):
        return signals, 0.0
    cutoff = rules.passed * slowest_mode(system, rules.held)
    cut = round(rules.settled / cutoff * signals.sample_rate)
    filtered = butter(HIGH_PASS_ORDER, cutoff, "highpass", fs=signals.sample_rate, output="sos")

    def high(series: FloatArray) -> FloatArray:
        known = np.isfinite(series[0]) if series.shape[1] else np.zeros(0, dtype=bool)
        out = series.copy()
        if known.any():
            out[:, known] = sosfiltfilt(filtered, series[:, known], axis=0, padlen=min(3 * cut, len(series) - 1))
        return out

    whole = replace(
        signals,
        displacement=high(signals.displacement),
        velocity=high(signals.velocity),
        force=high(signals.force),
        sensors=high(signals.sensors),
        fused=(),
        cutoff=cutoff,
    )
    return whole.part(cut, max(signals.samples - cut, cut)), cutoff
