"""Report of a finished investigation: values with units, figures of fit, sentences, arrays for plots."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from sprung.model.diagnosis.investigation.configuration.fitted import SetupFault
from sprung.model.diagnosis.investigation.measurements.calibration import calibration_indices
from sprung.model.diagnosis.investigation.state import Investigation, Outcome, Recorded
from sprung.model.diagnosis.report.advice import LOST_PHASE, nothing_fits, search_ended, undecided
from sprung.model.diagnosis.report.calibration import beyond_tolerance, calibration_of, in_words
from sprung.model.diagnosis.report.findings import clock_in_words, findings_of
from sprung.model.diagnosis.report.plot_data import plot_data_of
from sprung.model.diagnosis.report.report import (
    CandidateRow,
    Finding,
    IdentifiedLaw,
    LawParameter,
    RecordingFacts,
    Report,
    Unexplained,
)
from sprung.model.diagnosis.report.values import deviations, figures, formula_of, law_parameters, reported_parameters


def compose(outcome: Outcome, record: Recorded) -> Report:
    """The report of an investigation."""
    state, before, after = outcome.investigation, outcome.runs.before, outcome.runs.after
    judgement, names = outcome.judgement, state.signals.sensor_names
    findings, calibration = findings_of(outcome), calibration_of(outcome)
    clocks = [clock_in_words(drift) for drift in state.clock_drifts if not drift.beyond(state.options.rules)]
    advice = [*state.prepared.notes, *clocks, *state.notes]
    if judgement.nothing_fits:
        advice.insert(0, nothing_fits(outcome))
    else:
        advice += undecided(state)
        if judgement.lost_phase and not state.held.still:
            advice.insert(0, LOST_PHASE)
    if judgement.ended:
        advice.insert(0, search_ended(judgement.ended))
    rules = state.options.rules.verdict
    explained = judgement.reported.explained(rules) if state.found else None
    left = judgement.reported.unexplained(rules)
    per_sensor = {} if judgement.lost_phase else dict(zip(names, left.tolist(), strict=True))
    unexplained = Unexplained(float(np.mean(left)), per_sensor, judgement.where)
    return Report(
        system=state.system.name,
        recording=RecordingFacts(
            state.options.file,
            len(record.values) / record.sample_rate,
            len(record.values),
            int(record.lost),
            state.prepared.used,
        ),
        verdict=judgement.verdict,
        baseline=reported_parameters(state.system, state.base),
        baseline_validation=figures(names, before.per_sensor),
        findings=tuple(findings),
        augmented=reported_parameters(state.system, outcome.final, _reported(outcome)),
        augmented_validation=figures(names, after.per_sensor),
        noise_floor=figures(names, judgement.errors.floor),
        localization=state.first.localization(),
        candidates=_candidates(state),
        changes=_changes(outcome),
        explained=explained,
        unexplained=unexplained,
        laws=_laws(outcome, calibration),
        calibration=calibration,
        noise=_noise(state),
        summary=_summary(
            outcome, findings, explained, in_words(calibration, state.system.catalogue, beyond_tolerance(outcome))
        ),
        advice=tuple(advice),
        plot_data=plot_data_of(state, before, after, judgement.floor, [(f.location, f.effect) for f in findings]),
    )


def _reported(outcome: Outcome) -> int:
    """How many of the final model's first laws are reported; the others are not believed."""
    state = outcome.investigation
    return state.given + (len(state.found) if outcome.judgement.carried else 0)


def _laws(outcome: Outcome, calibration: tuple[IdentifiedLaw, ...]) -> tuple[IdentifiedLaw, ...]:
    """Named laws of the final model: those of the file, then those that were found.

    Corrected positions of elements are included.
    """
    reported = {(one.location, one.effect) for one in calibration}
    fit, state = outcome.final, outcome.investigation
    found = []
    for index, term in enumerate(fit.point.terms[: _reported(outcome)]):
        moot = index in calibration_indices(state) and (term.location, term.law.name) not in reported
        everywhere = term.law.branches is not None  # cannot be expressed in a system file
        if term.law.named and not moot and not everywhere:
            values, texts = law_parameters(fit, index, state.options.rules.plausible), formula_of(term)
            found.append(IdentifiedLaw(term.location, term.law.name, values, term.variant, *texts))
    for fault in state.input_faults:
        spec, value = fault.term.law.parameters[0], fault.term.parameters[0]
        parameter = LawParameter(spec.name, value, fault.std, spec.unit)
        found.append(IdentifiedLaw(fault.term.location, fault.term.law.name, (parameter,)))
    return (*found, *places_put_right(state.setup_faults))


