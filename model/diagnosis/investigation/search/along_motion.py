"""All laws of one element together, from its force along the measured motion.

Beside a model that lacks several laws of an element, each of them is sought along a motion that the others would
change: a search one by one is slow there, and takes values on that the others keep it from leaving.  With an unmeasured
force on every body the smoothed motion is the measured one, and what the element's model lacks is a known force along
it.  Its laws are found by regressions (`force.search`) and then simulated together.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import refreshed, settled
from sprung.model.diagnosis.fit.misfit import misfit
from sprung.model.diagnosis.fit.optimise import Fit, falling, try_optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.force.fit import ComponentFit, ComponentTask, NominalValues
from sprung.model.diagnosis.force.motion import ElementMotion
from sprung.model.diagnosis.force.piece import Piece
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.diagnosis.force.search import search
from sprung.model.diagnosis.investigation.search.redundant import fit_without
from sprung.model.diagnosis.investigation.search.widened import with_model
from sprung.model.diagnosis.investigation.state import AcceptedFinding, Investigation, Progress, share_done
from sprung.model.diagnosis.record.white_noise import white_noise
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import WIDER, Term, evaluated_in_time, typical_scales
from sprung.model.diagnosis.screening.families import ELEMENT
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.selection.along_measured import ForceAlongMotion, MeasuredMotion, force_along_motion
from sprung.model.diagnosis.selection.compete import Trial, cost, gain_over
from sprung.model.diagnosis.selection.evidence import chance, profile_gain
from sprung.model.diagnosis.selection.plausible import doubt, hardly_there
from sprung.model.laws import ElementLaw, Law, SpringDamper, observe
from sprung.model.laws.along import force_along
from sprung.model.system import System

_STEPS, _ROUNDS = 12, 3  # of the simulation of all laws, and how often it goes on
_LEAST = 1e-3  # of nominal, of a spring or damper that a force seems not to have
_TURNED = 2  # of the same model with its laws in another order


def with_laws_along_motion(state: Investigation, progress: Progress) -> Investigation | None:
    """The investigation with several laws of one element as findings; None where these are no plausible ones.

    Only where the model is far from the recording, and before anything was found.
    """
    place = _place(state)
    if state.found or state.problem.process_noise or place is None or not _lacks_several(state, place):
        return None
    progress(share_done(0), f"the force of {place} along the measured motion")
    fits = _sets_of_laws(state, place)
    if not fits:
        return None
    closest = min(fits, key=lambda fit: fit.chi_square)
    wrong = _doubted(state, closest)
    if wrong:  # its force is close to the true one, which plausible laws have to make
        progress(share_done(0), f"the force of {place} along the simulated motion")
        fits += _sets_beside(state, place, closest, wrong)
    plausible = [fit for fit in fits if not _doubted(state, fit)]
    best = min(plausible, key=lambda fit: fit.chi_square, default=None)
    return None if best is None else _accepted(state, best, plausible)


def law_along_motion(state: Investigation) -> Candidate | None:
    """The law that alone makes the force of the most suspicious element along the measured motion, to be fitted from
    there; None where it takes several laws, or its simulation diverges.

    None for a law with a corner, too, which begins blunt (`selection.along_measured`).

    For a model that is far from the recording: a law that yields permanently then hardly shows along the model's own
    motion, and no step from a small share of it leads to its values.  Nor do scores compare elements with bodies there:
    a suspended mass imitates the resonance that a yielding storey has moved.
    """
    best = _most_suspicious(state, [one for one in state.last.candidates if one.location in state.system.elements])
    measured = None if best is None else _measured(state, best.location)
    if best is None or measured is None:
        return None
    along, force, task = measured
    found = search(task, _pieces(state.problem.system), lags=()).final
    terms = list(_terms(found, best.location, force))
    if len(found.model.pieces) != 1 or len(terms) != 1 or terms[0].law.corner is not None:
        return None
    start = _start(state, best.location, found, force, along)
    fit = _simulated(state, replace(start, terms=tuple(_narrow(state.problem.system, term) for term in start.terms)))
    return None if fit is None else Candidate(fit.point.terms[-1], best.score, ELEMENT, start=fit.point)


def _accepted(state: Investigation, best: Fit, sets: list[Fit]) -> Investigation | None:
    """The investigation with a set of laws as findings; None if one may be chance, or the held-out part refutes it."""
    problem, fit = refreshed(state.problem, best)
    fit = _narrowed(problem, settled(problem, fit), state.given)
    found = _findings(state, fit.point, best, sets)
    if found is None:
        return None
    other = replace(with_model(replace(state, problem=problem), fit), found=found)
    return None if state.refutes(other.fit) else other


def _place(state: Investigation) -> str | None:
    """The element with the most suspicious law in time; None where a part or a body is more suspicious."""
    best = _most_suspicious(state, state.last.candidates)
    return best.location if best is not None and best.location in state.system.elements else None


def _most_suspicious(state: Investigation, candidates: Iterable[Candidate]) -> Candidate | None:
    rules = state.options.rules.screening
    return max((one for one in candidates if one.score > 0), key=lambda one: one.strength(rules), default=None)


def _measured(state: Investigation, place: str) -> tuple[Fit, ForceAlongMotion, ComponentTask] | None:
    """The model along the measured motion, and the force of an element there, also as a task; None if it diverges."""
    measured = MeasuredMotion.of(state.problem, state.fit)
    if measured is None:
        return None
    along = MeasuredMotion(*refreshed(measured.problem, measured.fit))
    force = along.force_of(place)
    return along.fit, force, _task(state, place, force, along.fit)


def _lacks_several(state: Investigation, place: str) -> bool:
    """Whether an element's model is far from the recording, and a force without a name promises more than any law."""
    rules = state.options.rules.selection
    here = [one for one in state.last.candidates if one.location == place]
    named = max((one.score for one in here if one.term.law.named), default=0.0)
    unnamed = max((one.score for one in here if not one.term.law.named), default=0.0)
    error = float(np.sqrt(np.mean(misfit(state.fit))))
    return error > rules.several * rules.gross and unnamed > rules.unnamed_ratio * named


