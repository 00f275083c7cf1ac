"""The diagnosis of component tests: from a recording to a report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.component.compose import compose_components
from sprung.model.diagnosis.component.drifting import drifts, possible_drift
from sprung.model.diagnosis.component.formula import formula_search
from sprung.model.diagnosis.component.imitated import approximate, imitates
from sprung.model.diagnosis.component.judgement import JudgedComponent, concluded
from sprung.model.diagnosis.component.measured import ComponentRecord, component_records, turned_round
from sprung.model.diagnosis.component.smooth import smooth_serves
from sprung.model.diagnosis.force.fit import ComponentModel, fitted, refined
from sprung.model.diagnosis.force.lag import Lag
from sprung.model.diagnosis.force.parts import Part
from sprung.model.diagnosis.force.piece import HYSTERESIS, Piece
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.diagnosis.force.ranking import Ranked, Step, determined
from sprung.model.diagnosis.force.search import Progress as PieceProgress
from sprung.model.diagnosis.force.search import Search, search
from sprung.model.diagnosis.force.slider_surface import SURFACE
from sprung.model.diagnosis.investigation.state import Options, Progress, Recorded
from sprung.model.diagnosis.report.report import Report
from sprung.model.diagnosis.rules import ComponentRules, VerdictRules
from sprung.model.diagnosis.selection.evidence import chance, effective_count, level_gain
from sprung.model.laws import CATALOGUE, ElementLaw, Law
from sprung.model.system import System

_ONE_LOOP = (
    "the test repeats one loop, which several laws in combination can imitate whatever its origin; "
    "another amplitude or rate, or random motion, would tell them apart"
)


def diagnose_components(system: System, record: Recorded, options: Options, progress: Progress) -> Report:
    """Diagnose every component test of a system without bodies.

    Errors: `DiagnosisError` when the recording cannot be used at all.
    """
    progress(0.05, "channels, motion and noise")
    pieces, own = pieces_of(system.catalogue)
    records = component_records(system, record.values, record.sample_rate, options.rules, own)
    judged = []
    for number, one in enumerate(records):

        def of_component(text: str, name: str = one.element, share: float = 0.1 + 0.8 * number / len(records)) -> None:
            progress(share, f"{name}: {text}")

        judged.append(_judge(one, pieces, options.rules.verdict, of_component))
    progress(0.95, "report")
    report = compose_components(system, record, options, judged, concluded(judged, options.rules))
    progress(1.0, "done")
    return report


def pieces_of(catalogue: Sequence[Law]) -> tuple[tuple[Piece, ...], tuple[Law, ...]]:
    """Pieces of a catalogue's laws, and the laws without one, for `own` to make pieces of.

    Bundled laws without a piece are nuisances or do not act at elements.
    """
    names = {law.name for law in catalogue}
    pieced = {law.name for piece in PIECES for law in (piece.law, piece.acting) if law is not None}
    others = [law for law in catalogue if law not in CATALOGUE or (_of_element(law) and law.name not in pieced)]
    return tuple(piece for piece in PIECES if piece.law.name in names), tuple(others)


def _of_element(law: Law) -> bool:
    return isinstance(law, ElementLaw) and law.where == "element" and not law.nuisance


def _judge(
    one: ComponentRecord, pieces: tuple[Piece, ...], rules: VerdictRules, progress: PieceProgress
) -> JudgedComponent:
    turned = turned_round(one.task)
    if turned:
        one = replace(one, task=replace(one.task, force=-one.task.force))
    one, found = _searched(one, pieces, progress)
    base, final = found.base, found.final
    judged = JudgedComponent(one, found, base, final, final.floor, turned)
    alone = _only_one_loop(judged)
    if alone:
        judged = replace(judged, record=replace(one, notes=(*one.notes, f"{one.element}: {_ONE_LOOP}")))
    else:
        judged = _established(judged, rules)
    if alone or _doubtful(judged, rules):
        progress("remaining force as a formula")
        candidate = _with_formula(judged, rules)
        if candidate is not None:
            return candidate
        progress("remaining force as an unnamed force")
        judged = replace(_with_surface(_closest(judged)), named=False)
    return judged


def _searched(
    one: ComponentRecord, pieces: tuple[Piece, ...], progress: PieceProgress
) -> tuple[ComponentRecord, Search]:
    """The laws of a record; with a drift of the zero among what is given, if these with it are the record's."""
    candidates = (*pieces, *one.own)
    found = search(one.task, candidates, progress, one.given)
    drift = possible_drift(found, one.given)
    if drift is None:
        return one, found
    progress("laws beside a drift of the zero")
    given = one.given.plus(drift, ())
    beside = search(one.task, candidates, progress, given)
    return (replace(one, given=given), beside) if drifts(beside, found, given) else (one, found)


