"""Faults of the channels of a support whose motion is measured more than once, detected by analytical redundancy.

Displacement and velocity are compared over frequency (`record.signals`).  With an acceleration among them, they are
compared in the time domain with the motion that fits all (`record.fused`).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sprung.model.diagnosis.record.fused import QUANTITIES, ParityResiduals
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.terms import Term, supports
from sprung.model.diagnosis.screening.families import INPUT, Family
from sprung.model.diagnosis.screening.score import Candidate, Projector
from sprung.model.laws import SensorLaw, SensorResponse
from sprung.model.signals import FloatArray


def support_candidates(projector: Projector, laws: list[SensorLaw]) -> Iterator[tuple[Candidate, int]]:
    """Every fault of a channel of a support that another channel contradicts."""
    yield from _of_pairs(projector, laws)
    for one in projector.problem.part.parity:
        yield from _of_fused(projector, laws, one)


def fault_candidate(
    projector: Projector, law: SensorLaw, place: str, score: float, amplitude: float, family: Family, variant: str = ""
) -> Candidate:
    """A fault whose first parameter leaves its neutral value by an amplitude."""
    scale = law.scale(projector.grid.step, amplitude)
    values = (law.absent[0] + amplitude, *law.absent[1:])
    return Candidate(Term(law, place, values, variant, scales=(scale,) * len(values)), score, family)


def fault_factor(slope: SensorResponse, jw: ComplexArray) -> ComplexArray:
    """Change of what is shown per truth, (F,)."""
    return slope.gain - jw * (slope.lag + slope.delay)


def _of_pairs(projector: Projector, laws: list[SensorLaw]) -> Iterator[tuple[Candidate, int]]:
    """Faults of displacements and velocities that are measured beside each other."""
    problem, grid = projector.problem, projector.grid
    part, noise = problem.part, problem.noise
    band = grid.band
    omega = grid.omega[band]
    G = projector.of_support
    names = supports(problem.system)
    for at, support in enumerate(part.pairs):
        precision_d = 1 / noise.displacement[support] ** 2
        precision_v = (omega / noise.velocity[support]) ** 2
        share_d = precision_d / (precision_d + precision_v)
        integrated = noise.velocity[support] / np.maximum(omega, omega[1])
        level = np.hypot(noise.displacement[support], integrated)
        periodic = problem.driving(projector.fit.forward).support[band, support]
        shown = _pack(part.redundancy[band, at] / level, grid.weight)
        yield from _of_rate_offset(projector, laws, at)
        for channel, share, sign in (("displacement", share_d, -1.0), ("velocity", 1 - share_d, 1.0)):
            for law in laws:
                if law.slope().offset:
                    continue
                signal = fault_factor(law.slope(), 1j * omega) * periodic
                column = projector.pack(-G[:, :, support] * (share * signal)[:, None])
                beside = _pack(sign * signal / level, grid.weight)
                score, amplitude = projector.score(column, (float(beside @ shown), float(beside @ beside)))
                yield fault_candidate(projector, law, f"{names[support]}.{channel}", score, amplitude, INPUT), 1


def _of_rate_offset(projector: Projector, laws: list[SensorLaw], at: int) -> Iterator[tuple[Candidate, int]]:
    """Offset of the velocity of a support whose displacement goes elsewhere in the long run.

    No sensor sees it, since the mean motion is that of the displacement.  An offset of the displacement is another zero
    of the support's position: nothing contradicts it.
    """
    part = projector.problem.part
    variance = float(projector.problem.noise.rate_offset_variance(part)[at])
    shown = float(part.rate_offset[at])
    place = f"{supports(projector.problem.system)[part.pairs[at]]}.velocity"
    for law in laws:
        slope = law.slope().offset
        if slope:
            yield fault_candidate(projector, law, place, shown**2 / variance, shown / slope, INPUT), 1


def _of_fused(
    projector: Projector, laws: list[SensorLaw], measured: ParityResiduals
) -> Iterator[tuple[Candidate, int]]:
    """Faults of the channels of a support whose acceleration is measured beside its displacement or velocity."""
    problem, grid = projector.problem, projector.grid
    support = measured.support
    omega = grid.omega[grid.band]
    shares = measured.shares_at(np.maximum(omega, omega[1]))
    driving, G = problem.driving(projector.fit.forward), projector.of_support[:, :, support]
    periodic = driving.support[grid.band, support]
    name = supports(problem.system)[support]
    for order in measured.orders:
        shown, rate = measured.shown(order)
        for law in laws:
            slope = law.slope()
            if slope.offset:
                if QUANTITIES[order] != "velocity" or 0 not in measured.orders:
                    continue  # nothing contradicts another zero of a position, and accelerometers have zeros anyway
                column, wrong = np.zeros_like(projector.residual), np.full_like(shown, slope.offset)
            else:
                factor = fault_factor(slope, 1j * omega)
                column = projector.pack(-G * (shares[order] * factor * periodic)[:, None])
                wrong = slope.gain * shown - (slope.lag + slope.delay) * rate
            score, amplitude = projector.score(column, measured.score(order, wrong))
            yield fault_candidate(projector, law, f"{name}.{QUANTITIES[order]}", score, amplitude, INPUT), 1


def _pack(spectrum: ComplexArray, weight: FloatArray) -> FloatArray:
    weighted = spectrum * weight
    return np.concatenate([weighted.real, weighted.imag])
