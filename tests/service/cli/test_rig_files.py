"""From a file as a test rig writes it to a named law: inspect writes the system file, diagnose reads it."""

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from sprung.model.signals import FloatArray
from sprung.service.cli import main

h5py = pytest.importorskip("h5py")
pytest.importorskip("pyarrow")
nptdms = pytest.importorskip("nptdms")
import pyarrow as pa  # noqa: E402
import pyarrow.parquet as pq  # noqa: E402

from tests.replay_files import uff58  # noqa: E402

FRICTION, STEP = 60.0, 0.01  # N, s


def columns() -> dict[str, FloatArray]:
    """A damper with dry friction under two sines."""
    random, t = np.random.default_rng(6), STEP * np.arange(900)
    stroke = 0.012 * np.sin(4.4 * t + 0.3) + 0.004 * np.sin(12 * t)
    rate = 0.0528 * np.cos(4.4 * t + 0.3) + 0.048 * np.cos(12 * t)
    force = 4e4 * stroke + 1.5e3 * rate + FRICTION * np.tanh(rate / 1e-3) + random.standard_normal(len(t))
    return {"time": t, "stroke": stroke + 1e-6 * random.standard_normal(len(t)), "force": force}


def mat5(path: Path) -> None:
    scipy.io.savemat(path, columns())


def hdf5(path: Path, userblock: int = 0) -> None:
    with h5py.File(path, "w", userblock_size=userblock) as file:
        for name, values in columns().items():
            file[name] = values[None, :] if userblock else values
            if not userblock and name == "force":
                file[name].attrs["unit"] = "N"


def mat73(path: Path) -> None:
    hdf5(path, 512)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def parquet(path: Path) -> None:
    pq.write_table(pa.table(columns()), path)


def tdms(path: Path) -> None:
    waveform = {"wf_increment": STEP, "wf_start_offset": 0.0}
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(
            [
                nptdms.ChannelObject("rig", name, values, properties=waveform)
                for name, values in columns().items()
                if name != "time"
            ]
        )


def uff(path: Path) -> None:
    data = columns()
    path.write_bytes(
        b"".join(
            uff58(node, 3, data[name], unit=unit, times=data["time"])
            for node, name, unit in ((1, "stroke", "m"), (2, "force", "N"))
        )
    )


def german(path: Path) -> None:
    """Semicolons, decimal commas, kilonewtons, milliseconds and a row of units."""
    t, stroke, force = columns().values()
    rows = (f"{1e3 * a:.1f};{1e3 * b:.5f};{1e-3 * c:.6f}" for a, b, c in zip(t, stroke, force, strict=True))
    path.write_text("Zeit;Weg;Kraft\nms;mm;kN\n" + "\n".join(rows).replace(".", ",") + "\n", encoding="utf-8")


FILES = {
    "rig5.mat": mat5,
    "rig73.mat": mat73,
    "rig.h5": hdf5,
    "rig.parquet": parquet,
    "rig.tdms": tdms,
    "rig.uff": uff,
    "versuch.csv": german,
}


@pytest.mark.parametrize("name", FILES)
def test_a_rigs_file_leads_to_its_friction_without_a_script(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    path, system = tmp_path / name, tmp_path / "rig.yaml"
    FILES[name](path)
    assert main(["inspect", str(path), "--write-system", str(system)]) == 0
    assert main(["diagnose", str(path), "--system", str(system), "--json"]) == 1
    report = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert report["verdict"] == "missing_physics", report["summary"]
    first = next(f for f in report["findings"] if f["effect"] != "preload")
    assert first["effect"] in ("coulomb_friction", "dahl", "bouc_wen", "stribeck")
    values = {p["name"]: p["value"] for p in (*first["parameters"], *first.get("quoted", ()))}
    force = values.get("breakaway_force", values.get("yield_force"))
    assert force == pytest.approx(FRICTION, rel=0.1)
    assert report["unexplained"]["share"] < 1e-3
