"""CAN frames to samples: the signals of a cantools database, extracted from whole blocks with NumPy.

cantools is the reference: for every frame that it decodes, the values here are the same (to rounding).  What
cantools has no opinion on is decided here: a value that the database's value table calls invalid, one outside
the database's range, and, where the database gives no range, a field of all ones (the customary "signal not
available", SAE J1939-71) are missing samples.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from cantools.database import Database, Message, Signal
from numpy.typing import NDArray

from sprung.model.signals import BoolArray, Channel, FloatArray, SampleBlock
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.candatabase import load_database
from sprung.replay.frames import EXTENDED, ByteArray, FrameBlock, WordArray, id_text, last_byte, raw_bits
from sprung.replay.statedunits import compare_units

INVALID_CHOICE = re.compile(
    r"invalid|not[ _]?(available|avail|valid|supported|defined|used)|unavailable|unknown|undefined|"
    r"^(sna|na|n/a|nan|init)$|(?<!no )(?<!no_)(?<!no)(?<!de)(fault|error|fail)",
    re.IGNORECASE,
)
MOST_BYTES, FLOAT_BITS = 64, (16, 32, 64)  # of a frame of CAN FD; of a field in IEEE 754
ALL_ONES_BITS = 8  # a narrower field of all ones is an ordinary value


@dataclass(frozen=True, slots=True)
class Bits:
    """Where a signal lies in its frame."""

    start: int
    length: int
    big_endian: bool

    def raw(self, data: ByteArray) -> WordArray:
        """Unsigned integers of the signal, shape (n,)."""
        return raw_bits(data, self.start, self.length, big_endian=self.big_endian)

    @property
    def aligned(self) -> tuple[str, int, int] | None:
        """Byte order, size and column of the field where the frame, seen as an array of such items, holds it."""
        size = self.length // 8
        first = self.start // 8
        whole = self.start % 8 == (7 if self.big_endian else 0)
        if self.length not in (8, 16, 32, 64) or not whole or first % size:
            return None
        return (">" if self.big_endian else "<"), size, first // size

    @property
    def end(self) -> int:
        """Bytes that a frame needs to hold the signal."""
        return last_byte(self.start, self.length, big_endian=self.big_endian) + 1


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """One wanted signal: bits -> number -> physical value, and when it is there at all."""

    channel: int
    name: str
    bits: Bits
    kind: str  # "uint", "int" or "float"
    unit: str | None  # as the database states it
    scale: float
    offset: float
    minimum: float | None
    maximum: float | None
    invalid_raw: tuple[int, ...]  # raw values, as unsigned integers, that mark a missing value
    conditions: tuple[tuple[Bits, tuple[int, ...]], ...]  # multiplexer fields and the values that select it

    def decode(self, data: ByteArray, out: FloatArray) -> tuple[BoolArray | None, BoolArray | None]:
        """Write physical values (NaN where missing) to `out` (n,); returns which were marked invalid and which were
        out of range, where None stands for "none of them" and costs nothing."""
        with np.errstate(invalid="ignore", over="ignore"):  # a float signal may carry any bits
            np.multiply(self._number(data), self.scale, out=out, dtype=np.float64)
        if self.offset != 0.0:
            out += self.offset
        invalid = _any(~np.isfinite(out)) if self.kind == "float" else None
        if self.invalid_raw:
            marked = _any(np.isin(self.bits.raw(data), np.array(self.invalid_raw, dtype=np.uint64)))
            invalid = marked if invalid is None else invalid if marked is None else invalid | marked
        outside = self._outside(out)
        if invalid is not None:
            outside = _any(outside & ~invalid) if outside is not None else None
            out[invalid] = np.nan
        if outside is not None:
            out[outside] = np.nan
        return invalid, outside

    def _outside(self, physical: FloatArray) -> BoolArray | None:
        """Values beyond the database's range, by more than the rounding of its decimal limits."""
        slack = 0.5 * abs(self.scale) if self.kind != "float" else 0.0
        outside = None
        if self.minimum is not None:
            outside = _any(physical < self.minimum - slack)
        if self.maximum is not None:
            above = _any(physical > self.maximum + slack)
            outside = above if outside is None else outside if above is None else outside | above
        return outside

    def _number(self, data: ByteArray) -> NDArray[Any]:
        """The field as integers or floats, not scaled yet, shape (n,)."""
        aligned = self.bits.aligned
        if aligned is not None:  # a whole item of the frame: no shifting
            order, size, column = aligned
            return data.view(f"{order}{self.kind[0]}{size}")[:, column]
        raw, length = self.bits.raw(data), self.bits.length
        if self.kind == "float":
            return raw.astype(f"<u{length // 8}").view(f"<f{length // 8}").astype(np.float64)
        if self.kind == "int":
            return (raw << np.uint64(64 - length)).view(np.int64) >> np.int64(64 - length)
        return raw

    def selected(self, data: ByteArray) -> BoolArray:
        """Frames whose multiplexer fields select this signal, shape (n,)."""
        chosen = np.ones(len(data), dtype=bool)
        for bits, codes in self.conditions:
            chosen &= np.isin(bits.raw(data), np.array(codes, dtype=np.uint64))
        return chosen


