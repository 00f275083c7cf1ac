"""Reasons to reject a formula that fits: uncertain values, an equally good rival, or a remaining dependence on motion.

Forces are compared along the motion of the fit, spring and damper of the element included, relative to the rms of the
formula's part that no spring and damper can imitate: two formulas that differ by a spring are equivalent.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation.formula.shapes import FormulaSearch, without_last_term
from sprung.model.diagnosis.record.spectra import OVERSAMPLING
from sprung.model.diagnosis.screening.score import Projector
from sprung.model.diagnosis.selection.compete import Trial
from sprung.model.laws.along import force_along
from sprung.model.signals import FloatArray

_STEP = 1e-4  # of a parameter's scale, for derivatives


def doubt_of(problem: Problem, trial: Trial, trials: Sequence[Trial]) -> str:
    """Reason to reject a formula, in words; empty if there is none.  trials: all formulas that were fitted."""
    rules = problem.rules.formula
    size = nonlinear_rms(trial.fit)
    if uncertainty(problem, trial.fit) > rules.agree * size:
        return "the values of the best formula leave its force uncertain"
    for rival in trials:
        equivalent = rival is not trial and rival.finished and rival.evidence > trial.evidence - rules.rival
        if equivalent and np.std(whole_force(trial.fit) - whole_force(rival.fit, trial.fit)) > rules.agree * size:
            own, other = trial.term.element_law.formula, rival.term.element_law.formula
            return f"{own} and {other} explain as much and differ in the range of the motion"
    if missing(problem, trial.fit) > rules.missing:
        return "the residual of the best formula depends on the element's motion"
    return ""


def whole_force(fit: Fit, motion: Fit | None = None) -> FloatArray:
    """Force of spring, damper and the last term of a fit along its motion, or another fit's, (N,)."""
    term = fit.point.terms[-1]
    element, forward = fit.forward.element_of(term), (motion or fit).forward
    port = term.port(forward.system)
    d, v = (part @ port for part in (motion or fit).element_motion)
    grid = forward.part.grid
    force = force_along(term.element_law, term.parameters, d, v, grid.start + grid.fine_time, element)
    return np.asarray((element.stiffness * d + element.damping * v + force)[::OVERSAMPLING])


def nonlinear_rms(fit: Fit) -> float:
    """rms of the part of the last term's force that spring and damper cannot imitate, N."""
    term = fit.point.terms[-1]
    port = term.port(fit.forward.system)
    d, v = ((part @ port)[::OVERSAMPLING] for part in fit.element_motion)
    force = fit.force_along(term)[::OVERSAMPLING]
    columns = np.column_stack([d, v, np.ones_like(d)])
    columns /= np.linalg.norm(columns, axis=0)
    return float(np.std(force - columns @ np.linalg.lstsq(columns, force, rcond=None)[0]))


def uncertainty(problem: Problem, fit: Fit) -> float:
    """Standard deviation of the whole force along the motion, rms over it, N."""
    term, names = fit.point.terms[-1], [(p.element, p.quantity) for p in problem.system.parameters]
    element, port = fit.forward.element_of(term), term.port(problem.system)
    grid, (d, v) = fit.forward.part.grid, (part @ port for part in fit.element_motion)
    columns, at = [], []
    for quantity, change in (("stiffness", element.stiffness * d), ("damping", element.damping * v)):
        if (term.location, quantity) in names:
            columns.append(change)
            at.append(names.index((term.location, quantity)))
    place = fit.place(len(fit.point.terms) - 1)
    for index, scale in enumerate(term.scales):
        spec = term.law.parameters[index]
        step = _STEP if spec.log else _STEP * max(scale, abs(term.parameters[index]))
        up, down = (
            force_along(term.element_law, term.moved(index, s).parameters, d, v, grid.start + grid.fine_time, element)
            for s in (step, -step)
        )
        columns.append((up - down) / (2 * step) / (1.0 if not spec.log else term.parameters[index]))
        at.append(place.start + index)
    J = np.column_stack(columns)[::OVERSAMPLING]
    J = J - J.mean(axis=0)
    covariance = fit.covariance[np.ix_(at, at)]
    return float(np.sqrt(max(np.einsum("ti,ij,tj->", J, covariance, J) / len(J), 0.0)))


def missing(problem: Problem, fit: Fit) -> float:
    """Significant rest of the residual along the element's motion, relative to the formula; 0: noise.

    The rest is the score of the best shape of the grammar beside the formula.
    """
    most = FormulaSearch.beside(problem, fit).most()
    if most < problem.rules.formula.chance * min(fit.reduced, 1.0):
        return 0.0
    before = Projector(problem, without_last_term(problem, fit)).residual
    return float(np.sqrt(most / max(float(before @ before) - fit.chi_square, 1e-300)))
