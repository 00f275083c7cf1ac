"""Objects that name a key twice are never taken for whole, however they are written."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sprung.replay.jsonkeys import KeyTwice, load, may_name_twice

TEXT = st.text('ab":\\ {}[],', max_size=4)
VALUES = st.recursive(
    st.none() | st.integers(0, 9) | TEXT,
    lambda inner: st.lists(inner, max_size=3) | st.lists(st.tuples(TEXT, inner), max_size=4).map(tuple),
    max_leaves=12,
)
BLANK = st.sampled_from(["", " ", "\t", "\n", "\r\n"])


def written(value: object, blank: str) -> str:
    """JSON in which a tuple of pairs is an object, names that are there twice included."""
    if isinstance(value, tuple):
        pairs = (f"{json.dumps(name)}{blank}:{blank}{written(item, blank)}" for name, item in value)
        return "{" + ",".join(pairs) + "}"
    if isinstance(value, list):
        return "[" + ",".join(written(item, blank) for item in value) + "]"
    return json.dumps(value)


def twice(value: object) -> bool:
    if isinstance(value, tuple):
        return len({name for name, _ in value}) < len(value) or any(twice(item) for _, item in value)
    return isinstance(value, list) and any(map(twice, value))


@given(st.lists(VALUES, max_size=3), BLANK)
def test_the_quick_look_never_misses_one(documents: list[object], blank: str) -> None:
    text = f"[{','.join(written(one, blank) for one in documents)}]"
    if twice(documents):
        assert may_name_twice(text.encode(), json.loads(text))
        with pytest.raises(KeyTwice, match="is there twice"):
            load(text)
    else:
        assert load(text) == json.loads(text)


def test_an_integer_beyond_every_float_is_infinite() -> None:
    assert load("[" + "1" * 5000 + ", -" + "9" * 5000 + ", 123]") == [math.inf, -math.inf, 123]


ORDINARY = [{"left": 0.5, "right": -1e-3}, {"header": {"stamp": {"sec": 1, "nanosec": 2}}, "axes": [{"z": 1}]}]


@pytest.mark.parametrize("document", ORDINARY)
def test_ordinary_messages_are_not_looked_at_closely(document: dict[str, object]) -> None:
    assert not may_name_twice(f"[{json.dumps(document)}]".encode(), [document])
