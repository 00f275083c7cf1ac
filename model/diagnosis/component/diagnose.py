"""The diagnosis of component tests: from a recording to a report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sprung.model.diagnosis.component.alike import Alike, look_alikes
from sprung.model.diagnosis.component.deviations import covariance, left_open, spread
from sprung.model.diagnosis.component.fit import ComponentFit, fitted, refined
from sprung.model.diagnosis.component.formula import formula_search
from sprung.model.diagnosis.component.given import identified_laws
from sprung.model.diagnosis.component.measured import ComponentRecord, component_records, turned_round
from sprung.model.diagnosis.component.piece import HYSTERESIS, SURFACE, Lag, Piece
from sprung.model.diagnosis.component.pieces import PIECES
from sprung.model.diagnosis.component.search import (
    Progress as Told,
)
from sprung.model.diagnosis.component.search import (
    Ranked,
    Search,
    Step,
    search,
)
from sprung.model.diagnosis.component.smooth import smooth_serves
from sprung.model.diagnosis.component.words import (
    finding_of,
    late_finding,
    leftover_words,
    preload_finding,
    reversed_finding,
    unknown_finding,
)
from sprung.model.diagnosis.investigation.course import Options, Progress, Recorded
from sprung.model.diagnosis.investigation.verdict import EffectKind, HeldOutErrors, kind_named, verdict_of
from sprung.model.diagnosis.report.report import (
    CandidateRow,
    Finding,
    FitFigures,
    IdentifiedLaw,
    RecordingFacts,
    Report,
    ReportedParameter,
    Unexplained,
)
from sprung.model.diagnosis.rules import ComponentRules, VerdictRules
from sprung.model.diagnosis.selection.evidence import bic, chance, effective_count, level_gain
from sprung.model.laws import CATALOGUE, ElementLaw, Law
from sprung.model.signals import FloatArray
from sprung.model.system import System

_ONE_LOOP = (
    "the test repeats one loop, which several laws together imitate whatever made it; "
    "another amplitude or rate, or random motion, would tell them apart"
)


@dataclass(frozen=True)
class Judged:
    """One component with everything that the report says of it."""

    record: ComponentRecord
    found: Search
    base: ComponentFit
    final: ComponentFit
    floor: float  # N
    reversed: bool  # the force or the motion was measured with the other sign
    surface: Step | None = None  # what no law explains, as an unnamed force
    named: bool = True  # the laws explain enough to be the component's; else they are what comes closest

    @property
    def size(self) -> float:
        """Deviation of the held-out force, N."""
        return float(np.std(self.record.task.force[self.record.task.split :])) or 1.0

    @cached_property
    def by_chance(self) -> tuple[FloatArray, list[str]]:
        """Covariance of what the final model has, by chance alone, and names."""
        return covariance(self.final)

    @cached_property
    def covariance(self) -> tuple[FloatArray, list[str]]:
        """Covariance of what the final model has, with what the record leaves open besides chance, and names."""
        full, names = self.by_chance
        return full + left_open(self.final, [one.moved for one in self.alike]), names

    @cached_property
    def alike(self) -> tuple[Alike, ...]:
        """What the record does not tell from the laws that are named."""
        return look_alikes(self.final, self.found.steps if self.named else (), len(self.record.given.pieces))

    @property
    def errors(self) -> HeldOutErrors:
        held = [np.sqrt(fit.held_out) / self.size for fit in (self.base, self.final)]
        return HeldOutErrors(np.array(held[:1]), np.array(held[1:]), np.array([self.floor / self.size]))


def diagnose_components(system: System, record: Recorded, options: Options, tell: Progress) -> Report:
    """Diagnose every component test of a system without bodies.

    Errors: `DiagnosisError` when the recording cannot be used at all.
    """
    tell(0.05, "channels, motion and noise")
    pieces, own = pieces_of(options.catalogue)
    records = component_records(system, record.values, record.sample_rate, options.rules, own)
    judged = []
    for number, one in enumerate(records):

        def progress(text: str, name: str = one.element, share: float = 0.1 + 0.8 * number / len(records)) -> None:
            tell(share, f"{name}: {text}")

        judged.append(_judge(one, pieces, options.rules.verdict, progress))
    tell(0.95, "report")
    report = _report(system, record, options, judged)
    tell(1.0, "done")
    return report


def pieces_of(catalogue: Sequence[Law]) -> tuple[tuple[Piece, ...], tuple[Law, ...]]:
    """The pieces of a catalogue's laws, and the laws that have none, of which `own` makes pieces where it can.

    Of our own laws without a piece, those that do not act at an element or that are nuisances need none.
    """
    names = {law.name for law in catalogue}
    pieced = {law.name for piece in PIECES for law in (piece.law, piece.acting) if law is not None}
    others = [law for law in catalogue if law not in CATALOGUE or (_of_element(law) and law.name not in pieced)]
    return tuple(piece for piece in PIECES if piece.law.name in names), tuple(others)


def _of_element(law: Law) -> bool:
    return isinstance(law, ElementLaw) and law.where == "element" and not law.nuisance


def _judge(one: ComponentRecord, pieces: tuple[Piece, ...], rules: VerdictRules, tell: Told) -> Judged:
    turned = turned_round(one.task)
    if turned:
        one = replace(one, task=replace(one.task, force=-one.task.force))
    found = search(one.task, (*pieces, *one.own), tell, one.given)
    base, final = found.base, found.final
    judged = Judged(one, found, base, final, final.floor, turned)
    alone = _only_one_loop(judged)
    if alone:
        judged = replace(judged, record=replace(one, notes=(*one.notes, f"{one.element}: {_ONE_LOOP}")))
    else:
        judged = _established(judged, rules)
    share = judged.errors.explained(rules)
    left = bool(np.any(judged.errors.unexplained(rules) > 0))
    least = _least(judged.found.steps, one.task.rules)
    carried = bool(judged.found.steps) and share is not None and share >= least
    if alone or (left and not carried) or smooth_serves(judged.final, len(one.given.pieces)):
        tell("what is left, as a formula")
        told = _with_formula(judged, rules)
        if told is not None:
            return told
        tell("what is left, as an unnamed force")
        judged = replace(_with_surface(_closest(judged)), named=False)
    return judged


def _only_one_loop(judged: Judged) -> bool:
    """Whether a hysteresis beside other laws was seen along one loop alone, which such sums imitate whatever it is.

    The held-out part, the same loop again, refutes none of them.
    """
    task, found = judged.final.task, judged.found.steps
    if len(found) < 2 or task.signals or not any(step.chosen.last.kind is HYSTERESIS for step in found):
        return False
    return task.motion.repeats(task.rules)


def _least(steps: tuple[Step, ...], rules: ComponentRules) -> float:
    """Share of the excess power that laws explain if they are the component's; several imitate much that is none."""
    one = len(steps) < 2 and not any(isinstance(p, Piece) and p.imitates for p in (s.chosen.last for s in steps))
    return rules.named if one else 1 - rules.together


