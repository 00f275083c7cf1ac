"""PySINDy on the same files: sparse regression of the forces that springs and dampers leave over.

Body accelerations from the redundant accelerometers, integrated to motions in the recording's band, give deflection
and rate of every element.  The balance of forces of all bodies is one regression whose columns are, per element, k d,
c v and the shapes of every law without memory; both sides pass the same band filter.  STLSQ picks from normalised
columns with the threshold that is best on the held-out third.  What it keeps beside k d and c v is its finding: place
and law by the largest share of force.  A recording counts as detected when the held-out error falls by more than on
99 % of the clean recordings of the same benchmark, so that its false-alarm rate is known.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from sprung.benchmarks.concealed_score import rate
from sprung.benchmarks.generator import Vehicle
from sprung.model.system import System
from sprung.replay.record import load_record

Array = NDArray[np.float64]

BAND = (0.8, 20.0)  # Hz, where integrated accelerations can be trusted
THRESHOLDS = (0.002, 0.004, 0.008, 0.015, 0.03, 0.05, 0.08, 0.12, 0.2)  # of the target's norm
FITTED = 0.66  # share of the recording that is fitted


def candidate_forces(d: Array, v: Array) -> dict[str, Array]:
    """Force shapes of one element by the law they stand for; knees and gaps in usual deflections and rates."""
    d_size, v_size = d.std(), v.std()
    out = {
        "cubic_stiffness": d**3,
        "coulomb_friction": np.tanh(v / 0.002),
        "damper_asymmetry": np.abs(v),
        "quadratic_damping": v * np.abs(v),
        "quadratic_stiffness": d**2,
        "position_dependent_damping": d**2 * v,
        "rate_dependent_stiffness": np.abs(v) * d,
    }
    out |= {f"bump_stop@{g}": np.sign(d) * np.maximum(np.abs(d) - g * d_size, 0) for g in (1.0, 1.5, 2.0)}
    out |= {f"clearance@{g}": np.clip(d, -g * d_size, g * d_size) for g in (0.1, 0.3)}
    out |= {f"damper_blowoff@{g}": np.sign(v) * np.maximum(np.abs(v) - g * v_size, 0) for g in (0.5, 1.0)}
    return out


def _filtered(x: Array, rate_hz: float) -> Array:
    sections = signal.butter(4, BAND, "band", fs=rate_hz, output="sos")
    result: Array = signal.sosfiltfilt(sections, x, axis=0)
    return result


def _integrated(x: Array, rate_hz: float) -> Array:
    """Integral of a band-passed signal, in the frequency domain."""
    spectrum = np.fft.rfft(x, axis=0)
    omega = 2 * np.pi * np.fft.rfftfreq(len(x), 1 / rate_hz)
    spectrum[1:] /= 1j * omega[1:, None]
    spectrum[0] = 0
    result: Array = np.fft.irfft(spectrum, len(x), axis=0)
    return result


def regression(vehicle: Vehicle, values: Array, rate_hz: float) -> tuple[list[tuple[str, str]], Array, Array]:
    """Column names (element, law), matrix (T, D, columns) and target (T, D): weighted forces on every body.

    `values` are displacements, velocities, sensors in columns.
    """
    wheels = len(vehicle.inputs)
    supports = np.zeros((wheels, len(vehicle.elements)))
    for row, wheel in enumerate(vehicle.support):
        if wheel >= 0:
            supports[wheel, row] = 1.0
    acceleration = _filtered(values[:, 2 * wheels :] @ np.linalg.pinv(vehicle.pickup).T, rate_hz)
    velocity = _integrated(acceleration, rate_hz)
    position = _integrated(velocity, rate_hz)
    d = position @ vehicle.geometry.T - _filtered(values[:, :wheels], rate_hz) @ supports
    v = velocity @ vehicle.geometry.T - _filtered(values[:, wheels : 2 * wheels], rate_hz) @ supports
    target = acceleration * vehicle.inertia
    weight = 1 / target.std(axis=0)
    names: list[tuple[str, str]] = []
    columns = []
    for e, element in enumerate(vehicle.elements):
        shapes = {"stiffness": d[:, e], "damping": v[:, e], **candidate_forces(d[:, e], v[:, e])}
        names += [(element, law) for law in shapes]
        force = _filtered(np.stack(list(shapes.values()), axis=1), rate_hz)
        columns.append(-force[:, None, :] * (vehicle.geometry[e] * weight)[None, :, None])
    edge = slice(int(2 * rate_hz), -int(2 * rate_hz))
    return names, np.concatenate(columns, axis=2)[edge], (target * weight)[edge]


def sparse_fit(names: list[tuple[str, str]], matrix: Array, target: Array) -> dict[str, Any]:
    """PySINDy's STLSQ over thresholds: share of held-out error removed beyond k d + c v, and what it kept."""
    import pysindy

    cut = int(FITTED * len(target))
    fit, held = (matrix[:cut].reshape(-1, len(names)), matrix[cut:].reshape(-1, len(names)))
    y, y_held = target[:cut].ravel(), target[cut:].ravel()
    norm, y_norm = np.linalg.norm(fit, axis=0), np.linalg.norm(y)
    # An orthogonal turn leaves every least-squares problem of STLSQ as it is, on a square matrix.
    turn, square = np.linalg.qr(fit / norm)
    turned = (turn.T @ (y / y_norm))[:, None]
    linear = np.array([law in ("stiffness", "damping") for _, law in names])
    plain = np.linalg.lstsq(square[:, linear], turned[:, 0], rcond=None)[0] * y_norm / norm[linear]
    error = float(np.mean((y_held - held[:, linear] @ plain) ** 2))
    best: dict[str, Any] = {"gain": 0.0, "location": None, "effect": None, "terms": 0}
    for threshold in THRESHOLDS:
        optimizer = pysindy.STLSQ(threshold=threshold, alpha=1e-6, max_iter=30)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            optimizer.fit(square, turned)
        share = np.ravel(optimizer.coef_)
        gain = 1 - float(np.mean((y_held - held @ (share * y_norm / norm)) ** 2)) / error
        kept = np.where(linear, 0.0, np.abs(share))
        if gain > best["gain"] and kept.any():
            element, law = names[int(np.argmax(kept))]
            best = {"gain": gain, "location": element, "effect": law.partition("@")[0], "terms": int((kept > 0).sum())}
    return best


