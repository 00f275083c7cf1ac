"""The tracker's state: a small frozen value that goes through JSON and comes back bit for bit."""

from __future__ import annotations

import base64
from binascii import b2a_base64
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from fnmatch import fnmatchcase
from functools import cache
from typing import Any, Literal

import numpy as np

from sprung.model.signals import BoolArray, FaultKind, IntArray
from sprung.model.tracking import deviation_record
from sprung.model.tracking.cargo import Cargo
from sprung.model.tracking.changes import Changes
from sprung.model.tracking.coverage import Coverage
from sprung.model.tracking.deviation_model import model_of
from sprung.model.tracking.deviation_record import DeviationRecord
from sprung.model.tracking.filter import Belief
from sprung.model.tracking.inflation import VarianceInflation
from sprung.model.tracking.innovation import InnovationCusum
from sprung.model.tracking.misfit import MisfitFloor
from sprung.model.tracking.weather import Weather

_Record = VarianceInflation | InnovationCusum | Changes | DeviationRecord | Weather | Cargo  # of arrays only
FORMAT = 3
_READ = (1, 2, FORMAT)

Kind = Literal["change", "misfit", "sensor", "load"]
Severity = Literal["warning", "alarm"]
Health = Literal["ok", "maintenance_required", "out_of_specification", "check_function", "failure"]


