"""Faults of measurements as candidates, told from physics by redundancy and by causality.

A wrong sensor is wrong alone: its residual is a copy (gain), a derivative (lag) or a constant (bias), while the
other sensors on the same rigid body and the bodies that it would act on contradict it; the projection and the joint
whitening of `Projector` do that weighing.  Input channels have a redundant measurement, the second one of the same
support (`record.signals`).

To first order a channel shows, beside the truth y, dp times  (dG - s (d lag + d delay)) y + d offset, with the
derivatives of the law's response by its parameter p.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.terms import Term, supports
from sprung.model.diagnosis.screening.families import FORCE, INPUT, SENSOR, Family
from sprung.model.diagnosis.screening.places import wheelsets
from sprung.model.diagnosis.screening.score import Candidate, Projector
from sprung.model.laws import Law, SensorLaw, SensorResponse
from sprung.model.laws.base import Channels
from sprung.model.signals import FloatArray


def measurement_candidates(projector: Projector, laws: tuple[Law, ...]) -> Iterator[tuple[Candidate, int]]:
    """Every fault of a measurement at every sensor and input channel that may have it."""
    faults = [law for law in laws if isinstance(law, SensorLaw) and law.response is not None]

    def at(channel: Channels) -> list[SensorLaw]:
        return [law for law in faults if channel in law.at]

    yield from _of_sensors(projector, at("sensor"))
    yield from _of_supports(projector, at("support"))
    for law in faults:
        if law.where == "axle":
            yield from _of_axles(projector, law)
    yield from _of_forces(projector, at("force"))


def _candidate(
    projector: Projector, law: SensorLaw, place: str, score: float, amplitude: float, family: Family, variant: str = ""
) -> Candidate:
    """A fault whose first parameter leaves its neutral value by an amplitude."""
    scale = law.scale(projector.grid.step, amplitude)
    values = (law.absent[0] + amplitude, *law.absent[1:])
    return Candidate(Term(law, place, values, variant, scales=(scale,) * len(values)), score, family)


def _factor(slope: SensorResponse, jw: ComplexArray) -> ComplexArray:
    """Change of what is shown per truth, (F,)."""
    return slope.gain - jw * (slope.lag + slope.delay)


def _of_sensors(projector: Projector, laws: list[SensorLaw]) -> Iterator[tuple[Candidate, int]]:
    problem, fit, grid = projector.problem, projector.fit, projector.grid
    band = grid.band
    truth = problem.shown_of_smoothed(fit.forward, fit.spectrum)[band]
    constant = np.zeros(len(truth), dtype=complex)
    constant[0] = np.sqrt(grid.samples)
    jw = 1j * grid.omega[band]
    own = np.eye(len(problem.sensors))[:, None, :, None] * fit.forward.of_inputs[band]  # of one sensor each
    for i, index in enumerate(problem.sensors):
        name = problem.system.sensors[index]
        for law in laws:
            slope = law.slope()
            factor = _factor(slope, jw)
            if problem.part.differentiated[i] and not np.any(factor):
                continue  # a position that is compared by its rate shows no bias
            signal = factor * truth[:, i] + slope.offset * constant
            column = projector.pack(projector.factor[:, :, i] * signal[:, None])
            determinant = projector.spread(column, own[i] * factor[:, None, None])
            score, amplitude = projector.score(column, (determinant, 0.0))
            for variant, form in [*law.forms.items(), ("", law)]:  # alike to first order
                yield _candidate(projector, form, name, score, amplitude, SENSOR, variant), 1


def _of_supports(projector: Projector, laws: list[SensorLaw]) -> Iterator[tuple[Candidate, int]]:
    """Faults of the channels of supports that are measured twice."""
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
        periodic = part.support[band, support]
        shown = _pack(part.redundancy[band, at] / level, grid.weight)
        yield from _of_rate_offset(projector, laws, at)
        for channel, share, sign in (("displacement", share_d, -1.0), ("velocity", 1 - share_d, 1.0)):
            for law in laws:
                if law.slope().offset:
                    continue
                signal = _factor(law.slope(), 1j * omega) * periodic
                column = projector.pack(-G[:, :, support] * (share * signal)[:, None])
                beside = _pack(sign * signal / level, grid.weight)
                score, amplitude = projector.score(column, (float(beside @ shown), float(beside @ beside)))
                yield _candidate(projector, law, f"{names[support]}.{channel}", score, amplitude, INPUT), 1


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
            yield _candidate(projector, law, place, shown**2 / variance, shown / slope, INPUT), 1


def _of_axles(projector: Projector, law: SensorLaw) -> Iterator[tuple[Candidate, int]]:
    """Both wheels of an axle wrong together, all that is measured of them: nothing redundant but the vehicle."""
    part, grid = projector.problem.part, projector.grid
    system = projector.problem.system
    names = supports(system)
    factor = _factor(law.slope(), 1j * grid.omega[grid.band])
    for location in wheelsets(system):
        at = [names.index(wheel) for wheel in location.split("|")]
        moved = -factor[:, None] * part.support[grid.band][:, at]
        column = projector.pack(np.einsum("fsa,fa->fs", projector.of_support[:, :, at], moved))
        yield _candidate(projector, law, location, *projector.score(column), INPUT), 1


def _of_forces(projector: Projector, laws: list[SensorLaw]) -> Iterator[tuple[Candidate, int]]:
    """Faults of measured forces: the true force is the measured one less what the fault adds."""
    problem, fit, grid = projector.problem, projector.fit, projector.grid
    part, band = problem.part, grid.band
    names = [n for n, s in problem.system.file.inputs.items() if s.kind == "force"]
    plant = fit.forward.plant
    for i, name in enumerate(names):
        if not np.any(part.force[:, i]):
            continue  # zero throughout: nobody measured it
        direction = plant.structure.F[:, i]
        load = np.zeros((part.force_polynomial.shape[0], len(direction)))
        load[0] = -direction
        q = plant.polynomial_response(load)
        steady = plant.polynomial_sensors(q, np.zeros_like(part.support_polynomial))
        spectrum = (grid.monomial_spectra @ steady)[band] * fit.forward.sensor_factor[band]
        of_offset = (projector.factor @ spectrum[:, :, None])[:, :, 0]
        of_gain = -(projector.of_load @ direction) * part.force[band, i, None]
        for law in laws:
            slope = law.slope()
            column = projector.pack(slope.gain * of_gain + slope.offset * of_offset)
            spread = projector.spread(column, fit.forward.inputs_by_force_fault(Term(law, name, law.absent))[band])
            yield _candidate(projector, law, name, *projector.score(column, (spread, 0.0)), FORCE), 1


def _pack(spectrum: ComplexArray, weight: FloatArray) -> FloatArray:
    weighted = spectrum * weight
    return np.concatenate([weighted.real, weighted.imag])
