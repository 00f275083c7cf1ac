"""Configuration faults of a set-up: a sign, exchanged channels, a delayed node, a wrong scale, a wrong position.

Such a fault is large, and springs, dampers and laws partly imitate it.  It is therefore tested before any law: every
hypothesis is a change of the recorded signals (or of a position in the system file), whose misfit to the prediction of
the nominal structure follows from known spectra; the best few are fitted.  A hypothesis is accepted if the structure
then explains what it did not explain before.

    misfit of a sensor:  sum |Y - P|^2 / sum |Y|^2   over the compared bins, Y measured, P predicted by the structure
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import baseline, refreshed
from sprung.model.diagnosis.fit.misfit import misfit, total_misfit
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation import setup_changes as changes
from sprung.model.diagnosis.investigation.setup_effects import (
    SIGN_REVERSED_BY_ONSET,
    CorrectedFit,
    Hypothesis,
    SetupEffect,
    SetupPlace,
)
from sprung.model.diagnosis.investigation.setup_hypotheses import Wiring, hypotheses
from sprung.model.diagnosis.investigation.setup_onset import begins_backwards, driving_point, velocity_of
from sprung.model.diagnosis.investigation.setup_response import Group, ModelResponse
from sprung.model.diagnosis.investigation.setup_scores import SetupScores
from sprung.model.diagnosis.investigation.setup_structure import structure_hypotheses
from sprung.model.diagnosis.record.channels import DiagnosisError
from sprung.model.diagnosis.record.signals import Noise, Signals
from sprung.model.diagnosis.record.stretch import liveliest
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.screening.elements import element_candidates
from sprung.model.diagnosis.screening.score import Projector
from sprung.model.diagnosis.screening.structures import structure_candidates
from sprung.model.diagnosis.selection.compete import compete
from sprung.model.diagnosis.selection.starts import structure_starts
from sprung.model.laws import ElementLaw, StructureLaw
from sprung.model.system import System


@dataclass(frozen=True)
class SetupFault:
    """One accepted fault of the set-up."""

    effect: SetupEffect
    site: SetupPlace
    value: float | None  # time s, ratio, offset m
    std: float
    before: float  # misfit of all sensors without and with it
    after: float


def without_setup_faults(
    system: System,
    signals: Signals,
    declared: Noise,
    split: int,
    problem: Problem,
    fit: Fit,
    suspected: Hypothesis | None = None,
) -> tuple[System, Signals, tuple[SetupFault, ...]]:
    """System and signals corrected for faults of the set-up, and these faults.

    suspected: a hypothesis that is fitted before all others.
    """
    found: list[SetupFault] = []
    if not (np.any(signals.force) or signals.support_names or system.on_track):
        return system, signals, ()  # without measured inputs there is no prediction to compare sensors with
    present = misfit(fit)
    rules = problem.rules.setup
    while len(found) < rules.most and float(np.max(present)) > rules.misfit:
        best, total = None, float(np.sum(np.minimum(present, 1.0)))  # a prediction of nothing leaves 1 of every sensor
        if not found and suspected is not None:
            best = _confirmed(suspected, system, signals, declared, split, problem, total)
        elif not found:
            best = _reversed_by_onset(system, signals, declared, split, problem, fit)
        best = best or _best(system, signals, declared, split, problem, fit, total)
        if best is None or _is_outdone(best.fault, problem, fit):
            break
        system, signals, split, problem, fit = best.system, best.signals, best.split, best.problem, best.fit
        if any(best.fault.site.location == known.site.location for known in found):
            break
        found.append(best.fault)
        present = misfit(fit)
    return system, signals, tuple(found)


def _is_outdone(fault: SetupFault, problem: Problem, fit: Fit) -> bool:
    """Whether a missing part explains the misfit better than a fault of the set-up."""
    if fault.effect.model_free:
        return False
    return _misfit_with_missing_part(problem, fit, fault.after) < problem.rules.setup.outdone * fault.after


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


def fitted_samples(whole: Signals, cut: Signals, split: int) -> int:
    """Number of fitted samples of signals that lost some at both ends."""
    return split - (whole.samples - cut.samples) // 2


@dataclass(frozen=True)
class _FittedFault:
    """A fault of the set-up with the structure fitted beside it."""

    fault: SetupFault
    system: System  # corrected for it
    signals: Signals  # likewise
    split: int  # number of fitted samples
    problem: Problem
    fit: Fit
    by_mass: bool = False  # read from frequencies above all modes


def _best(
    system: System,
    signals: Signals,
    declared: Noise,
    split: int,
    problem: Problem,
    fit: Fit,
    total: float,
) -> _FittedFault | None:
    """The fitted hypothesis that explains most of the misfit `total`, if one explains enough."""
    rules = problem.rules.setup
    accepted: list[_FittedFault] = []
    refined: dict[int, _FittedFault] = {}  # by the identity of the accepted one
    for ranked in _ranked(system, signals, problem, fit, total):
        fitted = _fits(ranked, system, signals, declared, split, problem, total)
        explaining = [one for one in fitted if one.fault.after < rules.explains * total]
        if fitted and not explaining:  # by their values, read beside parameters that had absorbed part of them
            again = (_refined(one, declared) for one in _leading(fitted))
            explaining = [one for one in again if one.fault.after < rules.explains * total]
        if explaining and explaining[0].by_mass:  # independent of stiffnesses, which absorb part of the others
            return _refined(explaining[0], declared)
        accepted = sorted([*accepted, *explaining], key=_after)
        rivals = _rivals(accepted, rules.rivals)
        if all(one.fault.effect.ordinary for one in rivals):
            continue
        for one in rivals:
            if id(one) not in refined:
                refined[id(one)] = _refined(one, declared)
        best = min((refined[id(one)] for one in rivals), key=_after)
        if not best.fault.effect.ordinary:
            return best
    return None  # a fault of one sensor is screened with the laws and validated on the held-out part


def _confirmed(
    suspected: Hypothesis,
    system: System,
    signals: Signals,
    declared: Noise,
    split: int,
    problem: Problem,
    total: float,
) -> _FittedFault | None:
    """A hypothesis fitted and estimated again, if it then explains enough of the misfit `total`."""
    one = _tried(suspected, system, signals, declared, split, problem, total)
    one = None if one is None else _refined(one, declared)
    return one if one is not None and one.fault.after < problem.rules.setup.explains * total else None


def _fits(
    ranked: list[Hypothesis],
    system: System,
    signals: Signals,
    declared: Noise,
    split: int,
    problem: Problem,
    total: float,
) -> list[_FittedFault]:
    """Hypotheses fitted, in their order; the first that explains enough alone if it is read from masses only."""
    rules, found = problem.rules.setup, list[_FittedFault]()
    for hypothesis in _best_on_a_stretch(ranked, system, signals, declared, problem):
        if problem.worked_out:
            return []
        one = _tried(hypothesis, system, signals, declared, split, problem, total)
        if one is not None and one.by_mass and one.fault.after < rules.explains * total:
            return [one]
        found += [one] if one is not None else []
    return found


def _leading(fitted: list[_FittedFault]) -> list[_FittedFault]:
    """Of fitted hypotheses with a value the first, which leads by spectra, and the one that leaves least."""
    valued = [one for one in fitted if one.fault.value is not None and not one.fault.effect.ordinary]
    if not valued:
        return []
    best = min(valued, key=_after)
    return [best] if best is valued[0] else [valued[0], best]


def _reversed_by_onset(
    system: System, signals: Signals, declared: Noise, split: int, problem: Problem, fit: Fit
) -> _FittedFault | None:
    """The force or the sensor beside it turned, where the response begins backwards; whatever else is wrong."""
    beside = driving_point(system.mechanics)
    if problem.worked_out or beside is None or beside not in problem.sensors:
        return None
    i, force, part = list(problem.sensors).index(beside), signals.force_names[0], problem.part
    velocity = velocity_of(part, system.mechanics.sensor_kind[beside], i)
    if not begins_backwards(part.grid.inverse(part.force[:, 0]), velocity, part.grid.compared, problem.rules.setup):
        return None
    wired = Wiring(system, signals)
    turned = [(wired.site(Group(forces=(0,))), changes.turn(forces=[0]))]
    if len(problem.sensors) > 1:  # a single sensor cannot tell which of the two is turned
        turned.append((wired.site(Group((i,))), changes.turn(sensors=[i])))
    fitted, total = [], total_misfit(fit)
    for site, undo in turned:
        _, corrected = undo(system, signals)
        try:
            other, better = _fitted(system, corrected, declared, split, problem)
        except DiagnosisError:
            continue
        place = replace(site, detail=force)
        fault = SetupFault(SIGN_REVERSED_BY_ONSET, place, None, 0.0, total, total_misfit(better))
        fitted.append(_FittedFault(fault, system, corrected, split, other, better))
    return min(fitted, key=_after, default=None)


def _tried(
    hypothesis: Hypothesis,
    system: System,
    signals: Signals,
    declared: Noise,
    split: int,
    problem: Problem,
    total: float,
) -> _FittedFault | None:
    """A hypothesis fitted; None if it diverges, or leaves more of the misfit `total` than spectra promise of any."""
    changed, corrected = hypothesis.undo(system, signals)
    split = fitted_samples(signals, corrected, split)
    try:
        other, fit = _fitted(changed, corrected, declared, split, problem)
    except DiagnosisError:
        return None
    remaining = total_misfit(fit)
    if remaining >= problem.rules.setup.promising * total:
        return None
    fault = _fault(hypothesis, total, remaining)
    return _FittedFault(fault, changed, corrected, split, other, fit, hypothesis.by_mass)


def _best_on_a_stretch(
    ranked: list[Hypothesis], system: System, signals: Signals, declared: Noise, problem: Problem
) -> list[Hypothesis]:
    """The hypotheses that explain enough of the liveliest stretch, where there are many of them.

    Spectra cannot rank all signs and exchanges; fits of a stretch are cheaper than those of the recording.
    """
    rules, count = problem.rules.setup, problem.part.grid.samples
    if len(ranked) <= rules.tried + rules.beside or count <= rules.stretch:
        return ranked
    first, last = liveliest(signals.sensors[:count], rules.stretch, problem.rules.record.shock)
    stretch = signals.part(first, last)

    def misfit_of(hypothesis: Hypothesis | None) -> float:
        changed, corrected = (system, stretch) if hypothesis is None else hypothesis.undo(system, stretch)
        if 2 * corrected.samples < stretch.samples:
            return 0.0  # a delay of most of the stretch: decided on the whole recording
        try:
            begun = baseline(
                changed, corrected, declared, corrected.samples, problem.rules, work=problem.work, roughly=True
            )
            return total_misfit(begun[1])
        except DiagnosisError:
            return np.inf

    most = rules.on_a_stretch * min(misfit_of(None), float(stretch.sensors.shape[1]))
    by_misfit = [(misfit_of(hypothesis), number) for number, hypothesis in enumerate(ranked)]
    good = sorted(one for one in by_misfit if one[0] < most)[: rules.tried]
    return [ranked[number] for number in sorted(number for _, number in good)]


def _rivals(accepted: list[_FittedFault], most: int) -> list[_FittedFault]:
    """Accepted hypotheses, least misfit first, that are compared after a refined estimate.

    Other faults of the channel with the best gain or lag are included: rough values do not rank these reliably.
    """
    if not accepted or not accepted[0].fault.effect.ordinary:
        return accepted[:1]
    first = accepted[0]
    return [one for one in accepted if one.fault.site.location == first.fault.site.location][:most]


def _after(accepted: _FittedFault) -> float:
    return accepted.fault.after


def _ranked(system: System, signals: Signals, problem: Problem, fit: Fit, total: float) -> Iterator[list[Hypothesis]]:
    """Hypotheses to be fitted, the most promising first: of channels, then of the system file."""
    rules = problem.rules.setup
    ranking = _promising(system, signals, problem, fit)
    unranked = [h for h in ranking if h.unranked and not h.by_mass] if problem.process_noise else []
    unranked = unranked if len(unranked) <= rules.few else []
    ranked = [h for h in ranking if h.by_mass]
    ranked += [h for h in ranking if not h.effect.ordinary and h not in (*unranked, *ranked)][: rules.tried] + unranked
    if ranked:
        yield ranked + [h for h in ranking if h.effect.ordinary][: rules.beside]
    yield _promising_of_file(problem, fit, total)


def _promising(system: System, signals: Signals, problem: Problem, fit: Fit) -> list[Hypothesis]:
    """Faults of channels that may explain the misfit, by what they leave of it, with the fit or nominal parameters."""
    rules = problem.rules.setup
    nominal = Forward(system, fit.forward.part, problem.sensors, np.zeros(len(fit.point.theta)))
    promising: dict[tuple[SetupEffect, str, bool], Hypothesis] = {}
    for one in (ModelResponse.of(problem, fit.forward), ModelResponse.of(problem, nominal)):
        whole = one.misfit(one.predicted)
        for hypothesis in hypotheses(one, system, signals, rules):
            key = (hypothesis.effect, hypothesis.site.location, hypothesis.by_mass)
            share = replace(hypothesis, misfit=hypothesis.misfit / whole)
            # under a measured force, spectra at wrong resonances determine neither signs nor exchanges
            always = hypothesis.by_mass or (problem.process_noise and hypothesis.unranked)
            better = key not in promising or share.misfit < promising[key].misfit
            if better and (always or share.misfit < rules.promising):
                promising[key] = share
    return sorted(promising.values(), key=lambda h: h.misfit)


def _promising_of_file(problem: Problem, fit: Fit, total: float) -> list[Hypothesis]:
    """Faults of the system file that may explain the misfit, the best of each place."""
    rules = problem.rules.setup
    best: dict[tuple[SetupEffect, str, str], Hypothesis] = {}
    for hypothesis in sorted(structure_hypotheses(problem, fit, rules), key=lambda h: h.misfit):
        if hypothesis.misfit < rules.promising * total:
            best.setdefault((hypothesis.effect, hypothesis.site.location, hypothesis.site.detail), hypothesis)
    return list(best.values())[: rules.tried]


def _fault(hypothesis: Hypothesis, before: float, after: float) -> SetupFault:
    """With a rough standard deviation of its value from the remaining misfit."""
    value = hypothesis.value
    std = 0.0 if value is None else float(abs(value) * np.sqrt(after) / 3)
    return SetupFault(hypothesis.effect, hypothesis.site, value, std, before, after)


def _rough(problem: Problem) -> bool:
    """Whether noise levels are estimated for the best hypotheses only; with measured forces every fit needs them."""
    return not problem.process_noise


def _fitted(system: System, signals: Signals, declared: Noise, split: int, like: Problem) -> tuple[Problem, Fit]:
    """Another system or other signals fitted with the settings of a problem, roughly where that suffices."""
    return baseline(system, signals, declared, split, like.rules, like.memory, like.work, roughly=_rough(like))


def _refined(accepted: _FittedFault, declared: Noise) -> _FittedFault:
    """A delay, scale or position refined on the structure fitted without it, which had absorbed part of it."""
    if _rough(accepted.problem):
        problem, fit = refreshed(accepted.problem, accepted.fit)
        fault = replace(accepted.fault, after=total_misfit(fit))
        accepted = replace(accepted, fault=fault, problem=problem, fit=fit)
    effect, value, std = accepted.fault.effect, accepted.fault.value, accepted.fault.std
    if value is None or effect.remaining is None:
        return accepted
    for _ in range(accepted.problem.rules.setup.rounds):
        system, problem = accepted.system, accepted.problem
        weighing = CorrectedFit(
            SetupScores(problem, accepted.fit), ModelResponse.of(problem, accepted.fit.forward), system
        )
        found, unit = effect.remaining(accepted.fault.site, weighing)
        change, std = found.amount * unit, found.std * unit
        value = effect.further(value, change)
        system, signals = effect.remainder(accepted.fault.site, change)(system, accepted.signals)
        split = fitted_samples(accepted.signals, signals, accepted.split)
        problem, fit = baseline(system, signals, declared, split, problem.rules, problem.memory, problem.work)
        accepted = _FittedFault(accepted.fault, system, signals, split, problem, fit)
    std *= value if effect.relative else 1.0
    return replace(accepted, fault=replace(accepted.fault, value=value, std=std, after=total_misfit(accepted.fit)))
