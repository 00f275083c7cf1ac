"""One small recording in every format that mutants are made of, and the samples it holds."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.io
from mcap.writer import CompressionType

from sprung.model.signals import Channel, FloatArray
from tests.replay_files import (
    CHANNELS,
    LEFT,
    NUMBERS,
    RIGHT,
    START,
    TIMES,
    VALUES,
    uff58,
    write_can,
    write_csv,
    write_json,
    write_protobuf,
    write_ros2,
)

TABLE = [Channel(c.name, c.unit, c.noise, c.mcap, c.can, c.csv, column=c.csv) for c in CHANNELS]
GROUPED = [Channel(c.name, c.unit, c.noise, column=f"group/{c.csv}") for c in CHANNELS]  # as TDMS names them
RECORDS = [Channel(c.name, c.unit, c.noise, column=f"data.{c.csv}") for c in CHANNELS]  # of a structured array
UNIVERSAL = [Channel(c.name, c.unit, c.noise, column=name) for c, name in zip(CHANNELS, ("12+Z", "7-X"), strict=True)]
SECONDS: FloatArray = NUMBERS / 100
COLUMNS: dict[str, FloatArray] = {"time": SECONDS, "left": LEFT, "right": RIGHT}


def _mcap(compression: CompressionType) -> Callable[[Path], None]:
    return lambda path: write_json(path, compression=compression, chunk=2048)


def _loose_mcap(path: Path) -> None:
    write_json(path, chunked=False)


def _mat(path: Path) -> None:
    scipy.io.savemat(path, COLUMNS, do_compression=True)


def _json(path: Path) -> None:
    path.write_text(json.dumps({name: values.tolist() for name, values in COLUMNS.items()}))


def _parquet(path: Path) -> None:
    import pyarrow
    from pyarrow.parquet import write_table

    write_table(pyarrow.table(COLUMNS), path, row_group_size=64)


def _hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        for name, values in COLUMNS.items():
            file.create_dataset(name, data=values, compression="gzip", fletcher32=True)


def _tdms(path: Path) -> None:
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(path) as writer:
        writer.write_segment([ChannelObject("group", name, values) for name, values in COLUMNS.items()])


def _uff(path: Path) -> None:
    path.write_bytes(uff58(12, 3, LEFT, unit="m/s2", times=SECONDS) + uff58(7, -1, RIGHT, unit="m/s2", times=SECONDS))


def _npz(path: Path) -> None:
    np.savez_compressed(path, **COLUMNS)  # type: ignore[arg-type]


def _npy(path: Path) -> None:
    kinds = [(name, "f8") for name in COLUMNS]
    np.save(path, np.array(list(zip(*COLUMNS.values(), strict=True)), dtype=kinds))


def _lvm(path: Path) -> None:
    head = ["LabVIEW Measurement\t", "Separator\tTab", "X_Columns\tOne", "***End_of_Header***\t", "Channels\t2"]
    head += ["Delta_X\t0.01\t0.01", "X0\t0\t0", "***End_of_Header***\t", "X_Value\tleft\tright"]
    rows = [f"{s:.2f}\t{x}\t{y}" for s, x, y in zip(SECONDS, LEFT, RIGHT, strict=True)]
    path.write_text("\n".join([*head, *rows]) + "\n")


def _tab(path: Path) -> None:
    rows = [f"{s:.2f}\t{x}\t{y}".replace(".", ",") for s, x, y in zip(SECONDS, LEFT, RIGHT, strict=True)]
    path.write_text("\n".join(["# made for tests", "time [s]\tleft\tright", *rows]) + "\n", encoding="cp1252")


SEEDS: dict[str, tuple[str, Callable[[Path], None]]] = {  # name -> file name, writer
    "mcap": ("a.mcap", _mcap(CompressionType.ZSTD)),
    "mcap-lz4": ("a.mcap", _mcap(CompressionType.LZ4)),
    "mcap-plain": ("a.mcap", _mcap(CompressionType.NONE)),
    "mcap-loose": ("a.mcap", _loose_mcap),
    "mcap-protobuf": ("a.mcap", write_protobuf),
    "mcap-ros2": ("a.mcap", write_ros2),
    "blf": ("a.blf", write_can),
    "asc": ("a.asc", write_can),
    "candump": ("a.log", write_can),
    "csv": ("a.csv", write_csv),
    "text": ("a.txt", _tab),
    "mat": ("a.mat", _mat),
    "json": ("a.json", _json),
    "parquet": ("a.parquet", _parquet),
    "hdf5": ("a.h5", _hdf5),
    "tdms": ("a.tdms", _tdms),
    "uff": ("a.uff", _uff),
    "mf4": ("a.mf4", write_can),
    "npz": ("a.npz", _npz),
    "npy": ("a.npy", _npy),
    "lvm": ("a.lvm", _lvm),
}
CHECKED = ("mcap", "mcap-lz4", "mcap-plain", "blf")  # every sample is under a checksum that the reader verifies
NEEDS = {"parquet": "pyarrow", "hdf5": "h5py", "tdms": "nptdms", "mf4": "asammdf"}  # optional packages

__all__ = ["CHECKED", "GROUPED", "NEEDS", "RECORDS", "SEEDS", "START", "TABLE", "TIMES", "UNIVERSAL", "VALUES"]
