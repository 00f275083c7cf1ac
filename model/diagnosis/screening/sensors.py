"""Faults of measurements as candidates, distinguished from physics by redundancy and by causality.

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

from sprung.model.diagnosis.response.terms import Term, supports
from sprung.model.diagnosis.screening.families import FORCE, INPUT, SENSOR
from sprung.model.diagnosis.screening.places import wheelsets
from sprung.model.diagnosis.screening.score import Candidate, Projector
from sprung.model.diagnosis.screening.supports import fault_candidate, fault_factor, support_candidates
from sprung.model.laws import Law, SensorLaw
from sprung.model.laws.base import Channels


def measurement_candidates(projector: Projector, laws: tuple[Law, ...]) -> Iterator[tuple[Candidate, int]]:
    """Every fault of a measurement at every sensor and input channel that may have it."""
    faults = [law for law in laws if isinstance(law, SensorLaw) and law.response is not None and not law.filters]

    def at(channel: Channels) -> list[SensorLaw]:
        return [law for law in faults if channel in law.at]

    yield from _of_sensors(projector, at("sensor"))
    yield from support_candidates(projector, at("support"))
    for law in faults:
        if law.where == "axle":
            yield from _of_axles(projector, law)
    yield from _of_forces(projector, at("force"))


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
            factor = fault_factor(slope, jw)
            if problem.part.differentiated[i] and not np.any(factor):
                continue  # a position that is compared by its rate shows no bias
            signal = factor * truth[:, i] + slope.offset * constant
            column = projector.pack(projector.factor[:, :, i] * signal[:, None])
            determinant = projector.spread(column, own[i] * factor[:, None, None])
            score, amplitude = projector.score(column, (determinant, 0.0))
            for variant, form in [*law.forms.items(), ("", law)]:  # alike to first order
                yield fault_candidate(projector, form, name, score, amplitude, SENSOR, variant), 1


def _of_axles(projector: Projector, law: SensorLaw) -> Iterator[tuple[Candidate, int]]:
    """Both wheels of an axle wrong together, all that is measured of them: nothing redundant but the vehicle."""
    problem, grid = projector.problem, projector.grid
    system, part = problem.system, problem.driving(projector.fit.forward)
    names = supports(system)
    factor = fault_factor(law.slope(), 1j * grid.omega[grid.band])
    for location in wheelsets(system):
        at = [names.index(wheel) for wheel in location.split("|")]
        moved = -factor[:, None] * part.support[grid.band][:, at]
        column = projector.pack(np.einsum("fsa,fa->fs", projector.of_support[:, :, at], moved))
        yield fault_candidate(projector, law, location, *projector.score(column), INPUT), 1


def _of_forces(projector: Projector, laws: list[SensorLaw]) -> Iterator[tuple[Candidate, int]]:
    """Faults of measured forces: the true force is the measured one less what the fault adds."""
    problem, fit, grid = projector.problem, projector.fit, projector.grid
    part, band = problem.part, grid.band
    names = [n for n, s in problem.system.file.inputs.items() if s.kind == "force"]
    plant = fit.forward.plant
    pushed = problem.driving(fit.forward)
    for i, name in enumerate(names):
        if not np.any(part.force[:, i]):
            continue  # zero throughout: it was not measured
        direction = plant.structure.F[:, i]
        load = np.zeros((part.force_polynomial.shape[0], len(direction)))
        load[0] = -direction
        q = plant.polynomial_response(load)
        steady = plant.polynomial_sensors(q, np.zeros_like(part.support_polynomial))
        spectrum = (grid.monomial_spectra @ steady)[band] * fit.forward.sensor_factor[band]
        of_offset = (projector.factor @ spectrum[:, :, None])[:, :, 0]
        of_gain = -(projector.of_load @ direction) * pushed.force[band, i, None]
        for law in laws:
            slope = law.slope()
            column = projector.pack(slope.gain * of_gain + slope.offset * of_offset)
            spread = projector.spread(column, fit.forward.inputs_by_force_fault(Term(law, name, law.absent))[band])
            yield fault_candidate(projector, law, name, *projector.score(column, (spread, 0.0)), FORCE), 1
