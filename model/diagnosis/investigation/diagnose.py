"""Where a simulation departs from a recording, what was left out, the model with it, and how much better it fits."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import refreshed, settled
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.fit.work import WorkBudget
from sprung.model.diagnosis.investigation.by_names import by_names
from sprung.model.diagnosis.investigation.calibration import calibrated, freed, of_others, within_sheet
from sprung.model.diagnosis.investigation.doubt import by_what_is_left
from sprung.model.diagnosis.investigation.excess_noise import noise_faults
from sprung.model.diagnosis.investigation.formula import formula_of, left
from sprung.model.diagnosis.investigation.formula_doubt import missing
from sprung.model.diagnosis.investigation.idle import without_idle
from sprung.model.diagnosis.investigation.inputs import best_input_fault, compensate, nominal
from sprung.model.diagnosis.investigation.judgement import (
    another_structure,
    is_part,
    judged,
    leaves_more_than_noise,
    unmeasured_share,
)
from sprung.model.diagnosis.investigation.setup import fitted_samples, misfit, without_setup_faults
from sprung.model.diagnosis.investigation.standing import by_shared_gain, standing
from sprung.model.diagnosis.investigation.state import (
    Found,
    InputFault,
    Investigation,
    Nominal,
    Options,
    Outcome,
    Progress,
    Recorded,
)
from sprung.model.diagnosis.investigation.surface import with_surface
from sprung.model.diagnosis.investigation.widened import (
    act_together,
    left_open,
    outdoes,
    tried_wider,
    widest,
    with_wider,
    with_wider_rivals,
)
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import Noise, declared_noise, drifting, transform
from sprung.model.diagnosis.record.split import cut
from sprung.model.diagnosis.response.terms import is_waveform
from sprung.model.diagnosis.rules import PlausibleRules, Rules
from sprung.model.diagnosis.screening.families import INPUT
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.diagnosis.selection.compete import Trial, compete, preferred, runner_up, shortlist
from sprung.model.diagnosis.selection.evidence import chance
from sprung.model.diagnosis.selection.holdout import HeldOut
from sprung.model.diagnosis.selection.plausible import doubt, hardly_there, harmonic, out_of_range
from sprung.model.laws import BodyLaw, ElementLaw, Law, StructureLaw
from sprung.model.system import System


def investigate(system: System, record: Recorded, options: Options, tell: Progress) -> Outcome:
    """Baseline, then finding after finding until the rest is noise.

    Errors: `DiagnosisError` when the recording cannot be used at all.
    """
    return concluded(with_findings(begun(system, record, options, tell), tell), tell)


def with_findings(state: Investigation, tell: Progress) -> Investigation:
    """Finding after finding until the rest is noise."""
    # what a delay, scale or position leaves, estimated as it is, is no physics
    uncertain, notes = any(fault.value is not None for fault in state.setup_faults), state.notes
    for number in range(len(state.found), 0 if uncertain else state.options.rules.acceptance.findings):
        before = state
        state = _next_finding(state, number, tell)
        if state.problem.work is not None and state.problem.worked_out:
            tell(0.92, f"the search ends at its {state.problem.work.limit}: no further candidate is fitted")
        if state.calibrations and not before.calibrations:  # everything is sought anew beside them
            return with_findings(replace(state, notes=notes), tell)
        if len(state.found) == len(before.found):
            break
        state = by_names(before, state, lambda plain: with_findings(plain, tell), tell)
        state = without_idle(state)
        if _still_rejected(state, before.fit) or another_structure(state):
            break  # what comes next would be names for what another structure does
    return state


def _still_rejected(state: Investigation, before: Fit) -> bool:
    """Whether the last finding leaves most of what was missing, and a model that does not describe the recording."""
    rules, fit = state.options.rules.verdict, state.fit
    if state.problem.process_noise:
        left = float(np.sum(fit.noise.force**2) / np.sum(before.noise.force**2))
        error = unmeasured_share(fit, fit.noise.force)
    else:
        left = fit.chi_square / before.chi_square
        error = float(np.sqrt(np.mean(misfit(fit))))
    return left > 1 - rules.carried and error > rules.rejected


def concluded(state: Investigation, tell: Progress) -> Outcome:
    """The model on the whole recording, its errors on the held-out part, and the verdict."""
    work = state.problem.work
    ended = work.limit if work is not None and work.ended else ""  # from here on time no longer counts
    state = standing(state)
    tell(0.93, "the model on the whole recording")
    final = _on_everything(state)
    final = replace(final, covariance=final.covariance + left_open(state) + by_shared_gain(state))
    before, after = state.held.runs(state.base.point, state.fit.point)
    noisy = noise_faults(state, before, after)
    said = judged(state, before, after, noisy, ended)
    if np.any(said.errors.unexplained(state.options.rules.verdict) > 0):
        final = replace(final, covariance=final.covariance + by_what_is_left(state.problem, state.fit))
    return Outcome(state, final, before, after, noisy, said)


def under(state: Investigation, rules: Rules) -> Investigation:
    """An investigation that has begun, to go on under other rules."""
    return replace(
        state,
        options=replace(state.options, rules=rules),
        problem=replace(state.problem, rules=rules),
        held=replace(state.held, rules=rules),
    )


def begun(system: System, record: Recorded, options: Options, tell: Progress) -> Investigation:
    """The nominal structure on the recording, with faulty inputs compensated, and its held-out part."""
    tell(0.02, "channels and noise")
    options = replace(options, work=options.work or WorkBudget(options.rules.fit.work))
    prepared = prepare(system, system.undistorted(record.values), record.sample_rate, options.rules.record)
    signals, split = cut(prepared.signals, options.rules.record.fitted)
    declared = declared_noise(system, signals, options.rules.record)
    tell(0.05, "nominal structure identified again; screening all laws at all places")
    start = nominal(system, signals, declared, split, options)
    tell(0.15, "set-up: signs, channels, nodes, scales, positions")
    system, mended, setup = without_setup_faults(system, signals, declared, split, start.problem, start.fit)
    if setup:
        split, signals = fitted_samples(signals, mended, split), mended
        start = nominal(system, signals, declared, split, options)
    tell(0.2, "input channels")
    faults: tuple[InputFault, ...] = ()
    doubts: tuple[str, ...] = ()
    if not any(fault.value is not None for fault in setup):
        start, faults, doubts = _without_input_faults(system, options, declared, start, tell)
    held = HeldOut(system, start.signals, start.problem.noise, split, options.rules)
    still = ("the last part of the recording hardly moves: findings could not be checked on it",) if held.still else ()
    return Investigation(
        system=system,
        options=options,
        prepared=prepared,
        declared=declared,
        signals=start.signals,
        problem=start.problem,
        base=start.fit,
        fit=start.fit,
        held=held,
        first=start.screening,
        last=start.screening,
        input_faults=faults,
        setup_faults=setup,
        notes=(*still, *doubts),
    )


def _without_input_faults(
    system: System, options: Options, declared: Noise, start: Nominal, tell: Progress
) -> tuple[Nominal, tuple[InputFault, ...], tuple[str, ...]]:
    """Faults of input channels come first: everything else is simulated from the inputs.

    With what is not believed of them, in words.
    """
    faults: list[InputFault] = []
    doubts: list[str] = []
    for _ in range(options.rules.acceptance.input_faults):
        candidate = best_input_fault(start.screening, options.rules.acceptance.alpha)
        if candidate is None:
            break
        tell(0.25, f"input channel {candidate.location}")
        fault, signals = compensate(system, start, candidate, declared, options)
        reason = out_of_range(fault.term)
        if reason is not None:
            name = fault.term.law.name.replace("_", " ")
            doubts.append(f"{name} at {fault.term.location} is implausible and not named: {reason}")
            break
        faults.append(fault)
        start = nominal(system, signals, declared, start.split, options)
    return start, tuple(faults), tuple(doubts)


def _on_everything(state: Investigation) -> Fit:
    """The model fitted to the whole recording, once it has been judged; the first part's where that diverges."""
    differentiated = drifting(state.system, state.signals.sensor_index)
    part = transform(state.signals, state.problem.noise, differentiated=differentiated)
    problem = replace(state.problem, part=part, work=None)
    fit = try_optimise(problem, state.held.run(state.fit.point).point, 4)
    most = state.options.rules.acceptance.diverged * state.fit.reduced
    return fit if fit is not None and fit.reduced < most else state.fit


