"""MCAP files with JSON messages whose schemas are in the file, as Foxglove and mcap's own reader take them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, BinaryIO

from mcap.writer import CompressionType, Writer

NUMBER = {"type": "number"}


@dataclass(frozen=True, slots=True)
class Schema:
    """A kind of message."""

    name: str
    properties: Mapping[str, Any]
    required: tuple[str, ...] = field(default=())

    def text(self) -> bytes:
        """As JSON Schema."""
        body = {"type": "object", "title": self.name, "properties": dict(self.properties)}
        return json.dumps(body | {"required": list(self.required or self.properties)}).encode()


ESTIMATE = Schema("sprung.Estimate", dict.fromkeys(("value", "std", "lower95", "upper95", "ratio"), NUMBER))
SIGNAL = Schema("sprung.Signal", {"value": NUMBER})
COMPARED = Schema("sprung.Compared", dict.fromkeys(("measured", "simulated", "residual"), NUMBER), ("simulated",))
FIT = Schema("sprung.Fit", {"nrmse": NUMBER, "adequate": {"type": "boolean"}})
EVENT = Schema(  # foxglove.Log, so that viewers list it: level 2 info, 3 warning, 4 error
    "foxglove.Log",
    {
        "timestamp": {
            "type": "object",
            "title": "time",
            "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
        },
        "level": {"type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer"},
    },
)


_ENCODER = json.JSONEncoder(allow_nan=False)  # made once: `json.dumps` with options makes one a message


class McapSink:
    """Writes messages; one topic has one schema."""

    def __init__(self, sink: BinaryIO, about: Mapping[str, str]) -> None:
        self._writer = Writer(sink, compression=CompressionType.ZSTD)
        self._about = dict(about)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence = 0

    def __enter__(self) -> McapSink:
        self._writer.start("", "sprung")
        self._writer.add_metadata("recording", self._about)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.finish()

    def write(self, topic: str, schema: Schema, time: int, message: Mapping[str, Any]) -> None:
        """One message at `time`, ns since epoch."""
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._writer.register_schema(schema.name, "jsonschema", schema.text())
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[schema.name])
        self._sequence += 1
        data = _ENCODER.encode(message).encode()
        self._writer.add_message(self._channels[topic], time, data, time, self._sequence)

    def event(self, time: int, level: int, name: str, text: str) -> None:
        """A line on the topic /events."""
        stamp = {"sec": time // 1_000_000_000, "nsec": time % 1_000_000_000}
        message = {"timestamp": stamp, "level": level, "message": text, "name": name, "file": "", "line": 0}
        self.write("/events", EVENT, time, message)