def _any(mask: BoolArray) -> BoolArray | None:
    return mask if mask.any() else None


@dataclass(frozen=True, slots=True)
class MessagePlan:
    """One wanted message."""

    name: str
    frame_id: int  # with EXTENDED
    signals: list[SignalPlan] = field(default_factory=list)

    @property
    def multiplexed(self) -> bool:
        return any(signal.conditions for signal in self.signals)

    @property
    def end(self) -> int:
        """Bytes that a frame needs to hold all of the wanted signals."""
        return max(signal.bits.end for signal in self.signals)


class CanDecoder:
    """Blocks of frames in, blocks of samples out; every frame goes into the account."""

    def __init__(self, channels: Sequence[Channel], dbc: str | Path | Database) -> None:
        database = dbc if isinstance(dbc, Database) else load_database(Path(dbc))
        self.plans = sorted(_plan(channels, database), key=lambda plan: plan.frame_id)
        self.ids = np.array([plan.frame_id for plan in self.plans], dtype=np.uint32)
        self._stated = [
            (channels[signal.channel], f"{plan.name}.{signal.name}", signal.unit)
            for plan in self.plans
            for signal in plan.signals
        ]
        most = max(len(plan.signals) for plan in self.plans)
        self.table = np.full((len(self.plans) + 1, most), -1, dtype=np.int32)  # channels of a message; last: foreign
        for row, plan in enumerate(self.plans):
            self.table[row, : len(plan.signals)] = [signal.channel for signal in plan.signals]

    def decode(self, frames: FrameBlock, account: Account) -> SampleBlock:
        """Samples of the wanted signals in the order of the frames; a missing value is NaN."""
        place = np.minimum(np.searchsorted(self.ids, frames.id), len(self.ids) - 1).astype(np.int16)
        place[self.ids[place] != frames.id] = len(self.ids)
        order = np.argsort(place, kind="stable")  # message by message, foreign frames last
        data, length = _take_rows(frames.data, order), frames.length[order]
        value = np.empty((len(place), self.table.shape[1]))  # what no message fills is left out by its channel, -1
        channel = np.take(self.table, place, axis=0)
        begin = 0
        for index, count in enumerate(np.bincount(place, minlength=len(self.ids) + 1)[:-1].tolist()):
            if count:
                rows = slice(begin, begin + count)
                plan = self.plans[index]
                account.contents[id_text(plan.frame_id)] += count
                present = self._decode_message(plan, data[rows], length[rows], value[rows], account)
                if present is not None:
                    columns = np.arange(len(plan.signals))
                    channel[order[rows, None], columns] = np.where(present, channel[order[rows, None], columns], -1)
                begin += count
        if begin < len(place):
            account.foreign(len(place) - begin)
            self._count_foreign(frames.id[order[begin:]], account)
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        value = _take_rows(value, back)
        time = np.repeat(frames.time, value.shape[1])
        keep = channel.reshape(-1) >= 0
        if keep.all():
            return SampleBlock(time, channel.reshape(-1), value.reshape(-1))
        return SampleBlock(time[keep], channel.reshape(-1)[keep], value.reshape(-1)[keep])

    def _decode_message(
        self, plan: MessagePlan, data: ByteArray, length: ByteArray, value: FloatArray, account: Account
    ) -> BoolArray | None:
        """Fill `value` (n, at least wanted signals) from the frames of one message; returns which signals each frame
        holds, shape (n, wanted signals), or None when every frame holds all."""
        if plan.multiplexed or length.min() < plan.end:
            return _decode_piecewise(plan, data, length, value, account)
        missing = False
        for column, signal in enumerate(plan.signals):
            invalid, outside = signal.decode(data, value[:, column])
            if invalid is not None or outside is not None:
                missing = True
                _count_missing(invalid, outside, None, account)
        lost = int(np.isnan(value).all(axis=1).sum()) if missing else 0
        account.drop(lost, "no valid value")
        account.tally.used += len(data) - lost
        return None

    def compare_units(self, account: Account) -> None:
        """Note the signals that the database has in another unit than the system file reads."""
        compare_units(self._stated, account)

    def _count_foreign(self, ids: NDArray[np.uint32], account: Account) -> None:
        for frame_id, count in zip(*(part.tolist() for part in np.unique(ids, return_counts=True)), strict=True):
            account.contents[id_text(frame_id)] += count


