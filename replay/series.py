"""Files that hold whole series: MATLAB, HDF5, JSON, UFF 58, TDMS, NumPy and LabVIEW text, each as a list of columns."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from sprung.replay import lvm, numpyfile, uff
from sprung.replay.account import UnreadableRecording
from sprung.replay.bounds import check_piece, check_whole, mat_sizes
from sprung.replay.extras import needed
from sprung.replay.jsonkeys import load
from sprung.replay.stamps import SECOND
from sprung.replay.tables import MOST_COLUMNS, Column, EvenTimes, lost, whole

DEEPEST = 8  # structures inside each other
DEEPEST_GROUP = 64  # of HDF5: the library takes minutes for thousands of levels


@contextmanager
def opened(path: Path) -> Iterator[list[Column]]:
    """The columns of a file, by its extension; they can be read while it is open."""
    with KINDS[path.suffix.lower()](path) as columns:
        if all(column.damage for column in columns):
            why = "; ".join(f"{column.name} cannot be read: {column.damage}" for column in columns[:3])
            raise UnreadableRecording(f"{path}: it holds no series of numbers{f': {why}' if why else ''}")
        yield columns


@contextmanager
def _mat(path: Path) -> Iterator[list[Column]]:
    """MATLAB files: version 7.3 is HDF5, older ones are read by SciPy."""
    with path.open("rb") as file:
        start = file.read(128)
    if start.startswith(b"MATLAB 7.3") or start.startswith(b"\x89HDF"):
        with _hdf5(path) as columns:
            yield columns
        return
    check_whole(path, mat_sizes(path))
    try:
        content = loadmat(path, simplify_cells=True)
    except (MatReadError, ValueError, TypeError, OSError, NotImplementedError, IndexError, KeyError, MemoryError) as e:
        raise UnreadableRecording(f"{path}: not a MATLAB file that can be read: {e}") from e
    yield list(_flat({k: v for k, v in content.items() if not k.startswith("__")}))


@contextmanager
def _json(path: Path) -> Iterator[list[Column]]:
    """JSON: an object of arrays, an array of objects, or matrices as arrays of arrays."""
    try:
        content = load(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise UnreadableRecording(f"{path}: not JSON that can be read: {error}") from error
    if isinstance(content, list) and content and isinstance(content[0], Mapping):
        keys = list(dict.fromkeys(key for row in content if isinstance(row, Mapping) for key in row))
        content = {key: [row.get(key) if isinstance(row, Mapping) else None for row in content] for key in keys}
    yield list(_flat(content if isinstance(content, Mapping) else {"data": content}))


def _flat(content: Any, name: str = "", depth: int = 0) -> Iterator[Column]:
    """Every series in nested structures: `rig.force`; columns of matrices as `data(:,2)`."""
    if isinstance(content, Mapping):
        if depth < DEEPEST:
            for key, value in content.items():
                yield from _flat(value, f"{name}.{key}" if name else str(key), depth + 1)
        return
    try:
        values = np.asarray(content)
    except ValueError:  # rows of different lengths, or something else among numbers
        values = np.empty(len(content), dtype=object)
        values[:] = content
    if values.dtype.kind == "O":  # other things may be among numbers, not the other way round
        numbers = sum(isinstance(value, int | float) for value in values.ravel())
        if 2 * numbers < values.size:
            return
    yield from of_array(name, values)


def of_array(name: str, values: NDArray[Any]) -> Iterator[Column]:
    """The series of an array of numbers, along its longest axis."""
    if values.dtype.kind in "fiubUMO":
        for suffix, sheet, at in _series_in(values.shape):
            yield replace(whole(name + suffix, values[at(slice(None))], None), sheet=sheet)


Place = Callable[[slice], tuple[int | slice, ...]]


def _series_in(shape: tuple[int, ...]) -> Iterator[tuple[str, int, Place]]:
    """(what follows the array's name, number of its sheet, index of a stretch) of every series: nothing for a vector,
    `(:,2)` in a matrix, `(:,2,5)` on the fifth sheet of an array with three axes.

    The longest axis is the time.  Where it is the last one, the others count backwards, as in HDF5 files of MATLAB.
    """
    along = int(np.argmax(shape)) if shape else 0
    if max(shape, default=0) < 2 or math.prod(shape) // shape[along] > MOST_COLUMNS:
        return
    others = [axis for axis in range(len(shape)) if axis != along]
    if along == len(shape) - 1:
        others.reverse()
    single = math.prod(shape) == shape[along]
    for i, index in enumerate(product(*(range(shape[axis]) for axis in reversed(others)))):
        place = dict(zip(reversed(others), index, strict=True))
        suffix = "" if single else f"(:,{','.join(str(place[axis] + 1) for axis in others)})"
        yield suffix, i // shape[others[0]] if others else 0, _place(along, place)


def _place(along: int, others: Mapping[int, int]) -> Place:
    return lambda part: tuple(part if axis == along else others[axis] for axis in range(len(others) + 1))


@contextmanager
def _hdf5(path: Path) -> Iterator[list[Column]]:
    """HDF5 and MATLAB 7.3: `group/data`, read piece by piece; compound tables as `table.column`."""
    needed("h5py", "hdf5", path)
    import h5py

    try:
        file = h5py.File(path, "r")
    except (OSError, RuntimeError) as error:
        raise UnreadableRecording(f"{path}: not an HDF5 file that can be read: {error}") from error
    with file:
        found: list[Column] = []

        def visit(name: str, item: Any) -> None:
            if name.count("/") >= DEEPEST_GROUP:
                raise UnreadableRecording(f"{path}: holds groups more than {DEEPEST_GROUP} deep inside each other")
            if isinstance(item, h5py.Dataset) and not name.startswith("#") and item.shape is not None:
                _check_own(path, name, item)
                found.extend(_checked(path, item, column) for column in _datasets(name, item))

        file.visititems(visit)
        yield found


def _check_own(path: Path, name: str, item: Any) -> None:
    """Raise UnreadableRecording where the values of a dataset lie elsewhere: an upload could name any file of this
    machine, and its sender would read it as samples.  Views of the file itself may lead there through its links."""
    if item.external or item.is_virtual:
        raise UnreadableRecording(f"{path}: {name} takes its values from elsewhere; a file must hold its own")


def _checked(path: Path, item: Any, column: Column) -> Column:
    """The column, whose chunks are looked at before the first of them is unpacked."""

    def read(a: int, b: int) -> NDArray[Any]:
        rows = b - a if item.chunks is None else math.prod(item.chunks)
        check_piece(path, column.name, rows * item.dtype.itemsize)
        return column.read(a, b)

    return replace(column, read=read)


def _datasets(name: str, item: Any) -> Iterator[Column]:
    unit = item.attrs.get("unit", item.attrs.get("units"))
    unit = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else unit if isinstance(unit, str) else None
    if item.dtype.names and item.ndim == 1:
        for field in item.dtype.names:
            if item.dtype[field].kind in "fiub":
                yield Column(f"{name}.{field}", len(item), _field(item, field), unit)
        return
    if item.dtype.kind in "fiub":
        for suffix, sheet, at in _series_in(item.shape):
            yield Column(name + suffix, max(item.shape), _stretch(item, at), unit, sheet=sheet)


Read = Callable[[int, int], NDArray[Any]]


def _field(item: Any, field: str) -> Read:
    return lambda a, b: item[a:b][field]


def _stretch(item: Any, at: Place) -> Read:
    return lambda a, b: item[at(slice(a, b))]


@contextmanager
def _tdms(path: Path) -> Iterator[list[Column]]:
    """National Instruments TDMS: `group/channel`, with the waveform's start and increment where it has them."""
    needed("nptdms", "tdms", path)
    from nptdms import TdmsFile
    from nptdms.log import log_manager

    log_manager.set_level(logging.CRITICAL)  # damage is reported by its consequences
    raw = path.open("rb")
    try:
        file = TdmsFile.open(raw)
    except Exception as error:  # the library raises many kinds
        raw.close()
        raise UnreadableRecording(f"{path}: not a TDMS file that can be read: {error}") from error
    with raw, file:
        columns = []
        for group in file.groups():
            for channel in group.channels():
                said = channel.properties
                if channel.data_type is None or len(channel) < 2:
                    continue
                unit = said.get("unit_string") or said.get("Unit") or said.get("NI_UnitDescription")
                name = f"{group.name}/{channel.name}"
                unit = unit if isinstance(unit, str) and unit else None
                columns.append(Column(name, len(channel), _reader(channel), unit, _waveform(said)))
        yield columns


def _reader(channel: Any) -> Read:
    return lambda a, b: channel.read_data(a, b - a)


def _waveform(said: Mapping[str, Any]) -> EvenTimes | None:
    """The clock of a channel; None where its properties are none, whatever they are."""
    step, start = said.get("wf_increment"), said.get("wf_start_time")
    if not isinstance(step, int | float) or not 0 < step < math.inf:
        return None
    try:
        offset = round(float(said.get("wf_start_offset") or 0.0) * SECOND)
    except (TypeError, ValueError, OverflowError):
        return None
    if not isinstance(start, np.datetime64 | datetime):
        return EvenTimes(offset, step, True)
    began = int(np.datetime64(start).astype("datetime64[ns]").astype(np.int64))
    return EvenTimes(began + offset, step, began < 0)


@contextmanager
def _uff(path: Path) -> Iterator[list[Column]]:
    yield uff.columns(path)


@contextmanager
def _lvm(path: Path) -> Iterator[list[Column]]:
    yield lvm.columns(path)


@contextmanager
def _numpy(path: Path) -> Iterator[list[Column]]:
    found = list(numpyfile.arrays(path))
    damaged = [lost(name, values) for name, values in found if isinstance(values, str)]
    yield [
        column for name, values in found if not isinstance(values, str) for column in of_array(name, values)
    ] + damaged


KINDS: dict[str, Callable[[Path], Any]] = {
    ".mat": _mat,
    ".json": _json,
    ".h5": _hdf5,
    ".hdf5": _hdf5,
    ".hdf": _hdf5,
    ".tdms": _tdms,
    ".uff": _uff,
    ".unv": _uff,
    ".npz": _numpy,
    ".npy": _numpy,
    ".lvm": _lvm,
}