def _result(vehicle: Vehicle, system: System, file: Path) -> dict[str, Any]:
    kept = file.with_suffix(".pysindy.json")
    if kept.exists():
        found: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8"))
        return found
    record = load_record(file, system.channels, system.sample_rate)
    names = [channel.name for channel in system.channels]
    order = [f"{w}.{q}" for q in ("displacement", "velocity") for w in vehicle.inputs] + list(vehicle.sensors)
    values = np.nan_to_num(record.values[:, [names.index(name) for name in order]])
    found = sparse_fit(*regression(vehicle, values, system.sample_rate))
    kept.write_text(json.dumps(found), encoding="utf-8")
    return found


def compare(
    vehicle: Vehicle, system: System, chosen: Mapping[str, list[tuple[Path, Mapping[str, Any]]]]
) -> Iterator[dict[str, Any]]:
    """One line per set: how often PySINDy finds, places and names; only effects on elements are asked of it."""
    found = {name: [(truth, _result(vehicle, system, path)) for path, truth in files] for name, files in chosen.items()}
    quiet = [r["gain"] for results in found.values() for truth, r in results if truth["verdict"] == "consistent"]
    limit = float(np.quantile(quiet, 0.99)) if quiet else 0.0
    for name, results in found.items():
        asked = [
            (truth["findings"], r)
            for truth, r in results
            if truth["findings"] and all(f["location"] in vehicle.elements for f in truth["findings"])
        ]
        if not asked:
            continue
        hit = [r["gain"] > limit for _, r in asked]
        placed = [r["location"] in {f["location"] for f in fs} for fs, r in asked]
        named = [any((r["location"], r["effect"]) == (f["location"], f["effect"]) for f in fs) for fs, r in asked]
        yield {
            "pysindy": name,
            "recordings": len(asked),
            "detected": rate(hit),
            "located_one": rate(h and p for h, p in zip(hit, placed, strict=True)),
            "named_one": rate(h and n for h, n in zip(hit, named, strict=True)),
            "located_one_without_threshold": rate(placed),
            "named_one_without_threshold": rate(named),
            "false_alarms_without_threshold": rate(gain > 0 for gain in quiet),
            "gain_threshold": limit,
            "clean_recordings": len(quiet),
            "median_terms_kept": float(np.median([r["terms"] for _, r in asked])),
        }
