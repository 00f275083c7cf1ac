"""What users see of a vehicle, made from the tracker's state and its newest window: the shapes of the contract."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Any
from urllib.parse import quote

import numpy as np

from sprung.model.signals import BuiltOtherwise, FloatArray, MeasurementFault, Window
from sprung.model.system import System
from sprung.model.tracking.fusion import KNOWN
from sprung.model.tracking.tracker import Alarm, TrackerState
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.words import spoken
from sprung.service.store.fleet import AlarmRow
from sprung.service.store.standstill import UNINFORMATIVE
from sprung.service.store.status import Status
from sprung.service.store.windows import WindowRecord
from sprung.service.times import optional_iso, to_iso

SEVERITIES = ("warning", "alarm")
KINDS = ("change", "misfit", "sensor", "load")
LETTERS = ".?owa"  # of an element in the small drawing, worse last: learning, not identifiable, ok, warning, alarm


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
    lost_with: str | None = None  # stuck channels, joined by |, without which it is not identifiable

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
            "state": self.state,
        } | ({} if self.lost_with is None else {"lost_with": self.lost_with})

    @property
    def state(self) -> str:
        """In one word; `learning` until the baseline is known."""
        if self.alarm is not None:
            return self.alarm
        if not self.identifiable:
            return "not_identifiable"
        return "learning" if self.drift is None else "ok"


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
    sensors: tuple[MeasurementFault, ...] = ()  # what was found wrong with measurements
    load: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # kg beside the empty mass, std, by body
    built: tuple[BuiltOtherwise, ...] = ()  # how bodies are built otherwise than the system file says
    load_as_of_ns: int | None = None  # the last window that told of the loads, where any other is possible by now

    @property
    def active(self) -> tuple[Alarm, ...]:
        """Alarms that are not closed."""
        return tuple(alarm for alarm in self.alarms if alarm.closed is None)

    @property
    def fits(self) -> bool:
        """Whether the newest window says how well the model fits; that of a standing vehicle is of noise alone."""
        return self.last is not None and self.last.outcome != UNINFORMATIVE

    @property
    def largest(self) -> ParameterView | None:
        """The parameter with the largest drift from its baseline; None while all are learning."""
        drifted = [p for p in self.parameters if p.drift is not None and p.identifiable]
        return max(drifted, key=lambda p: abs(p.drift or 0.0), default=None)

    def status(self, elements: Sequence[str]) -> Status:
        """The vehicle's line in the list of the fleet; `elements` in the order of the drawing."""
        counts, largest = self.active_by_severity(), self.largest
        solved = self.last.solved if self.fits and self.last is not None else None  # else the fit before it stands
        letters = {name: "." for name in elements}
        for p in self.parameters:
            letters[p.element] = max(letters.get(p.element, "."), _letter(p), key=LETTERS.index)
        learned = sum(p.baseline is not None for p in self.parameters) / max(len(self.parameters), 1)
        return Status(
            self.health,
            counts["alarm"],
            counts["warning"],
            None if largest is None else largest.name,
            None if largest is None else finite(largest.drift),
            None if largest is None else finite(largest.drift_std),
            None if solved is None else finite(solved.nrmse),
            learned,
            "".join(letters[name] for name in elements)[:400],
            self.last_window_ns,
        )

    def active_by_severity(self) -> dict[str, int]:
        """Active alarms counted, zero where there is none."""
        return {s: sum(alarm.severity == s for alarm in self.active) for s in SEVERITIES}

    def active_by_kind(self) -> dict[str, int]:
        """Active alarms counted by what they are about, zero where there is none."""
        return dict.fromkeys(KINDS, 0) | Counter(alarm.kind for alarm in self.active)

    def as_dict(self) -> dict[str, Any]:
        """JSON of `GET /vehicles/{id}`."""
        solved = None if self.last is None else self.last.solved
        told = {"reason": None if self.last is None else self.last.reason}
        return {
            "vehicle": self.vehicle,
            "model": self.model,
            "health": self.health,
            "last_window": optional_iso(self.last_window_ns),
            "fit": None if solved is None else fit_dict(solved.nrmse, self.per_sensor) | ({} if self.fits else told),
            "parameters": [p.as_dict() for p in self.parameters],
            "alarms": [alarm_dict(alarm) for alarm in self.active],
            **self.measurements(),
        }

    def measurements(self) -> dict[str, Any]:
        """What was found wrong with measurements, and the loads."""
        return {
            "sensors": [
                {"channel": f.channel, "kind": f.kind, "value": finite(f.value), "std": finite(f.std)}
                for f in self.sensors
            ],
            "load": {body: list(pair) for body, pair in self.load.items()},
            "load_as_of": optional_iso(self.load_as_of_ns) if self.load else None,
            "built": [asdict(one) for one in self.built],
        }


