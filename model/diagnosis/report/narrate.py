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
from sprung.model.diagnosis.report.plots_data import evidence_arrays
from sprung.model.diagnosis.report.report import (
    Candidate,
    Finding,
    FitFigures,
    LawParameter,
    ParameterValue,
    RecordingFacts,
    Report,
    Verdict,
)
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.selection.holdout import FreeRun
from sprung.model.laws import ElementLaw, SensorLaw
from sprung.model.laws.basis import UNKNOWN
from sprung.model.signals import FloatArray
from sprung.model.system import System

_NAMING_MARGIN = 6.0  # evidence by which a law must beat its look-alikes to be named alone (odds of 20 to 1)
_CHANGED = 0.25  # a parameter this far from nominal, and surely so, is listed as changed
_STRANGE = 0.6  # nrmse of the final model from which the system file does not describe this recording
_NUMERICAL = 1e-3  # of a law's parameter: what the simulation of kinks and stops at 4 steps a sample is good for
_LOOSE = 0.2  # standard deviation of a log-ratio from which a parameter counts as undecided


def narrate(outcome: Outcome, record: Recorded) -> Report:
    """The report of an investigation."""
    course, before, after = outcome.investigation, outcome.before, outcome.after
    names = course.signals.sensor_names
    size = np.sqrt(np.mean(before.measured**2, axis=0))
    floor = course.held.noise_rms(course.fit, course.problem.noise)
    floor_figures = realised_floor(floor / np.where(size > 0, size, 1.0), after)
    findings = [_input_finding(f) for f in course.input_faults]
    findings += [_stuck_finding(name, at) for name, at in course.prepared.stuck]
    findings += [_noise_finding(f) for f in outcome.noise_faults]
    findings += _physics(outcome)
    findings.sort(key=lambda f: f.delta_bic)
    advice = [*course.prepared.notes, *course.notes, *_undecided(course)]
    verdict = _verdict(findings)
    strange = _blamed(course) if course.problem.follows else after.nrmse
    if strange > _STRANGE and verdict != "sensor_fault":
        verdict, findings = "unknown_physics", []
        advice.insert(
            0,
            f"nothing fits: the best model still errs by {100 * strange:.0f} % of the signal; "
            "the system file does not seem to belong to this recording",
        )
    elif course.problem.follows and after.nrmse > _STRANGE and not course.held.still:
        advice.insert(0, "the free run loses its phase: its errors say little here, judged was how the motion goes on")
    explained = _explained(before, after, floor_figures) if course.found else None
    return Report(
        system=course.system.name,
        recording=RecordingFacts(
            course.options.file, len(record.values) / record.sample_rate, len(record.values), int(record.lost)
        ),
        verdict=verdict,
        baseline=_parameters(course.system, course.base),
        baseline_validation=_figures(names, before.per_sensor),
        findings=tuple(findings),
        augmented=_parameters(course.system, outcome.final),
        augmented_validation=_figures(names, after.per_sensor),
        noise_floor=_figures(names, floor_figures),
        localization=course.first.localization(),
        candidates=_candidates(course),
        changes=_changes(outcome),
        explained=explained,
        summary=_summary(verdict, findings, explained),
        advice=tuple(advice),
        evidence=evidence_arrays(course, before, after, floor, [(f.location, f.effect) for f in findings]),
    )


def _blamed(course: Investigation) -> float:
    """Forces that nobody measured, as the noise of the measured ones, over the inertia forces, rms over rms."""
    fit = course.fit
    structure = fit.forward.plant.structure
    inertia = structure.mass * fit.forward.part.grid.inverse(fit.motions.acceleration)
    return float(np.sqrt(np.sum(structure.F**2 @ fit.noise.force**2) / np.sum(np.mean(inertia**2, axis=0))))


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
        if term.law.name != UNKNOWN or fit.forces is None:
            continue
        d, v = fit.forces.deflection[:, i], fit.forces.rate[:, i]
        force = np.std(fit.forces.force[:, i] + term.preload[0] * d + term.preload[1] * v)
        for j, parameter in enumerate(system.parameters):
            if parameter.element == term.location and parameter.quantity != "mass":
                along = np.std(d if parameter.quantity == "stiffness" else v)
                value = parameter.nominal * np.exp(fit.point.theta[j])
                sigma[j] = np.hypot(sigma[j], force / max(along * value, 1e-300))
    return sigma


def _parameters(system: System, fit: Fit) -> tuple[ParameterValue, ...]:
    sigma = _deviations(system, fit)
    values = []
    for i, parameter in enumerate(system.parameters):
        value = parameter.nominal * float(np.exp(fit.point.theta[i]))
        values.append(ParameterValue(parameter.name, value, value * float(sigma[i]), parameter.nominal, parameter.unit))
    return tuple(values)


def _explained(before: FreeRun, after: FreeRun, floor: FloatArray) -> float | None:
    """Share of the error power beyond the noise floor that the findings remove."""
    excess = float(np.mean(before.per_sensor**2) - np.mean(floor**2))
    left = float(np.mean(after.per_sensor**2) - np.mean(floor**2))
    if excess <= 0:
        return None
    return float(np.clip(1 - left / excess, -1.0, 1.0))


def realised_floor(expected: FloatArray, after: FreeRun) -> FloatArray:
    """Noise floor of each sensor on the held-out samples themselves.

    The estimated noise would give `expected` on average; these samples had their own.  Where the free run errs by
    no more than that within sampling error, its error is noise, and is the floor.
    """
    spread = 4 * np.sqrt(1 / (2 * len(after.measured)))
    return np.where(np.abs(after.per_sensor / expected - 1) < spread, after.per_sensor, expected)


