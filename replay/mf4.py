"""ASAM MDF 4 bus logs (extra `mf4`), through asammdf: the CAN_DataFrame groups, merged in time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.frames import BLOCK_FRAMES, EXTENDED, FrameBlock


def frames(path: Path, account: Account) -> Iterator[FrameBlock]:
    """Blocks in time order.  The groups of an MDF file follow each other, so they are read whole and merged."""
    try:
        from asammdf import MDF
    except ImportError:
        raise UnreadableRecording(f"{path}: reading MF4 needs asammdf; install sprung[mf4]") from None
    try:
        with MDF(path) as mdf:
            start = round(mdf.header.start_time.timestamp() * 1e6) * 1_000
            groups = [found for index in range(len(mdf.groups)) if (found := _group(mdf, index))]
            mdf_version = mdf.version
    except UnreadableRecording:
        raise
    except Exception as error:
        raise UnreadableRecording(f"{path}: not an MDF file that can be read: {error}") from error
    if not groups:
        raise UnreadableRecording(f"{path}: MDF {mdf_version} without a CAN_DataFrame group (no bus log)")
    width = 64 if max(group[2].max(initial=0) for group in groups) > 8 else 8
    seconds = np.concatenate([group[0] for group in groups])
    order = np.argsort(seconds, kind="stable")
    time = start + np.round(seconds * 1e9).astype(np.int64)
    identifier = np.concatenate([group[1] for group in groups])
    length = np.concatenate([group[2] for group in groups])
    data = np.concatenate([_fit(group[3], width) for group in groups])
    data[np.arange(width) >= length[:, None]] = 0
    for first in range(0, len(order), BLOCK_FRAMES):
        rows = order[first : first + BLOCK_FRAMES]
        yield FrameBlock(time[rows], identifier[rows], length[rows], data[rows])


def _group(mdf: Any, index: int) -> tuple[Any, Any, Any, Any] | None:
    """Seconds, identifiers, lengths, data of one CAN_DataFrame group."""
    names = {channel.name for channel in mdf.groups[index].channels}
    if "CAN_DataFrame" not in names:
        return None

    def column(name: str) -> Any:
        return mdf.get(f"CAN_DataFrame.{name}", group=index, raw=True).samples

    stamps = mdf.get_master(index)
    identifier = np.asarray(column("ID"), dtype=np.uint32) & np.uint32(0x1FFFFFFF)
    if "CAN_DataFrame.IDE" in names:
        identifier |= np.where(np.asarray(column("IDE")) != 0, np.uint32(EXTENDED), np.uint32(0))
    data = np.asarray(column("DataBytes"), dtype=np.uint8)
    has_length = "CAN_DataFrame.DataLength" in names
    length = np.asarray(column("DataLength" if has_length else "DLC"), dtype=np.uint8)
    return stamps, identifier, np.minimum(length, 64), data


def _fit(data: Any, width: int) -> Any:
    if data.shape[1] < width:
        return np.pad(data, ((0, 0), (0, width - data.shape[1])))
    return data[:, :width].copy()