def vehicle_view(engine: Engine, vehicle: str, state: TrackerState, last: WindowRecord | None) -> VehicleView:
    """The view of a vehicle after its newest window."""
    alarmed = {alarm.parameter: alarm.severity for alarm in state.active}  # "*.damping": of all dampers together
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
            alarmed.get(r.name) or (_of_kind(alarmed, r.name) if r.baseline is not None else None),
            r.lost_with,
        )
        for r, p in zip(reports, engine.system.tracked, strict=True)
    )
    return VehicleView(
        vehicle,
        engine.digest,
        engine.tracker.health(state),
        parameters,
        state.alarms,
        last,
        state.time,
        _of_sensors(engine, last),
        engine.tracker.sensors(state),
        in_kg(engine, engine.tracker.loads(state)),
        engine.tracker.body_constants(state),
        engine.tracker.loads_as_of(state),
    )


def beside_window(engine: Engine, view: VehicleView, last: WindowRecord | None) -> VehicleView:
    """The same with another window as the newest one."""
    return view if view.last is last else replace(view, last=last, per_sensor=_of_sensors(engine, last))


def _of_sensors(engine: Engine, last: WindowRecord | None) -> dict[str, float]:
    return {} if last is None or last.solved is None else sensor_dict(engine, last.solved.per_sensor)


def changed_part(alarm: Alarm | AlarmRow) -> str:
    """What an alarm is about; what the measurements do not tell it from comes first, for a sensor is checked sooner."""
    return " or ".join([*alarm.alternatives, spoken(alarm.parameter or "")])


def unclear(rivals: Sequence[str]) -> str:
    """A sentence on what the measurements do not tell an alarm from, to stand before others; empty where nothing."""
    heavier = all(rival.endswith(".mass") for rival in rivals)
    first = "look first for ice, or what was built in" if heavier else "check the sensor first"
    return f"The measurements do not tell it from {' or '.join(rivals)}: {first}. " if rivals else ""


def _of_kind(alarmed: Mapping[str | None, str], name: str) -> str | None:
    """Severity of an alarm of all elements of a kind, `*.damping` or `primary_*.damping`, to which one belongs."""
    return next(
        (s for pattern, s in alarmed.items() if pattern and "*" in pattern and fnmatchcase(name, pattern)), None
    )


