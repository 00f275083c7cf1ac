"""The force of an unknown law as a smooth surface over deflection and rate, put into the simulation and refitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.screening.score import Projector
from sprung.model.laws.spline import LatentForce, Surface, estimate_force
from sprung.model.signals import FloatArray

_ROUNDS = 2  # of estimate and refit: the surface is estimated along the motion that it shapes itself


def with_surface(problem: Problem, fit: Fit) -> Fit | None:
    """A fit whose last term is an unnamed force, with an estimated surface in its place; None where that diverges."""
    current: Fit | None = fit
    for _ in range(_ROUNDS):
        if current is None:
            break
        latent = _estimate(problem, current)
        term = Term(latent.law(), current.point.terms[-1].location, (1.0,), scales=(1.0,))
        point = replace(current.point, terms=(*current.point.terms[:-1], term))
        current = try_optimise(problem, point, 6, fit.whitener)
    return current


def _estimate(problem: Problem, fit: Fit) -> LatentForce:
    """The surface that the residual without the last term asks for."""
    projector = Projector(problem, fit)
    grid, term = projector.grid, fit.point.terms[-1]
    element = problem.system.elements.index(term.location)
    d, v = (motion[:, element] for motion in fit.element_motion)
    present = fit.force_along(term)

    def respond(forces: FloatArray) -> FloatArray:
        spectra = grid.coarse_forces(forces)[grid.band]  # (F, m)
        answers = [projector.pack(projector.of_force[:, :, element] * column[:, None]) for column in spectra.T]
        return np.stack(answers, axis=1)

    own = np.zeros(fit.jacobian.shape[1], dtype=bool)
    own[fit.place(len(fit.point.terms) - 1)] = True
    residual = fit.residual + respond(present[:, None])[:, 0]
    return estimate_force(Surface.over(d, v), (d, v), respond, residual, fit.jacobian[:, ~own])
