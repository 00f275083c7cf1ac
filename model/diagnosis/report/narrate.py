"""From a finished investigation to the report: numbers with units, fit figures, sentences, arrays for pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.investigation.course import (
    Found,
    InputFault,
    Investigation,
    NoiseFault,
    Outcome,
    Recorded,
)
from sprung.model.diagnosis.investigation.setup import SetupFault
from sprung.model.diagnosis.report.plots_data import evidence_arrays
from sprung.model.diagnosis.report.report import (
    CandidateRow,
    Finding,
    FitFigures,
    IdentifiedLaw,
    LawParameter,
    RecordingFacts,
    Report,
    ReportedParameter,
    Unexplained,
)
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import ReportRules
from sprung.model.laws import ElementLaw, SensorLaw, reversal_step
from sprung.model.laws.basis import UNKNOWN
from sprung.model.signals import FloatArray
from sprung.model.system import System

_NUMERICAL = 1e-3  # of a law's parameter: what the simulation of kinks and stops at 4 steps a sample is good for
_NO_LONGER = 900.0  # %, of a value that stood for something else


def narrate(outcome: Outcome, record: Recorded) -> Report:
    """The report of an investigation."""
    course, before, after = outcome.investigation, outcome.before, outcome.after
    said, names = outcome.judgement, course.signals.sensor_names
    findings = _findings(outcome)
    advice = [*course.prepared.notes, *course.notes, *_undecided(course)]
    if said.strange is not None:
        advice.insert(0, _nothing_fits(outcome, said.strange))
    elif said.lost_phase and not course.held.still:
        advice.insert(0, "the free run loses its phase: its errors say little here, judged was how the motion goes on")
    explained = said.errors.explained() if course.found else None
    left = said.errors.unexplained()
    unexplained = Unexplained(float(np.mean(left)), dict(zip(names, left.tolist(), strict=True)), said.where)
    return Report(
        system=course.system.name,
        recording=RecordingFacts(
            course.options.file,
            len(record.values) / record.sample_rate,
            len(record.values),
            int(record.lost),
            course.prepared.used,
        ),
        verdict=said.verdict,
        baseline=_parameters(course.system, course.base),
        baseline_validation=_figures(names, before.per_sensor),
        findings=tuple(findings),
        augmented=_parameters(course.system, outcome.final),
        augmented_validation=_figures(names, after.per_sensor),
        noise_floor=_figures(names, said.errors.floor),
        localization=course.first.localization(),
        candidates=_candidates(course),
        changes=_changes(outcome),
        explained=explained,
        unexplained=unexplained,
        laws=_laws(outcome),
        noise=_noise(course),
        summary=_summary(outcome, findings, explained),
        advice=tuple(advice),
        evidence=evidence_arrays(course, before, after, said.floor, [(f.location, f.effect) for f in findings]),
    )


def _laws(outcome: Outcome) -> tuple[IdentifiedLaw, ...]:
    """Every law of the final model that has a name and values: those of the file, then those that were found."""
    fit, course = outcome.final, outcome.investigation
    count = course.given + (len(course.found) if outcome.judgement.carried else 0)
    found = []
    for index, term in enumerate(fit.point.terms[:count]):
        if term.law.named:
            found.append(IdentifiedLaw(term.location, term.law.name, _law_parameters(fit, index)[0], term.variant))
    for fault in course.input_faults:
        spec, value = fault.term.law.parameters[0], fault.term.parameters[0]
        parameter = LawParameter(spec.name, value, fault.std, spec.unit)
        found.append(IdentifiedLaw(fault.term.location, fault.term.law.name, (parameter,)))
    return tuple(found)


def _noise(course: Investigation) -> dict[str, float]:
    """Standard deviation of one sample of every channel, as the model found it."""
    system, noise = course.system, course.problem.noise
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
    present = [system.sensors[i] for i in course.problem.sensors]
    levels |= dict(zip(present, noise.sensors.tolist(), strict=True))
    known = {channel.name for channel in system.channels}
    return {name: level for name, level in levels.items() if name in known and np.isfinite(level)}


def _findings(outcome: Outcome) -> list[Finding]:
    """Findings, the strongest first: a channel that is dead, then by what each explains of chi-square."""
    course, said = outcome.investigation, outcome.judgement
    if said.strange is not None:
        return []
    ranked = [(np.inf, _stuck_finding(name, at)) for name, at in course.prepared.stuck]
    ranked += [(np.inf, _setup_finding(f)) for f in course.setup_faults]
    ranked += [(f.score, _input_finding(f)) for f in course.input_faults]
    ranked += [(f.sigmas**2, _noise_finding(f)) for f in outcome.noise_faults]
    if said.carried:
        ranked += [(-(f.delta_bic or 0.0), f) for f in _physics(outcome)]
    ranked.sort(key=lambda pair: -pair[0])
    findings = [finding for _, finding in ranked]
    if said.verdict == "unknown_physics" and not any(f.effect == UNKNOWN for f in findings):
        findings.insert(len(course.setup_faults), _unknown_finding(outcome))
    return findings


def _unknown_finding(outcome: Outcome) -> Finding:
    """What is left above the noise, at the place where it is seen best, without a name."""
    course, said = outcome.investigation, outcome.judgement
    here = [hit for hit in course.last.candidates if hit.location == said.place]
    best = max(here, key=lambda hit: hit.score, default=None)
    tried = ""
    if course.found:
        names = " and ".join(f.trial.term.law.name.replace("_", " ") for f in course.found)
        tried = f"; {names} would explain too little of it"
    return Finding(
        location=said.place,
        effect=UNKNOWN,
        parameters=(),
        p_value=None if best is None else course.last.p_value(best),
        delta_bic=None,
        sentence=f"a misfit that no law explains: {said.where}{tried}",
    )


def _nothing_fits(outcome: Outcome, strange: float) -> str:
    """That the system file does not describe the recording, and the likeliest reasons."""
    return (
        f"nothing fits: the best model still errs by {100 * strange:.0f} % of the signal; the system file does not "
        f"seem to belong to this recording. Likeliest: {'; '.join(likely_reasons(outcome))}"
    )


def likely_reasons(outcome: Outcome) -> list[str]:
    """Two or three reasons for which nothing fits, by what the record shows."""
    course, before = outcome.investigation, outcome.before
    names, rules = course.signals.sensor_names, course.options.rules.report
    turned, scales = [], []
    for i, name in enumerate(names):
        measured, simulated = before.measured[:, i], before.simulated[:, i]
        power = float(np.sum(measured**2) * np.sum(simulated**2))
        alike = float(measured @ simulated) / np.sqrt(power) if power > 0 else 0.0
        if alike < -rules.alike:
            turned.append(name)
        elif alike > rules.alike:
            scale = float(np.sqrt(np.sum(measured**2) / np.sum(simulated**2)))
            if not 1 / rules.scale < scale < rules.scale:
                scales.append(f"{name} is {scale:.3g} times what it should show (a unit or a scale?)")
    reasons = [f"the sign of {', '.join(turned)}"] if turned else []
    reasons += scales[:1]
    sigma = np.sqrt(np.maximum(np.diag(course.base.covariance), 0))[: len(course.base.point.theta)]
    far = [
        i
        for i in np.argsort(-np.abs(course.base.point.theta))
        if abs(course.base.point.theta[i]) > rules.far * (1 + sigma[i])
    ]
    if far:
        parameter = course.system.parameters[int(far[0])]
        factor = float(np.exp(course.base.point.theta[int(far[0])]))
        reasons.append(f"{parameter.name} came out {factor:.2g} times nominal, which is not plausible: units, masses")
    reasons.append("an excitation that nobody measured")
    reasons.append("channels swapped, sensors elsewhere than stated, or bodies that the file does not have")
    return reasons[:3]


def _figures(names: tuple[str, ...], per_sensor: FloatArray) -> FitFigures:
    return FitFigures(
        nrmse=float(np.sqrt(np.mean(np.asarray(per_sensor) ** 2))),
        per_sensor={name: float(value) for name, value in zip(names, per_sensor, strict=True)},
    )


def _deviations(system: System, fit: Fit) -> FloatArray:
    """Standard deviations of the log-ratios, (P,).

    What of an unnamed force belongs to the spring and damper that it works beside is a matter of convention: their
    own values are uncertain by as much as the whole of it would change them.
    """
    sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0))[: len(system.parameters)]
    for i, term in enumerate(fit.forces.terms if fit.forces is not None else ()):
        if term.law.named or fit.forces is None:
            continue
        d, v = fit.forces.deflection[:, i], fit.forces.rate[:, i]
        force = np.std(fit.forces.force[:, i] + term.equivalent[0] * d + term.equivalent[1] * v)
        for j, parameter in enumerate(system.parameters):
            if parameter.element == term.location and parameter.quantity != "mass":
                along = np.std(d if parameter.quantity == "stiffness" else v)
                value = parameter.nominal * np.exp(fit.point.theta[j])
                sigma[j] = np.hypot(sigma[j], force / max(along * value, 1e-300))
    return sigma


def _parameters(system: System, fit: Fit) -> tuple[ReportedParameter, ...]:
    sigma = _deviations(system, fit)
    values = []
    for i, parameter in enumerate(system.parameters):
        value = parameter.nominal * float(np.exp(fit.point.theta[i]))
        values.append(
            ReportedParameter(parameter.name, value, value * float(sigma[i]), parameter.nominal, parameter.unit)
        )
    return tuple(values)


def _law_parameters(fit: Fit, index: int) -> tuple[tuple[LawParameter, ...], FloatArray]:
    term, place = fit.point.terms[index], fit.place(index)
    block = _with_corner(fit, term, fit.covariance[place, place])
    sigma = np.hypot(np.sqrt(np.maximum(np.diag(block), 0)), _NUMERICAL * np.abs(term.parameters))
    hidden = not term.law.named
    parameters = tuple(
        LawParameter(spec.name, float(value), float(s), spec.unit)
        for spec, value, s in zip(term.law.parameters, term.parameters, sigma, strict=True)
        if not hidden
    )
    return parameters, block


def _with_corner(fit: Fit, term: Term, covariance: FloatArray) -> FloatArray:
    """Covariance of a law's parameters with what sampling leaves open of a corner over the rate.

    A corner of width s is passed in steps of the rate, h each.  The slope there, sech^2(v / s), summed over samples
    instead of integrated is off by 2 x / sinh x cos(phase) of itself, x = pi^2 s / h (Poisson's sum formula).
    """
    corner = term.law.corner if isinstance(term.law, ElementLaw) else None
    if corner is None or covariance[corner, corner] <= 0:
        return covariance
    rate = fit.element_motion[1] @ term.port(fit.forward.system)
    passing = reversal_step(rate)
    if passing == 0.0:
        return covariance
    width = term.parameters[corner]
    x = min(np.pi**2 * width / passing, 300.0)
    along = covariance[:, corner] / covariance[corner, corner]  # what the others do when the width is off
    return covariance + 2 * np.outer(along, along) * (width * x / np.sinh(x)) ** 2


def _physics(outcome: Outcome) -> list[Finding]:
    """Findings of the fitted terms, in the order in which they were found: by evidence."""
    course, findings = outcome.investigation, []
    for index, found in enumerate(course.found):
        term = course.fit.point.terms[course.given + index]
        parameters, block = _law_parameters(outcome.final, course.given + index)
        rival = found.runner_up
        family, advice = _look_alikes(found, course.options.rules.report)
        finding = Finding(
            location=term.location,
            effect=term.law.name,
            parameters=parameters,
            p_value=found.p_value,
            delta_bic=found.trial.delta_bic(),
            runner_up=None if rival is None else (rival.term.law.name, rival.delta_bic()),
            runner_up_location=None if rival is None else rival.term.location,
            family=family,
            advice=advice,
            parameter_covariance=block,
            look_alikes=_beaten(found),
        )
        findings.append(replace(finding, sentence=_sentence(outcome, term, finding)))
    return findings


def _look_alikes(found: Found, rules: ReportRules) -> tuple[str | None, str | None]:
    """The laws at the same place that the recording cannot tell from the chosen one, and what would."""
    best = found.trial
    near = [
        t
        for t in found.trials
        if t.evidence > best.evidence - rules.naming_margin
        and t.named
        and t.term.location == best.term.location
        and t.term.law.name != best.term.law.name
    ]
    if not near:
        return None, None
    names = " or ".join([best.term.law.name, *dict.fromkeys(t.term.law.name for t in near)])
    return names, f"{names} fit this recording almost equally well; {_experiment(best.term)} would tell them apart"


def _beaten(found: Found) -> dict[str, float]:
    """Laws that similar data may suggest, as far as they were fitted, with the evidence by which they lost."""
    best, beaten = found.trial, dict[str, float]()
    for rival in found.trials:
        name, margin = rival.term.law.name, best.evidence - rival.evidence
        if rival.finished and name in best.term.law.confused_with:
            beaten[name] = min(margin, beaten.get(name, margin))
    return beaten


def _experiment(term: Term) -> str:
    if isinstance(term.law, ElementLaw) and term.law.memory:
        return "a recording at another speed, so that the same deflections come at other rates,"
    if isinstance(term.law, SensorLaw):
        return "a calibration of the sensor"
    return "a longer recording, or one at a higher level (worse track, more speed or load),"


def _value(parameter: LawParameter) -> str:
    """395 +- 6 N, to the digits that the deviation supports."""
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    if not np.isfinite(parameter.std) or parameter.std <= 0:
        return f"{parameter.value:.4g}{unit}"
    digits = max(2, int(np.ceil(np.log10(max(abs(parameter.value), parameter.std) / parameter.std))) + 1)
    return f"{parameter.value:.{min(digits, 6)}g} +- {parameter.std:.2g}{unit}"


def _sentence(outcome: Outcome, term: Term, finding: Finding) -> str:
    values = {p.name: _value(p) for p in finding.parameters}
    try:
        words = term.law.sentence.format(**values)
    except (KeyError, IndexError):
        words = term.law.title
    if finding.family is not None:
        words = f"{finding.family.replace('_', ' ')}, which this recording does not tell apart; as the first, {words}"
    sentence = f"{term.location.replace('|', ' and ')}: {words}"
    bias = _worst_bias(outcome)
    if bias is not None:
        sentence += f"; {bias}"
    return sentence


def _worst_bias(outcome: Outcome) -> str | None:
    """What the missing physics had done to the parameter that it shifted most."""
    course, final = outcome.investigation, outcome.final
    sigma = _deviations(course.system, final)
    shift = course.base.point.theta - final.point.theta
    if not len(shift):
        return None
    shift = np.where(np.abs(shift) > 5 * sigma, shift, 0.0)
    worst = int(np.argmax(np.abs(shift)))
    if abs(shift[worst]) < 0.01:
        return None
    change = 100 * (np.exp(shift[worst]) - 1)
    side = "high" if change > 0 else "low"
    if change > _NO_LONGER:
        return f"{course.system.parameters[worst].name} is then no longer needed"
    return f"without it {course.system.parameters[worst].name} was read {abs(change):.0f} % too {side}"


def _input_finding(fault: InputFault) -> Finding:
    spec = fault.term.law.parameters[0]
    parameter = LawParameter(spec.name, fault.term.parameters[0], fault.std, spec.unit)
    words = fault.term.law.sentence.format(**{spec.name: _value(parameter)})
    return Finding(
        location=fault.term.location,
        effect=fault.term.law.name,
        parameters=(parameter,),
        p_value=fault.p_value,
        delta_bic=None,
        runner_up=fault.runner_up,
        sentence=f"{fault.term.location}: {words}",
    )


_SETUP_WORDS = {
    "sign_reversed": "{place}: the sign is reversed",
    "channels_swapped": "{place}: the two channels are exchanged",
    "node_delay": "{place}: all of them are late by {value}, as a whole node is",
    "wrong_scale": "{place}: {value} times what it should show, a wrong scale or unit",
    "wrong_position": "{place}: sits {value} along {axis} from where the system file says",
    "wrong_body": "{place}: is not fixed to what the system file says; its {detail} fits",
}
_SETUP_VALUES = {"node_delay": ("time", "s"), "wrong_scale": ("ratio", "1"), "wrong_position": ("offset", "m")}


def _setup_finding(fault: SetupFault) -> Finding:
    parameters: tuple[LawParameter, ...] = ()
    words = ""
    if fault.value is not None:
        name, unit = _SETUP_VALUES[fault.effect]
        parameters = (LawParameter(name, fault.value, fault.std, unit),)
        words = _value(parameters[0])
    sentence = _SETUP_WORDS[fault.effect].format(
        place=fault.location.replace("|", " and "), value=words, axis="xy"[fault.axis], detail=fault.detail
    )
    share = 100 * (1 - fault.after / fault.before)
    return Finding(
        location=fault.location,
        effect=fault.effect,
        parameters=parameters,
        p_value=None,
        delta_bic=None,
        sentence=f"{sentence}; put right, {share:.0f} % of the misfit goes",
    )


def _noise_finding(fault: NoiseFault) -> Finding:
    return Finding(
        location=fault.location,
        effect="sensor_noise",
        parameters=(LawParameter("ratio", fault.ratio, fault.std, "1"),),
        p_value=fault.p_value,
        delta_bic=None,
        sentence=f"{fault.location}: {fault.ratio:.3g} times the noise declared, its peers {fault.usual:.3g} times",
    )


def _stuck_finding(name: str, at: float) -> Finding:
    return Finding(
        location=name,
        effect="sensor_stuck",
        parameters=(),
        p_value=None,
        delta_bic=None,
        sentence=f"{name}: repeats one value from {at:.2f} s on; it was left out of the diagnosis",
    )


def _undecided(course: Investigation) -> list[str]:
    """What the recording is too short or too still to tell."""
    sigma = _deviations(course.system, course.base)
    loose = [p.name for i, p in enumerate(course.system.parameters) if sigma[i] > course.options.rules.report.loose]
    if not loose:
        return []
    shown = ", ".join(loose[:6]) + (f" and {len(loose) - 6} more" if len(loose) > 6 else "")
    return [
        f"undecided: {shown}: the motion is too small or the recording too short to tell them from their nominal "
        "values; record longer, faster or on rougher track"
    ]


def _changes(outcome: Outcome) -> tuple[str, ...]:
    """Parameters that the nominal structure explains by another value."""
    course, final = outcome.investigation, outcome.final
    sigma, theta = _deviations(course.system, final), final.point.theta
    words = []
    order = sorted(range(len(theta)), key=lambda i: -abs(theta[i]))
    for i in order:
        if abs(theta[i]) > np.log1p(course.options.rules.report.changed) and abs(theta[i]) > 5 * sigma[i]:
            change = 100 * (np.exp(theta[i]) - 1)
            words.append(f"{course.system.parameters[i].name} is {change:+.0f} % from nominal")
    return tuple(words)


def _candidates(course: Investigation) -> tuple[CandidateRow, ...]:
    rows: dict[tuple[str, str], CandidateRow] = {}
    for found in course.found:
        for trial in [found.trial, *found.trials, *([found.runner_up] if found.runner_up else [])]:
            key = (trial.term.location, trial.term.law.name)
            if key not in rows:
                p = course.first.p_value(trial.hit)
                rows[key] = CandidateRow(*key, trial.hit.score, p, trial.delta_bic())
    for hit in course.first.candidates:
        if len(rows) >= 20:
            break
        rows.setdefault(
            (hit.location, hit.effect), CandidateRow(hit.location, hit.effect, hit.score, course.first.p_value(hit))
        )
    fitted = [c for c in rows.values() if c.delta_bic is not None]
    screened = [c for c in rows.values() if c.delta_bic is None]
    fitted.sort(key=lambda c: c.delta_bic or 0.0)
    return tuple([*fitted, *screened][:20])


def _summary(outcome: Outcome, findings: list[Finding], explained: float | None) -> str:
    said = outcome.judgement
    if said.verdict == "consistent":
        return "The nominal structure explains the recording down to the noise."
    text = "; ".join(f.sentence for f in findings) or "Nothing in the system file fits this recording"
    if said.carried and said.strange is None and explained is not None and explained > 0:
        share = "100" if not said.where else f"{min(100 * explained, 99):.0f}"
        text += f"; explains {share} % of the excess error"
        if said.where:
            text += f"; still unexplained: {said.where}"
    return text + "."
