"""Histories as files: CSV and Parquet with a column a parameter, MCAP with a topic a parameter."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

import numpy as np

from sprung.model.signals import FloatArray
from sprung.service.errors import UserError
from sprung.service.export.messages import ESTIMATE, McapSink
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.views import known_limit
from sprung.service.store.history import Series
from sprung.service.times import to_iso

MEDIA_TYPES = {
    "csv": "text/csv; charset=utf-8",
    "parquet": "application/vnd.apache.parquet",
    "mcap": "application/octet-stream",
}
BAND = 1.96  # standard deviations


def history_file(engine: Engine, vehicle: str, names: Sequence[str], found: Series, kind: str) -> bytes:
    """A file of `kind` (csv, parquet, mcap) with the named parameters.

    Raises UserError where a library for the kind is not installed.
    """
    if kind == "csv":
        return _csv(engine, names, found)
    if kind == "parquet":
        return _parquet(engine, vehicle, names, found)
    return _mcap(engine, vehicle, names, found)


def values_of(engine: Engine, name: str, found: Series) -> tuple[FloatArray, FloatArray]:
    """Value and standard deviation in the parameter's unit, shapes (n,); NaN where it was not identifiable."""
    index = [p.name for p in engine.system.tracked].index(name)
    if not len(found.time):
        return np.zeros(0), np.zeros(0)
    known = found.std[:, index] < known_limit(engine)
    value = np.where(known, engine.system.tracked[index].nominal * np.exp(found.mean[:, index]), np.nan)
    return value, value * found.std[:, index]


def _csv(engine: Engine, names: Sequence[str], found: Series) -> bytes:
    """One row a point: RFC 3339 time, seconds since the epoch, windows, then value and std of each parameter."""
    columns = [values_of(engine, name, found) for name in names]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    units = {p.name: p.unit for p in engine.system.tracked}
    heads = [head for name in names for head in (f"{name} [{units[name]}]", f"{name}.std [{units[name]}]")]
    writer.writerow(["time", "seconds", "windows", *heads])
    for i, time in enumerate(found.time.tolist()):
        cells = [format(series[i], ".9g") if np.isfinite(series[i]) else "" for pair in columns for series in pair]
        writer.writerow([to_iso(time), f"{time / 1e9:.3f}", int(found.windows[i]), *cells])
    return text.getvalue().encode()


def _parquet(engine: Engine, vehicle: str, names: Sequence[str], found: Series) -> bytes:
    """The same as columns; units and vehicle are in the metadata."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise UserError("Parquet needs pyarrow: pip install 'sprung[parquet]', or ask for csv") from None
    units = {p.name: p.unit for p in engine.system.tracked}
    fields = [pa.field("time", pa.timestamp("ns", tz="UTC")), pa.field("windows", pa.int64())]
    arrays = [pa.array(found.time, pa.timestamp("ns", tz="UTC")), pa.array(found.windows)]
    for name in names:
        for suffix, series in zip(("", ".std"), values_of(engine, name, found), strict=True):
            fields.append(pa.field(name + suffix, pa.float64(), metadata={"unit": units[name]}))
            arrays.append(pa.array(series, pa.float64(), from_pandas=True))
    about = {"vehicle": vehicle, "model": engine.digest, "system": engine.system.name}
    table = pa.table(arrays, schema=pa.schema(fields, metadata=about))
    sink = io.BytesIO()
    pq.write_table(table, sink, compression="zstd")
    return sink.getvalue()


def _mcap(engine: Engine, vehicle: str, names: Sequence[str], found: Series) -> bytes:
    """One topic a parameter: /estimate/ELEMENT/QUANTITY."""
    sink = io.BytesIO()
    with McapSink(sink, {"vehicle": vehicle, "model": engine.digest, "system": engine.system.name}) as file:
        for name in names:
            element, _, quantity = name.rpartition(".")
            parameter = next(p for p in engine.system.tracked if p.name == name)
            topic = f"/estimate/{element}/{quantity}"
            value, std = values_of(engine, name, found)
            for i in np.flatnonzero(np.isfinite(value)).tolist():
                file.write(topic, ESTIMATE, int(found.time[i]), estimate(value[i], std[i], parameter.nominal))
    return sink.getvalue()


def estimate(value: float, std: float, nominal: float) -> dict[str, float]:
    """A message of the schema `sprung.Estimate`."""
    return {
        "value": float(value),
        "std": float(std),
        "lower95": float(value - BAND * std),
        "upper95": float(value + BAND * std),
        "ratio": float(value / nominal),
    }