def _only_one_loop(judged: JudgedComponent) -> bool:
    """Whether laws that can imitate any loop were observed along a single one.

    The held-out part repeats the same loop and cannot refute them.  These are hysteresis beside other laws, and all
    sums and laws of many values that leave more than noise even of the loop they were fitted to.
    """
    task, pieces = judged.final.task, [step.piece for step in judged.found.steps]
    imitates = len(pieces) > 1 and any(piece.kind is HYSTERESIS for piece in pieces)
    imitates = imitates or (_imitating(pieces) and judged.final.leaves_more)
    return imitates and not task.signals and task.motion.repeats(task.rules)


def _doubtful(judged: JudgedComponent, rules: VerdictRules) -> bool:
    """Whether the laws, if any, explain too little of what is no noise, or others would do as well."""
    share, steps = judged.errors.explained(rules), judged.found.steps
    carried = bool(steps) and share is not None and share >= _least(steps, judged.final.task.rules)
    if np.any(judged.errors.unexplained(rules) > 0) and not carried:
        return True
    if steps and (judged.errors.outweigh_findings(rules) or judged.errors.reject(rules)):
        return True
    if steps and (imitates(judged.final, judged.base) or approximate(judged.final, judged.base, judged.alike)):
        return True
    return bool(_undetermined(judged)) or smooth_serves(judged.final, len(judged.record.given.pieces))


def _imitating(pieces: Sequence[Part]) -> bool:
    """Whether laws are so flexible that they imitate others: several, or one of many values."""
    return len(pieces) > 1 or any(isinstance(piece, Piece) and piece.imitates for piece in pieces)


def _undetermined(judged: JudgedComponent) -> list[int]:
    """Which of several laws that leave more than noise might be absent by their stated deviations.

    Their sum is then one of many that make nearly the same force.
    """
    final, first = judged.final, len(judged.record.given.pieces)
    if len(judged.found.steps) < 2 or not final.leaves_more:
        return []
    laws = [n for n in range(len(judged.found.steps)) if not isinstance(final.model.pieces[first + n], Lag)]
    return [n for n in laws if not determined(final, first + n, *judged.covariance)]


def _least(steps: tuple[Step, ...], rules: ComponentRules) -> float:
    """Least share of the excess power that true laws explain; more for several laws, which are more flexible."""
    return 1 - rules.together if _imitating([step.piece for step in steps]) else rules.named


def _established(judged: JudgedComponent, rules: VerdictRules) -> JudgedComponent:
    """With the first law only, if it suffices and several laws leave too much to be named, or are undetermined.

    If the first does not suffice, all are kept as the closest approximation, and none is named.
    """
    task, steps = judged.final.task, judged.found.steps
    share = judged.errors.explained(rules)
    if len(steps) < 2 or share is None:
        return judged
    undetermined = _undetermined(judged)
    if 0 in undetermined or (share >= _least(steps, task.rules) and not undetermined):
        return judged
    final = refined(task, _given_and(judged, steps[0]))
    one = replace(judged, found=replace(judged.found, steps=steps[:1]), final=final, floor=final.floor)
    alone = one.errors.explained(rules)
    return one if alone is not None and alone >= _least(steps[:1], task.rules) else judged


def _given_and(judged: JudgedComponent, step: Step) -> ComponentModel:
    """The given laws and that of a step alone, which others may have been found beside."""
    model = step.chosen.fit.model
    kept = [*range(len(judged.record.given.pieces)), step.index % len(model.pieces)]
    return ComponentModel(tuple(model.pieces[i] for i in kept), tuple(model.shapes[i] for i in kept))


def _with_formula(judged: JudgedComponent, rules: VerdictRules) -> JudgedComponent | None:
    """With a formula for the unexplained force, if it explains as much as a law must, and hardly less than the laws."""
    with np.errstate(all="ignore"):  # trial formulas overflow
        found = formula_search(judged.record.task, judged.record.given)
    if found is None:
        return None
    candidate = replace(judged, found=found, final=found.final, floor=found.final.floor)
    share, final = candidate.errors.explained(rules), candidate.final
    if share is None or share < judged.record.task.rules.named:
        return None
    return None if final.leaves_more and not final.leaves_hardly_more(judged.final) else candidate


def _closest(judged: JudgedComponent) -> JudgedComponent:
    """With the single law that predicts best, if it predicts better than the insufficient combination."""
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


def _with_surface(judged: JudgedComponent) -> JudgedComponent:
    """With the remainder as an unnamed force, if that improves the held-out part.

    The law beside it is chosen by prediction only and has no meaning.
    """
    task, before = judged.final.task, judged.final
    beside = [judged.final.model, *(ranked.fit.model for ranked in judged.found.alone)]
    after = min((fitted(task, model.plus(SURFACE, ())) for model in beside), key=lambda fit: fit.held_out)
    if after.held_out > after.task.rules.surface_serves * before.held_out:
        return judged
    count = effective_count(after.residual[: task.split])
    gain = level_gain(before.error, after.error, count)
    by_chance = chance(gain, after.task.rules.surface, 1)
    step = Step(Ranked(after, gain, gain, count), Ranked(before, 0.0, 0.0, count), (), by_chance)
    return replace(judged, final=after, surface=step)
