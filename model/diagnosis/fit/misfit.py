"""Misfit of sensors: power of what a model leaves of them, relative to their own."""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.signals import FloatArray


def misfit(fit: Fit) -> FloatArray:
    """Misfit of every sensor, (S,)."""
    part = fit.forward.part
    return relative(fit.spectrum[part.grid.band][1:], part.sensors[part.grid.band][1:])


def total_misfit(fit: Fit) -> float:
    """Misfit of all sensors together."""
    return float(np.sum(misfit(fit)))


def is_gross(problem: Problem, fit: Fit) -> bool:
    """Whether a simulated motion is far from the measured one; motions that are smoothed never are."""
    return not problem.process_noise and float(np.sqrt(np.mean(misfit(fit)))) > problem.rules.selection.gross


def relative(error: ComplexArray, measured: ComplexArray) -> FloatArray:
    """Misfit of every sensor, (S,), of errors (F, S)."""
    return np.asarray(power(error) / np.maximum(power(measured), 1e-300))


def power(spectrum: ComplexArray) -> FloatArray:
    """Sum of squares of every column, (S,)."""
    parts = spectrum.real, spectrum.imag
    return np.asarray(sum(np.einsum("fs,fs->s", part, part) for part in parts))
