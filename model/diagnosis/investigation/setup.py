"""Wrong set-ups: a sign, two channels exchanged, a whole node late, a wrong scale, a sensor elsewhere than stated.

Such a fault is gross and is no physics, but spring and damper values absorb what they can of it and laws imitate the
rest.  So it is sought before any law: every hypothesis is a change of the recorded signals (or of a sensor's position
in the system file) whose misfit against what the nominal structure shows follows from spectra that are known already;
the best few are fitted.  One is accepted when the structure then explains what it did not explain before.

    misfit of a sensor:  sum |Y - P|^2 / sum |Y|^2   over the compared bins, Y measured, P shown by the structure
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import baseline, refreshed
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation.setup_effects import Hypothesis, SetupEffect, SetupPlace, Weighing
from sprung.model.diagnosis.investigation.setup_hypotheses import hypotheses
from sprung.model.diagnosis.investigation.setup_response import ModelResponse, relative
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
from sprung.model.signals import FloatArray
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
    system: System, signals: Signals, declared: Noise, split: int, problem: Problem, fit: Fit
) -> tuple[System, Signals, tuple[SetupFault, ...]]:
    """System and signals with faults of the set-up undone, and which they were."""
    found: list[SetupFault] = []
    if not (np.any(signals.force) or signals.support_names or system.on_track):
        return system, signals, ()  # nothing was measured of what drives it: nothing to hold the sensors against
    present = misfit(fit)
    rules = problem.rules.setup
    while len(found) < rules.most and float(np.max(present)) > rules.misfit:
        best = _best(system, signals, declared, split, problem, fit, present)
        if best is None or _left_beside_a_part(problem, fit, best[0].after) < rules.outdone * best[0].after:
            break
        fault, system, mended, problem, fit = best
        split, signals = fitted_samples(signals, mended, split), mended
        if any(fault.site.location == known.site.location for known in found):
            break
        found.append(fault)
        present = misfit(fit)
    return system, signals, tuple(found)


def _left_beside_a_part(problem: Problem, fit: Fit, rival: float) -> float:
    """Misfit of all sensors beside the best of the parts that a file may lack: then nothing of it is set up wrongly.

    Parts of the structure, and springs and dampers in series: linear as a wrong set-up is, and as gross.
    rival: what the accepted set-up leaves; a part that leaves less is fitted on.
    """
    rules, projector = problem.rules.setup, Projector(problem, fit)
    structures = tuple(law for law in problem.system.catalogue if isinstance(law, StructureLaw) and not law.fault)
    candidates = [candidate for candidate, _ in structure_candidates(projector, structures)]
    best = sorted(candidates, key=lambda candidate: -candidate.score)[: rules.parts]
    starts = [start for candidate in best for start in structure_starts(problem, fit, candidate)]
    fits = [try_optimise(problem, start, rules.part_steps) for start in starts]
    series = tuple(law for law in problem.system.catalogue if isinstance(law, ElementLaw) and law.memory_decay)
    candidates = [candidate for candidate, _ in element_candidates(projector, series) if candidate.term.law in series]
    best = sorted(candidates, key=lambda candidate: -candidate.score)[: rules.parts]
    fits += [trial.fit for trial in compete(problem, fit, best)]
    good = [one for one in fits if one is not None]
    if not good:
        return np.inf
    leading = min(good, key=_left)
    if _left(leading) < rival and not leading.converged:
        leading = try_optimise(problem, leading.point, rules.part_steps) or leading
    return _left(leading)


def _left(fit: Fit) -> float:
    """Misfit of all sensors together."""
    return float(np.sum(misfit(fit)))


def fitted_samples(whole: Signals, cut: Signals, split: int) -> int:
    """How many samples are fitted of signals that lost some at both ends."""
    return split - (whole.samples - cut.samples) // 2


def misfit(fit: Fit) -> FloatArray:
    """Misfit of every sensor, (S,)."""
    part = fit.forward.part
    return relative(fit.spectrum[part.grid.band][1:], part.sensors[part.grid.band][1:])


_Accepted = tuple[SetupFault, System, Signals, Problem, Fit]


def _best(
    system: System,
    signals: Signals,
    declared: Noise,
    split: int,
    problem: Problem,
    fit: Fit,
    present: FloatArray,
) -> _Accepted | None:
    """The hypothesis that explains most, fitted, if one explains enough."""
    rules = problem.rules.setup
    total = float(np.sum(present))
    accepted: list[_Accepted] = []
    sharpened: dict[int, _Accepted] = {}  # by the identity of the accepted one
    for ranked in _ranked(system, signals, problem, fit, total):
        for hypothesis in _seen_on_a_stretch(ranked, system, signals, declared, problem):
            if problem.worked_out:
                return None
            changed, mended = hypothesis.undo(system, signals)
            try:
                fitted = fitted_samples(signals, mended, split)
                other, again = _fitted(changed, mended, declared, fitted, problem)
            except DiagnosisError:
                continue
            left = _left(again)
            if left < rules.explains * total:
                if hypothesis.by_mass:  # told apart from all stiffnesses, which others only bend to their needs
                    fault = _fault(hypothesis, total, left), changed, mended, other, again
                    return _sharpened(fault, declared, fitted)
                accepted.append((_fault(hypothesis, total, left), changed, mended, other, again))
        accepted.sort(key=_after)
        rivals = _rivals(accepted, rules.rivals)
        if all(one[0].effect.ordinary for one in rivals):
            continue  # whichever of them is the best
        for one in rivals:
            if id(one) not in sharpened:
                sharpened[id(one)] = _sharpened(one, declared, fitted_samples(signals, one[2], split))
        best = min((sharpened[id(one)] for one in rivals), key=_after)
        if not best[0].effect.ordinary:
            return best
    return None  # the fault of one sensor: sought with everything else, and judged on the held-out part


def _seen_on_a_stretch(
    ranked: list[Hypothesis], system: System, signals: Signals, declared: Noise, problem: Problem
) -> list[Hypothesis]:
    """Those of many hypotheses that explain enough of a stretch: what is wrong all the time is wrong there, too.

    Where spectra cannot rank signs and exchanges, most are fitted in vain.
    """
    rules, count = problem.rules.setup, problem.part.grid.samples
    if len(ranked) <= rules.tried + rules.beside or count <= rules.stretch:
        return ranked
    first, last = liveliest(signals.sensors[:count], rules.stretch)
    stretch = signals.part(first, last)

    def left(hypothesis: Hypothesis | None) -> float:
        changed, mended = (system, stretch) if hypothesis is None else hypothesis.undo(system, stretch)
        if 2 * mended.samples < stretch.samples:
            return 0.0  # a delay that takes most of it: only the whole recording tells
        try:
            begun = baseline(changed, mended, declared, mended.samples, problem.rules, work=problem.work, roughly=True)
            return _left(begun[1])
        except DiagnosisError:
            return np.inf

    most = rules.on_a_stretch * left(None)
    by_left = [(left(hypothesis), number) for number, hypothesis in enumerate(ranked)]
    good = sorted(one for one in by_left if one[0] < most)[: rules.tried]
    return [ranked[number] for number in sorted(number for _, number in good)]


def _rivals(accepted: list[_Accepted], most: int) -> list[_Accepted]:
    """Those of accepted hypotheses, least misfit first, of which the best is to be found by estimating them again.

    What else the channel of a wrong gain or lag may have is weighed like it: rough values rank these by chance.
    """
    if not accepted or not accepted[0][0].effect.ordinary:
        return accepted[:1]
    first = accepted[0]
    return [one for one in accepted if one[0].site.location == first[0].site.location][:most]


def _after(accepted: _Accepted) -> float:
    return accepted[0].after


def _ranked(system: System, signals: Signals, problem: Problem, fit: Fit, total: float) -> Iterator[list[Hypothesis]]:
    """Hypotheses worth fitting, the most promising first: of channels, then of the system file."""
    rules = problem.rules.setup
    nominal = Forward(system, fit.forward.part, problem.sensors, np.zeros(len(fit.point.theta)))
    promising: dict[tuple[SetupEffect, str, bool], Hypothesis] = {}
    for one in (ModelResponse.of(problem, fit.forward), ModelResponse.of(problem, nominal)):
        whole = one.left(one.shown)
        for hypothesis in hypotheses(one, system, signals, rules):
            key = (hypothesis.effect, hypothesis.site.location, hypothesis.by_mass)
            share = replace(hypothesis, left=hypothesis.left / whole)
            # under a measured force spectra at wrong resonances say nothing of a sign, or which sensor is which
            always = problem.process_noise and hypothesis.unranked
            good = always or hypothesis.by_mass or share.left < rules.promising
            if good and (key not in promising or share.left < promising[key].left):
                promising[key] = share
    by_left = sorted(promising.values(), key=lambda h: h.left)
    forced = [h for h in by_left if h.left >= rules.promising and not h.by_mass]
    forced = forced if len(forced) <= rules.few else []
    ranked = [h for h in by_left if h.by_mass]
    ranked += [h for h in by_left if not h.effect.ordinary and h not in (*forced, *ranked)][: rules.tried] + forced
    if ranked:
        yield ranked + [h for h in by_left if h.effect.ordinary][: rules.beside]
    of_file: dict[tuple[SetupEffect, str, str], Hypothesis] = {}
    for hypothesis in sorted(structure_hypotheses(problem, fit, rules), key=lambda h: h.left):
        if hypothesis.left < rules.promising * total:
            of_file.setdefault((hypothesis.effect, hypothesis.site.location, hypothesis.site.detail), hypothesis)
    yield list(of_file.values())[: rules.tried]


def _fault(hypothesis: Hypothesis, before: float, after: float) -> SetupFault:
    """With a rough deviation of its value: by what is left of the misfit."""
    value = hypothesis.value
    std = 0.0 if value is None else float(abs(value) * np.sqrt(after) / 3)
    return SetupFault(hypothesis.effect, hypothesis.site, value, std, before, after)


def _rough(problem: Problem) -> bool:
    """Whether noise levels may wait until a hypothesis is among the best; beside measured forces the fit needs them."""
    return not problem.process_noise


def _fitted(system: System, signals: Signals, declared: Noise, split: int, like: Problem) -> tuple[Problem, Fit]:
    """Another system or other signals on the terms of a problem, roughly where that will do."""
    return baseline(system, signals, declared, split, like.rules, like.memory, like.work, roughly=_rough(like))


def _sharpened(accepted: _Accepted, declared: Noise, split: int) -> _Accepted:
    """A delay, scale or position estimated again on the structure fitted without it, which had absorbed some of it."""
    fault, system, signals, problem, fit = accepted
    if _rough(problem):
        problem, fit = refreshed(problem, fit)
        fault = replace(fault, after=_left(fit))
        accepted = fault, system, signals, problem, fit
    effect = fault.effect
    if fault.value is None or effect.left is None:
        return accepted
    rules, value, std = problem.rules, fault.value, fault.std
    for _ in range(rules.setup.rounds):
        weighing = Weighing(SetupScores(problem, fit), ModelResponse.of(problem, fit.forward), system)
        found, unit = effect.left(fault.site, weighing)
        change, std = found.amount * unit, found.std * unit
        value = effect.further(value, change)
        system, mended = effect.remainder(fault.site, change)(system, signals)
        split, signals = fitted_samples(signals, mended, split), mended
        problem, fit = baseline(system, signals, declared, split, problem.rules, problem.memory, problem.work)
    std *= value if effect.relative else 1.0
    return replace(fault, value=value, std=std, after=_left(fit)), system, signals, problem, fit
