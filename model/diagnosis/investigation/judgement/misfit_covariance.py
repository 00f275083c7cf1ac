"""Additional uncertainty of values from unexplained residuals: parameters absorb an unknown part of model-form error.

Noise alone gives the covariance (J^T J)^-1.  If the residual is more than noise, three terms are added:

- that covariance by as much as chi-square exceeds its degrees of freedom (Birge 1932);
- the sandwich  (J^T J)^-1 [sum over stretches of the spectrum of g g^T] (J^T J)^-1,  g = J^T r of a stretch, where it
  is larger: errors correlated within a stretch do not average out (White 1980);
- a discrepancy force at every element (Kennedy and O'Hagan 2001): static functions of deflection and rate with random
  amplitudes, whose variance explains their observable part in the residual.
"""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit, information
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.record.spectra import OVERSAMPLING
from sprung.model.diagnosis.screening.score import Projector
from sprung.model.laws import observe
from sprung.model.laws.basis import static_law, trials
from sprung.model.signals import FloatArray

_SEEN = 1e-6  # share of a force's power below which it is not observable beside the fit


def misfit_covariance(problem: Problem, fit: Fit) -> FloatArray:
    """Term that is added to a fit's covariance if its residual is more than noise, (P + p, P + p)."""
    free = len(fit.covariance)
    normal = information(problem, fit)
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-13, hermitian=True) / np.outer(scale, scale)
    chance = max(fit.reduced - 1.0, 0.0) * inverse[:free, :free]
    own = inverse[:free, :free] + chance
    sandwich = inverse @ _of_stretches(fit, problem.rules.report.stretches) @ inverse
    grow = np.sqrt(np.maximum(np.diag(sandwich)[:free] / np.maximum(np.diag(own), 1e-300), 1.0))
    slopes = np.concatenate([np.ones(len(fit.point.theta)), *[term.slopes for term in fit.point.terms]])
    added = own * np.outer(grow, grow) - inverse[:free, :free]
    if not problem.process_noise:  # with process noise, unmeasured forces have absorbed the observable part
        added = added + _of_forces(problem, fit, inverse)[:free, :free]
    return np.asarray(added * np.outer(slopes, slopes))


def _of_stretches(fit: Fit, count: int) -> FloatArray:
    """Sum of the outer products of J^T r of every stretch of the spectrum, (P + p + 2n, P + p + 2n)."""
    bins = fit.whitener.factor.shape[0]
    score = (fit.jacobian * fit.residual[:, None]).reshape(2, bins, -1, fit.jacobian.shape[1]).sum(axis=(0, 2))
    parts = np.array([part.sum(axis=0) for part in np.array_split(score, count)])
    return np.asarray(parts.T @ parts)


def _of_forces(problem: Problem, fit: Fit, inverse: FloatArray) -> FloatArray:
    """Covariance of the values from discrepancy forces of the size of the residual."""
    columns = _forces(problem, fit)
    columns /= np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    along = fit.jacobian.T @ columns
    taken = inverse @ along
    seen = columns.T @ columns - along.T @ taken
    product = columns.T @ fit.residual - taken.T @ (fit.jacobian.T @ fit.residual)
    sizes, basis = np.linalg.eigh(seen)
    good = sizes > _SEEN
    inside = float(np.sum((basis[:, good].T @ product) ** 2 / sizes[good]))
    whole = float(fit.residual @ fit.residual)
    noise = np.sum(good) * (whole - inside) / max(1, fit.count - fit.jacobian.shape[1] - np.sum(good))
    power = max(inside - noise, 0.0) / max(float(np.sum(sizes[good])), 1e-300)
    return np.asarray(power * taken @ taken.T)


def _forces(problem: Problem, fit: Fit) -> FloatArray:
    """Whitened sensor responses to discrepancy forces at every element, (R, m)."""
    projector, system = Projector(problem, fit), problem.system
    found = []
    for index, name in enumerate(system.elements):
        port = np.eye(len(system.elements))[index]
        d, v = (motion @ port for motion in fit.element_motion)
        element, thin = fit.forward.element_at(name), slice(None, None, OVERSAMPLING)
        seen = observe(d[thin], v[thin], 1 / projector.grid.step, float(element.stiffness), float(element.damping))
        values = np.array(static_law(trials()["map"], seen).values(d, v))
        found += [projector.seen_of(port, force) for force in projector.grid.compared_forces(values)]
    return np.column_stack(found)
