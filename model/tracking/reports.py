"""Where a vehicle stands: every parameter in physical units, and its health."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sprung.model.signals import FloatArray
from sprung.model.tracking.alarms import HARD, Drift
from sprung.model.tracking.fusion import KNOWN
from sprung.model.tracking.settings import TrackerSettings
from sprung.model.tracking.state import Health, TrackerState


class ParameterLike(Protocol):
    """What the tracker needs to know about a parameter."""

    @property
    def name(self) -> str: ...
    @property
    def unit(self) -> str: ...
    @property
    def nominal(self) -> float: ...


@dataclass(frozen=True, slots=True)
class ParameterReport:
    """Where one parameter stands."""

    name: str
    unit: str
    nominal: float  # `unit`
    value: float  # posterior, `unit`
    std: float
    ratio: float  # value / nominal
    log_ratio: float  # posterior mean of log(value / nominal)
    log_std: float
    identifiable: bool  # False: what is reported is the prior
    baseline: float | None  # the vehicle's own healthy value, `unit`; None while it is learned
    baseline_std: float | None
    drift: float | None  # value / baseline - 1
    drift_std: float | None


def reported(
    parameters: Sequence[ParameterLike], state: TrackerState, settings: TrackerSettings, base: FloatArray, drift: Drift
) -> tuple[ParameterReport, ...]:
    """Every parameter in physical units, against nominal and against the vehicle's own baseline.

    base: log-ratios to nominal of the healthy state, (P,).
    """
    level, std = state.belief.level, np.sqrt(state.belief.level_variance)
    base_std = np.sqrt(state.changes.baseline_variance)
    learned = state.changes.learned >= settings.learning
    reports = []
    for i, parameter in enumerate(parameters):
        value, own = parameter.nominal * float(np.exp(level[i])), bool(learned[i])
        healthy = parameter.nominal * float(np.exp(base[i])) if own else None
        reports.append(
            ParameterReport(
                name=parameter.name,
                unit=parameter.unit,
                nominal=parameter.nominal,
                value=value,
                std=value * float(std[i]),
                ratio=value / parameter.nominal,
                log_ratio=float(level[i]),
                log_std=float(std[i]),
                identifiable=bool(std[i] < KNOWN * settings.prior),
                baseline=healthy,
                baseline_std=None if healthy is None else healthy * float(base_std[i]),
                drift=float(drift.whole[i]) if own else None,
                drift_std=float(drift.std[i]) if own else None,
            )
        )
    return tuple(reports)


def health_of(state: TrackerState, settings: TrackerSettings) -> Health:
    """NAMUR NE 107: the worst of what is active, in the recommendation's order F, C, S, M.

    A vehicle of which nothing came, or too little lately that could be used, is not monitored: check function.
    """
    changes = [abs(alarm.change or 0.0) for alarm in state.active if alarm.kind == "change"]
    severities = {(alarm.kind, alarm.severity) for alarm in state.active}
    if max(changes, default=0.0) >= settings.failure_change:
        return "failure"
    broken = any(a.kind == "sensor" and (a.parameter or "").endswith(HARD) for a in state.active)
    if broken or any(kind == "misfit" for kind, _ in severities) or not state.coverage.monitored:
        return "check_function"
    if ("change", "alarm") in severities:
        return "out_of_specification"
    return "maintenance_required" if severities else "ok"