def _law_parameters(fit: Fit, index: int) -> tuple[tuple[LawParameter, ...], FloatArray]:
    term, place = fit.point.terms[index], fit.place(index)
    block = _with_corner(fit, term, fit.covariance[place, place])
    sigma = np.hypot(np.sqrt(np.maximum(np.diag(block), 0)), _NUMERICAL * np.abs(term.parameters))
    hidden = term.law.name == UNKNOWN
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
    passing = np.abs(np.diff(rate))[rate[1:] * rate[:-1] < 0]
    if not len(passing):
        return covariance
    width = term.parameters[corner]
    x = min(np.pi**2 * width / max(float(np.median(passing)), 1e-300), 300.0)
    along = covariance[:, corner] / covariance[corner, corner]  # what the others do when the width is off
    return covariance + 2 * np.outer(along, along) * (width * x / np.sinh(x)) ** 2


def _physics(outcome: Outcome) -> list[Finding]:
    """Findings of the fitted terms, in the order in which they were found: by evidence."""
    course, findings = outcome.investigation, []
    for index, found in enumerate(course.found):
        term = course.fit.point.terms[index]
        parameters, block = _law_parameters(outcome.final, index)
        rival = found.runner_up
        family, advice = _look_alikes(found)
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
        )
        findings.append(replace(finding, sentence=_sentence(outcome, term, finding)))
    return findings


def _look_alikes(found: Found) -> tuple[str | None, str | None]:
    """The laws at the same place that the recording cannot tell from the chosen one, and what would."""
    best = found.trial
    near = [
        t
        for t in found.trials
        if t.evidence > best.evidence - _NAMING_MARGIN
        and t.named
        and t.term.location == best.term.location
        and t.term.law.name != best.term.law.name
    ]
    if not near:
        return None, None
    names = " or ".join([best.term.law.name, *dict.fromkeys(t.term.law.name for t in near)])
    return names, f"{names} fit this recording almost equally well; {_experiment(best.term)} would tell them apart"


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
        sentence += f"; without it {bias}"
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
    return f"{course.system.parameters[worst].name} was read {abs(change):.0f} % too {side}"


def _input_finding(fault: InputFault) -> Finding:
    spec = fault.term.law.parameters[0]
    parameter = LawParameter(spec.name, fault.term.parameters[0], fault.std, spec.unit)
    words = fault.term.law.sentence.format(**{spec.name: _value(parameter)})
    return Finding(
        location=fault.term.location,
        effect=fault.term.law.name,
        parameters=(parameter,),
        p_value=fault.p_value,
        delta_bic=-fault.score,
        runner_up=fault.runner_up,
        sentence=f"{fault.term.location}: {words}",
    )


def _noise_finding(fault: NoiseFault) -> Finding:
    return Finding(
        location=fault.location,
        effect="sensor_noise",
        parameters=(LawParameter("ratio", fault.ratio, fault.std, "1"),),
        p_value=fault.p_value,
        delta_bic=-(fault.sigmas**2),
        sentence=f"{fault.location}: {fault.ratio:.3g} times the noise declared, its peers {fault.usual:.3g} times",
    )


def _stuck_finding(name: str, at: float) -> Finding:
    return Finding(
        location=name,
        effect="sensor_stuck",
        parameters=(),
        p_value=0.0,
        delta_bic=-1e6,
        sentence=f"{name}: repeats one value from {at:.2f} s on; it was left out of the diagnosis",
    )


def _verdict(findings: list[Finding]) -> Verdict:
    if not findings:
        return "consistent"
    faults = {"sensor_gain", "sensor_lag", "sensor_bias", "sensor_noise", "sensor_stuck", "axle_delay"}
    physics = [f for f in findings if f.effect not in faults]
    if not physics:
        return "sensor_fault"
    return "unknown_physics" if physics[0].effect == UNKNOWN else "missing_physics"


def _undecided(course: Investigation) -> list[str]:
    """What the recording is too short or too still to tell."""
    sigma = _deviations(course.system, course.base)
    loose = [p.name for i, p in enumerate(course.system.parameters) if sigma[i] > _LOOSE]
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
        if abs(theta[i]) > np.log1p(_CHANGED) and abs(theta[i]) > 5 * sigma[i]:
            change = 100 * (np.exp(theta[i]) - 1)
            words.append(f"{course.system.parameters[i].name} is {change:+.0f} % from nominal")
    return tuple(words)


def _candidates(course: Investigation) -> tuple[Candidate, ...]:
    rows: dict[tuple[str, str], Candidate] = {}
    for found in course.found:
        for trial in [found.trial, *found.trials, *([found.runner_up] if found.runner_up else [])]:
            key = (trial.term.location, trial.term.law.name)
            if key not in rows:
                p = course.first.p_value(trial.hit)
                rows[key] = Candidate(*key, trial.hit.score, p, trial.delta_bic())
    for hit in course.first.hits:
        if len(rows) >= 20:
            break
        rows.setdefault(
            (hit.location, hit.effect), Candidate(hit.location, hit.effect, hit.score, course.first.p_value(hit))
        )
    fitted = [c for c in rows.values() if c.delta_bic is not None]
    screened = [c for c in rows.values() if c.delta_bic is None]
    fitted.sort(key=lambda c: c.delta_bic or 0.0)
    return tuple([*fitted, *screened][:20])


def _summary(verdict: Verdict, findings: list[Finding], explained: float | None) -> str:
    if verdict == "consistent":
        return "The nominal structure explains the recording down to the noise."
    text = "; ".join(f.sentence for f in findings) or "Nothing in the system file fits this recording"
    if explained is not None and explained > 0:
        text += f"; explains {100 * explained:.0f} % of the excess error"
    return text + "."