def _sets_of_laws(state: Investigation, place: str) -> list[Fit]:
    """Sets of laws of an element, as simulated: the likeliest, and if that is no good, likely ones without one of it.

    Regressions prefer one set to another by little where the smoothed motion is not exactly the measured one, and the
    simulations of both by far.  None where a single law makes the force: it competes with those of other places
    (`next_finding`).
    """
    measured = _measured(state, place)
    if measured is None:
        return []
    (along, force, task), pieces = measured, _pieces(state.problem.system)
    rules = state.options.rules.selection
    first = search(task, pieces, lags=())
    names = dict.fromkeys(piece.effect for piece in first.final.model.pieces)
    if len(names) < 2:
        return []
    fit = _simulated(state, _start(state, place, first.final, force, along))
    if fit is not None and fit.chi_square < rules.fine * state.fit.chi_square and not _doubted(state, fit):
        return [fit]
    most = rules.alike * first.final.error
    others = (search(task, tuple(p for p in pieces if p.effect != name), lags=()) for name in names)
    starts = [
        _start(state, place, other.final, force, along)
        for other in others
        if len(other.steps) > 1 and other.final.error <= most
    ]
    return [one for one in (fit, *(_simulated(state, start) for start in starts)) if one is not None]


def _sets_beside(state: Investigation, place: str, simulated: Fit, wrong: set[str]) -> list[Fit]:
    """A set of laws that makes the force of a simulated model without some of its laws, as simulated."""
    force = force_along_motion(simulated, place)
    pieces = tuple(piece for piece in _pieces(state.problem.system) if piece.effect not in wrong)
    found = search(_task(state, place, force, simulated), pieces, lags=())
    fit = _simulated(state, _start(state, place, found.final, force, simulated)) if found.steps else None
    return [] if fit is None else [fit]


def _task(state: Investigation, place: str, force: ForceAlongMotion, along: Fit) -> ComponentTask:
    """The force of an element along a motion, as that of a component test."""
    rules = state.options.rules
    noise = white_noise(force.force, rules.white_noise)
    return ComponentTask(
        motion=ElementMotion.of(force.time, force.deflection, force.rate, 0.0, 0.0),
        force=force.force,
        split=int(rules.record.fitted * len(force.force)),
        nominal=_held(state.problem.system, place, along),
        # thinned out, the motion does not resolve the knees of valves
        rules=replace(rules.component, search=len(force.force)),
        noise=noise,
        least_noise=noise,  # along a smoothed motion, what laws leave shows no noise of the force
    )


