"""CAN frames to samples: the signals of a cantools database, extracted from whole blocks with NumPy.

cantools is the reference: for every frame that it decodes, the values here are the same (to rounding).  What
cantools has no opinion on is decided here: a value that the database's value table calls invalid, one outside
the database's range, and, where the database gives no range, a field of all ones (the customary "signal not
available", SAE J1939-71) are missing samples.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import cantools
import numpy as np
from cantools.database import Database, Message, Signal
from numpy.typing import NDArray

from model.signals import BoolArray, Channel, FloatArray, SampleBlock
from replay.account import Account, UnreadableRecording
from replay.frames import EXTENDED, FrameBlock, WordArray, id_text, last_byte, raw_bits

INVALID_CHOICE = re.compile(
    r"invalid|not[ _]?(available|avail|valid|supported|defined|used)|unavailable|unknown|undefined|"
    r"^(sna|na|n/a|nan|init)$|(?<!no )(?<!no_)(?<!no)(?<!de)(fault|error|fail)",
    re.IGNORECASE,
)
ALL_ONES_BITS = 8  # a narrower field of all ones is an ordinary value


@dataclass(frozen=True, slots=True)
class Bits:
    """Where a signal lies in its frame."""

    start: int
    length: int
    big_endian: bool

    def raw(self, data: NDArray[np.uint8]) -> WordArray:
        """Unsigned integers of the signal, shape (n,)."""
        return raw_bits(data, self.start, self.length, big_endian=self.big_endian)

    @property
    def end(self) -> int:
        """Bytes that a frame needs to hold the signal."""
        return last_byte(self.start, self.length, big_endian=self.big_endian) + 1


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """One wanted signal: bits -> number -> physical value, and when it is there at all."""

    channel: int
    bits: Bits
    kind: str  # "unsigned", "signed" or "float"
    scale: float
    offset: float
    minimum: float | None
    maximum: float | None
    invalid_raw: tuple[int, ...]  # raw values, as unsigned integers, that mark a missing value
    conditions: tuple[tuple[Bits, tuple[int, ...]], ...]  # multiplexer fields and the values that select it

    def values(self, data: NDArray[np.uint8]) -> tuple[FloatArray, BoolArray, BoolArray]:
        """Physical values (NaN where missing), which were marked invalid, which were out of range: (n,) each."""
        raw = self.bits.raw(data)
        with np.errstate(invalid="ignore", over="ignore"):  # a float signal may carry any bits
            physical = self._number(raw) * self.scale + self.offset
        invalid = ~np.isfinite(physical)
        for code in self.invalid_raw:
            invalid |= raw == np.uint64(code)
        outside = np.zeros(len(raw), dtype=bool)
        slack = 0.5 * abs(self.scale) if self.kind != "float" else 0.0  # decimal limits are rounded
        if self.minimum is not None:
            outside |= physical < self.minimum - slack
        if self.maximum is not None:
            outside |= physical > self.maximum + slack
        outside &= ~invalid
        physical[invalid | outside] = np.nan
        return physical, invalid, outside

    def _number(self, raw: WordArray) -> FloatArray:
        length = self.bits.length
        if self.kind == "float":
            unsigned, floating = {16: ("<u2", "<f2"), 32: ("<u4", "<f4"), 64: ("<u8", "<f8")}[length]
            return raw.astype(unsigned).view(floating).astype(np.float64)
        if self.kind == "signed":
            shift = np.uint64(64 - length)
            return ((raw << shift).view(np.int64) >> np.int64(64 - length)).astype(np.float64)
        return raw.astype(np.float64)

    def selected(self, data: NDArray[np.uint8]) -> BoolArray:
        """Frames whose multiplexer fields select this signal, shape (n,)."""
        chosen = np.ones(len(data), dtype=bool)
        for bits, codes in self.conditions:
            chosen &= np.isin(bits.raw(data), np.array(codes, dtype=np.uint64))
        return chosen


@dataclass(frozen=True, slots=True)
class MessagePlan:
    """One wanted message."""

    name: str
    frame_id: int  # with EXTENDED
    signals: list[SignalPlan] = field(default_factory=list)

    @property
    def multiplexed(self) -> bool:
        return any(signal.conditions for signal in self.signals)


class CanDecoder:
    """Blocks of frames in, blocks of samples out; every frame goes into the account."""

    def __init__(self, channels: Sequence[Channel], dbc: str | Path | Database) -> None:
        database = dbc if isinstance(dbc, Database) else load_database(Path(dbc))
        self.plans = sorted(_plan(channels, database), key=lambda plan: plan.frame_id)
        self.ids = np.array([plan.frame_id for plan in self.plans], dtype=np.uint32)

    def decode(self, frames: FrameBlock, account: Account) -> SampleBlock:
        """Samples of the wanted signals in the order of the frames; a missing value is NaN."""
        place = np.minimum(np.searchsorted(self.ids, frames.id), len(self.ids) - 1)
        ours = self.ids[place] == frames.id
        self._count_contents(frames, ours, account)
        account.foreign(int((~ours).sum()))
        most = max(len(plan.signals) for plan in self.plans)
        value = np.full((len(ours), most), np.nan)  # (n, most) keeps the order of the frames
        channel = np.full((len(ours), most), -1, dtype=np.int32)
        for index, plan in enumerate(self.plans):
            rows = np.flatnonzero(ours & (place == index))
            if len(rows):
                self._decode_message(plan, frames, rows, value, channel, account)
        time = np.repeat(frames.time, most)
        flat = channel.reshape(-1)
        if np.all(flat >= 0):
            return SampleBlock(time, flat, value.reshape(-1))
        keep = flat >= 0
        return SampleBlock(time[keep], flat[keep], value.reshape(-1)[keep])

    def _decode_message(
        self,
        plan: MessagePlan,
        frames: FrameBlock,
        rows: NDArray[np.intp],
        value: FloatArray,
        channel: NDArray[np.int32],
        account: Account,
    ) -> None:
        data, length = frames.data[rows], frames.length[rows]
        if data.shape[1] < max(signal.bits.end for signal in plan.signals):  # an FD layout in a classic block
            data = np.pad(data, ((0, 0), (0, 64 - data.shape[1])))
        wanted = np.zeros(len(rows), dtype=bool)
        short = np.zeros(len(rows), dtype=bool)
        usable = np.zeros(len(rows), dtype=bool)
        for column, signal in enumerate(plan.signals):
            chosen = signal.selected(data)
            lacking = chosen & (length < signal.bits.end)
            for bits, _ in signal.conditions:
                lacking |= length < bits.end
            chosen &= ~lacking
            short |= lacking
            wanted |= chosen
            physical, invalid, outside = signal.values(data)
            usable |= chosen & ~np.isnan(physical)
            account.values["marked invalid"] += int((invalid & chosen).sum())
            account.values["outside the database's range"] += int((outside & chosen).sum())
            value[rows, column] = physical
            channel[rows, column] = np.where(chosen, signal.channel, -1)
        channel[rows[short]] = -1
        account.corrupt(int(short.sum()), "frame shorter than its message")
        account.foreign(int((~wanted & ~short).sum()), "other multiplexer value")
        account.drop(int((wanted & ~usable & ~short).sum()), "no valid value")
        account.tally.used += int((wanted & usable & ~short).sum())

    def _count_contents(self, frames: FrameBlock, ours: BoolArray, account: Account) -> None:
        if not (ours.all() and account.contents):
            found, counts = np.unique(frames.id, return_counts=True)
            for frame_id, count in zip(found.tolist(), counts.tolist(), strict=True):
                account.contents[id_text(frame_id)] += count


def load_database(path: Path) -> Database:
    """A cantools database (DBC, KCD, SYM, ARXML); raises UnreadableRecording with one line."""
    try:
        database = cantools.database.load_file(path, strict=False)
    except FileNotFoundError:
        raise UnreadableRecording(f"{path}: no such CAN database") from None
    except Exception as error:
        line = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UnreadableRecording(f"{path}: not a CAN database that can be read: {line}") from error
    if not isinstance(database, Database):
        raise UnreadableRecording(f"{path}: a diagnostics database, not one of CAN messages")
    return database


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
    conversion = signal.conversion
    full = (1 << signal.length) - 1
    ranged = (signal.minimum, signal.maximum) != (None, None) and signal.minimum != signal.maximum
    invalid = {int(raw) & full for raw, text in _choices(signal) if INVALID_CHOICE.search(text)}
    unsigned = not signal.is_signed and not conversion.is_float
    if unsigned and signal.length >= ALL_ONES_BITS and (not ranged or message.protocol == "j1939"):
        invalid.add(full)
    return SignalPlan(
        channel=index,
        bits=_bits(signal),
        kind="float" if conversion.is_float else "signed" if signal.is_signed else "unsigned",
        scale=float(conversion.scale),
        offset=float(conversion.offset),
        minimum=float(signal.minimum) if ranged and signal.minimum is not None else None,
        maximum=float(signal.maximum) if ranged and signal.maximum is not None else None,
        invalid_raw=tuple(sorted(invalid)),
        conditions=tuple(_conditions(signal, signals)),
    )


def _choices(signal: Signal) -> Iterable[tuple[int, str]]:
    return [(raw, str(text)) for raw, text in (signal.choices or {}).items()]


def _bits(signal: Signal) -> Bits:
    return Bits(signal.start, signal.length, signal.byte_order == "big_endian")


def _conditions(signal: Signal, signals: dict[str, Signal]) -> Iterable[tuple[Bits, tuple[int, ...]]]:
    """The chain of multiplexer fields above a signal (extended multiplexing nests them)."""
    while signal.multiplexer_ids and signal.multiplexer_signal:
        parent = signals[signal.multiplexer_signal]
        yield _bits(parent), tuple(signal.multiplexer_ids)
        signal = parent