def _established(judged: Judged, rules: VerdictRules) -> Judged:
    """With the first law alone, where that is enough and several leave too much to be named.

    Where the first is not enough by itself, all stay, for what comes closest, and nothing is named.
    """
    task, steps = judged.final.task, judged.found.steps
    share = judged.errors.explained(rules)
    if len(steps) < 2 or share is None or share >= _least(steps, task.rules):
        return judged
    first = steps[0].chosen
    final = refined(task, first.fit.model)
    one = replace(judged, found=replace(judged.found, steps=steps[:1]), final=final, floor=final.floor)
    alone = one.errors.explained(rules)
    return one if alone is not None and alone >= _least(steps[:1], task.rules) else judged


def _with_formula(judged: Judged, rules: VerdictRules) -> Judged | None:
    """The force that no law explains as a formula, where one explains as much as a law has to."""
    with np.errstate(all="ignore"):  # trial formulas overflow
        found = formula_search(judged.record.task, judged.record.given)
    if found is None:
        return None
    told = replace(judged, found=found, final=found.final, floor=found.final.floor)
    share = told.errors.explained(rules)
    return told if share is not None and share >= judged.record.task.rules.named else None


def _closest(judged: Judged) -> Judged:
    """With the single law that predicts best, where it does so better than those that were not enough together."""
    task, found = judged.final.task, judged.found
    alone = [replace(ranked, fit=fitted(task, ranked.fit.model)) for ranked in found.alone]
    best = min(alone, key=lambda ranked: ranked.fit.held_out, default=None)
    if best is None or best.fit.held_out >= judged.final.held_out:
        return judged
    p_value = chance(best.gain, best.fit.model.count - judged.base.model.count, len(alone))
    if p_value > task.rules.alpha:
        return judged
    step = Step(best, Ranked(judged.base, 0.0, 0.0, best.count), (), p_value)
    return replace(judged, found=replace(found, steps=(step,)), final=best.fit, floor=best.fit.floor)


