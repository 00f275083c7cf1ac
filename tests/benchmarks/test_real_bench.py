"""The benchmark of measured records: its readers and references, on records made here."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from sprung.benchmarks.real import run
from sprung.benchmarks.real_reference import bouc_wen, linear


def damper(seconds: float = 12.0, rate: float = 100.0) -> tuple[np.ndarray, np.ndarray]:
    """Stroke (m) and force (N) of a damper with hysteresis and preload, started from rest."""
    t = np.arange(int(seconds * rate)) / rate
    stroke = 0.012 * (1 - np.cos(2 * np.pi * 0.8 * np.maximum(t - 1.5, 0)))
    speed = np.gradient(stroke, t)
    z, path = 0.0, []
    for way in np.diff(stroke, prepend=0.0):
        z += way - 1500.0 * (abs(way) * z + 0.5 * way * abs(z))
        path.append(z)
    noise = 0.5 * np.random.default_rng(5).standard_normal(len(t))
    return stroke, 117.0 + 800 * stroke + 900 * speed + 2.0e5 * np.array(path) + noise


def test_records_are_diagnosed_beside_references(tmp_path: Path) -> None:
    stroke, force = damper()
    savemat(tmp_path / "mr_damper_test.mat", {"dist": 1e3 * stroke[:, None], "forc": force[:, None]})
    (line,) = run(tmp_path, tmp_path / "pictures")
    assert line["verdict"] == "missing_physics"
    assert any("bouc_wen" in name for name in line["laws"])
    assert line["laws"]["damper: preload"]["force"][0] == pytest.approx(117, abs=8)
    assert line["held_out"] <= line["reference"]["bouc_wen"] < line["reference"]["linear"]
    assert line["met"]
    assert Path(line["picture"]).stat().st_size > 10_000


def test_units_of_the_friction_damper_are_converted(tmp_path: Path) -> None:
    stroke, force = damper()
    table = np.column_stack(
        [np.arange(len(stroke)) / 100, stroke / 0.0254, force / 4448.22, np.gradient(stroke) / 2.54e-4]
    )
    text = json.dumps({"data": table.tolist(), "sampling freq": 100})
    (tmp_path / "brfd_test.json").write_text(text, encoding="utf-8")
    (line,) = run(tmp_path)
    values = {name: value for law in line["laws"].values() for name, value in law.items()}
    assert values["yield_force"][0] == pytest.approx(2.0e5 / 2250, rel=0.15)


def test_a_folder_without_records_says_what_is_known(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="mr_damper"):
        list(run(tmp_path))


def test_the_references_recover_what_they_can_express() -> None:
    stroke, force = damper()
    speed = np.gradient(stroke, 0.01)
    plain = 3.0 + 800 * stroke + 900 * speed
    np.testing.assert_allclose(linear(stroke, speed, plain, 800), plain, atol=1e-6)
    moving = slice(160, None)
    error = (force[moving] - bouc_wen(stroke[moving], speed[moving], force[moving], 700))[100:]  # forgets its start
    assert float(np.std(error)) < 2.0
