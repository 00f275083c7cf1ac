"""Models with one law more, fitted and ranked by evidence; which of them are plausible and determined.

The evidence of a model is its gain over the linear one, n log(mean square before / after), less log n per parameter
(BIC) and the cost of searching many laws.  n is the effective number of independent values in the residual, since the
errors of a sine test repeat with every cycle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.diagnosis.force.deviations import covariance, left_open, spread
from sprung.model.diagnosis.force.fit import ComponentFit, ComponentModel, bounded_solution, fitted, refined
from sprung.model.diagnosis.force.lag import Lag
from sprung.model.diagnosis.force.parts import LawPiece, Part
from sprung.model.diagnosis.force.piece import FittedPiece
from sprung.model.diagnosis.rules import ComponentRules
from sprung.model.diagnosis.selection.evidence import bic, effective_count, level_gain
from sprung.model.signals import FloatArray


@dataclass(frozen=True)
class Ranked:
    """A model with its evidence over the linear one."""

    fit: ComponentFit
    gain: float
    evidence: float
    count: float  # effective numbers

    @property
    def last(self) -> Part:
        return self.fit.model.pieces[-1]


@dataclass(frozen=True)
class Step:
    """One accepted law among its rivals."""

    chosen: Ranked
    before: Ranked
    rivals: tuple[Ranked, ...]  # other laws in its place, best first
    p_value: float
    forms: tuple[Ranked, ...] = ()  # other forms of the same law
    index: int = -1  # of the law among the chosen model's

    @property
    def piece(self) -> Part:
        """The accepted law."""
        return self.chosen.fit.model.pieces[self.index]

    @property
    def gain(self) -> float:
        return level_gain(self.before.fit.error, self.chosen.fit.error, self.chosen.count)

    @property
    def delta_bic(self) -> float:
        """BIC of the chosen law over the model without it."""
        return bic(self.gain, len(self.piece.signs) + len(self.piece.shapes), int(self.chosen.count))

    def rival_bic(self, rival: Ranked) -> float:
        """BIC of another law in its place."""
        return bic(rival.gain, rival.fit.model.count - self.before.fit.model.count, int(rival.count))


def rank(fits: list[ComponentFit], before: ComponentFit, rules: ComponentRules) -> list[Ranked]:
    """Fits by their evidence over one that all of them extend."""
    if not fits:
        return []
    best = min(fits, key=lambda fit: fit.error)
    count = effective_count(best.residual[: best.task.split])
    ranked = []
    for fit in fits:
        gain = level_gain(before.error, fit.error, count)
        cost = (fit.model.count - before.model.count) * float(np.log(count)) if count > 1 else 0.0
        cost += rules.plain_cost * sum(piece.commoner for piece in fit.model.pieces)
        ranked.append(Ranked(fit, gain, gain - cost, count))
    return sorted(ranked, key=lambda r: -r.evidence)


def next_laws(current: ComponentFit, pieces: tuple[LawPiece, ...], rules: ComponentRules) -> list[Ranked]:
    """Models with one more law, refined, best first."""
    used = {piece.effect for piece in current.model.pieces}
    kinds = {piece.kind for piece in current.model.pieces if piece.dissipates}
    open_pieces = [p for p in pieces if p.effect not in used and p.kind not in kinds]
    trials = [trial for piece in open_pieces for trial in _trials(current, piece, rules)]
    trials.sort(key=lambda t: t[0])
    seen: dict[str, int] = {}
    chosen = []
    for _error, model in trials:
        name = model.pieces[-1].key
        if name not in seen and len(seen) >= rules.close + rules.beside:
            continue
        seen[name] = seen.get(name, 0) + 1
        if seen[name] <= rules.starts:
            chosen.append(model)
    fits = [refined(current.task, model) for model in chosen]
    best: dict[str, ComponentFit] = {}
    for fit in fits:
        name = fit.model.pieces[-1].key
        if plausible(fit) and (name not in best or fit.error < best[name].error):
            best[name] = fit
    return rank(list(best.values()), current, rules)


def _trials(current: ComponentFit, piece: LawPiece, rules: ComponentRules) -> list[tuple[float, ComponentModel]]:
    """The best trial shapes of a law beside the present ones: residual sum of squares, and model."""
    task = current.task
    if isinstance(piece, Lag):
        late = (current.model.plus(piece, (float(row[0]),)) for row in piece.grid(task.seen))
        fits = [fitted(task, model) for model in late]
        return sorted(((fit.error * task.split, fit.model) for fit in fits), key=lambda t: t[0])[: rules.starts]
    task = task.through(current.model.channel)
    base, free, force = task.linear
    train = slice(0, task.split)
    fixed = np.column_stack([base, current.model.columns(current.task)])[train]
    signs = tuple(np.array([0, 1, 1])[free].tolist()) + current.model.signs
    found = []
    for row in piece.grid(task.seen):
        shape = tuple(float(value) for value in row)
        columns = task.columns_of(piece, shape)[train]
        if not np.all(np.isfinite(columns)):
            continue
        _, left = bounded_solution(np.column_stack([fixed, columns]), force[train], (*signs, *piece.signs))
        found.append((left, current.model.plus(piece, shape)))
    return sorted(found, key=lambda t: t[0])[: rules.starts]


def plausible(fit: ComponentFit, index: int = -1) -> bool:
    """Whether the values of a law, by default the last, are admissible and resolved by the sampling."""
    index %= len(fit.model.pieces)
    piece, strengths = fit.model.pieces[index], fit.strengths_of(index)
    if len(strengths) and not np.any(np.abs(strengths) > 0):
        return False
    task = fit.task
    return piece.plausible(
        FittedPiece(
            values={name: value for name, (value, _) in fit.values(index).items()},
            strengths=strengths,
            shape=fit.model.shapes[index],
            element=fit.element,
            deflection=task.motion.deflection,
            corner=task.seen.slowest_corner(task.motion),
            rules=task.rules,
            step=task.motion.step,
            seconds=task.seen.seconds,
        )
    )


def determined(fit: ComponentFit, index: int, full: FloatArray, names: list[str]) -> bool:
    """Whether a law's first parameter and first quoted value are significant under a named covariance (K, K)."""
    sigma = spread(fit, index, full, names)
    values = [fit.values(index), fit.quoted(index)]
    significant = [
        abs(next(iter(of.values()))[0]) > fit.task.rules.significant * float(s[0])
        for of, s in zip(values, sigma, strict=True)
        if of
    ]
    return all(significant)


def is_last_determined(fit: ComponentFit, *, by_all: bool = False) -> bool:
    """Whether the last law is determined.  by_all: with systematic errors."""
    full, names = covariance(fit)
    return determined(fit, len(fit.model.pieces) - 1, full + left_open(fit) if by_all else full, names)
