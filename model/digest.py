"""Hashes of system files: which of them describe the same vehicle, and whose estimates are the same values."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from sprung.model.schema import RUNNING, SystemFile

# An address without its noise, which the mechanics does not see.
_WHERE = (
    *("mcap", "can", "csv", "column", "scale", "offset", "sign", "unit", "range"),
    *("gain_std", "delay_std", "offset_std"),
)


def digest_of(file: SystemFile, on_track: bool) -> str:
    """Hash of everything that the mechanics depends on; addresses and comments do not count.

    on_track: whether wheels run on a track that is not measured, so that the speed counts.
    """
    keep = file.model_dump(mode="json", exclude={"hop", "time", *RUNNING})
    signals = [*keep["inputs"].values(), *keep["sensors"].values()]
    signals += [keep["speed"] or {}, *((body["load"] or {}) for body in keep["bodies"].values())]
    for signal in _with_parts(signals):
        for key in _WHERE:
            signal.pop(key, None)
    for source in keep["inputs"].values():
        if source["kind"] == "support":
            source["kind"] = "displacement"
    keep.pop("signals")  # without influence on windows
    for element in keep["elements"].values():
        element.pop("depends_on")
    added = [(source, "acceleration") for source in keep["inputs"].values()]  # keys that older files do not have
    for body in keep["bodies"].values():
        body.pop("load", None)  # what varies from ride to ride does not make another vehicle
        body["mass"].pop("std")  # nor does how well a mass is known
    if not on_track:
        keep["speed"] = None
    for part, key in [*added, (keep, "speed")]:
        if part.get(key) is None:
            part.pop(key, None)
    _without_empty_laws(keep)
    return _hash(keep)


def structure_of(file: SystemFile) -> str:
    """Hash of what estimates depend on but for their uncertainty: neither names nor noises, ranges or addresses.

    Values of two files with the same structure are the same values.
    """
    keep = file.model_dump(mode="json", include={"bodies", "elements", "inputs", "sensors", "estimate", "speed"})
    for body in keep["bodies"].values():
        body.pop("load", None)
        body["mass"].pop("std")
    for signal in _with_parts([*keep["inputs"].values(), *keep["sensors"].values(), keep["speed"] or {}]):
        for key in ("noise", *_WHERE):
            signal.pop(key, None)
    for source in keep["inputs"].values():
        source["kind"] = "displacement" if source["kind"] == "support" else source["kind"]
    _without_empty_laws(keep)
    return _hash(keep)


def _hash(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _with_parts(signals: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Signals, and the addresses that they hold."""
    return [*signals, *(part for signal in signals for part in signal.values() if isinstance(part, dict))]


def _without_empty_laws(part: Any) -> None:
    """Take out what older files do not have, and the deviations of laws' values."""
    if isinstance(part, dict):
        if not part.get("laws", True):
            del part["laws"]
        if part.get("by_load") == 0:
            del part["by_load"]
        for setting in (s for law in part.get("laws", ()) for s in law.values()):
            for value in setting.values():
                if isinstance(value, dict):
                    value.pop("std", None)
        for child in part.values():
            _without_empty_laws(child)