def _next_finding(state: Investigation, number: int, tell: Progress) -> Investigation:
    """Find, fit and accept one more finding; none more when the rest is noise."""
    options = state.options
    plausible = options.rules.plausible
    error = float(np.sqrt(np.mean(misfit(state.fit))))
    gross = not state.problem.process_noise and error > options.rules.selection.gross
    told = of_others(state)
    listed = shortlist(told, options.rules.acceptance.alpha, options.multiplicity, options.rules, gross=gross)
    candidates = _new(state, listed)
    if candidates or act_together(state):
        state = tried_wider(state)
    wide = widest(state)
    promised = max((candidate.score for candidate in candidates), default=0.0)
    if wide is not None and wide.fall > promised and outdoes(state, wide, []):
        return _next_finding(with_wider(state, wide), number, tell)
    if not candidates:
        return state
    share = 0.25 + 0.17 * number
    tried = compete(state.problem, state.fit, candidates, lambda text: tell(share, text))
    tried = with_wider_rivals(state, tried)
    believed = [t for t in tried if doubt(t.fit, t.term, plausible) is None]
    there = [t for t in tried if not hardly_there(t.fit, plausible)]
    worthy = [t for t in there if t.finished and t.evidence > 0 and not _minor(state, t)]
    plain = [t for t in worthy if any(t is one for one in believed)]
    trials = preferred(plain, options.rules.selection)
    trials.sort(key=lambda t: t.candidate.family.rank)  # faults of the inputs first, of forces as of motions
    disbelieved = _disbelieved(worthy, trials, plausible)
    state = replace(state, notes=(*state.notes, *(_words_of(one, plausible) for one in disbelieved)))
    if wide is not None and outdoes(state, wide, trials):
        return _next_finding(with_wider(state, wide), number, tell)
    if not trials:
        return state
    tell(share + 0.08, f"checking {trials[0].term.location}")
    trials, note = _with_formula(state, plain, trials)
    chosen = trials[0]
    if options.held_out and not state.held.still and state.held.compare(state.fit, chosen.fit).refuted:
        return state
    tests = state.last.tried(chosen.candidate.family) if options.multiplicity else 1
    p_value = max(chosen.p_value(tests), min(1.0, chosen.candidate.p_single * tests))
    if p_value > options.rules.acceptance.alpha:
        return state
    if state.calibrations is None and within_sheet(state, chosen.term, instruments=2):
        state = calibrated(state, chosen.term)
        if state.calibrations:
            return state
    second = runner_up(state.problem, state.fit, _new(state, state.last.candidates), chosen, believed)
    problem, fit = refreshed(state.problem, freed(state, chosen.fit if chosen.named else _smoother(state, chosen.fit)))
    state = replace(state, problem=problem, fit=fit)
    trial, fit = _variant(state, chosen, trials)
    if not fit.converged and not problem.process_noise:
        problem, fit = refreshed(problem, settled(problem, fit))
    tell(share + 0.12, "screening what is left")
    return replace(
        state,
        problem=problem,
        fit=fit,
        held=replace(state.held, noise=problem.noise),
        found=(*state.found, Found(trial, tuple(t for t in trials if t is not trial), second, p_value, disbelieved)),
        last=screen(problem, fit, problem.system.catalogue, options.project),
        notes=(*state.notes, *note),
    )


