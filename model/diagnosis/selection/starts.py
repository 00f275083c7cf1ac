"""Initial values of candidates: as screened, after a joint linear step of all parameters, and at look-alikes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.jacobian import linearise
from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.fit.smoothing import opened
from sprung.model.diagnosis.record.spectra import OVERSAMPLING
from sprung.model.diagnosis.response.forward import response_of
from sprung.model.diagnosis.response.point import Point, advance, fixed
from sprung.model.diagnosis.response.terms import WIDER, Term, branches_of, evaluated_in_time, typical_scales
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.laws import ElementLaw, Observed, SpringDamper, StructureLaw, observe
from sprung.model.laws.base import FittedElement, Restart


def starts_of(problem: Problem, base: Fit, candidate: Candidate) -> list[Point]:
    """Initial values of a candidate beside the present model, the most promising first."""
    if candidate.start is not None:
        return [candidate.start]
    if isinstance(candidate.term.law, StructureLaw):
        return structure_starts(problem, base, candidate)
    starts = [joint_start(problem, base, candidate), *_further_starts(problem, base, candidate)]
    if _far_from_nominal(problem, base):  # parameters have absorbed a gross law
        if candidate.term.law.strengths:
            starts.append(joint_start(problem, base, candidate, nominal=True))
        elif candidate.term.law.filters:
            start = start_of(base, candidate)
            starts.append(replace(start, theta=np.zeros_like(start.theta)))
    return starts


def _far_from_nominal(problem: Problem, base: Fit) -> bool:
    """Whether any parameter is far off nominal."""
    far: float = np.max(np.abs(base.point.theta), initial=0.0)
    return far > problem.rules.selection.far


def start_of(base: Fit, candidate: Candidate) -> Point:
    """The present model with the candidate's term added; other values are left to the first Gauss-Newton step."""
    point, structure = base.point, base.forward.plant.structure
    law = candidate.term.law
    state, of_filters = np.split(point.state, [structure.moving])
    if law.adds_motion:  # a degree of freedom, last in q and in q'
        n = len(structure.mass)
        state = np.concatenate([state[:n], [0.0], state[n : 2 * n], [0.0], state[2 * n :]])
    more = branches_of(candidate.term, base.forward.system, structure)
    response = response_of(candidate.term)
    filtered = 0 if response is None else len(candidate.term.places) * sum(one.order for one in response.sections)
    # forces of the branches, and what filters still show of the time before
    state = np.concatenate([state, np.zeros(len(more)), of_filters, np.zeros(filtered)])
    warm_start = point.warm_start
    if evaluated_in_time(candidate.term):
        warm_start = (*warm_start, base.force_along(candidate.term))
    return Point(point.theta, (*point.terms, candidate.term), state, warm_start)


def structure_starts(problem: Problem, base: Fit, candidate: Candidate) -> list[Point]:
    """Initial values of a structural part: as screened, and after a joint step.

    If the present parameters are far off nominal, having absorbed a gross part, also after a step from nominal.
    """
    starts = []
    for nominal in (False, True)[: 2 if _far_from_nominal(problem, base) else 1]:
        start = start_of(base, candidate)
        start = replace(start, theta=np.zeros_like(start.theta)) if nominal else start
        beside = joint_start(problem, base, candidate, nominal)
        starts += [start] if beside.terms[-1] is candidate.term else [start, beside]
    return starts


def _further_starts(problem: Problem, base: Fit, candidate: Candidate) -> list[Point]:
    """Initial values with an element's stiffness or damping other than estimated without the law."""
    law, names = candidate.term.law, [p.name for p in problem.system.parameters]
    at = {quantity: f"{candidate.location}.{quantity}" for quantity in ("stiffness", "damping")}
    if not isinstance(law, ElementLaw) or at["damping"] not in names:
        return []
    start = start_of(base, candidate)
    restarts = () if law.restarts is None else law.restarts(_reading(problem, base, candidate.location))
    if candidate.beyond > 1.0:  # a law proportional to the damper that exceeds it: the damper is stronger
        stronger = problem.rules.selection.stronger
        values = law.scaled(candidate.term.parameters, 1 / stronger)
        restarts += (Restart(1.0, stronger * candidate.beyond, tuple(values)),)
    points = []
    for restart in restarts:
        theta = start.theta.copy()
        for quantity, factor in (("stiffness", restart.stiffness), ("damping", restart.damping)):
            if at[quantity] in names:
                theta[names.index(at[quantity])] += np.log(factor)
        term = candidate.term.at(np.array(restart.parameters))
        points.append(replace(start, theta=theta, terms=(*base.point.terms, term)))
    return points