def _start(state: Investigation, place: str, found: ComponentFit, force: ForceAlongMotion, along: Fit) -> Point:
    """The model with the laws, spring and damper that were found in a force."""
    theta = along.point.theta.copy()
    for index, parameter in enumerate(state.problem.system.parameters):
        if parameter.element == place:
            value = max(float(getattr(found.element, parameter.quantity)), _LEAST * parameter.nominal)
            theta[index] = np.log(value / parameter.nominal)
    terms = (*along.point.terms[: state.given], *_terms(found, place, force))
    return _started(state, Point(theta, terms, np.zeros_like(state.fit.point.state)), along)


def _held(system: System, place: str, fit: Fit) -> NominalValues:
    """Spring and damper of an element that are not estimated."""
    free = {parameter.quantity for parameter in system.parameters if parameter.element == place}
    element = fit.forward.element_at(place)
    k, c = (None if q in free else float(getattr(element, q)) for q in ("stiffness", "damping"))
    return NominalValues(k, c)


def _pieces(system: System) -> tuple[Piece, ...]:
    """Pieces of the laws that are sought in systems of bodies, in time."""
    sought = [
        law for law in system.catalogue if isinstance(law, ElementLaw) and law.screened and law.where == "element"
    ]
    known: list[Law] = [*sought, *(law.wider for law in sought if law.wider is not None)]
    return tuple(p for p in PIECES if p.acting is None and p.law.in_time and not p.law.nuisance and p.law in known)


def _terms(fit: ComponentFit, place: str, along: ForceAlongMotion) -> Iterator[Term]:
    """Terms of the laws of a fit."""
    element = fit.element
    seen = observe(along.deflection, along.rate, 1 / fit.task.motion.step, element.stiffness, element.damping)
    for index, piece in enumerate(fit.model.pieces):
        if not isinstance(piece, Piece):
            continue
        law = piece.law
        assert isinstance(law, ElementLaw)  # of `_pieces`
        values = law.clip([value for value, _ in fit.values(index).values()])
        scales = typical_scales(law, seen)
        yield Term(law, place, tuple(values.tolist()), "" if law.screened else WIDER, scales=scales)


def _started(state: Investigation, point: Point, along: Fit) -> Point:
    """A point with the forces of its laws along a motion as the start of their simulation."""
    grid = along.forward.part.grid
    time, forces = grid.start + grid.fine_time, []
    elements = state.problem.forward(replace(point, terms=along.point.terms[: state.given]))
    for term in point.terms:
        if evaluated_in_time(term):
            d, v = (motion @ term.port(state.problem.system) for motion in along.element_motion)
            element = SpringDamper(*(float(value) for value in elements.element_of(term)))
            forces.append(force_along(term.element_law, term.parameters, d, v, time, element))
    return replace(point, warm_start=tuple(forces))


def _simulated(state: Investigation, start: Point) -> Fit | None:
    """The fit of all laws to the recording; None where it diverges."""
    fit = try_optimise(state.problem, start, _STEPS, state.fit.whitener)
    return None if fit is None else falling(state.problem, fit, _STEPS, _ROUNDS)


def _narrowed(problem: Problem, fit: Fit, given: int) -> Fit:
    """The fit with laws in their narrower forms, where these are likelier: regressions hardly tell which it is."""
    for index in range(given, len(fit.point.terms)):
        term, rules = fit.point.terms[index], problem.rules.evidence
        plain = _narrow(problem.system, term)
        if plain is term:
            continue
        start = replace(fit.point, terms=(*fit.point.terms[:index], plain, *fit.point.terms[index + 1 :]))
        other = try_optimise(problem, start, _STEPS, fit.whitener)
        if other is None:
            continue
        gain, _ = gain_over(problem, other, fit, rules.quiet)
        if gain < cost(fit, rules, index) - cost(other, rules, index):
            fit = other
    return fit