def places_put_right(faults: Iterable[SetupFault]) -> Iterator[IdentifiedLaw]:
    """Corrected positions of elements, as laws for the system file."""
    for fault in faults:
        law, at = fault.effect.law, fault.site
        if law is not None and fault.value is not None:
            offset = LawParameter(law.names[0], fault.value, fault.std, law.parameters[0].unit)
            yield IdentifiedLaw(at.location, law.name, (offset,), law.variants[at.axis])


def _noise(state: Investigation) -> dict[str, float]:
    """Estimated standard deviation of one sample of every channel."""
    system, noise = state.system, state.problem.noise
    levels: dict[str, float] = {}
    support = force = 0
    for name, source in system.file.inputs.items():
        if source.kind == "force":
            levels[name] = float(noise.force[force])
            force += 1
            continue
        levels[f"{name}.displacement"] = float(noise.displacement[support])
        levels[f"{name}.velocity"] = float(noise.velocity[support])
        support += 1
    present = [system.sensors[i] for i in state.problem.sensors]
    levels |= dict(zip(present, noise.sensors.tolist(), strict=True))
    known = {channel.name for channel in system.channels}
    return {name: level for name, level in levels.items() if name in known and np.isfinite(level)}


def _changes(outcome: Outcome) -> tuple[str, ...]:
    """Parameters whose estimates differ from nominal, in words."""
    state, final = outcome.investigation, outcome.final
    rules = state.options.rules.report
    sigma, theta = deviations(state.system, final, _reported(outcome)), final.point.theta
    words = []
    order = sorted(range(len(theta)), key=lambda i: -abs(theta[i]))
    for i in order:
        if abs(theta[i]) > np.log1p(rules.changed) and abs(theta[i]) > rules.sure * sigma[i]:
            change = 100 * (np.exp(theta[i]) - 1)
            words.append(f"{state.system.parameters[i].name} is {change:+.0f} % from nominal")
    return tuple(words)


def _candidates(state: Investigation) -> tuple[CandidateRow, ...]:
    rows: dict[tuple[str, str], CandidateRow] = {}
    for step, found in enumerate(state.found, 1):
        for trial in [found.trial, *found.trials, *([found.runner_up] if found.runner_up else [])]:
            key = (trial.term.location, trial.term.law.name)
            if key not in rows:
                p = state.first.p_value(trial.candidate)
                rows[key] = CandidateRow(*key, trial.candidate.score, p, trial.delta_bic(), step)
    for candidate in state.first.candidates:
        if len(rows) >= 20:
            break
        rows.setdefault(
            (candidate.location, candidate.effect),
            CandidateRow(candidate.location, candidate.effect, candidate.score, state.first.p_value(candidate)),
        )
    return tuple(sorted(rows.values(), key=_step_and_evidence)[:20])


def _step_and_evidence(row: CandidateRow) -> tuple[float, float]:
    """What is fitted first, step by step; what was not compared leads its step."""
    evidence = -np.inf if row.delta_bic is None else row.delta_bic
    return (np.inf, 0.0) if row.step is None else (row.step, evidence)


def _summary(outcome: Outcome, findings: list[Finding], explained: float | None, calibration: str) -> str:
    judgement = outcome.judgement
    beside = f"; {calibration}" if calibration and not judgement.rejected else ""
    if judgement.verdict == "consistent":
        return f"The nominal structure explains the recording down to the noise{beside}."
    where = f": {judgement.where}" if judgement.where else ""
    text = "; ".join(f.sentence for f in findings) or f"Nothing in the system file fits this recording{where}"
    if judgement.carried and not judgement.rejected and explained is not None and explained > 0:
        share = "100" if not judgement.where else f"{min(100 * explained, 99):.0f}"
        text += f"; explains {share} % of the excess error"
        if judgement.where:
            text += f"; still unexplained: {judgement.where}"
    if judgement.ended:
        text += f"; the search ended at its {judgement.ended}"
    return f"{text}{beside}."