def _take_rows(array: NDArray[Any], rows: NDArray[np.intp]) -> NDArray[Any]:
    """`array[rows]`; rows of eight bytes are taken as words, which is quicker."""
    if array.dtype == np.uint8 and array.shape[1] == 8 and array.flags.c_contiguous:
        found: NDArray[Any] = array.view(np.uint64)[rows, 0].view(np.uint8).reshape(-1, 8)
        return found
    return np.take(array, rows, axis=0)


def _decode_piecewise(
    plan: MessagePlan, data: ByteArray, length: ByteArray, value: FloatArray, account: Account
) -> BoolArray:
    """As `_decode_message`, where not every frame holds every signal."""
    if data.shape[1] < plan.end:  # an FD layout in a classic block
        data = np.pad(data, ((0, 0), (0, 64 - data.shape[1])))
    present = np.zeros((len(data), len(plan.signals)), dtype=bool)
    short = np.zeros(len(data), dtype=bool)
    for column, signal in enumerate(plan.signals):
        chosen = signal.selected(data)
        lacking = chosen & (length < signal.bits.end)
        for bits, _ in signal.conditions:
            lacking |= length < bits.end
        chosen &= ~lacking
        short |= lacking
        invalid, outside = signal.decode(data, value[:, column])
        _count_missing(invalid, outside, chosen, account)
        present[:, column] = chosen
    present[short] = False
    wanted = present.any(axis=1)
    usable = (present & ~np.isnan(value[:, : len(plan.signals)])).any(axis=1)
    account.corrupt(int(short.sum()), "frame shorter than its message")
    account.foreign(int((~wanted & ~short).sum()), "other multiplexer value")
    account.drop(int((wanted & ~usable).sum()), "no valid value")
    account.tally.used += int(usable.sum())
    return present


def _count_missing(
    invalid: BoolArray | None, outside: BoolArray | None, chosen: BoolArray | None, account: Account
) -> None:
    for mask, reason in ((invalid, "marked invalid"), (outside, "outside the database's range")):
        if mask is not None:
            account.values[reason] += int((mask if chosen is None else mask & chosen).sum())


def _plan(channels: Sequence[Channel], database: Database) -> list[MessagePlan]:
    plans: dict[str, MessagePlan] = {}
    messages = {message.name: message for message in database.messages}
    for index, channel in enumerate(channels):
        if channel.can is None:
            continue
        name, _, signal_name = channel.can.partition(".")
        message = _named(messages, name, f"channel {channel.name}: the CAN database has no message", "messages")
        signals = {signal.name: signal for signal in message.signals}
        signal = _named(signals, signal_name, f"channel {channel.name}: CAN message {name} has no signal", "signals")
        frame_id = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
        plan = plans.setdefault(name, MessagePlan(name, frame_id))
        plan.signals.append(_signal_plan(index, signal, signals, message))
    if not plans:
        raise UnreadableRecording(
            "the system file names no CAN signal; give its channels `can: Message.Signal` to read CAN recordings"
        )
    return list(plans.values())


