"""Report of component tests: findings, values, sentences, arrays for plots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sprung.model.diagnosis.component.alike import gives_way
from sprung.model.diagnosis.component.given import identified_laws
from sprung.model.diagnosis.component.judgement import ComponentJudgement, JudgedComponent
from sprung.model.diagnosis.component.words import (
    drift_finding,
    finding_of,
    late_finding,
    leftover_words,
    preload_finding,
    reversed_finding,
    unknown_finding,
)
from sprung.model.diagnosis.force.deviations import covariance, spread
from sprung.model.diagnosis.force.fit import ComponentFit
from sprung.model.diagnosis.force.lag import Lag
from sprung.model.diagnosis.force.zero_drift import ZeroDrift
from sprung.model.diagnosis.investigation.state import Options, Recorded
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.report.report import (
    CandidateRow,
    Finding,
    IdentifiedLaw,
    LawParameter,
    RecordingFacts,
    Report,
    ReportedParameter,
    Unexplained,
)
from sprung.model.diagnosis.report.values import figures
from sprung.model.diagnosis.selection.evidence import chance, effective_count, level_gain
from sprung.model.laws.hysteresis import SERIES_STIFFNESS
from sprung.model.signals import FloatArray
from sprung.model.system import System

DRAWN_CYCLES = 6  # of a law's loop


def compose_components(
    system: System, record: Recorded, options: Options, judged: Sequence[JudgedComponent], judgement: ComponentJudgement
) -> Report:
    """The report of component tests."""
    errors, left = judgement.errors, judgement.left
    findings = sorted((f for one in judged for f in _findings(one)), key=_rank)
    names = [j.record.sensor for j in judged]
    words = "; ".join(leftover_words(j.record.element, j.final, j.size) for j, x in zip(judged, left, strict=True) if x)
    unexplained = Unexplained(float(np.mean(left)), dict(zip(names, left.tolist(), strict=True)), words)
    advice = [note for j in judged for note in j.record.notes]
    left_out = dict.fromkeys(f"{words}." for j in judged for words in j.record.left_out)  # of channels that some share
    return Report(
        system=system.name,
        recording=RecordingFacts(
            options.file, len(record.values) / record.sample_rate, len(record.values), int(record.lost)
        ),
        verdict=judgement.verdict,
        baseline=tuple(p for j in judged for p in _parameters(system, j.record.element, j.base, covariance(j.base))),
        baseline_validation=figures(names, errors.before),
        findings=tuple(findings),
        augmented=tuple(p for j in judged for p in _parameters(system, j.record.element, j.final, j.covariance)),
        augmented_validation=figures(names, errors.after),
        noise_floor=figures(names, errors.bounded(options.rules.verdict)),
        localization={
            j.record.element: level_gain(j.base.error, j.final.error, effective_count(j.final.residual)) for j in judged
        },
        candidates=tuple(c for j in judged for c in _candidates(j)),
        explained=judgement.explained,
        laws=tuple(law for j in judged for law in _laws(j)),
        noise={j.record.sensor: j.record.task.noise for j in judged if j.record.task.noise > 0},
        unexplained=unexplained,
        summary=" ".join((_summary(judgement, findings, unexplained), *left_out)),
        advice=tuple(advice if judgement.verdict != "consistent" else []),
        plot_data=_arrays(judged),
    )


def _rank(finding: Finding) -> tuple[int, float]:
    """Sort key: set-up faults, laws by evidence, nuisances."""
    order = {EffectKind.FAULT: 0, EffectKind.NUISANCE: 2}.get(finding.kind, 1)
    return order, finding.delta_bic if finding.delta_bic is not None else 0.0


def _findings(one: JudgedComponent) -> list[Finding]:
    full, names = one.covariance
    findings = []
    if one.reversed:
        findings.append(reversed_finding(one.record.sensor, one.record.element))
    for index, step in enumerate(one.found.steps if one.named else (), len(one.record.given.pieces)):
        sigma = spread(one.final, index, full, names)
        others = [other.effect for other in one.alike if other.index == index]
        piece = one.final.model.pieces[index]
        others += [SERIES_STIFFNESS.name] if gives_way(one.final, piece) else []
        if isinstance(piece, Lag):
            late = LawParameter("time", one.final.model.shapes[index][0], float(sigma[0][0]), "s")
            where = one.record.sensor, one.record.element
            findings.append(late_finding(*where, late, step, others, filters=piece.filters))
        else:
            findings.append(finding_of(one.record.element, one.final, one.base, index, step, sigma, others))
    if one.unnamed is not None:
        mapped = one.surface is not None
        findings.append(unknown_finding(one.record.element, one.unnamed, one.found.steps, mapped=mapped))
    for index, piece in enumerate(one.record.given.pieces):
        if isinstance(piece, ZeroDrift):
            of_drift = spread(one.final, index, full, names)[0]
            findings.append(drift_finding(one.record.sensor, one.record.element, one.final, index, of_drift))
    deviation, by_chance = (float(np.sqrt(max(of[0, 0], 0.0))) for of in (full, one.by_chance[0]))
    sign = -1.0 if one.reversed else 1.0
    least = one.final.task.rules.preload * max(by_chance, one.floor / np.sqrt(one.record.task.split))
    if abs(one.final.preload) > max(least, deviation):
        findings.append(preload_finding(one.record.element, sign * one.final.preload, deviation))
    return findings


def _laws(one: JudgedComponent) -> tuple[IdentifiedLaw, ...]:
    """Laws for the system file: given and named ones, and the preload."""
    count = len(one.record.given.pieces) + (len(one.found.steps) if one.named else 0)
    return identified_laws(one.final, one.record.element, count, *one.covariance, -1.0 if one.reversed else 1.0)


def _parameters(
    system: System, element: str, fit: ComponentFit, covariance: tuple[FloatArray, list[str]]
) -> list[ReportedParameter]:
    full, names = covariance
    sigma = dict(zip(names, np.sqrt(np.maximum(np.diag(full), 0.0)).tolist(), strict=False))
    values = []
    for parameter in system.parameters:
        if parameter.element == element:
            value = float(getattr(fit.element, parameter.quantity))
            deviation = sigma.get(parameter.quantity, 0.0)
            values.append(ReportedParameter(parameter.name, value, deviation, parameter.nominal, parameter.unit))
    values.append(ReportedParameter(f"{element}.preload", fit.preload, sigma["preload"], 0.0, "N"))
    return values


def _candidates(one: JudgedComponent) -> list[CandidateRow]:
    rows: dict[str, CandidateRow] = {}
    for number, step in enumerate(one.found.steps, 1):
        for ranked, piece in ((step.chosen, step.piece), *((rival, rival.last) for rival in step.rivals)):
            delta = step.rival_bic(ranked)
            p_value = chance(ranked.gain, ranked.fit.model.count - step.before.fit.model.count, one.found.tests)
            row = CandidateRow(one.record.element, piece.effect, ranked.gain, p_value, delta, number)
            rows.setdefault(piece.effect, row)
    for effect, gain in one.found.screened.items():
        rows.setdefault(effect, CandidateRow(one.record.element, effect, gain, chance(gain, 2, one.found.tests)))
    return list(rows.values())[:20]


def _summary(judgement: ComponentJudgement, findings: list[Finding], left: Unexplained) -> str:
    if judgement.verdict == "consistent":
        text = "The nominal structure explains the recording down to the noise."
        nuisance = "; ".join(f.sentence for f in findings)
        return f"{text} {nuisance[:1].upper()}{nuisance[1:]}." if nuisance else text
    main = [f for f in findings if f.kind is not EffectKind.NUISANCE]
    text = "; ".join(f.sentence for f in main)
    if not text:
        text = "No law of the catalogue explains the measured force"
    if judgement.explained is not None and judgement.explained > 0:
        share = 100 * judgement.explained
        exact = "100" if left.share == 0 else f"{min(share, 99):.0f}"
        text += f"; explains {exact} % of the excess error"
    if left.share > 0:
        text += f"; still unexplained: {left.where}"
    nuisance = "; ".join(f.sentence for f in findings if f not in main)
    return f"{text}{'; ' + nuisance if nuisance else ''}."


def _arrays(judged: Sequence[JudgedComponent]) -> dict[str, np.ndarray]:
    """Arrays for plots: validation of every force; motion and force before and after every law."""
    first = judged[0]
    arrays: dict[str, np.ndarray] = {}
    if all(len(j.record.task.force) == len(first.record.task.force) for j in judged):
        at = {id(j): slice(j.final.task.split, None) for j in judged}
        arrays["validation.time"] = first.final.task.motion.time[at[id(first)]]
        parts = [(j.final.task.force, j.base.force, j.final.force) for j in judged]
        for number, key in enumerate(("measured", "baseline", "augmented")):
            held = [series[number][at[id(j)]] for j, series in zip(judged, parts, strict=True)]
            arrays[f"validation.{key}"] = np.column_stack(held)
        arrays["validation.noise"] = np.array([j.floor for j in judged])
    arrays["localization.names"] = np.array([j.record.element for j in judged], dtype=str)
    arrays["localization.score"] = np.array([j.found.base.error for j in judged])
    for number, (one, columns) in enumerate((j, columns) for j in judged for columns in _columns_of_findings(j)):
        task = one.final.task
        thin = slice(None, None, max(1, len(task.force) // 4000))
        law = one.final.model.columns(task)[:, columns] @ one.final.strengths[columns]
        key = f"finding.{number}"
        arrays[f"{key}.time"], arrays[f"{key}.deflection"] = task.motion.time[thin], task.motion.deflection[thin]
        arrays[f"{key}.rate"] = task.motion.rate[thin]
        arrays[f"{key}.force_before"] = one.base.residual[thin]
        arrays[f"{key}.force_after"] = one.final.residual[thin]
        cycles = largest_cycles(task.motion.deflection, task.motion.rate)
        arrays[f"{key}.loop_x"], arrays[f"{key}.loop_y"] = task.motion.deflection[cycles], law[cycles]
        arrays[f"{key}.total_measured"] = task.force[thin]
        arrays[f"{key}.total_modelled"] = one.final.force[thin]
    return arrays


def largest_cycles(deflection: np.ndarray, rate: np.ndarray) -> slice:
    """The samples (T,) of the few cycles about the largest deflection: hundreds of loops are a stain."""
    turns = np.flatnonzero(np.diff(np.sign(rate)))
    if len(turns) <= 2 * DRAWN_CYCLES:
        return slice(None)
    largest = int(np.searchsorted(turns, np.argmax(np.abs(deflection))))
    first = min(max(largest - DRAWN_CYCLES, 0), len(turns) - 2 * DRAWN_CYCLES - 1)
    return slice(int(turns[first]), int(turns[first + 2 * DRAWN_CYCLES]) + 1)


def _columns_of_findings(one: JudgedComponent) -> list[slice]:
    """Columns of the model for every finding: of one law, or of all laws of an unnamed force."""
    counts = [len(piece.signs) for piece in one.final.model.pieces]
    given, steps = len(one.record.given.pieces), len(one.found.steps)
    if not one.named:
        return [slice(sum(counts[:given]), sum(counts))]
    return [slice(sum(counts[:i]), sum(counts[: i + 1])) for i in range(given, given + steps)]
