"""Messages from an edge or an identifying replica to the folding service: estimates of one vehicle's windows.

MessagePack, compressed with zlib.  Two codings of the numbers: `exact` (float64, so that folding elsewhere gives the
very same posterior) and `small`, for links that cost money:

- log-ratios in steps of a sixteenth of their own standard deviation (which adds 0.03 % to the variance),
- standard deviations in steps of 1.6 %,
- correlations as partial correlations of the sequence of parameters (Lewandowski, Kurowicka and Joe 2009), z = atanh(r)
  in steps of 1/16: whatever is rounded, the matrix stays positive definite, and the relative error of every
  conditional variance is bounded, however strong the correlation.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import msgpack
import numpy as np

from sprung.model.signals import Deviating, Estimate, FloatArray, MeasurementFault, Outcome, Window
from sprung.service.errors import UserError
from sprung.service.fleet.coding import (
    from_log_steps,
    log_steps,
    pack_floats,
    pack_ints,
    pack_spd,
    unpack_floats,
    unpack_ints,
    unpack_spd,
)

MEDIA_TYPE = "application/vnd.sprung.estimates"
FORMAT = 1
MOST_BYTES = 50_000_000  # of a message when it is unpacked: a small one may not grow beyond
MOST_WINDOWS = 2000  # of one message
LEVEL_STEP = 1 / 16  # of a log-ratio, in its standard deviations
SHIFT_STEP = 1 / 64  # of what deviations do, in standard deviations
RUNNING = 1 << 16  # the flag of an estimate above its iterations; older receivers take it for some more of these
Coding = Literal["exact", "small"]


class UnreadableMessage(ValueError):
    """Not a message of this format; one line."""


class OtherModel(UserError):
    """Estimates of another system file or estimator than this service has."""


@dataclass(frozen=True, slots=True)
class WindowEstimate:
    """One window that was identified where its samples are."""

    start: int  # ns since epoch
    outcome: Outcome  # used, repaired, dropped
    reason: str | None
    repaired_samples: int
    new_segment: bool  # the first after the clock jumped
    estimate: Estimate | None  # None where dropped
    auxiliary: FloatArray | None = None  # temperature, pressure and so on, as in `Window.auxiliary`

    @classmethod
    def of(cls, window: Window, estimate: Estimate | None) -> WindowEstimate:
        """What is sent of a window; one that could not be identified is a dropped one."""
        if estimate is not None and not estimate.identified:
            window, estimate = replace(window, outcome="dropped", reason=estimate.reason), None
        return cls(
            window.start,
            window.outcome,
            window.reason,
            window.repaired_samples,
            window.new_segment,
            estimate,
            window.auxiliary,
        )

    def window(self, sample_rate: float, channels: int) -> Window:
        """The window without its samples: they stayed where they were measured."""
        return Window(
            self.start,
            sample_rate,
            np.empty((0, channels)),
            self.outcome,
            self.reason,
            repaired_samples=self.repaired_samples,
            new_segment=self.new_segment,
            auxiliary=self.auxiliary,
        )


@dataclass(frozen=True, slots=True)
class IngestResult:
    """What became of one message."""

    vehicle: str
    folded: int  # windows that were tracked or counted now
    waiting: int  # of the message, kept until the gap before them is filled or given up
    known: int  # that were there before
    faults: tuple[MeasurementFault, ...] = ()  # of the vehicle's measurements, as its tracker knows them by now


@dataclass(frozen=True, slots=True)
class SentWindows:
    """Windows of one vehicle that are to be identified where they arrive."""

    vehicle: str
    starts: list[int]  # ns since epoch
    values: FloatArray  # (B, T, C), NaN for absent sensors


@dataclass(frozen=True, slots=True)
class Message:
    """Windows of one vehicle under one model, in the order in which they were cut."""

    vehicle: str
    model: str  # digest
    windows: tuple[WindowEstimate, ...]


def encode(message: Message, coding: Coding) -> bytes:
    """A message as bytes."""
    estimates = [w.estimate for w in message.windows if w.estimate is not None]
    body = {
        "format": FORMAT,
        "vehicle": message.vehicle,
        "model": message.model,
        "coding": coding,
        "start": pack_ints(np.array([w.start for w in message.windows], dtype=np.int64)),
        "windows": [
            [w.outcome, w.reason, w.repaired_samples, w.new_segment, w.estimate is not None] for w in message.windows
        ],
        "estimates": _estimates(estimates, coding) if estimates else None,
        "auxiliary": [None if w.auxiliary is None else _beside(w.auxiliary, coding) for w in message.windows],
    }
    return zlib.compress(msgpack.packb(body), 9)


def decode(data: bytes) -> Message:
    """The inverse of `encode`, of either coding.  Raises UnreadableMessage for anything else."""
    try:
        unpacker = zlib.decompressobj()
        plain = unpacker.decompress(data, MOST_BYTES)
        if not unpacker.eof:
            raise UnreadableMessage("the message is cut short, or larger than it may be")
        return _read(msgpack.unpackb(plain))
    except UnreadableMessage:
        raise
    except (zlib.error, msgpack.UnpackException, ValueError, TypeError, KeyError, IndexError, OverflowError) as error:
        raise UnreadableMessage(f"not a message of estimates ({type(error).__name__}: {error})"[:300]) from error


def read_messages(bodies: Sequence[bytes]) -> list[Message]:
    """Decoded messages.  Raises UserError for invalid ones."""
    try:
        return [decode(body) for body in bodies]
    except UnreadableMessage as error:
        raise UserError(str(error)) from None


def _read(body: dict[str, Any]) -> Message:
    if body["format"] != FORMAT:
        raise UnreadableMessage(f"the message has format {body['format']!r}; this version reads {FORMAT}")
    if len(body["windows"]) > MOST_WINDOWS:
        raise UnreadableMessage(f"{len(body['windows'])} windows in one message; at most {MOST_WINDOWS} are taken")
    found = iter(_read_estimates(body["estimates"], body["coding"]) if body["estimates"] is not None else ())
    starts = unpack_ints(body["start"]).tolist()
    beside = [None if one is None else np.array(one, dtype=np.float64) for one in body["auxiliary"]]
    windows = []
    rows = zip(starts, beside, body["windows"], strict=True)
    for start, auxiliary, (outcome, reason, repaired, new_segment, known) in rows:
        if outcome not in ("used", "repaired", "dropped"):
            raise UnreadableMessage(f"unknown outcome {outcome!r}"[:100])
        estimate = next(found, None) if known else None
        if bool(known) is (estimate is None) or bool(known) is (outcome == "dropped"):
            raise UnreadableMessage("windows and estimates do not belong together")
        said = None if reason is None else str(reason)[:200].replace("\x00", "")
        windows.append(WindowEstimate(start, outcome, said, int(repaired), bool(new_segment), estimate, auxiliary))
    return Message(str(body["vehicle"]), str(body["model"]), tuple(windows))


def _beside(values: FloatArray, coding: Coding) -> list[float]:
    return values.tolist() if coding == "exact" else [float(f"{value:.5g}") for value in values.tolist()]


def _estimates(found: Sequence[Estimate], coding: Coding) -> dict[str, Any]:
    level, covariance = np.stack([e.log_ratio for e in found]), np.stack([e.covariance for e in found])
    known = np.stack([e.identifiable for e in found])
    scalars = np.array([[e.nrmse, e.chi_square, e.noise] for e in found])
    sensors = np.stack([e.per_sensor for e in found])
    flags = [e.adequate + 2 * e.converged + 4 * e.informative + 8 * e.iterations + RUNNING * e.running for e in found]
    deviating = [(i, e.deviating) for i, e in enumerate(found) if e.deviating is not None]
    return {
        "level": _levels(level, np.diagonal(covariance, axis1=1, axis2=2), coding),
        "covariance": pack_floats(covariance) if coding == "exact" else pack_spd(covariance),
        "identifiable": pack_ints(known.astype(np.int64)),
        "scalars": pack_floats(scalars) if coding == "exact" else pack_ints(log_steps(scalars)),
        "sensors": pack_floats(sensors) if coding == "exact" else pack_ints(log_steps(sensors)),
        "flags": pack_ints(np.array(flags, dtype=np.int64)),
        "faults": [
            [i, [[f.channel, f.kind, f.value, f.std] for f in e.faults]] for i, e in enumerate(found) if e.faults
        ],
        "deviating": _deviating(deviating, coding) if deviating else None,
    }


def _read_estimates(data: dict[str, Any], coding: Coding) -> list[Estimate]:
    exact = coding == "exact"
    covariance = (unpack_floats if exact else unpack_spd)(data["covariance"])
    level = _read_levels(data["level"], np.diagonal(covariance, axis1=1, axis2=2), coding)
    known = unpack_ints(data["identifiable"]).astype(np.bool_)
    scalars, sensors = (
        unpack_floats(data[name]) if exact else from_log_steps(unpack_ints(data[name]))
        for name in ("scalars", "sensors")
    )
    flags = unpack_ints(data["flags"]).tolist()
    noise = scalars[:, 2].tolist() if scalars.shape[1:] == (3,) else [0.0] * len(scalars)  # older senders: none
    if not len(level) == len(covariance) == len(known) == len(scalars) == len(sensors) == len(flags):
        raise UnreadableMessage("the message's columns differ in length")
    if covariance.shape[1:] != (level.shape[1],) * 2 or known.shape != level.shape:
        raise UnreadableMessage("the message's columns differ in width")
    deviating = _read_deviating(data["deviating"], coding) if data["deviating"] is not None else {}
    faults = {
        int(i): tuple(MeasurementFault(str(c), k, float(v), float(s)) for c, k, v, s in some)
        for i, some in data["faults"]
    }
    return [
        Estimate(
            level[i],
            covariance[i],
            known[i],
            float(scalars[i, 0]),
            sensors[i],
            float(scalars[i, 1]),
            adequate=bool(flag & 1),
            converged=bool(flag & 2),
            iterations=flag % RUNNING >> 3,
            deviating=deviating.get(i),
            faults=faults.get(i, ()),
            informative=bool(flag & 4),
            running=bool(flag & RUNNING),
            noise=noise[i],
        )
        for i, flag in enumerate(flags)
    ]


def _levels(level: FloatArray, variance: FloatArray, coding: Coding) -> list[Any]:
    if coding == "exact":
        return pack_floats(level)
    unit = LEVEL_STEP * from_log_steps(log_steps(np.sqrt(variance)))
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.nan_to_num(np.clip(np.round(level / unit), -(2**40), 2**40))
    return pack_ints(steps.astype(np.int64))


def _read_levels(data: list[Any], variance: FloatArray, coding: Coding) -> FloatArray:
    if coding == "exact":
        return unpack_floats(data)
    return unpack_ints(data) * (LEVEL_STEP * np.sqrt(variance))


def _deviating(found: Sequence[tuple[int, Deviating]], coding: Coding) -> dict[str, Any]:
    given = np.stack([d.given for _, d in found])
    information = np.stack([d.information for _, d in found])
    cross, score = np.stack([d.cross for _, d in found]), np.stack([d.score for _, d in found])
    packed: dict[str, Any] = {
        "of": [i for i, _ in found],
        "whole": [d.whole for _, d in found],
        "freedom": [d.freedom for _, d in found],
        "point": pack_floats(np.stack([d.point for _, d in found])),
    }
    if coding == "exact":
        names = {"given": given, "information": information, "cross": cross, "score": score}
        return packed | {name: pack_floats(values) for name, values in names.items()}
    wide, sure = _scales(given, information)
    with np.errstate(divide="ignore", invalid="ignore"):
        rounded = np.round(cross / (SHIFT_STEP * wide[:, :, None] * sure[:, None, :]))
        pull = np.round(score / (SHIFT_STEP * sure))
    return packed | {
        "given": pack_spd(given),
        "information": pack_spd(information),
        "cross": pack_ints(np.nan_to_num(rounded, posinf=0, neginf=0).astype(np.int64)),
        "score": pack_ints(np.nan_to_num(pull, posinf=0, neginf=0).astype(np.int64)),
    }


def _read_deviating(data: dict[str, Any], coding: Coding) -> dict[int, Deviating]:
    if coding == "exact":
        given, information, cross, score = (
            unpack_floats(data[name]) for name in ("given", "information", "cross", "score")
        )
    else:
        given, information = unpack_spd(data["given"]), unpack_spd(data["information"])
        wide, sure = _scales(given, information)
        cross = unpack_ints(data["cross"]) * (SHIFT_STEP * wide[:, :, None] * sure[:, None, :])
        score = unpack_ints(data["score"]) * (SHIFT_STEP * sure)
    point = unpack_floats(data["point"])
    return {
        int(i): Deviating(
            point[n], given[n], cross[n], information[n], score[n], float(data["freedom"][n]), bool(data["whole"][n])
        )
        for n, i in enumerate(data["of"])
    }


def _scales(given: FloatArray, information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Units that sender and receiver both know: standard deviations (n, P), square roots of information (n, H)."""
    wide, sure = (np.sqrt(np.diagonal(m, axis1=1, axis2=2)) for m in (given, information))
    return from_log_steps(log_steps(wide)), np.where(sure > 0, from_log_steps(log_steps(sure)), 1.0)