def _with_surface(judged: Judged) -> Judged:
    """The rest as an unnamed force, if that serves the held-out part.

    Which law stands beside it is of no meaning: whatever predicts best.
    """
    task, before = judged.final.task, judged.final
    beside = [judged.final.model, *(ranked.fit.model for ranked in judged.found.alone)]
    after = min((fitted(task, model.plus(SURFACE, ())) for model in beside), key=lambda fit: fit.held_out)
    if after.held_out > after.task.rules.surface_serves * before.held_out:
        return judged
    count = effective_count(after.residual[: task.split])
    gain = level_gain(before.error, after.error, count)
    step = Step(Ranked(after, gain, gain, count), Ranked(before, 0.0, 0.0, count), (), chance(gain, 16, 1))
    return replace(judged, final=after, surface=step)


def _report(system: System, record: Recorded, options: Options, judged: list[Judged]) -> Report:
    errors = HeldOutErrors(
        *(np.concatenate([getattr(j.errors, key) for j in judged]) for key in ("before", "after", "floor"))
    )
    findings: list[Finding] = []
    for one in judged:
        findings += _findings(one)
    kinds = {f.effect: kind_named(f.effect, options.catalogue) for f in findings}
    findings.sort(key=lambda f: _rank(f, kinds[f.effect]))
    told = [f for f in findings if kinds[f.effect] is not EffectKind.NUISANCE]
    rules = replace(options.rules.verdict, carried=options.rules.component.named)
    verdict = verdict_of([kinds[f.effect] for f in findings], errors, rules)
    explained = errors.explained(rules) if told else None
    left = errors.unexplained(rules)
    names = [j.record.sensor for j in judged]
    words = "; ".join(leftover_words(j.record.element, j.final, j.size) for j, x in zip(judged, left, strict=True) if x)
    unexplained = Unexplained(float(np.mean(left)), dict(zip(names, left.tolist(), strict=True)), words)
    advice = [note for j in judged for note in j.record.notes]
    return Report(
        system=system.name,
        recording=RecordingFacts(
            options.file, len(record.values) / record.sample_rate, len(record.values), int(record.lost)
        ),
        verdict=verdict,
        baseline=tuple(p for j in judged for p in _parameters(system, j.record.element, j.base, covariance(j.base))),
        baseline_validation=_figures(names, errors.before),
        findings=tuple(findings),
        augmented=tuple(p for j in judged for p in _parameters(system, j.record.element, j.final, j.covariance)),
        augmented_validation=_figures(names, errors.after),
        noise_floor=_figures(names, errors.bounded(rules)),
        localization={
            j.record.element: level_gain(j.base.error, j.final.error, effective_count(j.final.residual)) for j in judged
        },
        candidates=tuple(c for j in judged for c in _candidates(j)),
        explained=explained,
        laws=tuple(law for j in judged for law in _laws(j)),
        noise={j.record.sensor: j.record.task.noise for j in judged if j.record.task.noise > 0},
        unexplained=unexplained,
        summary=_summary(verdict, findings, told, explained, unexplained),
        advice=tuple(advice if verdict != "consistent" else []),
        evidence=_arrays(judged, record.sample_rate),
    )


def _rank(finding: Finding, kind: EffectKind) -> tuple[int, float]:
    """Set-up faults first, laws by evidence, nuisances last."""
    order = {EffectKind.FAULT: 0, EffectKind.NUISANCE: 2}.get(kind, 1)
    return order, finding.delta_bic if finding.delta_bic is not None else 0.0


def _findings(one: Judged) -> list[Finding]:
    full, names = one.covariance
    findings = []
    if one.reversed:
        findings.append(reversed_finding(one.record.sensor, one.record.element))
    for index, step in enumerate(one.found.steps if one.named else (), len(one.record.given.pieces)):
        sigma = spread(one.final, index, full, names)
        others = [other.effect for other in one.alike if other.index == index]
        if isinstance(one.final.model.pieces[index], Lag):
            late, std = one.final.model.late, float(sigma[0][0])
            findings.append(late_finding(one.record.sensor, one.record.element, late, std, step, others))
        else:
            findings.append(finding_of(one.record.element, one.final, one.base, index, step, sigma, others))
    first = None if one.named else next(iter(one.found.steps), None)
    unnamed = one.surface or first
    if unnamed is not None:
        findings.append(unknown_finding(one.record.element, unnamed, one.found.steps, mapped=one.surface is not None))
    deviation, by_chance = (float(np.sqrt(max(of[0, 0], 0.0))) for of in (full, one.by_chance[0]))
    sign = -1.0 if one.reversed else 1.0
    least = one.final.task.rules.preload * max(by_chance, one.floor / np.sqrt(one.record.task.split))
    if abs(one.final.preload) > least:
        findings.append(preload_finding(one.record.element, sign * one.final.preload, deviation))
    return findings


