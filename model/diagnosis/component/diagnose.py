"""The diagnosis of component tests: from a recording to a report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.component.compose import compose_components
from sprung.model.diagnosis.component.fit import fitted, refined
from sprung.model.diagnosis.component.formula import formula_search
from sprung.model.diagnosis.component.judgement import Judged, concluded
from sprung.model.diagnosis.component.measured import ComponentRecord, component_records, turned_round
from sprung.model.diagnosis.component.piece import HYSTERESIS, SURFACE, Piece
from sprung.model.diagnosis.component.pieces import PIECES
from sprung.model.diagnosis.component.search import Progress as Told
from sprung.model.diagnosis.component.search import Ranked, Step, search
from sprung.model.diagnosis.component.smooth import smooth_serves
from sprung.model.diagnosis.investigation.state import Options, Progress, Recorded
from sprung.model.diagnosis.report.report import Report
from sprung.model.diagnosis.rules import ComponentRules, VerdictRules
from sprung.model.diagnosis.selection.evidence import chance, effective_count, level_gain
from sprung.model.laws import CATALOGUE, ElementLaw, Law
from sprung.model.system import System

_ONE_LOOP = (
    "the test repeats one loop, which several laws together imitate whatever made it; "
    "another amplitude or rate, or random motion, would tell them apart"
)


def diagnose_components(system: System, record: Recorded, options: Options, tell: Progress) -> Report:
    """Diagnose every component test of a system without bodies.

    Errors: `DiagnosisError` when the recording cannot be used at all.
    """
    tell(0.05, "channels, motion and noise")
    pieces, own = pieces_of(system.catalogue)
    records = component_records(system, record.values, record.sample_rate, options.rules, own)
    judged = []
    for number, one in enumerate(records):

        def progress(text: str, name: str = one.element, share: float = 0.1 + 0.8 * number / len(records)) -> None:
            tell(share, f"{name}: {text}")

        judged.append(_judge(one, pieces, options.rules.verdict, progress))
    tell(0.95, "report")
    report = compose_components(system, record, options, judged, concluded(judged, options.rules))
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