def _reading(problem: Problem, base: Fit, location: str) -> FittedElement:
    """An element as the present model has it; its damping is estimated."""
    element, read = problem.system.elements.index(location), base.forward.element_at(location)
    nominal = next(p.nominal for p in problem.system.parameters if p.name == f"{location}.damping")
    deflection, rate = (motion[:, element] for motion in base.element_motion)
    k, c, speed = float(read.stiffness), float(read.damping), float(np.std(rate))
    return FittedElement(k, c, nominal, speed / float(np.std(deflection)), speed)


def alike_starts(base: Fit, candidate: Candidate) -> list[Point]:
    """Initial values at other parameters of the same law with a similar force."""
    law = candidate.term.law
    if not isinstance(law, ElementLaw) or law.alike is None:
        return []
    terms = [candidate.term.at(law.clip(list(values))) for values in law.alike(candidate.term.parameters)]
    return [start_of(base, replace(candidate, term=term)) for term in terms]


def joint_start(problem: Problem, base: Fit, candidate: Candidate, nominal: bool = False) -> Point:
    """The term with the strength of a joint linear step of all parameters on the base's residual.

    The step is taken at a fraction of the law's strength with its shape kept, since the other parameters have absorbed
    much of it, and the full law beside them may be too far away for a linear step.  nominal: from nominal parameters.
    """
    if problem.memory is None:
        return _joint_start(problem, base, candidate, nominal)
    term = candidate.term
    key = "start", id(base), nominal, term.key, term.parameters, term.scales, problem.rules.selection.hint
    return problem.memory.recall(key, lambda: _joint_start(problem, base, candidate, nominal))


def _joint_start(problem: Problem, base: Fit, candidate: Candidate, nominal: bool) -> Point:
    start = start_of(base, candidate)
    hint = _hint(candidate.term, problem.rules.selection.hint)
    if hint is None:
        return start
    faint = start_of(base, replace(candidate, term=hint))
    faint = replace(faint, theta=np.zeros_like(faint.theta)) if nominal else faint
    try:
        with np.errstate(all="ignore"):
            faint, working = opened(problem, faint, base.whitener)
            lin = linearise(problem, faint, working)
            finite = np.isfinite(lin.residual).all() and np.isfinite(lin.jacobian).all()
    except np.linalg.LinAlgError:
        return start
    if not finite:
        return start
    count = len(candidate.term.parameters)
    first = lin.jacobian.shape[1] - len(faint.state) - count
    kept = np.ones(lin.jacobian.shape[1], dtype=bool)
    kept[first : first + count] = np.isin(np.arange(count), candidate.term.law.strengths)
    held = fixed(faint)
    kept[: len(held)] &= ~held
    columns = lin.jacobian[:, kept]
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    step = np.zeros(lin.jacobian.shape[1])
    step[kept] = np.linalg.lstsq(columns / scale, lin.residual, rcond=1e-10)[0] / scale
    moved = advance(faint, step)
    if not np.all(np.isfinite(step)) or _void(moved.terms[-1]):
        return start
    return moved


def _hint(term: Term, share: float) -> Term | None:
    """A term at a share of its strength; None if its law has no strength."""
    return term.at(term.law.scaled(term.parameters, share)) if term.law.strengths else None


def _void(term: Term) -> bool:
    """Whether a joint step has driven a law to a bound; of structural parts: in all their strengths."""
    if isinstance(term.law, StructureLaw):
        return not any(term.parameters[i] for i in term.law.strengths)
    return term.bounded


def wider_starts(base: Fit, index: int) -> Iterator[Point]:
    """Starts of the wider form of a term: from values of the element's other laws, and the law's own starts."""
    term = base.point.terms[index]
    law = term.law
    wider = law.wider
    if wider is None or wider.widened is None:
        return
    motion = seen(base, term)
    scales = typical_scales(wider, motion)
    known: dict[str, float] = {}
    for other in base.point.terms:
        if other.location == term.location and other is not term:
            known |= zip(other.law.names, other.parameters, strict=True)
    further = wider.names[len(term.parameters) :]
    starts = [(*term.parameters, *(known[name] for name in further))] if known.keys() >= {*further} else []
    for values in (*starts, *wider.widened(term.parameters, motion)):
        clipped = tuple(float(value) for value in wider.clip(values))
        moved = replace(term, law=wider, parameters=clipped, scales=scales, variant=WIDER, fixed=())
        terms = (*base.point.terms[:index], moved, *base.point.terms[index + 1 :])
        yield replace(base.point, terms=terms)


def seen(base: Fit, term: Term, element: SpringDamper | None = None) -> Observed:
    """The motion of a term's element; beside the spring and damper of the fit, or others."""
    port, thin = term.port(base.forward.system), slice(None, None, OVERSAMPLING)
    d, v = (motion[thin] @ port for motion in base.element_motion)
    element = base.forward.element_of(term) if element is None else element
    return observe(d, v, 1 / base.forward.part.grid.step, float(element.stiffness), float(element.damping))