def _laws(one: Judged) -> tuple[IdentifiedLaw, ...]:
    """What a system file takes over: laws that are given or named, and the preload."""
    count = len(one.record.given.pieces) + (len(one.found.steps) if one.named else 0)
    return identified_laws(one.final, one.record.element, count, *one.covariance, -1.0 if one.reversed else 1.0)


def _parameters(
    system: System, element: str, fit: ComponentFit, told: tuple[FloatArray, list[str]]
) -> list[ReportedParameter]:
    full, names = told
    sigma = dict(zip(names, np.sqrt(np.maximum(np.diag(full), 0.0)).tolist(), strict=False))
    values = []
    for parameter in system.parameters:
        if parameter.element == element:
            value = float(getattr(fit.element, parameter.quantity))
            deviation = sigma.get(parameter.quantity, 0.0)
            values.append(ReportedParameter(parameter.name, value, deviation, parameter.nominal, parameter.unit))
    values.append(ReportedParameter(f"{element}.preload", fit.preload, sigma["preload"], 0.0, "N"))
    return values


def _figures(names: list[str], per_sensor: FloatArray) -> FitFigures:
    return FitFigures(float(np.sqrt(np.mean(per_sensor**2))), dict(zip(names, per_sensor.tolist(), strict=True)))


def _candidates(one: Judged) -> list[CandidateRow]:
    rows: dict[str, CandidateRow] = {}
    for step in one.found.steps:
        for ranked in (step.chosen, *step.rivals):
            delta = bic(ranked.gain, ranked.fit.model.count - step.before.fit.model.count, int(ranked.count))
            p_value = chance(ranked.gain, ranked.fit.model.count - step.before.fit.model.count, one.found.tests)
            rows.setdefault(
                ranked.last.effect, CandidateRow(one.record.element, ranked.last.effect, ranked.gain, p_value, delta)
            )
    for effect, gain in one.found.screened.items():
        rows.setdefault(effect, CandidateRow(one.record.element, effect, gain, chance(gain, 2, one.found.tests)))
    return list(rows.values())[:20]


def _summary(
    verdict: str, findings: list[Finding], told: list[Finding], explained: float | None, left: Unexplained
) -> str:
    if verdict == "consistent":
        text = "The nominal structure explains the recording down to the noise."
        nuisance = "; ".join(f.sentence for f in findings)
        return f"{text} {nuisance[:1].upper()}{nuisance[1:]}." if nuisance else text
    text = "; ".join(f.sentence for f in told)
    if not text:
        text = "No law of the catalogue explains what was measured"
    if explained is not None and explained > 0:
        share = 100 * explained
        exact = "100" if left.share == 0 else f"{min(share, 99):.0f}"
        text += f"; explains {exact} % of the excess error"
    if left.share > 0:
        text += f"; still unexplained: {left.where}"
    nuisance = "; ".join(f.sentence for f in findings if f not in told)
    return f"{text}{'; ' + nuisance if nuisance else ''}."


def _arrays(judged: list[Judged], sample_rate: float) -> dict[str, np.ndarray]:
    """Arrays for pictures: validation of every force, and for every law motion and force before and after."""
    first = judged[0]
    arrays: dict[str, np.ndarray] = {}
    if all(len(j.record.task.force) == len(first.record.task.force) for j in judged):
        at = {id(j): slice(_fine_split(j), None) for j in judged}
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
        arrays[f"{key}.loop_x"], arrays[f"{key}.loop_y"] = task.motion.deflection[thin], law[thin]
        arrays[f"{key}.total_measured"] = task.force[thin]
        arrays[f"{key}.total_modelled"] = one.final.force[thin]
    return arrays


def _columns_of_findings(one: Judged) -> list[slice]:
    """Which columns of the model every finding is: one law's, or all of what is unnamed."""
    counts = [len(piece.signs) for piece in one.final.model.pieces]
    given, steps = len(one.record.given.pieces), len(one.found.steps)
    if not one.named:
        return [slice(sum(counts[:given]), sum(counts))]
    return [slice(sum(counts[:i]), sum(counts[: i + 1])) for i in range(given, given + steps)]


def _fine_split(one: Judged) -> int:
    return one.final.task.split
