"""ASAM MDF 4 bus logs (extra `mf4`), through asammdf: the CAN_DataFrame groups, merged in time."""

from __future__ import annotations

import gc
import logging
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sprung.model.signals import BoolArray, FloatArray, IntArray
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.bounds import MDF_HEADER, check_mdf_links, check_whole, mdf_sizes
from sprung.replay.frames import BLOCK_FRAMES, EXTENDED, FrameBlock
from sprung.replay.plausibility import EARLIEST, LATEST, OUT_OF_TIME

UNFINISHED = 60  # offset of the flags that say what a logger left undone, two and two bytes
COPIED_AT_ONCE = 1 << 20
SIGNATURES = (b"MDF", b"UnFinMF")  # the second of a logger that was not stopped


def frames(path: Path, account: Account) -> Iterator[FrameBlock]:
    """Blocks in time order.  The groups of an MDF file follow each other, so they are read whole and merged."""
    try:
        from asammdf import MDF
    except ImportError:
        raise UnreadableRecording(f"{path}: reading MF4 needs asammdf; install sprung[mf4]") from None
    with path.open("rb") as file:
        head = file.read(MDF_HEADER + 2)
    if head[:8].strip() not in SIGNATURES:
        raise UnreadableRecording(f"{path}: not an MDF file: {'it does not begin as one' if head else 'it is empty'}")
    if head[MDF_HEADER : MDF_HEADER + 2] == b"HD":
        version = head[8:16].decode("ascii", "replace").strip(" \0") or "?"
        raise UnreadableRecording(f"{path}: an MDF file of version {version}; bus logs are read from version 4 on")
    check_whole(path, mdf_sizes(path))
    check_mdf_links(path)
    unfinished = bool(int.from_bytes(head[UNFINISHED : UNFINISHED + 4], "little"))
    with _quietly():
        wrong = ""
        try:
            with _opened(path, unfinished) as source, MDF(source) as mdf:
                start = round(mdf.header.start_time.timestamp() * 1e6) * 1_000
                groups = list(_groups(mdf, account))
                mdf_version = mdf.version
        except Exception as error:  # asammdf raises arbitrary errors
            wrong = type(error).__name__
        if wrong:
            gc.collect()  # incomplete objects warn when collected: do it here, with warnings off
    if wrong:
        version = head[8:16].decode("ascii", "replace").strip(" \0") or "?"
        raise UnreadableRecording(
            f"{path}: an MDF file of version {version} that cannot be read: damaged, cut short, or of a kind that "
            f"asammdf does not know ({wrong})"
        )
    if not groups:
        raise UnreadableRecording(f"{path}: MDF {mdf_version} without a CAN_DataFrame group (no bus log)")
    width = 64 if max(group[2].max(initial=0) for group in groups) > 8 else 8
    time, timely = _absolute(np.concatenate([group[0] for group in groups]), start)
    account.corrupt(int((~timely).sum()), OUT_OF_TIME)
    identifier = np.concatenate([group[1] for group in groups])
    length = np.concatenate([group[2] for group in groups])
    data = np.concatenate([_fit(group[3], width) for group in groups])
    data[np.arange(width) >= length[:, None]] = 0
    order = np.argsort(time, kind="stable")
    order = order[timely[order]]
    for first in range(0, len(order), BLOCK_FRAMES):
        rows = order[first : first + BLOCK_FRAMES]
        yield FrameBlock(time[rows], identifier[rows], length[rows], data[rows])


def _absolute(seconds: FloatArray, start: int) -> tuple[IntArray, BoolArray]:
    """Times in ns of seconds since `start`, and which of them are times at all.

    They may lie before it by years: a file that was converted begins, for its writer, when that was done.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        scaled = np.round(seconds * 1e9)
        good = (np.abs(scaled) <= LATEST) & (EARLIEST <= start <= LATEST)  # False for NaN
    time = (start if EARLIEST <= start <= LATEST else 0) + np.where(good, scaled, 0.0).astype(np.int64)
    return time, good & (time >= EARLIEST) & (time <= LATEST)


@contextmanager
def _opened(path: Path, unfinished: bool) -> Iterator[Any]:
    """What asammdf reads: the file, or, of one that a logger did not finish and that asammdf completes, a copy.

    asammdf's own copy stays for ever when the file turns out to be damaged, or the process is killed; this one has no
    name and goes with the process.
    """
    if not unfinished:
        yield path
        return
    with tempfile.TemporaryFile() as copy:
        with path.open("rb") as file:
            shutil.copyfileobj(file, copy, COPIED_AT_ONCE)
        yield copy


@contextmanager
def _quietly() -> Iterator[None]:
    """asammdf prints tracebacks where it fails, and its objects when they end before they were whole; its log is for
    its authors."""
    hook, log = sys.unraisablehook, logging.getLogger("asammdf")
    level = log.level
    for name in ("mdf_v3", "mdf_v4"):
        vars(sys.modules[f"asammdf.blocks.{name}"])["print"] = _unsaid  # of these modules alone
    sys.unraisablehook = lambda unraisable: None if _of_asammdf(unraisable.object) else hook(unraisable)
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        sys.unraisablehook = hook
        log.setLevel(level)


def _unsaid(*_: object, **__: object) -> None:
    """In place of `print`."""


def _of_asammdf(thing: Any) -> bool:
    return (getattr(thing, "__module__", None) or "").startswith("asammdf")


def _groups(mdf: Any, account: Account) -> Iterator[tuple[Any, Any, Any, Any]]:
    """The groups of CAN frames; unreadable ones are reported and skipped."""
    for index in range(len(mdf.groups)):
        try:
            found = _group(mdf, index)
        except Exception as error:  # as above
            account.problem(f"group {index} of the MDF file cannot be read ({type(error).__name__})")
            continue
        if found is not None:
            yield found


def _group(mdf: Any, index: int) -> tuple[Any, Any, Any, Any] | None:
    """Seconds, identifiers, lengths, data of one CAN_DataFrame group."""
    names = {channel.name for channel in mdf.groups[index].channels}
    if "CAN_DataFrame" not in names:
        return None

    def column(name: str) -> Any:
        return mdf.get(f"CAN_DataFrame.{name}", group=index, raw=True).samples

    stamps = np.asarray(mdf.get_master(index), dtype=np.float64)
    identifier = np.asarray(column("ID"), dtype=np.uint32) & np.uint32(0x1FFFFFFF)
    if "CAN_DataFrame.IDE" in names:
        identifier |= np.where(np.asarray(column("IDE")) != 0, np.uint32(EXTENDED), np.uint32(0))
    data = np.asarray(column("DataBytes"), dtype=np.uint8)
    has_length = "CAN_DataFrame.DataLength" in names
    length = np.asarray(column("DataLength" if has_length else "DLC"), dtype=np.uint8)
    if data.ndim != 2 or not len(stamps) == len(identifier) == len(data) == len(length):
        raise ValueError("its columns do not belong together")
    return stamps, identifier, np.minimum(length, min(64, data.shape[1])), data


def _fit(data: Any, width: int) -> Any:
    if data.shape[1] < width:
        return np.pad(data, ((0, 0), (0, width - data.shape[1])))
    return data[:, :width].copy()