def _new(state: Investigation, candidates: Iterable[Candidate]) -> list[Candidate]:
    """Candidates that may be tried: not of the inputs, not found before, and no harmonics of the excitation."""
    return [
        h
        for h in candidates
        if h.family is not INPUT
        and (state.options.unnamed or h.term.law.named)
        and not _repeats(state, h)
        and not _hopeless(state, h)
        and harmonic(state.problem.part, h.term, state.options.rules.plausible) is None
    ]


def _disbelieved(worthy: list[Trial], believed: list[Trial], rules: PlausibleRules) -> tuple[Trial, ...]:
    """What fits better than every plausible candidate, with values that it cannot have."""
    best = max((trial.evidence for trial in believed), default=-np.inf)
    return tuple(t for t in worthy if t.evidence > best and doubt(t.fit, t.term, rules) is not None)


def _words_of(trial: Trial, rules: PlausibleRules) -> str:
    name, reason = trial.term.law.name.replace("_", " "), doubt(trial.fit, trial.term, rules)
    return f"{name} at {trial.term.location} fits better, but is implausible and not named: {reason}"


def _variant(state: Investigation, chosen: Trial, trials: list[Trial]) -> tuple[Trial, Fit]:
    """The variant of a law once the noise is known: beside a misfit that passed for noise, they looked alike."""
    best = chosen, state.fit
    for rival in trials:
        if rival is not chosen and rival.term.key[:2] == chosen.term.key[:2] and rival.named:
            fit = try_optimise(state.problem, freed(state, rival.fit).point, 6, state.fit.whitener)
            dearer = (rival.gain - rival.evidence) - (best[0].gain - best[0].evidence)
            if fit is not None and best[1].deviance - fit.deviance > dearer:
                best = rival, fit
    return best


