"""JSON of strangers: objects that name a key twice, integers of thousands of digits.

Parsers silently keep the last value of a repeated key, while the first may be the intended one.
"""

from __future__ import annotations

import json
from collections import Counter
from typing import Any

LONGEST = 400  # digits: a float has 309 at most, and Python reads no more than 4300


class KeyTwice(ValueError):
    """An object names a key twice."""


def load(content: bytes | str) -> Any:
    """The document; KeyTwice, or what `json.loads` raises.  Integers beyond every float are infinite."""
    return json.loads(content, object_pairs_hook=_once, parse_int=_integer)


def may_name_twice(content: bytes, documents: list[Any]) -> bool:
    """Whether an object of the text can have a key twice, given what was read of it; False is certain.

    A small part of the time that `load` takes: a colon stands behind every key, and elsewhere in strings alone, so a
    text has at least as many as its objects have keys, and more than were read where a key went.
    """
    written, read = content.count(b":"), sum([len(document) for document in documents if isinstance(document, dict)])
    return written != read and written != sum(map(_keys, documents))


def _integer(digits: str) -> int | float:
    return int(digits) if len(digits) < LONGEST else float(digits)


def _keys(item: Any) -> int:
    """How many keys the objects of a document have."""
    if isinstance(item, dict):
        return len(item) + sum(map(_keys, item.values()))
    return sum(map(_keys, item)) if isinstance(item, list) else 0


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        named = Counter(name for name, _ in pairs)
        raise KeyTwice(f"{max(named, key=named.__getitem__)!r:.80} is there twice")
    return content
