"""State of a vehicle in physical units: every parameter, and its health."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np

from sprung.model.signals import HARD_FAULTS, BoolArray, FloatArray
from sprung.model.tracking.drift import Drift
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
    """Value of one parameter, against nominal and against the vehicle's baseline."""

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
    lost_with: str | None = None  # stuck channels, joined by |, without which it is not identifiable


def reported(
    parameters: Sequence[ParameterLike],
    state: TrackerState,
    settings: TrackerSettings,
    base: FloatArray,
    drift: Drift,
    doubt: FloatArray,
    lost: Mapping[str, str] = MappingProxyType({}),
) -> tuple[ParameterReport, ...]:
    """Every parameter in physical units, against nominal and against the vehicle's own baseline.

    base: log-ratios to nominal of the healthy state, (P,); doubt: variance of all log-ratios (P,) beside that of
    the belief: part of the stated uncertainty, not of that of changes; lost: channels without which parameters are
    not identifiable, by parameter.
    """
    log_std = np.sqrt(state.belief.level_variance + doubt)
    nominal = np.array([parameter.nominal for parameter in parameters])
    value, healthy = nominal * np.exp(state.belief.level), nominal * np.exp(base)
    there = np.array([p.name not in lost for p in parameters])
    known = there & (log_std < KNOWN * settings.prior)
    now = (value, value * log_std, value / nominal, state.belief.level, log_std, known)
    since = (healthy, healthy * np.sqrt(state.changes.baseline_variance), drift.whole, drift.std)
    learned = (state.changes.learned >= settings.learning).tolist()
    reports = (
        ParameterReport(p.name, p.unit, p.nominal, *present, *(changed if known else _LEARNING))
        for p, present, changed, known in zip(parameters, _rows(now), _rows(since), learned, strict=True)
    )
    return tuple(replace(r, lost_with=lost[r.name]) if r.name in lost else r for r in reports)


def _rows(columns: Sequence[FloatArray | BoolArray]) -> Iterator[tuple[Any, ...]]:
    return zip(*(column.tolist() for column in columns), strict=True)


_LEARNING = (None, None, None, None)  # baseline and drift, with their deviations


def health_of(state: TrackerState, settings: TrackerSettings) -> Health:
    """NAMUR NE 107: the worst of what is active, in the recommendation's order F, C, S, M.

    A vehicle without windows, or with too few usable ones of late, is not monitored: check function.
    """
    changes = [abs(alarm.change or 0.0) for alarm in state.active if alarm.kind == "change"]
    severities = {(alarm.kind, alarm.severity) for alarm in state.active}
    if max(changes, default=0.0) >= settings.failure_change:
        return "failure"
    broken = any(a.kind == "sensor" and (a.parameter or "").endswith(HARD_FAULTS) for a in state.active)
    if broken or any(kind == "misfit" for kind, _ in severities) or not state.coverage.monitored:
        return "check_function"
    if ("change", "alarm") in severities:
        return "out_of_specification"
    return "maintenance_required" if severities else "ok"
