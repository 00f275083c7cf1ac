"""Messages of one MCAP topic to numbers: JSON, protobuf and ROS 2 CDR, addressed as `/topic.field`.

A field may be nested and indexed: `/imu/data.linear_acceleration.z`, `/scan.ranges[3]`.
"""

from __future__ import annotations

import io
import json
import re
import secrets
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Literal

import numpy as np
from mcap.records import Channel as McapChannel
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory as ProtobufFactory
from mcap_ros2.decoder import DecoderFactory as Ros2Factory

from sprung.model.signals import FloatArray, IntArray
from sprung.model.text import one_line
from sprung.replay.account import Account
from sprung.replay.jsonkeys import KeyTwice, load, may_name_twice
from sprung.replay.mcapfile import Messages
from sprung.replay.plausibility import LATEST

TimeSource = Literal["auto", "header", "publish", "log"]
STAMP_PATHS = (("header", "stamp"), ("timestamp",), ("stamp",))
STAMP_PARTS = (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"), ("secs", "nsecs"))
LOOKED_AT = 8  # messages of a batch in which a stamp is looked for: some may be damaged
SAID = {  # why a message cannot be decoded; other decoders' errors are called by their names
    KeyTwice: "a key is there twice",
    RecursionError: "nested too deeply",
    json.JSONDecodeError: "no JSON",
    UnicodeDecodeError: "no text",
}
MARK = secrets.token_hex(8)  # that no file can know
BETWEEN = f',"{MARK}",'.encode()
MOST_LINES = 10_000  # of a definition in ROS 2: reading it takes the square of its fields, a second for so many
TOKEN = re.compile(r"[^.\[\]]+")
Path = tuple[str | int, ...]


@dataclass(frozen=True, slots=True)
class Field:
    """A wanted number of a topic's messages."""

    channel: int
    path: Path
    source: TimeSource


def parse_field(text: str) -> Path:
    """`a.b[2].c` -> ("a", "b", 2, "c")."""
    return tuple(int(token) if token.isdecimal() else token for token in TOKEN.findall(text))


class Topic:
    """Decodes the messages of one topic; `decode` is None when its encoding cannot be read."""

    def __init__(self, channel: McapChannel, schema: Schema | None, fields: Sequence[Field], account: Account) -> None:
        self.name = channel.topic
        self.fields = list(fields)
        self.account = account
        self.is_json = channel.message_encoding == "json"
        self.decode: Callable[[bytes], Any] | None = load if self.is_json else None
        self._checked = False
        self._stamp: tuple[tuple[str, ...], tuple[str, str]] | None = None  # where the messages carry their time
        if schema is not None and schema.data.count(b"\n") > MOST_LINES and schema.encoding == "ros2msg":
            account.problem(f"schema of topic {self.name} has more than {MOST_LINES} lines")
            return
        for factory in () if self.is_json else (Ros2Factory(), ProtobufFactory()):
            try:
                # the parser of ROS 2 definitions prints its errors
                with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                    self.decode = self.decode or factory.decoder_for(channel.message_encoding, schema)
            except Exception as error:  # decoders raise arbitrary errors
                account.problem(f"schema of topic {self.name} cannot be read: {_words(error)}")
        if self.decode is None:
            account.problem(f"topic {self.name}: encoding {channel.message_encoding!r} cannot be read here")

    def samples(self, messages: Messages) -> tuple[IntArray, IntArray, FloatArray]:
        """Place (n,), time (n, k) and value (n, k) of the k fields; unreadable messages are counted, not given."""
        documents, good = self._documents(messages.data)
        place = np.array(messages.place, dtype=np.int64)[good]
        log, publish = _times(messages.log_time)[good], _times(messages.publish_time)[good]
        value = np.empty((len(documents), len(self.fields)))
        time = np.empty((len(documents), len(self.fields)), dtype=np.int64)
        if documents:
            self._check_fields(documents[0])
        stamps = self._stamps(documents)
        for column, wanted in enumerate(self.fields):
            value[:, column] = self._column(documents, wanted.path)
            time[:, column] = _choose(wanted.source, stamps, publish, log)
        self.account.values["missing or not a number"] += int(np.isnan(value).sum())
        nothing = ~np.isfinite(value).any(axis=1)
        self.account.drop(int(nothing.sum()), "no valid value")
        self.account.tally.used += int((~nothing).sum())
        return place, time, value

    def _documents(self, data: list[bytes]) -> tuple[list[Any], np.ndarray]:
        if self.decode is None:
            self.account.drop(len(data), "encoding that cannot be read")
            return [], np.zeros(len(data), dtype=bool)
        if self.is_json:  # one call for the whole batch is twice as fast as one a message
            try:
                content = b"[" + BETWEEN.join(data) + b"]"
                read = json.loads(content)
                # parts of messages that are none can make up one that is; what stands between them is in its place then
                documents, between = read[::2], read[1::2]
                whole = len(documents) == len(data) and between == [MARK] * (len(data) - 1)
                if whole and not may_name_twice(content, documents):
                    return documents, np.ones(len(data), dtype=bool)
            except (ValueError, RecursionError):
                pass  # some message is damaged, or nested beyond all reason, or names a key twice: find it below
        documents = []
        good = np.zeros(len(data), dtype=bool)
        reasons: Counter[str] = Counter()
        for index, item in enumerate(data):
            try:
                documents.append(self.decode(item))
                good[index] = True
            except Exception as error:  # decoders raise what their generated code happens to raise
                reasons[SAID.get(type(error), type(error).__name__)] += 1
        self.account.corrupt(len(data) - len(documents), f"message of {self.name} cannot be decoded")
        for reason, count in reasons.items():
            self.account.problem(f"{count} messages of {self.name} cannot be decoded ({reason})")
        return documents, good

    def _column(self, documents: list[Any], path: Path) -> FloatArray:
        if self.is_json and len(path) == 1:
            name = path[0]
            try:
                column = [document[name] for document in documents]
            except (KeyError, TypeError, IndexError):
                column = [walk(document, path) for document in documents]
        else:
            column = [walk(document, path) for document in documents]
        if set(map(type, column)) <= {float, int}:
            try:
                return np.array(column, dtype=np.float64)
            except OverflowError:
                pass  # an integer larger than any float
        return np.array([_number(item) for item in column], dtype=np.float64)

    def _stamps(self, documents: list[Any]) -> IntArray | None:
        """Header stamps in ns, 0 where empty; None when the messages have none."""
        if all(field.source in ("publish", "log") for field in self.fields):
            return None
        for document in documents[:LOOKED_AT] if self._stamp is None else ():
            self._stamp = self._stamp or _stamp_of(document)
        if self._stamp is None:
            return None
        path, parts = self._stamp
        return np.array([_stamp_ns(walk(item, path), parts) for item in documents], dtype=np.int64)

    def _check_fields(self, document: Any) -> None:
        """Report once which wanted fields are missing in the first message."""
        if self._checked:
            return
        self._checked = True
        for wanted in self.fields:
            names, text = _names(document), ".".join(map(str, wanted.path))
            if walk(document, wanted.path) is None and text not in names:  # not one that is null in this message
                near = get_close_matches(text, names, n=3, cutoff=0.3) or names[:5]
                line = f"topic {self.name} has no field {text!r}; nearest: {', '.join(near)}"
                self.account.problem(line, incomplete=False)


def walk(item: Any, path: Path | tuple[str, ...]) -> Any:
    """The part of a decoded message at `path`, or None."""
    for token in path:
        try:
            item = item[token] if isinstance(token, int) or isinstance(item, dict) else getattr(item, token)
        except (KeyError, IndexError, TypeError, AttributeError):
            return None
    return item


def _stamp_of(document: Any) -> tuple[tuple[str, ...], tuple[str, str]] | None:
    """Where a message carries its time: the path of the stamp, and the names of seconds and nanoseconds in it."""
    for path in STAMP_PATHS:
        stamp = walk(document, path)
        for parts in STAMP_PARTS:
            if all(isinstance(walk(stamp, (part,)), int) for part in parts):
                return path, parts
    return None


def _number(item: Any) -> float:
    if isinstance(item, bool) or not isinstance(item, (int, float)):
        return float("nan")
    try:
        return float(item)
    except OverflowError:
        return float("inf")  # out of every range


def _stamp_ns(stamp: Any, parts: tuple[str, str]) -> int:
    """ns, or 0 where the stamp is empty or none."""
    whole, rest = walk(stamp, (parts[0],)), walk(stamp, (parts[1],))
    if not isinstance(whole, int) or not isinstance(rest, int):
        return 0
    total = whole * 1_000_000_000 + rest
    return total if 0 < total <= LATEST else 0


def _times(stamps: list[int]) -> IntArray:
    """Unsigned ns as signed ones; what does not fit is later than any recording."""
    return np.minimum(np.array(stamps, dtype=np.uint64), np.uint64(np.iinfo(np.int64).max)).astype(np.int64)


def _words(error: Exception) -> str:
    return one_line(str(error), 200) or type(error).__name__


def _choose(source: TimeSource, stamps: IntArray | None, publish: IntArray, log: IntArray) -> IntArray:
    """The time that was asked for; where it is empty (0), the next best."""
    sent = np.where(publish > 0, publish, log)
    if source == "log":
        return log
    if source == "publish" or stamps is None:
        return sent
    return np.where(stamps > 0, stamps, sent)


def _names(document: Any) -> list[str]:
    if isinstance(document, dict):
        return [str(name) for name in document]
    descriptor = getattr(document, "DESCRIPTOR", None)
    if descriptor is not None:
        return [field.name for field in descriptor.fields]
    return [str(name) for name in getattr(document, "__slots__", ())]
