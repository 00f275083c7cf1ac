"""Diagnosis of a recording: baseline, set-up and input faults, then finding after finding, and the verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import refreshed, settled
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.fit.work import WorkBudget
from sprung.model.diagnosis.investigation.calibration import (
    calibrated,
    with_free_gains,
    within_data_sheet,
    without_calibrations,
)
from sprung.model.diagnosis.investigation.excess_noise import noise_faults
from sprung.model.diagnosis.investigation.formula_trial import with_formula
from sprung.model.diagnosis.investigation.inputs import best_input_fault, compensate, nominal
from sprung.model.diagnosis.investigation.judgement import (
    another_structure,
    judged,
    unmeasured_share,
)
from sprung.model.diagnosis.investigation.minor import is_minor, untried
from sprung.model.diagnosis.investigation.misfit_covariance import misfit_covariance
from sprung.model.diagnosis.investigation.named_laws import with_named_laws
from sprung.model.diagnosis.investigation.redundant import without_redundant
from sprung.model.diagnosis.investigation.setup import fitted_samples, misfit, without_setup_faults
from sprung.model.diagnosis.investigation.significance import shared_gain_covariance, without_insignificant
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
    adopt_wider,
    best_wider,
    form_covariance,
    is_better,
    share_an_element,
    with_wider_rivals,
    with_wider_tried,
)
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import Noise, declared_noise, drifting, transform
from sprung.model.diagnosis.record.split import cut
from sprung.model.diagnosis.rules import Rules
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.diagnosis.selection.compete import Trial, compete, preferred, runner_up, shortlist
from sprung.model.diagnosis.selection.holdout import HeldOut
from sprung.model.diagnosis.selection.plausible import doubt, hardly_there, out_of_range
from sprung.model.system import System


def investigate(system: System, record: Recorded, options: Options, tell: Progress) -> Outcome:
    """Baseline, then findings until the residual is noise.

    Errors: `DiagnosisError` when the recording cannot be used at all.
    """
    return concluded(with_findings(begun(system, record, options, tell), tell), tell)


def with_findings(state: Investigation, tell: Progress) -> Investigation:
    """Findings until the residual is noise."""
    # the residual of an estimated delay, scale or position is not searched for unmodelled dynamics
    uncertain, notes = any(fault.value is not None for fault in state.setup_faults), state.notes
    for number in range(len(state.found), 0 if uncertain else state.options.rules.acceptance.findings):
        before = state
        state = _next_finding(state, number, tell)
        if state.problem.work is not None and state.problem.worked_out:
            tell(0.92, f"the search ends at its {state.problem.work.limit}: no further candidate is fitted")
        if state.calibrations and not before.calibrations:  # the search restarts with them in the model
            return with_findings(replace(state, notes=notes), tell)
        if len(state.found) == len(before.found):
            break
        state = with_named_laws(before, state, lambda plain: with_findings(plain, tell), tell)
        state = without_redundant(state)
        if _still_rejected(state, before.fit) or another_structure(state):
            break  # further findings would only imitate another structure
    return state


def _still_rejected(state: Investigation, before: Fit) -> bool:
    """Whether most of the misfit remains after the last finding, and the model does not describe the recording."""
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
    ended = work.limit if work is not None and work.ended else ""  # the conclusion has no limit of work
    state = without_insignificant(state)
    tell(0.93, "the model on the whole recording")
    final = _on_whole_recording(state)
    final = replace(final, covariance=final.covariance + form_covariance(state) + shared_gain_covariance(state))
    before, after = state.held.runs(state.base.point, state.fit.point)
    noisy = noise_faults(state, before, after)
    said = judged(state, before, after, noisy, ended)
    if np.any(said.errors.unexplained(state.options.rules.verdict) > 0):
        final = replace(final, covariance=final.covariance + misfit_covariance(state.problem, state.fit))
    return Outcome(state, final, before, after, noisy, said)


def under(state: Investigation, rules: Rules) -> Investigation:
    """A begun investigation that continues under other rules."""
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
    system, corrected, setup = without_setup_faults(system, signals, declared, split, start.problem, start.fit)
    if setup:
        split, signals = fitted_samples(signals, corrected, split), corrected
        start = nominal(system, signals, declared, split, options)
    tell(0.2, "input channels")
    faults: tuple[InputFault, ...] = ()
    doubts: tuple[str, ...] = ()
    if not any(fault.value is not None for fault in setup):
        start, faults, doubts = _without_input_faults(system, options, declared, start, tell)
    held = HeldOut(system, start.signals, start.problem.noise, split, options.rules)
    still = ("the last part of the recording hardly moves: findings were not validated on it",) if held.still else ()
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
    """The baseline with faults of input channels compensated, these faults, and notes on implausible ones.

    Input faults come first: everything else is simulated from the inputs.
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


