"""Rigs for tests of component tests: forces of one element by code of their own, along sweeps and random motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, chirp, sosfiltfilt

from sprung.model.diagnosis.api import Report, diagnose
from sprung.model.signals import FloatArray
from sprung.model.system import System, parse_system
from tests.diagnosis.component.test_component import RATE, RigRecording

SECONDS, FINER, TRAVEL = 20.0, 16, 0.02  # s, steps per sample, m
K, C = 2.0e4, 500.0

Force = Callable[[FloatArray, FloatArray], FloatArray]  # deflections m, rates m/s, (T,) -> N


def moved(kind: str, seed: int = 0) -> FloatArray:
    """Deflections of a test, m: a sweep, a sweep that fades, three amplitudes of a sine, or random motion."""
    t = np.arange(int(SECONDS * RATE)) / RATE
    begin = TRAVEL * np.clip(t, 0.0, 1.0)
    if kind in ("sweep", "fading"):
        fades = np.linspace(1.0, 0.2, len(t)) if kind == "fading" else 1.0
        return np.asarray(begin * fades * chirp(t, 0.3, t[-1], 5.0, phi=-90))
    if kind == "sine":
        return np.asarray(begin * np.sin(2 * np.pi * 0.83 * t))
    if kind == "sines":
        size = np.interp(t, [0, 6, 8, 13, 15, 20], [1.0, 1.0, 0.4, 0.4, 0.7, 0.7])
        return np.asarray(begin * size * np.sin(2 * np.pi * 1.1 * t))
    noise = np.random.default_rng(seed).standard_normal(len(t) + 4000)
    series = sosfiltfilt(butter(3, [0.2, 5.0], "bandpass", fs=RATE, output="sos"), noise)[2000:-2000]
    return np.asarray(TRAVEL * series / np.max(np.abs(series)))


def recorded(force: Force, motion: FloatArray, noise: float = 0.01, seed: int = 1) -> RigRecording:
    """A spring, a damper and a force along a motion (T,), with noise as a share of the whole force, and of 10 um."""
    random, h = np.random.default_rng(seed), 1 / (RATE * FINER)
    at = np.arange((len(motion) - 1) * FINER + 1) / FINER
    d = CubicSpline(np.arange(len(motion)), motion)(at)
    v = np.gradient(d, h)
    whole = (K * d + C * v + force(d, v))[::FINER]
    cell = whole + noise * np.std(whole) * random.standard_normal(len(whole))
    return RigRecording(np.column_stack([motion + 1e-5 * random.standard_normal(len(motion)), cell]))


def bench(noise: float) -> System:
    """An element between a measured deflection and ground; noise: of its load cell, N."""
    return parse_system(f"""
name: test bench
sample_rate: {RATE:g}
window: 64
bodies: {{}}
inputs: {{rod: {{kind: displacement, displacement: {{csv: d, noise: 1e-5}}}}}}
elements: {{damper: {{upper: rod, lower: ground, stiffness: 1e4, damping: 1e3}}}}
sensors: {{cell: {{kind: force, element: damper, csv: F, noise: {noise}}}}}
""")


def diagnosed(record: RigRecording, noise: float = 0.01) -> Report:
    """The diagnosis of a record whose file declares the noise as it is."""
    return diagnose(bench(round(noise * float(np.std(record.values[:, 1])), 2)), record)


def found(report: Report) -> set[str]:
    """Effects that are named, preloads apart."""
    return {finding.effect for finding in report.findings} - {"preload"}


def sliders(stiffness: FloatArray, reach: FloatArray) -> Force:
    """Jenkins sliders (n,) in parallel (Iwan): springs, N/m, that slip beyond their reach, m."""

    def force(d: FloatArray, v: FloatArray) -> FloatArray:
        path, u = np.empty(len(d)), np.zeros(len(reach))
        for i, way in enumerate(np.diff(d, prepend=d[0])):
            u = np.clip(u + way, -reach, reach)
            path[i] = stiffness @ u
        return path

    return force


def leaves(stiffness: float, friction: float, reach: float, grows: float) -> Force:
    """A leaf spring: branches of loading and unloading, approached exponentially; friction grows with the load."""

    def force(d: FloatArray, v: FloatArray) -> FloatArray:
        path, f = np.empty(len(d)), 0.0
        for i, (x, way) in enumerate(zip(d, np.diff(d, prepend=d[0]), strict=True)):
            branch = (stiffness * x + friction * np.sign(way)) * (1 + grows * x / TRAVEL)
            f = branch + (f - branch) * np.exp(-abs(way) / reach)
            path[i] = f
        return path

    return force
