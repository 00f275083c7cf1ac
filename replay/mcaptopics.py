"""MCAP recordings to blocks of samples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from sprung.model.signals import Channel, SampleBlock
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.mcapfields import Field, TimeSource, Topic, parse_field
from sprung.replay.mcapfile import DISORDER, Batch, McapFile

SORTED_SAMPLES = 65_536  # handed out together from a recording that had to be sorted
SOURCES: tuple[TimeSource, ...] = ("auto", "header", "publish", "log")


def blocks(
    path: Path, channels: Sequence[Channel], account: Account, time_source: str | Mapping[str, str] = "auto"
) -> Iterator[SampleBlock]:
    """One block per chunk.  `time_source` is one source for all channels or a table by channel name."""
    sources = [_source(channel, time_source) for channel in channels]
    if not any(channel.mcap for channel in channels):
        raise UnreadableRecording(
            "the system file names no MCAP topic; give its channels `mcap: /topic.field` to read MCAP recordings"
        )
    file = McapFile(path, account)
    topics: dict[int, Topic | None] = {}
    kept: list[SampleBlock] = []
    for batch in file.batches():
        for channel_id in batch:
            if channel_id not in topics:
                topics[channel_id] = _topic(file, channel_id, channels, sources, account)
        block = _block(file, batch, topics, account)
        if block is None:
            continue
        if file.time_ordered:
            yield _sorted(block)
        else:  # written topic by topic: nothing can be aligned before everything is there
            kept.append(block)
    if kept:
        account.problem("messages are not in time order; they were sorted in memory", incomplete=False)
        whole = _sorted(
            SampleBlock(
                np.concatenate([block.time for block in kept]),
                np.concatenate([block.channel for block in kept]),
                np.concatenate([block.value for block in kept]),
            )
        )
        for first in range(0, len(whole.time), SORTED_SAMPLES):
            piece = slice(first, first + SORTED_SAMPLES)
            yield SampleBlock(whole.time[piece], whole.channel[piece], whole.value[piece])


def _sorted(block: SampleBlock) -> SampleBlock:
    """In time order, where the messages lie further back than a window waits for."""
    if not len(block.time) or int((np.maximum.accumulate(block.time) - block.time).max()) <= DISORDER:
        return block
    order = np.argsort(block.time, kind="stable")
    return SampleBlock(block.time[order], block.channel[order], block.value[order])


def _source(channel: Channel, time_source: str | Mapping[str, str]) -> TimeSource:
    name = time_source if isinstance(time_source, str) else time_source.get(channel.name, "auto")
    for source in SOURCES:
        if source == name:
            return source
    raise UnreadableRecording(f"time source {name!r} is not known; choose one of {', '.join(SOURCES)}")


def _topic(
    file: McapFile, channel_id: int, channels: Sequence[Channel], sources: Sequence[TimeSource], account: Account
) -> Topic | None:
    """The decoder of a channel, or None when the system file does not name its topic."""
    record = file.channels.get(channel_id)
    if record is None:
        return None
    prefix = record.topic + "."
    fields = [
        Field(index, parse_field(channel.mcap.removeprefix(prefix)), sources[index])
        for index, channel in enumerate(channels)
        if channel.mcap and channel.mcap.startswith(prefix)
    ]
    if not fields:
        return None
    return Topic(record, file.schemas.get(record.schema_id), fields, account)


def _block(file: McapFile, batch: Batch, topics: dict[int, Topic | None], account: Account) -> SampleBlock | None:
    places, times, indices, values = [], [], [], []
    for channel_id, messages in batch.items():
        count = len(messages.data)
        record = file.channels.get(channel_id)
        account.contents[record.topic if record else f"channel {channel_id}"] += count
        topic = topics[channel_id]
        if topic is None:
            account.foreign(count)
            continue
        place, time, value = topic.samples(messages)
        width = len(topic.fields)
        places.append(np.repeat(place, width))
        times.append(time.reshape(-1))
        values.append(value.reshape(-1))
        indices.append(np.tile(np.array([field.channel for field in topic.fields], dtype=np.int32), len(place)))
    if not places:
        return None
    order = np.argsort(np.concatenate(places), kind="stable")
    return SampleBlock(np.concatenate(times)[order], np.concatenate(indices)[order], np.concatenate(values)[order])
