"""Periodic support motion (wheel flats, rail joints): scores of all frequencies and phases at once.

The residual is mapped back to the support, r -> z(t).  For a movement w(t) = Re sum_n W_n e^{2 pi j n (f t - p)} the
product with the residual is sum_n Re W_n e^{-2 pi j n p} conj(Z(n f)): it needs nothing but the transform Z of z on a
fine axis of frequencies, and a transform over n for the phases p.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy.fft
from scipy.ndimage import median_filter

from sprung.model.diagnosis.record.spectra import Grid
from sprung.model.diagnosis.response.terms import Term, supports
from sprung.model.diagnosis.rules import ScreeningRules
from sprung.model.diagnosis.screening.families import HARMONIC
from sprung.model.diagnosis.screening.places import wheelsets
from sprung.model.diagnosis.screening.score import MEDIAN_OF_CHI_SQUARE, Candidate, Projector, ScalarResponse
from sprung.model.laws import CLOCK_LEAD, Law, SupportLaw
from sprung.model.signals import FloatArray

_FINER = 8  # frequencies per bin: the last harmonic drifts by half a turn at most over the recording
_PHASES = 64  # trial phases of a period


def harmonic_candidates(projector: Projector, laws: tuple[Law, ...]) -> Iterator[tuple[Candidate, int]]:
    """The best movement of every such law at every support or axle, with the number of trials."""
    system = projector.problem.system
    for law in laws:
        if isinstance(law, SupportLaw):
            for location in wheelsets(system) if law.where == "axle" else supports(system):
                yield _best(projector, law, location)


def _best(projector: Projector, law: SupportLaw, location: str) -> tuple[Candidate, int]:
    absent = Candidate(Term(law, location, law.absent), 0.0, HARMONIC)
    names, rules = supports(projector.problem.system), projector.problem.rules.screening
    at = [names.index(name) for name in location.split("|")]
    channel = ScalarResponse.of(projector, projector.of_support[:, :, at].sum(axis=2))
    fundamentals, products, sizes = _products(projector.grid, law, channel, rules)
    tests = len(fundamentals) * len(law.harmonics)
    best = np.argmax(products, axis=1)
    product = np.take_along_axis(products, best[:, None], axis=1)[:, 0]
    scores = np.where(product > 0, product**2 / sizes, 0.0)
    if not np.any(scores > 0):
        return absent, tests
    i = int(np.argmax(scores))
    values, exact = _refined(projector.grid, law, channel, float(fundamentals[i]), best[i] / _PHASES)
    score = min(exact, rules.colour * float(scores[i]))
    term = Term(law, location, values, scales=(max(values[0], 1e-9), 1.0, rules.turn))
    return Candidate(term, score, HARMONIC), tests


def _products(
    grid: Grid, law: SupportLaw, channel: ScalarResponse, rules: ScreeningRules
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fundamentals (m,) in Hz, products with the residual (m, phases) and squares (m,) of movements of unit depth.

    Both are normalised by the local level of the residual over noise.
    """
    scores = np.abs(channel.product) ** 2 / np.maximum(channel.size, 1e-300)
    colour = np.maximum(1.0, median_filter(scores, size=2 * rules.reach + 1, mode="nearest") / MEDIAN_OF_CHI_SQUARE)
    product, size, bins = channel.product / colour, channel.size / colour, len(colour)
    series = scipy.fft.ifft(np.pad(product, (0, grid.samples - bins))).real * np.sqrt(grid.samples)
    spectrum = scipy.fft.rfft(series, _FINER * grid.samples)
    first, last = (int(f * _FINER * grid.length) for f in (rules.slowest, rules.fastest))
    steps = np.arange(max(first, 1), min(last, _FINER * (bins - 1) // rules.harmonics) + 1)
    turned = np.zeros((len(steps), _PHASES), dtype=complex)
    squares = np.zeros(len(steps))
    for n, weight in enumerate(law.harmonics, 1):
        seen = n * steps <= _FINER * (bins - 1)
        at = np.where(seen, n * steps, 0)
        angle = 2 * np.pi * at / (_FINER * grid.length) * (grid.start + CLOCK_LEAD)
        turned[:, n] = weight * seen * np.exp(1j * angle) * spectrum[at].conj()
        squares += weight**2 * seen * np.interp(at / _FINER, np.arange(bins), size) * grid.samples / 4
    return steps / (_FINER * grid.length), scipy.fft.fft(turned, axis=1).real, np.maximum(squares, 1e-300)


def _refined(
    grid: Grid, law: SupportLaw, channel: ScalarResponse, frequency: float, phase: float
) -> tuple[tuple[float, float, float], float]:
    """Depth, frequency and phase, and the statistic, refined by exact columns."""
    time = grid.start + grid.time + CLOCK_LEAD
    middle = float(time.mean())  # a frequency turns the phase about the middle
    shifts = phase + np.linspace(-1, 1, 5) / _PHASES
    frequencies = frequency + np.linspace(-1, 1, 9) / (_FINER * grid.length)
    trials = [(f, (shifts + (f - frequency) * middle) % 1.0) for f in frequencies]
    moved = np.concatenate([law.displacements(time, f, phases, grid.nyquist) for f, phases in trials])
    scores, depths = channel.scores(scipy.fft.rfft(moved, axis=1, norm="ortho")[:, grid.band])
    scores = np.where(depths > 0, scores, 0.0)
    i = int(np.argmax(scores))
    f, phases = trials[i // len(shifts)]
    return (float(depths[i]), float(f), float(phases[i % len(shifts)])), float(scores[i])