def in_kg(engine: Engine, loads: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """(kg, standard deviation) of what every loaded body carries, from the log-ratios of its mass to the empty one."""
    empty = {load.body: load.empty for load in engine.system.loads}
    return {b: (empty[b] * math.expm1(x), empty[b] * math.exp(x) * s) for b, (x, s) in loads.items()}


UNITS = {"load": "kg", "temperature": "degC", "speed": "m/s", "pressure": "Pa", "lateral_acceleration": "m/s^2"}
UNITS |= {"yaw_rate": "rad/s"}  # of how a vehicle runs, by the last part of the name


def running(system: System, window: Window, loads: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """How a vehicle ran during a window: what was measured beside it, and what its bodies carry, kg."""
    measured = [] if window.auxiliary is None else window.auxiliary.tolist()
    found = {channel.name: value for channel, value in zip(system.auxiliary, measured, strict=False)}
    found |= {f"{body}.load": value for body, (value, _) in loads.items()}
    return {name: value for name, value in found.items() if math.isfinite(value)}


def load_parameters(engine: Engine, view: VehicleView) -> list[dict[str, Any]]:
    """Loads that the system file names, as parameters beside those of the elements."""
    return [
        {"name": load.name, "value": view.load[load.body][0], "std": view.load[load.body][1], "unit": "kg"}
        | {"nominal": 0.0, "ratio": None, "identifiable": True}
        for load in engine.system.loads
        if load.declared and load.body in view.load
    ]


def _letter(p: ParameterView) -> str:
    if p.alarm is not None:
        return "a" if p.alarm == "alarm" else "w"
    if not p.identifiable:
        return "?" if p.baseline is not None or p.drift is not None else "."
    return "." if p.drift is None else "o"


def physical(engine: Engine, log_ratio: FloatArray, std: FloatArray) -> list[tuple[float, float]]:
    """(value, standard deviation) of every parameter in its unit, from log-ratios."""
    values = np.array([p.nominal for p in engine.system.tracked]) * np.exp(log_ratio)
    return list(zip(values.tolist(), (values * std).tolist(), strict=True))


def sensor_dict(engine: Engine, per_sensor: FloatArray) -> dict[str, float]:
    """nrmse (S,) by sensor, absent sensors left out."""
    pairs = zip(engine.system.sensors, per_sensor.tolist(), strict=True)
    return {name: value for name, value in pairs if math.isfinite(value)}


def fit_dict(nrmse: float, per_sensor: Mapping[str, float]) -> dict[str, Any]:
    """How well a window fits."""
    return {"nrmse": finite(nrmse), "per_sensor": dict(per_sensor)}


def suspected(alarm: Alarm | AlarmRow) -> tuple[tuple[str, ...], str]:
    """Channels that an alarm of kind sensor names, and the fault: "car_1l|car_1r.delay" is one of both together."""
    channels, _, fault = (alarm.parameter or "").rpartition(".")
    return tuple(channels.split("|")), fault


def alarm_dict(alarm: Alarm | AlarmRow) -> dict[str, Any]:
    """JSON of one alarm."""
    found: dict[str, Any] = {
        "parameter": alarm.parameter,
        "kind": alarm.kind,
        "onset": to_iso(alarm.onset),
        "raised": to_iso(alarm.opened),
        "recovered": optional_iso(alarm.closed),
        "change": finite(alarm.change),
        "std": finite(alarm.std),
        "severity": alarm.severity,
    }
    if alarm.alternatives:
        found["alternatives"] = list(alarm.alternatives)
    if alarm.kind == "sensor":
        found["channel"], _, found["fault"] = (alarm.parameter or "").rpartition(".")
    if isinstance(alarm, AlarmRow):
        found |= {
            "report": alarm.report_id,
            "id": alarm.id,
            "vehicle": alarm.vehicle,
            "acknowledged": optional_iso(alarm.acknowledged),
            "acknowledged_by": alarm.acknowledged_by,
            "bundle": f"/vehicles/{quote(alarm.vehicle or '', safe=':')}/bundle?alarm={alarm.id}",
        }
    return found


def window_dict(engine: Engine, record: WindowRecord) -> dict[str, Any]:
    """One line of `replay --json`."""
    names = [p.name for p in engine.system.tracked]
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
        identifiable: Sequence[bool] = solved.identifiable.tolist()
        pairs = physical(engine, solved.log_ratio, solved.std)
        line["fit"] = {"nrmse": finite(solved.nrmse), "adequate": solved.adequate}
        line["estimate"] = {n: list(p) for n, p, ok in zip(names, pairs, identifiable, strict=True) if ok}
    if posterior is not None:
        pairs = physical(engine, posterior.log_ratio, posterior.std)
        line["posterior"] = {n: list(p) for n, p in zip(names, pairs, strict=True)}
    declared = [load for load in engine.system.loads if load.declared]
    for part, loads in (("estimate", record.loads.estimated), ("posterior", record.loads.believed)):
        if line[part] is not None:
            line[part] |= {load.name: list(loads[load.body]) for load in declared if load.body in loads}
    return line


def finite(value: float | None) -> float | None:
    """JSON knows no NaN."""
    return value if value is not None and math.isfinite(value) else None


def known_limit(engine: Engine) -> float:
    """Standard deviation of a log-ratio from which on a posterior is the prior and no measurement."""
    return KNOWN * engine.tracker.settings.prior
