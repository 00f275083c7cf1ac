"""Diagnosis of a recording: baseline, set-up and input faults, then finding after finding, and the verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import refreshed, settled
from sprung.model.diagnosis.fit.misfit import misfit
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.investigation.configuration.effects import SENSOR_POSITION, Hypothesis
from sprung.model.diagnosis.investigation.configuration.fitted import FittedSetup
from sprung.model.diagnosis.investigation.configuration.search import without_setup_faults
from sprung.model.diagnosis.investigation.judgement.judgement import (
    another_structure,
    held_out_runs,
    judged,
    unmeasured_share,
)
from sprung.model.diagnosis.investigation.judgement.misfit_covariance import misfit_covariance
from sprung.model.diagnosis.investigation.judgement.significance import (
    exceeds_noise,
    shared_gain_covariance,
    without_insignificant,
    without_refuted,
)
from sprung.model.diagnosis.investigation.measurements.clock_drift import without_clock_drift
from sprung.model.diagnosis.investigation.measurements.common_delay import common_delay
from sprung.model.diagnosis.investigation.measurements.contradicted import (
    is_compared,
    screened_anew,
    without_contradicted,
    without_misplaced,
)
from sprung.model.diagnosis.investigation.measurements.excess_noise import noise_faults
from sprung.model.diagnosis.investigation.measurements.floor import leaves_more_than_noise
from sprung.model.diagnosis.investigation.measurements.inputs import best_input_fault, compensate, nominal
from sprung.model.diagnosis.investigation.search.along_motion import with_laws_along_motion
from sprung.model.diagnosis.investigation.search.named_laws import with_laws_together, with_named_laws
from sprung.model.diagnosis.investigation.search.next_finding import next_finding
from sprung.model.diagnosis.investigation.search.redundant import without_redundant
from sprung.model.diagnosis.investigation.search.restated import restated
from sprung.model.diagnosis.investigation.search.widened import form_covariance
from sprung.model.diagnosis.investigation.state import (
    HeldOutRuns,
    InputFault,
    Investigation,
    Nominal,
    Options,
    Outcome,
    Progress,
    Recorded,
    share_done,
)
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import Noise, declared_noise, drifting, transform
from sprung.model.diagnosis.record.split import cut
from sprung.model.diagnosis.rules import Rules
from sprung.model.diagnosis.selection.holdout import HeldOut
from sprung.model.diagnosis.selection.plausible import out_of_range
from sprung.model.system import System
from sprung.model.work import WorkBudget


def investigate(system: System, record: Recorded, options: Options, progress: Progress) -> Outcome:
    """Baseline, then findings until the residual is noise.

    Errors: `DiagnosisError` when the recording cannot be used at all.
    """
    state = with_findings(begun(system, record, options, progress), progress)
    together = common_delay(state)
    if together is not None:
        again = begun(system, record, options, progress, together)
        state = with_findings(again, progress) if again.setup_faults else state
    return concluded(state, progress)


def with_findings(state: Investigation, progress: Progress) -> Investigation:
    """Findings until the residual is noise: several laws of one element first, or one by one where more is left."""
    if not any(fault.value is not None for fault in state.setup_faults):
        several = _with_several(state, progress)
        if several is not None:
            return several
    return _one_by_one(state, progress)


def _with_several(state: Investigation, progress: Progress) -> Investigation | None:
    """Findings that begin with several laws of one element at once; None if more than noise is left, or there are none.

    It has work of its own: what it takes, the search one by one does not lack.
    """
    work = state.problem.work
    own = None if work is None else work.portion(state.options.rules.selection.together)
    several = with_laws_along_motion(replace(state, problem=replace(state.problem, work=own)), progress)
    if several is None:
        return None
    several = _one_by_one(several, progress)
    if leaves_more_than_noise(several) or exceeds_noise(several):
        return None
    return replace(several, problem=replace(several.problem, work=work))


def _one_by_one(state: Investigation, progress: Progress) -> Investigation:
    """Findings one after the other, until the residual is noise."""
    state = without_misplaced(state if state.only else without_clock_drift(state) or state)
    notes, most = state.notes, 0 if _is_uncertain(state) else state.options.rules.acceptance.findings
    for number in range(len(state.found), most):
        rest = None if state.only else without_contradicted(state)
        if rest is not None:
            return _beside_contradicted(state, rest, progress)
        before = state
        state = next_finding(state, number, progress)
        if state.problem.work is not None and state.problem.worked_out:
            progress(0.92, f"the search ends at its {state.problem.work.limit}: no further candidate is fitted")
        if state.calibrations and not before.calibrations:  # the search restarts with them in the model
            return with_findings(replace(state, notes=notes), progress)
        if len(state.found) == len(before.found):
            return with_laws_together(state, lambda plain: _one_by_one(plain, progress))
        state = with_named_laws(before, state, lambda plain: _one_by_one(plain, progress), progress)
        state = restated(without_redundant(state))
        if _still_rejected(state, before.fit) or another_structure(state):
            break  # further findings would only imitate another structure
        if common_delay(state) is not None:
            break  # it is corrected before anything else is sought
    return state


def _is_uncertain(state: Investigation) -> bool:
    """Whether an estimated delay, scale or position remains, whose residual is not searched for unmodelled dynamics."""
    estimated = [fault for fault in state.setup_faults if fault.value is not None]
    return any(fault.effect is not SENSOR_POSITION or is_compared(state, fault) for fault in estimated)


def _beside_contradicted(state: Investigation, rest: Investigation, progress: Progress) -> Investigation:
    """Findings beside a contradicted sensor: a fault of it if that leaves nothing unexplained; else without it.

    Of several faults of one sensor, one takes up what another lacks, and so do springs and dampers.  rest: the
    investigation without the sensor.
    """
    sensor = rest.contradictions[-1].location
    progress(share_done(len(state.found)), f"the other sensors contradict {sensor}")
    own = replace(_one_by_one(replace(state, only=sensor), progress), only="")
    alone = len(own.found) <= len(state.found) + 1 and _explains(own, sensor, progress)
    return own if alone else _one_by_one(screened_anew(rest, state), progress)


def _explains(own: Investigation, sensor: str, progress: Progress) -> bool:
    """Whether the faults of a contradicted sensor leave nothing to be found, nor noise that its peers do not have."""
    i = own.signals.sensor_names.index(sensor)
    ratio = own.problem.noise.sensors / own.declared.sensors
    noisy = ratio[i] > own.options.rules.verdict.slack * max(1.0, float(np.median(ratio)))
    if noisy or leaves_more_than_noise(own):
        return False
    further = next_finding(own, len(own.found), progress)
    return len(further.found) == len(own.found) and further.calibrations == own.calibrations


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


def concluded(state: Investigation, progress: Progress) -> Outcome:
    """The model on the whole recording, its errors on the held-out part, and the verdict."""
    work = state.problem.work
    ended = work.limit if work is not None and work.ended else ""  # the conclusion has no limit of work
    if ended:  # values and noise levels of the last finding may not have been fitted to the end
        problem, fit = refreshed(replace(state.problem, work=None), state.fit)
        state = replace(state, problem=problem, fit=fit, held=replace(state.held, noise=problem.noise))
    state = replace(state, fit=settled(replace(state.problem, work=None), state.fit))
    state = without_insignificant(state)
    progress(0.93, "the model on the whole recording")
    final = _on_whole_recording(state)
    # what an unconverged fit still promised to fall bounds how far its values may yet move: by its last step s,
    # s_i^2 <= (s^T C^-1 s) C_ii (Cauchy and Schwarz), of the covariance C that noise alone gives
    moving = 0.0 if final.converged else final.left
    added = form_covariance(state) + shared_gain_covariance(state)
    final = replace(final, covariance=(1 + moving) * final.covariance + added)
    fewer = without_refuted(state, final)
    if fewer is not None:
        return concluded(fewer, progress)
    runs = _held_out(state, final)
    if exceeds_noise(state) or np.any(runs.errors.unexplained(state.options.rules.verdict) > 0):
        wider = misfit_covariance(state.problem, state.fit)
        final = replace(final, covariance=final.covariance + wider)
        # masses and instruments that are off by less than their stated deviations are no faults either
        stated = (1 + moving) * state.fit.covariance + added + wider
        state = replace(state, fit=replace(state.fit, covariance=stated))
    return Outcome(state, final, runs, judged(state, runs, ended))


def _held_out(state: Investigation, final: Fit) -> HeldOutRuns:
    """The held-out part without and with the findings, at the values of the fitted part.

    At those of the whole recording where they are as likely by the fitted part, and leave no more than noise: it did
    not determine them, as a sweep's does that has not reached a resonance yet.
    """
    before, after = state.held.runs(state.base.point, state.fit.point)
    noisy, rules = noise_faults(state, before, after), state.options.rules.verdict
    runs = held_out_runs(state, before, after, noisy)
    if not np.any(runs.errors.unexplained(rules) > 0) or not _as_likely(state.fit, final, rules.spread):
        return runs
    other = held_out_runs(state, before, state.held.run(final.point), noisy)
    return runs if np.any(other.errors.unexplained(rules) > 0) else other


def _as_likely(fit: Fit, other: Fit, spread: float) -> bool:
    """Whether all values of another fit are within so many standard deviations of those of a fit."""
    moved = [np.subtract(b.parameters, a.parameters) for a, b in zip(fit.point.terms, other.point.terms, strict=True)]
    away = np.concatenate([other.point.theta - fit.point.theta, *moved])
    return bool(np.all(np.abs(away) <= spread * np.sqrt(np.diag(fit.covariance)[: len(away)])))


def under(state: Investigation, rules: Rules) -> Investigation:
    """A begun investigation that continues under other rules."""
    return replace(
        state,
        options=replace(state.options, rules=rules),
        problem=replace(state.problem, rules=rules),
        held=replace(state.held, rules=rules),
    )


def begun(
    system: System, record: Recorded, options: Options, progress: Progress, suspected: Hypothesis | None = None
) -> Investigation:
    """The nominal structure on the recording, with faulty inputs compensated, and its held-out part.

    suspected: a fault of the set-up that is tried before all others.
    """
    progress(0.02, "channels and noise")
    options = replace(options, work=options.work or WorkBudget(options.rules.fit.work))
    prepared = prepare(
        system, system.undistorted(record.values, filtered=True), record.sample_rate, options.rules.record
    )
    signals, split = cut(prepared.signals, options.rules.record)
    declared = declared_noise(system, signals, options.rules)
    progress(0.05, "nominal structure identified again; screening all laws at all places")
    start = nominal(system, signals, declared, split, options)
    progress(0.15, "set-up: signs, channels, nodes, scales, positions")
    as_recorded = FittedSetup(system, signals, split, declared, start.problem, start.fit)
    corrected, setup = without_setup_faults(as_recorded, suspected)
    if setup:
        system, signals, split = corrected.system, corrected.signals, corrected.split
        start = nominal(system, signals, declared, split, options)
    progress(0.2, "input channels")
    faults: tuple[InputFault, ...] = ()
    doubts: tuple[str, ...] = ()
    if not any(fault.value is not None for fault in setup):
        start, faults, doubts = _without_input_faults(system, options, declared, start, progress)
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
    system: System, options: Options, declared: Noise, start: Nominal, progress: Progress
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
        progress(0.25, f"input channel {candidate.location}")
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
    part = transform(state.signals, state.problem.noise, state.options.rules.record, differentiated=differentiated)
    problem = replace(state.problem, part=part, work=None)
    fit = try_optimise(problem, state.held.run(state.fit.point).point, 4)
    most = state.options.rules.acceptance.diverged * state.fit.reduced
    return settled(problem, fit) if fit is not None and fit.reduced < most else state.fit
