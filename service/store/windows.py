"""Windows and what was made of them: stored once per vehicle, start and model."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Row, func, select

from sprung.model.signals import BoolArray, Estimate, FloatArray
from sprung.service.store.partitions import ensure_months, insert_new
from sprung.service.store.schema import windows

IN_LIMIT = 500  # values in one IN (...): below every dialect's bound on parameters


@dataclass(frozen=True, slots=True)
class StoredEstimate:
    """The part of an `Estimate` that is kept."""

    log_ratio: FloatArray  # log(theta / nominal), shape (P,)
    std: FloatArray  # of log_ratio, shape (P,)
    identifiable: BoolArray  # shape (P,)
    nrmse: float
    per_sensor: FloatArray  # nrmse, shape (S,); NaN for an absent sensor
    chi_square: float
    adequate: bool
    converged: bool
    iterations: int

    @classmethod
    def of(cls, estimate: Estimate) -> StoredEstimate:
        """Keep the variances, drop the correlations: 2 kB a window that nothing reads again."""
        return cls(
            estimate.log_ratio,
            np.sqrt(np.diagonal(estimate.covariance)),
            estimate.identifiable,
            float(estimate.nrmse),
            estimate.per_sensor,
            float(estimate.chi_square),
            bool(estimate.adequate),
            bool(estimate.converged),
            int(estimate.iterations),
        )


@dataclass(frozen=True, slots=True)
class Posterior:
    """What the tracker believed after a window."""

    log_ratio: FloatArray  # shape (P,)
    std: FloatArray  # shape (P,)


@dataclass(frozen=True, slots=True)
class WindowLoads:
    """What bodies carry, kg, with standard deviations, by body."""

    estimated: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # by the window alone
    believed: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # by the tracker after it

    @classmethod
    def read(cls, text: str | None) -> WindowLoads:
        """The inverse of `text`."""
        pairs = {} if text is None else json.loads(text)
        estimated, believed = ({body: tuple(pair[i]) for body, pair in pairs.items() if pair[i]} for i in (0, 1))
        return cls(estimated, believed)

    def text(self) -> str | None:
        """JSON, as the store keeps it; None where nothing is told."""
        identified = {
            body: [self.estimated.get(body), self.believed.get(body)] for body in {**self.estimated, **self.believed}
        }
        return json.dumps(identified, separators=(",", ":")) if identified else None


@dataclass(frozen=True, slots=True)
class WindowRecord:
    """One window as the store keeps it."""

    start: int  # ns since epoch
    outcome: str  # used, repaired, dropped, uninformative
    reason: str | None
    repaired_samples: int
    tracked: bool  # False: dropped, or older than what the tracker had seen
    solved: StoredEstimate | None  # None where dropped
    posterior: Posterior | None  # None where not tracked
    loads: WindowLoads = WindowLoads()  # of bodies whose load the system file names


@dataclass(frozen=True, slots=True)
class VehicleWindows:
    """Windows of one vehicle under one model, in order of time."""

    vehicle: str
    model_id: int
    records: Sequence[WindowRecord]


def add_windows(
    connection: Connection, found: Sequence[VehicleWindows], stored_ns: int, recording_id: str | None
) -> None:
    """Store windows whose key is not there yet; the others are left as they are."""
    rows = [
        {"vehicle_id": one.vehicle, "model_id": one.model_id, "stored_ns": stored_ns, "recording_id": recording_id}
        | _window_row(record)
        for one in found
        for record in one.records
    ]
    ensure_months(connection, (record.start for one in found for record in one.records))
    insert_new(connection, windows, rows)


def known_windows(
    connection: Connection, vehicle: str, model_id: int, starts: Iterable[int]
) -> dict[int, WindowRecord]:
    """Those of the windows that are stored already, by start."""
    found: dict[int, WindowRecord] = {}
    query = select(windows).where(windows.c.vehicle_id == vehicle, windows.c.model_id == model_id)
    for part in _parts(starts):
        for row in connection.execute(query.where(windows.c.start_ns.in_(part))):
            found[row.start_ns] = _record(row)
    return found


def known_starts(connection: Connection, vehicle: str, model_id: int, starts: Iterable[int]) -> set[int]:
    """Which of the windows are stored already."""
    query = select(windows.c.start_ns).where(windows.c.vehicle_id == vehicle, windows.c.model_id == model_id)
    found: set[int] = set()
    for part in _parts(starts):
        found.update(connection.execute(query.where(windows.c.start_ns.in_(part))).scalars())
    return found


def windows_between(
    connection: Connection, vehicle: str, model_id: int, since: int, until: int, together: int
) -> Iterator[list[WindowRecord]]:
    """Windows with since <= start < until in order of time, some at once."""
    query = (
        select(windows)
        .where(windows.c.vehicle_id == vehicle, windows.c.model_id == model_id)
        .where(windows.c.start_ns < until)
        .order_by(windows.c.start_ns)
        .limit(together)
    )
    while records := [_record(row) for row in connection.execute(query.where(windows.c.start_ns >= since))]:
        yield records
        since = records[-1].start + 1


def newest_start(connection: Connection, vehicle: str, model_id: int, last: int) -> int:
    """Start of the newest window that is stored after `last`, ns; `last` where there is none."""
    query = select(func.max(windows.c.start_ns)).where(windows.c.vehicle_id == vehicle, windows.c.model_id == model_id)
    found = connection.execute(query.where(windows.c.start_ns > last)).scalar()
    return last if found is None else int(found)


def latest_window(connection: Connection, vehicle: str, model_id: int) -> WindowRecord | None:
    """The newest window of a vehicle that was identified."""
    query = (
        select(windows)
        .where(
            windows.c.vehicle_id == vehicle,
            windows.c.model_id == model_id,
            windows.c.outcome != "dropped",
        )
        .order_by(windows.c.start_ns.desc())
        .limit(1)
    )
    row = connection.execute(query).first()
    return None if row is None else _record(row)


def pack(values: FloatArray) -> bytes:
    """Little-endian float64 bytes of values of any shape."""
    return np.ascontiguousarray(values, dtype="<f8").tobytes()


def unpack(data: bytes) -> FloatArray:
    """The inverse of `pack`, as a read-only array (N,)."""
    return np.frombuffer(data, dtype="<f8").astype(np.float64, copy=False)


def _window_row(record: WindowRecord) -> dict[str, Any]:
    row: dict[str, Any] = {
        "start_ns": record.start,
        "outcome": record.outcome,
        "reason": None if record.reason is None else record.reason[:200],
        "repaired_samples": record.repaired_samples,
        "tracked": record.tracked,
    }
    solved, posterior = record.solved, record.posterior
    return row | {
        "nrmse": None if solved is None else solved.nrmse,
        "chi_square": None if solved is None else solved.chi_square,
        "adequate": None if solved is None else solved.adequate,
        "converged": None if solved is None else solved.converged,
        "iterations": None if solved is None else solved.iterations,
        "log_ratio": None if solved is None else pack(solved.log_ratio),
        "std": None if solved is None else pack(solved.std),
        "identifiable": None if solved is None else np.asarray(solved.identifiable, np.uint8).tobytes(),
        "per_sensor": None if solved is None else pack(solved.per_sensor),
        "posterior": None if posterior is None else pack(posterior.log_ratio),
        "posterior_std": None if posterior is None else pack(posterior.std),
        "loads": record.loads.text(),
    }


def _record(row: Row[Any]) -> WindowRecord:
    solved = None
    if row.log_ratio is not None:
        identifiable: NDArray[np.bool_] = np.frombuffer(row.identifiable, np.uint8).astype(np.bool_)
        solved = StoredEstimate(
            unpack(row.log_ratio),
            unpack(row.std),
            identifiable,
            row.nrmse,
            unpack(row.per_sensor),
            row.chi_square,
            row.adequate,
            row.converged,
            row.iterations,
        )
    posterior = None if row.posterior is None else Posterior(unpack(row.posterior), unpack(row.posterior_std))
    loads = WindowLoads.read(row.loads)
    return WindowRecord(
        row.start_ns, row.outcome, row.reason, row.repaired_samples, row.tracked, solved, posterior, loads
    )


def _parts(starts: Iterable[int]) -> Iterable[list[int]]:
    values = list(starts)
    return (values[i : i + IN_LIMIT] for i in range(0, len(values), IN_LIMIT))