def _with_formula(state: Investigation, plain: list[Trial], trials: list[Trial]) -> tuple[list[Trial], tuple[str, ...]]:
    """Trials led by the formula of the force that leads by evidence where that has no name; a note where none is found.

    A named law that was preferred to an unnamed force, or that leaves much of what there was, makes way only for a
    formula that explains more than it does; one that leaves little, but says less than the unnamed force, for a formula
    that is far more likely.
    """
    leader = _led_by(state, plain)
    if leader is None or state.problem.process_noise or not state.options.unnamed:
        return trials, ()
    with np.errstate(all="ignore"):  # trial formulas overflow
        formula, reason = formula_of(state.problem, state.fit, leader, state.held)
    if formula is not None and _makes_way(state, trials[0], formula):
        return [formula, *(trial for trial in trials if trial is not leader or trial.named)], ()
    if formula is not None or trials[0].named:
        return trials, ()
    place = leader.term.location
    return trials, (f"{place}: surface only; {reason}",)


def _makes_way(state: Investigation, leader: Trial, formula: Trial) -> bool:
    """Whether the leader makes way for a formula."""
    rules = state.options.rules.formula
    if not leader.named or formula.explains > rules.beyond * leader.explains:
        return True
    settled = left(state.problem, leader.fit) == 0
    single = formula.term.element_law.strength is not None  # the second of two shapes may be another law's
    return settled and single and formula.evidence > leader.evidence + rules.likelier


def _led_by(state: Investigation, plain: list[Trial]) -> Trial | None:
    """The trial whose force a formula may be of; None: there is none.

    The unnamed one that leads by evidence, or the best force of an element where the leader has a name and leaves much
    (but not the leader itself where nothing of that follows its motion: then it is of another place),
    or says less than that force by more than chance; a named force itself where what it leaves follows its motion.
    """
    leader, rules = plain[0], state.options.rules.formula
    if not leader.named:
        return leader
    forces = [one for one in plain if is_waveform(one.term) and one.term.location in state.system.elements]
    own = any(leader is one for one in forces)
    if left(state.problem, leader.fit) > rules.leaves * left(state.problem, state.fit):
        best = next(iter(forces), None)  # unless what is left has to do with another place
        return None if best is leader and missing(state.problem, leader.fit) <= rules.missing else best
    for force in forces:
        if not force.named and leader.gain < rules.says * force.gain:
            luck = chance(force.gain - leader.gain, max(1, force.freedom - leader.freedom), 1)
            return force if luck < state.options.rules.acceptance.alpha else None
    return leader if own and missing(state.problem, leader.fit) > rules.missing else None