def _narrow(system: System, term: Term) -> Term:
    """A law's narrower form with the same values; the term itself where there is none."""
    narrow = next((law for law in system.catalogue if law.wider is not None and law.wider == term.law), None)
    if narrow is None:
        return term
    count = len(narrow.parameters)
    return Term(narrow, term.location, term.parameters[:count], scales=term.scales[:count])


def _doubted(state: Investigation, fit: Fit) -> set[str]:
    """Names of the laws whose values are implausible, or that are hardly there."""
    rules = state.options.rules.plausible
    new = [(index, fit.point.terms[index]) for index in range(state.given, len(fit.point.terms))]
    return {t.law.name for i, t in new if doubt(fit, t, rules) is not None or hardly_there(fit, rules, i)}


def _findings(state: Investigation, point: Point, best: Fit, sets: list[Fit]) -> tuple[AcceptedFinding, ...] | None:
    """Every law of a model as a finding, by what the model without it leaves; None if one may be chance.

    Gains are those over the noise that was assumed before, as of a first finding.
    """
    fit = try_optimise(state.problem, point, _TURNED, state.fit.whitener)
    if fit is None:
        return None
    whole = replace(state, fit=fit)
    tests = state.last.tried(ELEMENT) if state.options.multiplicity else 1
    found = []
    for index in range(state.given, len(fit.point.terms)):
        trial = _trial(whole, index)
        if trial is None or trial.evidence <= 0:
            return None
        p_value = chance(trial.gain, trial.freedom, tests)
        if p_value > state.options.rules.acceptance.alpha:
            return None
        rivals = [rival for one in sets if (rival := _rival(state, best, one, trial)) is not None]
        runner_up = max(rivals, key=lambda rival: rival.evidence, default=None)
        found.append(AcceptedFinding(trial, (trial, *rivals), runner_up, p_value))
    return tuple(found)


def _trial(whole: Investigation, index: int) -> Trial | None:
    """One law of a model as a trial beside all others; None where the model diverges with its laws in another order."""
    fit, rules = whole.fit, whole.options.rules.evidence
    turned = try_optimise(whole.problem, _with_last(fit.point, index), _TURNED, fit.whitener)
    if turned is None:
        return None
    other = fit_without(whole, index)
    if other is None:  # it diverges: every sample is evidence, of an amount that cannot be stated
        reduction = gain = fit.count * float(np.log(fit.count))
    else:
        gain, reduction = gain_over(whole.problem, other, fit, rules.quiet)
    term = turned.point.terms[-1]
    return Trial(
        Candidate(term, reduction, ELEMENT),
        turned,
        gain,
        reduction,
        gain - cost(turned, rules),
        len(term.parameters),
        compared=other is not None,
    )


def _rival(state: Investigation, best: Fit, other: Fit, trial: Trial) -> Trial | None:
    """The law of another set in the place of one of the best set's, as a trial; None where they differ by more."""
    names = [[term.law.name for term in fit.point.terms] for fit in (best, other)]
    new = [index for index, name in enumerate(names[1]) if name not in names[0]]
    if {*names[0]} - {*names[1]} != {trial.term.law.name} or len(new) != 1:
        return None
    fit = try_optimise(state.problem, _with_last(other.point, new[0]), _TURNED, other.whitener)
    if fit is None:
        return None
    rules, rise = state.options.rules.evidence, other.chi_square - best.chi_square
    behind = profile_gain(other.residual, best.residual, len(state.problem.sensors), rules.quiet, rules)
    candidate = Candidate(fit.point.terms[-1], trial.candidate.score - rise, ELEMENT)
    return replace(
        trial,
        candidate=candidate,
        fit=fit,
        gain=trial.gain - behind,
        reduction=trial.reduction - rise,
        evidence=trial.gain - behind - cost(fit, rules),
        freedom=candidate.freedom,
    )


def _with_last(point: Point, index: int) -> Point:
    """A point with one of its terms moved to the end."""
    order = [*(i for i in range(len(point.terms)) if i != index), index]
    forces = iter(point.warm_start)
    of = [next(forces, None) if evaluated_in_time(term) else None for term in point.terms]
    warm_start = tuple(force for force in (of[i] for i in order) if force is not None)
    return replace(point, terms=tuple(point.terms[i] for i in order), warm_start=warm_start)
