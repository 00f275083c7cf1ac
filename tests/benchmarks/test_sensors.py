"""`sprung bench sensors`: what is drawn, and what counts as named."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.benchmarks import sensors
from sprung.model.system import load_system

SYSTEM = load_system()
NAMES = [channel.name for channel in SYSTEM.channels]


def drawn(kind: str, seed: int = 1) -> sensors.WrongChannel:
    return sensors._drawn(SYSTEM, kind, 0.0, 2.0, np.random.default_rng(seed))


@pytest.mark.parametrize("kind", ["silent", "zero", "silent node", "silent wheels"])
def test_what_is_silent_sends_nothing_or_zeros_from_its_begin_on_and_all_else_is_as_it_was(kind: str) -> None:
    fault = drawn(kind)
    right, _ = sensors.ride(SYSTEM, None, np.random.default_rng(2), 4.0)
    wrong, _ = sensors.ride(SYSTEM, fault, np.random.default_rng(2), 4.0)
    hit = [fault.channel, *fault.others]
    differs = np.any((right != wrong) | np.isnan(wrong), axis=0)
    assert set(np.flatnonzero(differs)) == set(hit)
    np.testing.assert_array_equal(right[:200], wrong[:200])
    expected = 0.0 if kind == "zero" else np.nan
    np.testing.assert_array_equal(wrong[200:, hit], np.full((200, len(hit)), expected))


def test_a_node_is_silent_with_all_that_it_sends_and_wheels_but_for_one() -> None:
    node = drawn("silent node")
    assert len({sensors._node(SYSTEM.channels[c]) for c in (node.channel, *node.others)}) == 1
    assert len(node.others) == 3
    wheels = drawn("silent wheels")
    left = {NAMES[c].partition(".")[0] for c in (wheels.channel, *wheels.others)}
    assert len(left) == 7
    assert all(name.startswith("wheel_") for name in left)


@pytest.mark.parametrize("kind", ["swapped", "gain", "silent"])
def test_channels_are_drawn_as_they_always_were(kind: str) -> None:
    """Figures of the documents name seeds."""
    assert [drawn(kind, seed).channel for seed in range(4)] == [drawn("gain", seed).channel for seed in range(4)]
    exchanged = drawn("swapped")
    assert sensors._node(SYSTEM.channels[exchanged.others[0]]) == sensors._node(SYSTEM.channels[exchanged.channel])