def _smoother(state: Investigation, fit: Fit) -> Fit:
    """The unnamed force of a fit as an estimated surface, if that serves the held-out part better."""
    surface = with_surface(state.problem, fit)
    if surface is None:
        return fit
    return surface if state.held.compare(fit, surface).gain > 0 else fit


def _repeats(state: Investigation, candidate: Candidate) -> bool:
    """The same law at the same place, or physics at a place that is unknown already."""
    for term in state.fit.point.terms:
        if candidate.term.key[:2] == term.key[:2]:
            return True
        if candidate.location == term.location and not term.law.listed:
            return True
    return False


def _hopeless(state: Investigation, candidate: Candidate) -> bool:
    """Whether a candidate beside a finding, where laws follow the sensors' motion, would be minor however well it fits.

    Its score is the fall of chi-square that its first step promises, and so the share of the unmeasured forces.
    """
    if not state.problem.process_noise:
        return False
    beside = [found.trial for found in state.found if found.trial.term.location == candidate.location]
    if beside and not candidate.term.law.named:
        return True
    rules = state.options.rules.acceptance
    left = float(np.sum(state.fit.noise.force**2))
    promised = rules.better_than_promised * left * candidate.score / state.fit.chi_square
    return any(promised < min(rules.minor_beside * trial.worth, rules.most_left * left) for trial in beside)


def _minor(state: Investigation, trial: Trial) -> bool:
    """What a first finding leaves at its own place, when it is little, is its law's inaccuracy and no second law."""
    if _takes_up(state, trial):
        return True
    rules = state.options.rules.acceptance
    even = (found.trial.gain for found in state.found if _of_all_springs(found.trial.term.law))
    if is_part(trial.term.law) and trial.gain < rules.minor_beside * max(even, default=0.0):
        return True  # no material is as even over the frequency as its law
    for index, found in enumerate(state.found):
        if found.trial.term.location != trial.term.location:
            least = rules.minor_followed if state.problem.process_noise else rules.minor_elsewhere
            if trial.gain < least * found.trial.gain:
                return True
        elif not trial.named:
            return True
        elif state.problem.process_noise:
            left = float(np.sum(state.fit.noise.force**2))
            if trial.worth < min(rules.minor_beside * found.trial.worth, rules.most_left * left):
                return True
        elif trial.worth < rules.minor_beside * _worth(state.fit, state.given + index, found.trial.term.law):
            return not _explains_the_rest(state, trial)
    return False


def _of_all_springs(law: Law) -> bool:
    return isinstance(law, StructureLaw) and law.branches is not None


def _explains_the_rest(state: Investigation, trial: Trial) -> bool:
    """Whether a small second law explains most of what is left where that is far more than noise: no inaccuracy."""
    most = trial.worth > state.options.rules.verdict.carried * state.fit.chi_square
    return most and leaves_more_than_noise(state)


def _takes_up(state: Investigation, trial: Trial) -> bool:
    """Whether a part of the bodies that an unlisted force acts on explains less than it: what that force leaves."""
    if not isinstance(trial.term.law, StructureLaw | BodyLaw):
        return False
    parts, elements = set(trial.term.location.split("|")), state.system.file.elements
    unlisted = [found.trial for found in state.found if not found.trial.term.law.listed]
    stronger = [one.term.location for one in unlisted if one.gain > trial.gain and one.term.location in elements]
    return any(parts & {place, elements[place].upper, elements[place].lower} for place in stronger)


def _worth(fit: Fit, index: int, found: Law) -> float:
    """By how much chi-square would rise without a term of a fit, by its strength and that one's deviation (Wald).

    found: its law before it was widened, which may have a strength where the wider one has two.
    """
    term = fit.point.terms[index]
    strength = (found.strength if isinstance(found, ElementLaw) else None) or 0
    if not term.parameters:
        return 0.0
    absent = term.law.absent[strength] if isinstance(term.law, ElementLaw) else 0.0
    size = term.parameters[strength] - (absent if np.isfinite(absent) else 0.0)
    place = fit.place(index).start + strength
    return float(size**2 / max(fit.covariance[place, place], 1e-300))