def _named(table: dict[str, Any], name: str, complaint: str, what: str) -> Any:
    if name in table:
        return table[name]
    near = get_close_matches(name, table, n=3, cutoff=0.4) or sorted(table)[:3]
    raise UnreadableRecording(f"{complaint} {name!r}; its nearest {what}: {', '.join(near) or 'none'}")


def _signal_plan(index: int, signal: Signal, signals: dict[str, Signal], message: Message) -> SignalPlan:
    conversion, bits = signal.conversion, _bits(signal)
    try:
        scale, offset = float(conversion.scale), float(conversion.offset)
    except OverflowError:  # integers without end
        scale = offset = math.inf
    if not (math.isfinite(scale) and math.isfinite(offset)) or scale == 0:
        what = f"a scale of {scale:g} and an offset of {offset:g} make no values"
        raise UnreadableRecording(f"signal {signal.name} of the CAN database: {what}")
    full = (1 << signal.length) - 1
    ranged = (signal.minimum, signal.maximum) != (None, None) and signal.minimum != signal.maximum
    invalid = {int(raw) & full for raw, text in _choices(signal) if INVALID_CHOICE.search(text)}
    unsigned = not signal.is_signed and not conversion.is_float
    if unsigned and signal.length >= ALL_ONES_BITS and (not ranged or message.protocol == "j1939"):
        invalid.add(full)
    minimum, maximum = _binding_limits(signal) if ranged else (None, None)
    return SignalPlan(
        channel=index,
        name=signal.name,
        bits=bits,
        kind="float" if conversion.is_float else "int" if signal.is_signed else "uint",
        unit=signal.unit,
        scale=scale,
        offset=offset,
        minimum=minimum,
        maximum=maximum,
        invalid_raw=tuple(sorted(invalid)),
        conditions=tuple(_conditions(signal, signals)),
    )


def _binding_limits(signal: Signal) -> tuple[float | None, float | None]:
    """The limits of the database that some bit pattern can exceed; the others need no check."""
    minimum = None if signal.minimum is None else float(signal.minimum)
    maximum = None if signal.maximum is None else float(signal.maximum)
    if signal.conversion.is_float:
        return minimum, maximum
    scale, offset = float(signal.conversion.scale), float(signal.conversion.offset)
    lowest = -(1 << (signal.length - 1)) if signal.is_signed else 0
    ends = sorted((lowest * scale + offset, (lowest + (1 << signal.length) - 1) * scale + offset))
    slack = 0.5 * abs(scale)
    if minimum is not None and ends[0] >= minimum - slack:
        minimum = None
    if maximum is not None and ends[1] <= maximum + slack:
        maximum = None
    return minimum, maximum


def _choices(signal: Signal) -> Iterable[tuple[int, str]]:
    return [(raw, str(text)) for raw, text in (signal.choices or {}).items()]


def _bits(signal: Signal) -> Bits:
    """Errors: UnreadableRecording for bits that no frame has."""
    bits = Bits(signal.start, signal.length, signal.byte_order == "big_endian")
    lengths = FLOAT_BITS if signal.conversion.is_float else range(1, 65)
    if signal.length not in lengths or signal.start < 0 or bits.end > MOST_BYTES:
        what = f"{signal.length} bits from bit {signal.start} on"
        raise UnreadableRecording(f"signal {signal.name} of the CAN database: {what}, which no frame holds so")
    return bits


def _conditions(signal: Signal, signals: dict[str, Signal]) -> Iterable[tuple[Bits, tuple[int, ...]]]:
    """The chain of multiplexer fields above a signal (extended multiplexing nests them)."""
    passed: set[str] = set()
    while signal.multiplexer_ids and signal.multiplexer_signal:
        if signal.name in passed:
            raise UnreadableRecording(f"signal {signal.name} of the CAN database: is multiplexed by itself")
        passed.add(signal.name)
        parent = signals[signal.multiplexer_signal]
        yield _bits(parent), tuple(signal.multiplexer_ids)
        signal = parent
