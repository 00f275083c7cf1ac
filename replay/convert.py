"""Recorded numbers to the unit of their channels."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sprung.model.signals import Channel, SampleBlock


def converter(channels: Sequence[Channel]) -> Callable[[SampleBlock], SampleBlock]:
    """A function that puts blocks of recorded numbers into the channels' units: gain * recorded + offset."""
    gain = np.array([channel.gain for channel in channels])
    offset = np.array([channel.offset for channel in channels])
    if (gain == 1.0).all() and not offset.any():
        return lambda block: block

    def convert(block: SampleBlock) -> SampleBlock:
        value = gain[block.channel] * block.value + offset[block.channel]
        return SampleBlock(block.time, block.channel, value)

    return convert