class TrackerStateError(ValueError):
    """A stored state that can't be read, or that belongs to other parameters."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """A change of a parameter from the vehicle's own baseline, windows that stopped fitting, a wrong measurement, or a
    load beyond what the system file allows."""

    kind: Kind
    parameter: str | None  # None for a misfit; "bogie1_1l.gain" for a sensor; "car.load"; "*.damping": all of them
    onset: int  # ns, estimated time of the change
    opened: int  # ns, centre of the window that gave the evidence
    severity: Severity
    change: float | None = None  # relative to the baseline, now; None for a misfit
    std: float | None = None
    peak: float | None = None  # the largest change so far, signed
    closed: int | None = None  # ns; None: active
    alternatives: tuple[str, ...] = ()  # what the evidence cannot distinguish it from, "bogie1_1l.gain"

    @property
    def key(self) -> tuple[str, str | None, int]:
        """What names an alarm for as long as it lives."""
        return self.kind, self.parameter, self.opened

    def ended(self, now: int) -> Alarm:
        """Closed now, but not before it was opened: a wrong clock may have dated the opening later."""
        return replace(self, closed=max(now, self.opened))


@dataclass(frozen=True, slots=True)
class Stuck:
    """A channel that windows found frozen, saturated, silent, noisy, reversed or exchanged."""

    channel: str
    kind: FaultKind
    value: float
    count: int  # windows that said so, less those that did not; bounded
    since: int  # ns
    unseen: tuple[str, ...] = ()  # parameters that no window has identified without it

    def shifted(self, by: int) -> Stuck:
        """With its time later by `by`, ns."""
        return replace(self, since=self.since + by)


@dataclass(frozen=True, slots=True, eq=False)
class TrackerState:
    """All that the tracker knows about one vehicle; `update` makes a new one.  P parameters."""

    names: tuple[str, ...]
    time: int | None  # ns, start of the last window that was seen
    last: int | None  # ns, start of the last window that was used
    used: int  # windows fused
    rejected: int  # windows not fused: inadequate, not converged, or without a proper covariance
    idle: int  # windows without excitation: nothing was learned from them, for or against
    outliers: int  # windows fused with bounded influence
    belief: Belief
    inflation: VarianceInflation
    innovation: InnovationCusum
    changes: Changes
    fit: MisfitFloor
    calibration: DeviationRecord
    stuck: tuple[Stuck, ...]  # frozen, saturated, silent, noisy, reversed or exchanged channels of the last windows
    alarms: tuple[Alarm, ...]  # active and closed, oldest first
    coverage: Coverage = field(default_factory=Coverage)
    weather: Weather | None = None  # None: of an older format; it is learned from now on
    cargo: Cargo | None = None

    @property
    def active(self) -> tuple[Alarm, ...]:
        return tuple(alarm for alarm in self.alarms if alarm.closed is None)

    @property
    def accused(self) -> BoolArray:
        """Parameters that an active alarm says have changed, alone or with others of their kind, shape (P,)."""
        names = [alarm.parameter or "" for alarm in self.active if alarm.kind == "change"]
        return np.array([any(fnmatchcase(name, pattern) for pattern in names) for name in self.names], dtype=bool)

    @property
    def misfit_since(self) -> int | None:
        """ns since when windows don't fit; None while they do."""
        return self.fit.misfit_since

    def shifted(self, by: int) -> TrackerState:
        """As if all windows had come later by `by`, ns.  Alarms keep the times with which they were reported."""
        return replace(
            self,
            time=None if self.time is None else self.time + by,
            last=None if self.last is None else self.last + by,
            inflation=self.inflation.shifted(by),
            changes=self.changes.shifted(by),
            fit=self.fit.shifted(by),
            calibration=self.calibration.shifted(by),
            stuck=tuple(stuck.shifted(by) for stuck in self.stuck),
            weather=None if self.weather is None else self.weather.shifted(by),
            cargo=None if self.cargo is None else self.cargo.shifted(by),
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values; arrays as base64 of little-endian bytes, so that nothing is rounded."""
        upper = _upper(len(self.belief.mean))
        return {
            "format": FORMAT,
            "names": list(self.names),
            "time": self.time,
            "last": self.last,
            "used": self.used,
            "rejected": self.rejected,
            "idle": self.idle,
            "outliers": self.outliers,
            "belief": {"mean": _pack(self.belief.mean), "covariance": _pack(self.belief.covariance[upper])},
            "scatter": _packed(self.inflation),  # keys are those of format 1
            "surprise": _packed(self.innovation),
            "changes": _packed(self.changes),
            "fit": asdict(self.fit),
            "calibration": _packed(self.calibration),
            "stuck": [asdict(stuck) for stuck in self.stuck],
            "alarms": [asdict(alarm) for alarm in self.alarms],
            "coverage": asdict(self.coverage),
            "weather": None if self.weather is None else _packed(self.weather),
            "cargo": None if self.cargo is None else _packed(self.cargo),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> TrackerState:
        """Raises TrackerStateError with what is wrong."""
        if data.get("format") not in _READ:
            raise TrackerStateError(
                f"stored tracker state has format {data.get('format')!r}; this version reads formats 1 to {FORMAT}"
            )
        try:
            return cls(
                names=tuple(data["names"]),
                time=data["time"],
                last=data["last"],
                used=data["used"],
                rejected=data["rejected"],
                idle=data.get("idle", 0),
                outliers=data["outliers"],
                belief=_belief(data),
                inflation=_inflation(data),
                innovation=_innovation(data),
                changes=Changes(**_unpack_all(data["changes"])),
                fit=MisfitFloor(**data["fit"]),
                calibration=_calibration(data),
                stuck=tuple(
                    Stuck(**{**stuck, "unseen": tuple(stuck.get("unseen", ()))}) for stuck in data.get("stuck", ())
                ),
                alarms=tuple(
                    Alarm(**{**alarm, "alternatives": tuple(alarm.get("alternatives", ()))}) for alarm in data["alarms"]
                ),
                coverage=_coverage(data),
                weather=_weather(data),
                cargo=_cargo(data),
            )
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
            raise TrackerStateError(f"stored tracker state can't be read: {error!r}") from error


def _coverage(data: Mapping[str, Any]) -> Coverage:
    """Older states do not have it: what they used they could use."""
    return Coverage(**data["coverage"]) if "coverage" in data else Coverage(data["used"], 1.0)


def _weather(data: Mapping[str, Any]) -> Weather | None:
    if data.get("weather") is None:
        return None
    arrays = _unpack_all(data["weather"])
    P = len(data["names"])
    mean = arrays["mean"].reshape(P, -1)
    size = mean.shape[1]
    shapes = {"mean": (-1, size), "covariance": (-1, size, size)}
    shaped = {name: arrays[name].reshape(shapes[name.removeprefix("kind_")]) for name in
              ("mean", "covariance", "kind_mean", "kind_covariance")}  # fmt: skip
    return Weather(**{"warmth": np.full(1, np.nan), "shared": np.zeros(1)} | arrays | shaped)


def _cargo(data: Mapping[str, Any]) -> Cargo | None:
    if data.get("cargo") is None:
        return None
    arrays = _unpack_all(data["cargo"])
    zeros = np.zeros(len(arrays["constant"]))
    never = zeros.astype(np.int64)
    later = {"scatter": zeros, "past": zeros, "past_variance": zeros, "past_at": never}
    later["disputed"] = np.zeros(1, dtype=np.int64)
    return Cargo(**later | arrays)


def _belief(data: Mapping[str, Any]) -> Belief:
    arrays = _unpack_all(data["belief"])
    mean, covariance = arrays["mean"], arrays["covariance"]
    upper = _upper(len(mean))
    full = np.zeros((len(mean), len(mean)))
    full[upper] = covariance
    full.T[upper] = covariance
    return Belief(mean, full, len(mean) - 2 * len(data["names"]))


def _innovation(data: Mapping[str, Any]) -> InnovationCusum:
    """Older states do not say how far off the last windows were."""
    arrays = _unpack_all(data["surprise"])
    none = np.zeros(len(data["names"]))
    return InnovationCusum(**{"score": none, "windows": none, "offset": none} | arrays)


def _calibration(data: Mapping[str, Any]) -> DeviationRecord:
    """Format 1, and trackers without deviations, have none."""
    if "calibration" not in data:
        return deviation_record.start(len(data["names"]), model_of(()))
    arrays = _unpack_all(data["calibration"])
    size, none = len(arrays["reference"]), np.zeros(len(arrays["slope"]))
    unknown = np.full(size, np.nan)  # `deviation_record.extended` knows what older states leave open
    of_reference = ("origin", "reference_variance", "following", "followed", "lately")
    older: dict[str, Any] = {name: unknown for name in of_reference} | {"trend": none, "trend_curvature": none}
    shape = len(data["names"]), size
    return DeviationRecord(**older | arrays | {name: arrays[name].reshape(shape) for name in ("cross", "base_cross")})


def _inflation(data: Mapping[str, Any]) -> VarianceInflation:
    """Format 1 timed its pairs for the vehicle as a whole."""
    arrays = _unpack_all(data["scatter"])
    if data["format"] == 1:
        arrays["anchored"] = np.full(arrays["anchor"].shape, data["anchored"] or 0, dtype=np.int64)
    return VarianceInflation(**arrays)


def _packed(record: _Record) -> dict[str, str]:
    """A record of nothing but arrays."""
    return {field.name: _pack(getattr(record, field.name)) for field in fields(record)}


@cache
def _upper(size: int) -> tuple[IntArray, IntArray]:
    """Indices of the upper triangle of a matrix of this size."""
    return np.triu_indices(size)


def _unpack_all(packed: Mapping[str, str]) -> dict[str, Any]:
    return {name: _unpack(text) for name, text in packed.items()}


def _pack(array: Any) -> str:
    kind = _little_endian(array.dtype)
    return kind + ":" + b2a_base64(np.ascontiguousarray(array, kind).data, newline=False).decode("ascii")


@cache
def _little_endian(kind: np.dtype[Any]) -> str:
    return kind.newbyteorder("<").str


def _unpack(text: str) -> Any:
    kind, _, body = text.partition(":")
    if kind not in ("<f8", "<i8", "|i1"):
        raise TrackerStateError(f"stored tracker state holds an array of unknown type {kind!r}")
    return np.frombuffer(base64.b64decode(body, validate=True), dtype=kind).copy()
