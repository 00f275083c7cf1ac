"""Findings of an investigation: laws, unnamed forces, input faults, set-up faults, noise, stuck channels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.investigation.configuration.effects import WRONG_SCALE
from sprung.model.diagnosis.investigation.configuration.fitted import SetupFault
from sprung.model.diagnosis.investigation.measurements.calibration import faulty
from sprung.model.diagnosis.investigation.measurements.data_sheets import within_tolerance
from sprung.model.diagnosis.investigation.state import (
    AcceptedFinding,
    ClockDrift,
    Contradiction,
    InputFault,
    NoiseFault,
    Outcome,
)
from sprung.model.diagnosis.investigation.verdict import kind_of
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.report.report import Finding, LawParameter
from sprung.model.diagnosis.report.sentences import sentence_of
from sprung.model.diagnosis.report.values import formula_of, input_fault_parameter, law_parameters, quoted_values
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import ReportRules, Rules
from sprung.model.diagnosis.selection.compete import unnamed_alike
from sprung.model.laws.basis import UNKNOWN
from sprung.model.laws.sensor_faults import SENSOR_ERROR, SENSOR_NOISE, SENSOR_STUCK
from sprung.model.system import System
from sprung.model.units import confusion

CLOCK_DRIFT = "clock_drift"  # name of the effect


def findings_of(outcome: Outcome) -> list[Finding]:
    """Findings, strongest first: stuck channels, then by the reduction of chi-square."""
    state, judgement = outcome.investigation, outcome.judgement
    if judgement.rejected:
        return [setup_finding(state.system, fault) for fault in state.setup_faults if fault.effect.model_free]
    ranked = [(np.inf, _stuck_finding(name, at)) for name, at in state.prepared.stuck]
    ranked += [(np.inf, _contradiction_finding(fault)) for fault in state.contradictions]
    ranked += [(np.inf, _clock_finding(drift)) for drift in state.clock_drifts if drift.beyond(state.options.rules)]
    ranked += [(np.inf, setup_finding(state.system, f)) for f in state.setup_faults]
    ranked += [
        (f.score, _input_finding(state.system, f)) for f in state.input_faults if not within_tolerance(state, f.term)
    ]
    ranked += [_out_of_order(outcome, index) for index in faulty(state)]
    ranked += [(f.sigmas**2, _noise_finding(f)) for f in outcome.runs.noisy]
    if judgement.carried:
        ranked += [(np.inf if f.delta_bic is None else -f.delta_bic, f) for f in _physics(outcome)]
    ranked.sort(key=lambda pair: -pair[0])
    findings = [finding for _, finding in ranked]
    if judgement.verdict == "unknown_physics" and not any(f.kind is EffectKind.UNLISTED for f in findings):
        findings.insert(len(state.setup_faults), _unknown_finding(outcome))
    return findings


def _unknown_finding(outcome: Outcome) -> Finding:
    """The remaining misfit as an unnamed finding, at the place of the highest score."""
    state, judgement = outcome.investigation, outcome.judgement
    here = [candidate for candidate in state.last.candidates if candidate.location == judgement.place]
    best = max(here, key=lambda candidate: candidate.score, default=None)
    tried, place = "", judgement.imitated.replace("|", " and ")
    if state.found:
        names = " and ".join(f.trial.term.law.name.replace("_", " ") for f in state.found)
        tried = f"; {names} would explain too little of it"
        if judgement.imitated:
            tried = f"; {names} would come closest, but what is left then is itself a force of {place}'s motion"
    left = f"a misfit that no law explains: {judgement.where}" if judgement.where else "candidates that were not fitted"
    return Finding(
        location=judgement.place,
        effect=UNKNOWN,
        kind=EffectKind.UNLISTED,
        parameters=(),
        p_value=None if best is None else state.last.p_value(best),
        delta_bic=None,
        sentence=f"{left}{tried}",
    )


def _physics(outcome: Outcome) -> list[Finding]:
    """Findings of the fitted terms, in the order of the search."""
    state, findings = outcome.investigation, []
    for index, found in enumerate(state.found):
        term = state.fit.point.terms[state.given + index]
        if within_tolerance(state, term):
            continue
        parameters = _free(term, law_parameters(outcome.final, state.given + index, state.options.rules.plausible))
        rival = found.runner_up
        family, advice = _look_alikes(found, state.options.rules)
        finding = Finding(
            location=term.location,
            effect=term.law.name,
            kind=kind_of(term.law),
            parameters=parameters,
            p_value=found.p_value if found.trial.compared else None,
            delta_bic=found.trial.delta_bic(),
            runner_up=None if rival is None else (rival.term.law.name, rival.delta_bic()),
            runner_up_location=None if rival is None else rival.term.location,
            family=family,
            elsewhere=_elsewhere(found, state.options.rules.report),
            advice=advice,
            quoted=quoted_values(outcome.final, state.given + index),
            look_alikes=_beaten(found),
            formula=formula_of(term)[0],
            memory=formula_of(term)[1],
        )
        findings.append(replace(finding, sentence=sentence_of(outcome, term, finding)))
    return findings


def _free(term: Term, parameters: tuple[LawParameter, ...]) -> tuple[LawParameter, ...]:
    """Parameters that matter: without the position on a body that only heaves."""
    if not any(term.fixed):
        return parameters
    return tuple(one for one, fixed in zip(parameters, term.fixed, strict=True) if not fixed)


def _look_alikes(found: AcceptedFinding, rules: Rules) -> tuple[str | None, str | None]:
    """Look-alikes of a law at its place, in words, and the experiment that would distinguish them.

    A law of more evidence with implausible values is included, and a force without a name that is as plain.
    """
    best = found.trial
    close = [t for t in found.trials if t.evidence > best.evidence - rules.report.naming_margin]
    close += found.implausible
    equivalent = [
        t for t in close if t.named and t.term.location == best.term.location and t.term.law.name != best.term.law.name
    ]
    if best.term.law.listed:
        equivalent += unnamed_alike(found.trials, best, rules.report.naming_margin, rules.evidence)
    if not equivalent:
        return None, None
    names = " or ".join([best.term.law.name, *dict.fromkeys(t.term.law.name for t in equivalent)])
    return (
        names,
        f"{names} fit this recording almost equally well; {best.term.law.discriminated_by} would tell them apart",
    )


def _elsewhere(found: AcceptedFinding, rules: ReportRules) -> tuple[str, ...]:
    """Other places at which the chosen law explains the recording almost equally well.

    Without measured forces, a heavier body is equivalent to a lighter other one.
    """
    best = found.trial
    near = [t for t in found.trials if t.finished and t.evidence > best.evidence - rules.naming_margin]
    places = [t.term.location for t in near if t.term.law.name == best.term.law.name]
    return tuple(dict.fromkeys(place for place in places if place != best.term.location))


def _beaten(found: AcceptedFinding) -> dict[str, float]:
    """Fitted look-alikes of a law, with the evidence by which they lost."""
    best, beaten = found.trial, dict[str, float]()
    for rival in found.trials:
        name, margin = rival.term.law.name, best.evidence - rival.evidence
        if rival.finished and name in best.term.law.confused_with:
            beaten[name] = min(margin, beaten.get(name, margin))
    return beaten


def _out_of_order(outcome: Outcome, index: int) -> tuple[float, Finding]:
    """A gain or zero beyond its tolerance beside all findings, and its rank."""
    term = outcome.investigation.fit.point.terms[index]
    parameters = law_parameters(outcome.final, index, outcome.investigation.options.rules.plausible)
    score = float(((term.parameters[0] - term.law.absent[0]) / parameters[0].std) ** 2)
    words = term.law.sentence.format(**{p.name: p.words() for p in parameters})
    sentence = f"{term.location}: {words}"
    return score, Finding(
        location=term.location,
        effect=term.law.name,
        kind=kind_of(term.law),
        parameters=parameters,
        p_value=None,
        delta_bic=None,
        sentence=sentence,
    )


def _input_finding(system: System, fault: InputFault) -> Finding:
    parameter = input_fault_parameter(system, fault)
    words = fault.term.law.sentence.format(**{parameter.name: parameter.words()})
    return Finding(
        location=fault.term.location,
        effect=fault.term.law.name,
        kind=kind_of(fault.term.law),
        parameters=(parameter,),
        p_value=fault.p_value,
        delta_bic=None,
        runner_up=fault.runner_up,
        sentence=f"{fault.term.location}: {words}",
    )


def setup_finding(system: System, fault: SetupFault) -> Finding:
    parameters: tuple[LawParameter, ...] = ()
    if fault.value is not None and fault.effect.parameter is not None:
        name, unit = fault.effect.parameter
        parameters = (LawParameter(name, fault.value, fault.std, unit),)
    sentence = fault.effect.describe(fault.site, parameters[0].words() if parameters else "")
    if fault.effect is WRONG_SCALE and fault.value is not None:
        units = {channel.unit for channel in system.channels if channel.name in fault.site.location.split("|")}
        confused = confusion(abs(fault.value), units.pop()) if len(units) == 1 else None
        sentence += f", as of {confused}" if confused else ""
    share = 100 * (1 - fault.after / fault.before)
    gone = f"; put right, {share:.0f} % of the misfit goes" if share >= 1 else ""
    return Finding(
        location=fault.site.location,
        effect=fault.effect.name,
        kind=kind_of(fault.effect),
        parameters=parameters,
        p_value=None,
        delta_bic=None,
        elsewhere=(fault.site.inverse_at,) if fault.site.inverse_at and fault.effect.inverse else (),
        sentence=f"{sentence}{gone}",
    )


def _noise_finding(fault: NoiseFault) -> Finding:
    return Finding(
        location=fault.location,
        effect=SENSOR_NOISE.name,
        kind=kind_of(SENSOR_NOISE),
        parameters=(LawParameter("ratio", fault.ratio, fault.std, "1"),),
        p_value=fault.p_value,
        delta_bic=None,
        sentence=f"{fault.location}: {fault.ratio:.3g} times the noise declared, its peers {fault.usual:.3g} times",
    )


def _stuck_finding(name: str, at: float) -> Finding:
    return Finding(
        location=name,
        effect=SENSOR_STUCK.name,
        kind=kind_of(SENSOR_STUCK),
        parameters=(),
        p_value=None,
        delta_bic=None,
        sentence=f"{name}: repeats one value from {at:.2f} s on; it was left out of the diagnosis",
    )


def _contradiction_finding(fault: Contradiction) -> Finding:
    share = f"{100 * fault.share:.2g} % of its signal is no motion of its body ({fault.form})"
    return Finding(
        location=fault.location,
        effect=SENSOR_ERROR.name,
        kind=kind_of(SENSOR_ERROR),
        parameters=(LawParameter("share", fault.share, 0.0, "1"),),
        p_value=None,
        delta_bic=None,
        sentence=f"{fault.location}: the other sensors contradict it; {share}; it was left out of the diagnosis",
    )


def clock_in_words(drift: ClockDrift) -> str:
    """A drifting clock, in words."""
    sense, names = "later" if drift.rate > 0 else "earlier", drift.location.replace("|", " and ")
    rate = f"{1e6 * abs(drift.rate):.3g} +- {1e6 * drift.std:.1g} us every second"
    return f"{names}: all of them become {sense} by {rate}, as their clock drifts; put right"


def _clock_finding(drift: ClockDrift) -> Finding:
    return Finding(
        location=drift.location,
        effect=CLOCK_DRIFT,
        kind=EffectKind.FAULT,
        parameters=(LawParameter("rate", drift.rate, drift.std, "1"),),
        p_value=None,
        delta_bic=None,
        sentence=clock_in_words(drift),
    )
