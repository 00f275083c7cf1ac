"""What users see of a vehicle, made from the tracker's state and its newest window: the shapes of the contract."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sprung.model.signals import FloatArray
from sprung.model.tracking.tracker import Alarm, TrackerState
from sprung.service.engine import Engine
from sprung.service.store.fleet import AlarmRow
from sprung.service.store.windows import WindowRecord
from sprung.service.times import optional_iso, to_iso

SEVERITIES = ("warning", "alarm")


@dataclass(frozen=True, slots=True)
class ParameterView:
    """One parameter as tracked."""

    name: str
    element: str
    quantity: str
    unit: str
    nominal: float
    value: float
    std: float
    identifiable: bool
    baseline: float | None  # the vehicle's own; None while it is learned
    drift: float | None  # value / baseline - 1
    drift_std: float | None
    alarm: str | None  # severity of its active alarm

    def as_dict(self) -> dict[str, Any]:
        """JSON of the contract's section 4, with the drift beside it."""
        return {
            "name": self.name,
            "value": self.value,
            "std": self.std,
            "unit": self.unit,
            "nominal": self.nominal,
            "ratio": self.value / self.nominal,
            "identifiable": self.identifiable,
            "baseline": self.baseline,
            "drift": self.drift,
            "drift_std": self.drift_std,
            "alarm": self.alarm,
        }


@dataclass(frozen=True, slots=True)
class VehicleView:
    """One vehicle as it stands."""

    vehicle: str
    model: str
    health: str  # NAMUR NE 107
    parameters: tuple[ParameterView, ...]
    alarms: tuple[Alarm, ...]  # active and recently closed, oldest first
    last: WindowRecord | None
    last_window_ns: int | None
    per_sensor: Mapping[str, float]  # nrmse of the newest window, absent sensors left out

    @property
    def active(self) -> tuple[Alarm, ...]:
        """Alarms that are not closed."""
        return tuple(alarm for alarm in self.alarms if alarm.closed is None)

    def active_by_severity(self) -> dict[str, int]:
        """Active alarms counted, zero where there is none."""
        return {s: sum(alarm.severity == s for alarm in self.active) for s in SEVERITIES}

    def as_dict(self) -> dict[str, Any]:
        """JSON of `GET /vehicles/{id}`."""
        solved = None if self.last is None else self.last.solved
        return {
            "vehicle": self.vehicle,
            "model": self.model,
            "health": self.health,
            "last_window": optional_iso(self.last_window_ns),
            "fit": None if solved is None else fit_dict(solved.nrmse, self.per_sensor),
            "parameters": [p.as_dict() for p in self.parameters],
            "alarms": [alarm_dict(alarm) for alarm in self.active],
        }


def vehicle_view(engine: Engine, vehicle: str, state: TrackerState, last: WindowRecord | None) -> VehicleView:
    """The view of a vehicle after its newest window."""
    alarmed = {alarm.parameter: alarm.severity for alarm in state.active}
    reports = engine.tracker.report(state)
    parameters = tuple(
        ParameterView(
            r.name,
            p.element,
            p.quantity,
            r.unit,
            r.nominal,
            r.value,
            r.std,
            r.identifiable,
            r.baseline,
            r.drift,
            r.drift_std,
            alarmed.get(r.name),
        )
        for r, p in zip(reports, engine.system.parameters, strict=True)
    )
    per_sensor = {} if last is None or last.solved is None else sensor_dict(engine, last.solved.per_sensor)
    return VehicleView(
        vehicle,
        engine.digest,
        engine.tracker.health(state),
        parameters,
        state.alarms,
        last,
        state.time,
        per_sensor,
    )


def physical(engine: Engine, log_ratio: FloatArray, std: FloatArray) -> list[tuple[float, float]]:
    """(value, standard deviation) of every parameter in its unit, from log-ratios."""
    values = engine.system.nominal * np.exp(log_ratio)
    return list(zip(values.tolist(), (values * std).tolist(), strict=True))


def sensor_dict(engine: Engine, per_sensor: FloatArray) -> dict[str, float]:
    """nrmse by sensor, absent sensors left out."""
    pairs = zip(engine.system.sensors, per_sensor.tolist(), strict=True)
    return {name: value for name, value in pairs if math.isfinite(value)}


def fit_dict(nrmse: float, per_sensor: Mapping[str, float]) -> dict[str, Any]:
    """How well a window fits."""
    return {"nrmse": finite(nrmse), "per_sensor": dict(per_sensor)}


def alarm_dict(alarm: Alarm | AlarmRow) -> dict[str, Any]:
    """JSON of one alarm."""
    found = {
        "parameter": alarm.parameter,
        "kind": alarm.kind,
        "onset": to_iso(alarm.onset),
        "raised": to_iso(alarm.opened),
        "recovered": optional_iso(alarm.closed),
        "change": finite(alarm.change),
        "std": finite(alarm.std),
        "severity": alarm.severity,
    }
    if isinstance(alarm, AlarmRow):
        found["report"] = alarm.report_id
    return found


def window_dict(engine: Engine, record: WindowRecord) -> dict[str, Any]:
    """One line of `replay --json`."""
    names = [p.name for p in engine.system.parameters]
    line: dict[str, Any] = {
        "window": to_iso(record.start),
        "outcome": record.outcome,
        "reason": record.reason,
        "fit": None,
        "estimate": None,
        "posterior": None,
    }
    solved, posterior = record.solved, record.posterior
    if solved is not None:
        told: Sequence[bool] = solved.identifiable.tolist()
        pairs = physical(engine, solved.log_ratio, solved.std)
        line["fit"] = {"nrmse": finite(solved.nrmse), "adequate": solved.adequate}
        line["estimate"] = {n: list(p) for n, p, ok in zip(names, pairs, told, strict=True) if ok}
    if posterior is not None:
        pairs = physical(engine, posterior.log_ratio, posterior.std)
        line["posterior"] = {n: list(p) for n, p in zip(names, pairs, strict=True)}
    return line


def finite(value: float | None) -> float | None:
    """JSON knows no NaN."""
    return value if value is not None and math.isfinite(value) else None
