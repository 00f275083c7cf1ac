"""Whether a law imitates another force of its element: most of what the findings leave is a force of its motion.

True laws leave noise, and what has nothing to do with their element.  A law that resembles the true one leaves their
difference, which an unnamed force over the element's deflection, rate and memory makes beside it.  Parts of the
structure that were found besides may then make up for that difference, and are no facts either.
"""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.force.motion import ElementMotion
from sprung.model.diagnosis.force.slider_surface import SURFACE
from sprung.model.diagnosis.investigation.judgement.significance import exceeds_noise
from sprung.model.diagnosis.investigation.state import Investigation
from sprung.model.diagnosis.investigation.verdict import HeldOutErrors
from sprung.model.diagnosis.response.terms import Term, evaluated_in_time
from sprung.model.diagnosis.screening.elements import TrialElement
from sprung.model.diagnosis.screening.score import Projector
from sprung.model.signals import FloatArray


def imitated(state: Investigation, errors: HeldOutErrors) -> str:
    """The place of a law that imitates another force; empty if there is none.

    What is left counts if it is a visible share of what the findings explain.  Beside a measured force it is attributed
    to unmeasured ones, and along a motion that repeats one loop any force follows the loop.
    """
    rules = state.options.rules.verdict
    left = float(np.mean(errors.unexplained(rules)))
    excess = float(np.mean(errors.before**2 - errors.bounded(rules) ** 2))
    if state.problem.process_noise or left <= rules.imitated * excess or not exceeds_noise(state):
        return ""
    laws = [term for term in state.fit.point.terms[state.given :] if evaluated_in_time(term) and term.law.listed]
    shares = {term.location: share_of_motion(state.problem, state.fit, term) for term in laws}
    place = max(shares, key=lambda one: shares[one], default="")
    return place if place and shares[place] > 1 - rules.another_force else ""


def share_of_motion(problem: Problem, fit: Fit, term: Term) -> float:
    """Share of a fit's misfit beyond noise that an unnamed force along the motion of a term explains.

    0 along a motion that repeats one loop.
    """
    element = TrialElement.along(Projector(problem, fit), term.location, term.port(problem.system))
    grid, projector = element.projector.grid, element.projector
    motion = ElementMotion.of(grid.start + grid.fine_time, element.deflection, element.rate, 0.0, 0.0)
    if motion.repeats(problem.rules.component):
        return 0.0
    forces: FloatArray = np.ascontiguousarray(SURFACE.columns(motion, ()).T)
    explained, amounts = element.channel.joint(grid.compared_forces(forces))
    noise = fit.count - fit.jacobian.shape[1]
    excess = float(projector.residual @ projector.residual) - noise
    return (explained - len(amounts)) / excess if excess > 0 else 0.0
