"""Configuration faults of a set-up: a sign, exchanged channels, a delayed node, a wrong scale, a wrong position.

Such a fault is large, and springs, dampers and laws partly imitate it.  It is therefore tested before any law: every
hypothesis is a change of the recorded signals (or of a position in the system file), whose misfit to the prediction of
the nominal structure follows from known spectra; the best few are fitted.  A hypothesis is accepted if the structure
then explains what it did not explain before.

    misfit of a sensor:  sum |Y - P|^2 / sum |Y|^2   over the compared bins, Y measured, P predicted by the structure
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.fit.misfit import total_misfit
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation.configuration import changes
from sprung.model.diagnosis.investigation.configuration.effects import SIGN_REVERSED_BY_ONSET, Hypothesis, SetupEffect
from sprung.model.diagnosis.investigation.configuration.fitted import FittedFault, FittedSetup, SetupFault
from sprung.model.diagnosis.investigation.configuration.hypotheses import Wiring, hypotheses
from sprung.model.diagnosis.investigation.configuration.onset import begins_backwards, driving_point, velocity_of
from sprung.model.diagnosis.investigation.configuration.response import Group, ModelResponse
from sprung.model.diagnosis.investigation.configuration.structure import structure_hypotheses
from sprung.model.diagnosis.record.channels import DiagnosisError
from sprung.model.diagnosis.record.stretch import liveliest
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.screening.elements import element_candidates
from sprung.model.diagnosis.screening.score import Projector
from sprung.model.diagnosis.screening.structures import structure_candidates
from sprung.model.diagnosis.selection.compete import compete
from sprung.model.diagnosis.selection.starts import structure_starts
from sprung.model.laws import ElementLaw, StructureLaw


def without_setup_faults(
    setup: FittedSetup, suspected: Hypothesis | None = None
) -> tuple[FittedSetup, tuple[SetupFault, ...]]:
    """A set-up corrected for faults, and these faults.

    suspected: a hypothesis that is fitted before all others.
    """
    found: list[SetupFault] = []
    if not (np.any(setup.signals.force) or setup.signals.support_names or setup.system.on_track):
        return setup, ()  # without measured inputs there is no prediction to compare sensors with
    rules = setup.rules
    while len(found) < rules.most and not setup.fits:
        best = None
        if not found:
            best = _reversed_by_onset(setup) if suspected is None else _confirmed(suspected, setup)
        best = best or _best(setup)
        if best is None or _is_outdone(best.fault, setup):
            break
        setup = best.setup
        if any(best.fault.site.location == known.site.location for known in found):
            break
        found.append(best.fault)
    return setup, tuple(found)


def _is_outdone(fault: SetupFault, setup: FittedSetup) -> bool:
    """Whether a missing part explains the misfit better than a fault of the set-up."""
    if fault.effect.model_free:
        return False
    return _misfit_with_missing_part(setup.problem, setup.fit, fault.after) < setup.rules.outdone * fault.after


def _misfit_with_missing_part(problem: Problem, fit: Fit, rival: float) -> float:
    """Misfit of all sensors with the best linear part that the file may lack, an alternative to a configuration fault.

    Changes of the structure, and springs and dampers in series.  rival: misfit of the accepted set-up; a part that
    leaves less is fitted to convergence.
    """
    rules, projector = problem.rules.setup, Projector(problem, fit)
    structures = tuple(law for law in problem.system.catalogue if isinstance(law, StructureLaw) and not law.fault)
    candidates = [candidate for candidate, _ in structure_candidates(projector, structures)]
    best = sorted(candidates, key=lambda candidate: -candidate.score)[: rules.parts]
    starts = [start for candidate in best for start in structure_starts(problem, fit, candidate)]
    fits = [try_optimise(problem, start, rules.part_steps) for start in starts]
    series = tuple(law for law in problem.system.catalogue if isinstance(law, ElementLaw) and law.linear)
    candidates = [candidate for candidate, _ in element_candidates(projector, series) if candidate.term.law in series]
    best = sorted(candidates, key=lambda candidate: -candidate.score)[: rules.parts]
    fits += [trial.fit for trial in compete(problem, fit, best)]
    good = [one for one in fits if one is not None]
    if not good:
        return np.inf
    leading = min(good, key=total_misfit)
    if total_misfit(leading) < rival and not leading.converged:
        leading = try_optimise(problem, leading.point, rules.part_steps) or leading
    return total_misfit(leading)


def _best(setup: FittedSetup) -> FittedFault | None:
    """The fitted hypothesis that explains most of the misfit, if one explains enough."""
    rules, enough = setup.rules, setup.rules.explains * setup.misfit
    accepted: list[FittedFault] = []
    refined: dict[int, FittedFault] = {}  # by the identity of the accepted one
    for ranking in (_ranked_channels, _ranked_file):
        fitted = _fits(ranking(setup, accepted[0].after if accepted else np.inf), setup)
        explaining = [one for one in fitted if one.after < enough]
        if fitted and not explaining:  # by their values, read beside parameters that had absorbed part of them
            explaining = [one for one in (leading.refined() for leading in _leading(fitted)) if one.after < enough]
        if explaining and explaining[0].by_mass:  # independent of stiffnesses, which absorb part of the others
            return explaining[0].refined()
        accepted = sorted([*accepted, *explaining], key=_after)
        rivals = _rivals(accepted, rules.rivals)
        if all(one.fault.effect.ordinary for one in rivals):
            if rivals and rivals[0].setup.fits:
                break  # nothing is left that a fault of the system file could explain
            continue
        for one in rivals:
            if id(one) not in refined:
                refined[id(one)] = one.refined()
        best = min((refined[id(one)] for one in rivals), key=_after)
        if not best.fault.effect.ordinary:
            return best
        if best.setup.fits:
            break
    return None  # a fault of one sensor is screened with the laws and validated on the held-out part


def _confirmed(suspected: Hypothesis, setup: FittedSetup) -> FittedFault | None:
    """A hypothesis fitted and estimated again, if it then explains enough of the misfit."""
    one = setup.tried(suspected, setup.misfit)
    one = None if one is None else one.refined()
    return one if one is not None and one.after < setup.rules.explains * setup.misfit else None


def _fits(ranked: list[Hypothesis], setup: FittedSetup) -> list[FittedFault]:
    """Hypotheses fitted, in their order; the first that explains enough alone if it is read from masses only."""
    rules, before, found = setup.rules, setup.misfit, list[FittedFault]()
    for hypothesis in _best_on_a_stretch(ranked, setup):
        if setup.problem.worked_out:
            return []
        one = setup.tried(hypothesis, before)
        if one is not None and one.by_mass and one.after < rules.explains * before:
            return [one]
        found += [one] if one is not None else []
    return found


def _leading(fitted: list[FittedFault]) -> list[FittedFault]:
    """Of fitted hypotheses with a value the first, which leads by spectra, and the one that leaves least."""
    valued = [one for one in fitted if one.fault.value is not None and not one.fault.effect.ordinary]
    if not valued:
        return []
    best = min(valued, key=_after)
    return [best] if best is valued[0] else [valued[0], best]


def _reversed_by_onset(setup: FittedSetup) -> FittedFault | None:
    """The force or the sensor beside it turned, where the response begins backwards; whatever else is wrong."""
    system, signals, problem = setup.system, setup.signals, setup.problem
    beside = driving_point(system.mechanics)
    if problem.worked_out or beside is None or beside not in problem.sensors:
        return None
    i, force, part = list(problem.sensors).index(beside), signals.force_names[0], problem.part
    velocity = velocity_of(part, system.mechanics.sensor_kind[beside], i)
    if not begins_backwards(part.grid.inverse(part.force[:, 0]), velocity, part.grid.compared, setup.rules):
        return None
    wired = Wiring(system, signals)
    turned = [(wired.site(Group(forces=(0,))), changes.turn(forces=[0]))]
    if len(problem.sensors) > 1:  # a single sensor cannot tell which of the two is turned
        turned.append((wired.site(Group((i,))), changes.turn(sensors=[i])))
    fitted = []
    for site, undo in turned:
        try:
            other = setup.changed(undo, roughly=setup.rough)
        except DiagnosisError:
            continue
        place, before, after = replace(site, detail=force), total_misfit(setup.fit), total_misfit(other.fit)
        fitted.append(FittedFault(SetupFault(SIGN_REVERSED_BY_ONSET, place, None, 0.0, before, after), other))
    return min(fitted, key=_after, default=None)


def _best_on_a_stretch(ranked: list[Hypothesis], setup: FittedSetup) -> list[Hypothesis]:
    """The hypotheses that explain enough of the liveliest stretch, where there are many of them.

    Spectra cannot rank all signs and exchanges; fits of a stretch are cheaper than those of the recording.
    """
    rules, signals, problem = setup.rules, setup.signals, setup.problem
    count = problem.part.grid.samples
    if len(ranked) <= rules.tried + rules.beside or count <= rules.stretch:
        return ranked
    first, last = liveliest(signals.sensors[:count], rules.stretch, problem.rules.record.shock)
    stretch = signals.part(first, last)

    def misfit_of(hypothesis: Hypothesis | None) -> float:
        changed, corrected = (setup.system, stretch) if hypothesis is None else hypothesis.undo(setup.system, stretch)
        if 2 * corrected.samples < stretch.samples:
            return 0.0  # a delay of most of the stretch: decided on the whole recording
        try:
            begun = baseline(
                changed, corrected, setup.declared, corrected.samples, problem.rules, work=problem.work, roughly=True
            )
            return total_misfit(begun[1])
        except DiagnosisError:
            return np.inf

    most = rules.on_a_stretch * min(misfit_of(None), float(stretch.sensors.shape[1]))
    by_misfit = [(misfit_of(hypothesis), number) for number, hypothesis in enumerate(ranked)]
    good = sorted(one for one in by_misfit if one[0] < most)[: rules.tried]
    return [ranked[number] for number in sorted(number for _, number in good)]


def _rivals(accepted: list[FittedFault], most: int) -> list[FittedFault]:
    """Accepted hypotheses, least misfit first, that are compared after a refined estimate.

    Other faults of the channel with the best gain or lag are included: rough values do not rank these reliably.
    """
    if not accepted or not accepted[0].fault.effect.ordinary:
        return accepted[:1]
    first = accepted[0]
    return [one for one in accepted if one.fault.site.location == first.fault.site.location][:most]


def _after(accepted: FittedFault) -> float:
    return accepted.after


def _ranked_channels(setup: FittedSetup, _: float) -> list[Hypothesis]:
    """Faults of channels to be fitted, the most promising first."""
    rules = setup.rules
    ranking = _promising(setup)
    unranked = [h for h in ranking if h.unranked and not h.by_mass] if setup.problem.process_noise else []
    unranked = unranked if len(unranked) <= rules.few else []
    ranked = [h for h in ranking if h.by_mass]
    ranked += [h for h in ranking if not h.effect.ordinary and h not in (*unranked, *ranked)][: rules.tried] + unranked
    return ranked + [h for h in ranking if h.effect.ordinary][: rules.beside] if ranked else []


def _promising(setup: FittedSetup) -> list[Hypothesis]:
    """Faults of channels that may explain the misfit, by what they leave of it, with the fit or nominal parameters."""
    problem, fit, rules = setup.problem, setup.fit, setup.rules
    nominal = Forward(setup.system, fit.forward.part, problem.sensors, np.zeros(len(fit.point.theta)))
    promising: dict[tuple[SetupEffect, str, bool], Hypothesis] = {}
    for one in (ModelResponse.of(problem, fit.forward), ModelResponse.of(problem, nominal)):
        whole = one.misfit(one.predicted)
        for hypothesis in hypotheses(one, setup.system, setup.signals, rules):
            key = (hypothesis.effect, hypothesis.site.location, hypothesis.by_mass)
            share = replace(hypothesis, misfit=hypothesis.misfit / whole)
            # under a measured force, spectra at wrong resonances determine neither signs nor exchanges
            always = hypothesis.by_mass or (problem.process_noise and hypothesis.unranked)
            better = key not in promising or share.misfit < promising[key].misfit
            if better and (always or share.misfit < rules.promising):
                promising[key] = share
    return sorted(promising.values(), key=lambda h: h.misfit)


def _ranked_file(setup: FittedSetup, after: float) -> list[Hypothesis]:
    """Faults of the system file to be fitted, the best of each place.

    after: misfit that a fault of a channel leaves; spectra promise a better one to within `explains`.
    """
    rules = setup.rules
    most = min(rules.promising * setup.misfit, after / rules.explains)
    best: dict[tuple[SetupEffect, str, str], Hypothesis] = {}
    for hypothesis in sorted(structure_hypotheses(setup.problem, setup.fit, rules), key=lambda h: h.misfit):
        if hypothesis.misfit < most:
            best.setdefault((hypothesis.effect, hypothesis.site.location, hypothesis.site.detail), hypothesis)
    return list(best.values())[: rules.tried]