def _on_whole_recording(state: Investigation) -> Fit:
    """The model fitted to the whole recording after its validation; that of the first part if the fit diverges."""
    differentiated = drifting(state.system, state.signals.sensor_index)
    part = transform(state.signals, state.problem.noise, differentiated=differentiated)
    problem = replace(state.problem, part=part, work=None)
    fit = try_optimise(problem, state.held.run(state.fit.point).point, 4)
    most = state.options.rules.acceptance.diverged * state.fit.reduced
    return fit if fit is not None and fit.reduced < most else state.fit


def _next_finding(state: Investigation, number: int, tell: Progress) -> Investigation:
    """Screens, fits and accepts one more finding; the state unchanged when the residual is noise."""
    options = state.options
    plausible = options.rules.plausible
    error = float(np.sqrt(np.mean(misfit(state.fit))))
    gross = not state.problem.process_noise and error > options.rules.selection.gross
    screening = without_calibrations(state)
    listed = shortlist(screening, options.rules.acceptance.alpha, options.multiplicity, options.rules, gross=gross)
    candidates = untried(state, listed)
    if candidates or share_an_element(state):
        state = with_wider_tried(state)
    wide = best_wider(state)
    promised = max((candidate.score for candidate in candidates), default=0.0)
    if wide is not None and wide.fall > promised and is_better(state, wide, []):
        return _next_finding(adopt_wider(state, wide), number, tell)
    if not candidates:
        return state
    share = 0.25 + 0.17 * number
    tried = compete(state.problem, state.fit, candidates, lambda text: tell(share, text))
    tried = with_wider_rivals(state, tried)
    doubts = [(t, doubt(t.fit, t.term, plausible, before=state.fit)) for t in tried]
    believed = [t for t, reason in doubts if reason is None]
    there = [t for t in tried if not hardly_there(t.fit, plausible)]
    worthy = [t for t in there if t.finished and t.evidence > 0 and not is_minor(state, t)]
    plain = [t for t in worthy if any(t is one for one in believed)]
    trials = preferred(plain, options.rules.selection)
    trials.sort(key=lambda t: t.candidate.family.rank)  # faults of the inputs first, of forces as of motions
    best = max((trial.evidence for trial in trials), default=-np.inf)
    better = [(t, reason) for t, reason in doubts if reason and t.evidence > best and any(t is one for one in worthy)]
    state = replace(state, notes=(*state.notes, *(_implausible_note(*one) for one in better)))
    if wide is not None and is_better(state, wide, trials):
        return _next_finding(adopt_wider(state, wide), number, tell)
    if not trials:
        return state
    tell(share + 0.08, f"checking {trials[0].term.location}")
    trials, note = with_formula(state, plain, trials)
    chosen = trials[0]
    if options.held_out and not state.held.still and state.held.compare(state.fit, chosen.fit).refuted:
        return state
    tests = state.last.tried(chosen.candidate.family) if options.multiplicity else 1
    p_value = max(chosen.p_value(tests), min(1.0, chosen.candidate.p_single * tests))
    if p_value > options.rules.acceptance.alpha:
        return state
    if state.calibrations is None and within_data_sheet(state, chosen.term, instruments=2):
        state = calibrated(state, chosen.term)
        if state.calibrations:
            return state
    second = runner_up(state.problem, state.fit, untried(state, state.last.candidates), chosen, believed)
    problem, fit = refreshed(
        state.problem, with_free_gains(state, chosen.fit if chosen.named else _with_surface(state, chosen.fit))
    )
    state = replace(state, problem=problem, fit=fit)
    trial, fit = _variant(state, chosen, trials)
    if not fit.converged and not problem.process_noise:
        problem, fit = refreshed(problem, settled(problem, fit))
    tell(share + 0.12, "screening the residual")
    return replace(
        state,
        problem=problem,
        fit=fit,
        held=replace(state.held, noise=problem.noise),
        found=(
            *state.found,
            Found(trial, tuple(t for t in trials if t is not trial), second, p_value, tuple(t for t, _ in better)),
        ),
        last=screen(problem, fit, problem.system.catalogue, options.project),
        notes=(*state.notes, *note),
    )


def _implausible_note(trial: Trial, reason: str) -> str:
    name = trial.term.law.name.replace("_", " ")
    return f"{name} at {trial.term.location} fits better, but is implausible and not named: {reason}"


def _variant(state: Investigation, chosen: Trial, trials: list[Trial]) -> tuple[Trial, Fit]:
    """The best variant of the chosen law under the noise estimated with it: with more noise they were equivalent."""
    best = chosen, state.fit
    for rival in trials:
        if rival is not chosen and rival.term.key[:2] == chosen.term.key[:2] and rival.named:
            fit = try_optimise(state.problem, with_free_gains(state, rival.fit).point, 6, state.fit.whitener)
            extra_cost = (rival.gain - rival.evidence) - (best[0].gain - best[0].evidence)
            if fit is not None and best[1].deviance - fit.deviance > extra_cost:
                best = rival, fit
    return best


def _with_surface(state: Investigation, fit: Fit) -> Fit:
    """The fit with its unnamed force as an estimated surface, if that predicts the held-out part better."""
    surface = with_surface(state.problem, fit)
    if surface is None:
        return fit
    return surface if state.held.compare(fit, surface).gain > 0 else fit
