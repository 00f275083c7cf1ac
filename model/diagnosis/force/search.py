"""Forward selection of a component's laws beside spring, damper and preload, by evidence.

The evidence of a model is its gain over the linear one, n log(mean square before / after), less log n per parameter
(BIC) and the cost of searching many laws.  n is the effective number of independent values in the residual, since the
errors of a sine test repeat with every cycle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from sprung.model.diagnosis.force.deviations import covariance, left_open, spread
from sprung.model.diagnosis.force.fit import (
    NO_LAWS,
    ComponentFit,
    ComponentModel,
    ComponentTask,
    bounded_solution,
    fitted,
    refined,
)
from sprung.model.diagnosis.force.piece import LAGS, FittedPiece, Following, Lag, LawPiece, Part
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.diagnosis.force.pieces_following import pieces_following
from sprung.model.diagnosis.rules import ComponentRules
from sprung.model.diagnosis.selection.evidence import bic, chance, effective_count, level_gain
from sprung.model.signals import FloatArray

Progress = Callable[[str], None]


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


@dataclass(frozen=True)
class Search:
    """Result of a search."""

    base: ComponentFit
    final: ComponentFit
    steps: tuple[Step, ...]
    screened: dict[str, float]  # law -> gain of its best trial alone, as screened
    alone: tuple[Ranked, ...] = ()  # models with one law, best first, named or not
    tests: int = 1  # number of tests, for the correction of p-values


def search(
    task: ComponentTask,
    pieces: tuple[LawPiece, ...] = PIECES,
    progress: Progress = lambda text: None,
    given: ComponentModel = NO_LAWS,
    lags: tuple[Lag, ...] = LAGS,
) -> Search:
    """Add laws until the residual is noise, or no law explains enough of it.

    given: laws of the system file, to which others are added.  lags: of a measured force behind the motion.
    """
    rules = task.rules
    tests = rules.trials_of_a_law * len(pieces)
    pieces = (*pieces, *(piece for signal in task.signals for piece in pieces_following(signal)), *lags)
    quick = task.every(max(1, len(task.force) // rules.search))
    fine = task.every(max(1, len(task.force) // rules.fit))
    base = refined(quick, given)
    grown = _grown(base, pieces, tests, progress)
    composite = {piece.key for piece in grown.current.fit.model.pieces[len(given.pieces) :] if piece.commoner > 0}
    if composite:  # a law with many parameters may anticipate a sum of common ones
        progress(f"without {', '.join(sorted(composite))}")
        plainer = _grown(base, tuple(p for p in pieces if p.key not in composite), tests, progress)
        grown = replace(_plainer_of(grown, plainer, rules), first=grown.first)
    final = refined(fine, grown.current.fit.model)
    screened: dict[str, float] = {}
    for trial in grown.first:
        screened[trial.last.effect] = max(screened.get(trial.last.effect, 0.0), trial.gain)
    return Search(refined(fine, base.model), final, grown.steps, screened, grown.first, tests)


@dataclass(frozen=True)
class _SelectedLaws:
    """A model with the steps that led to it."""

    current: Ranked
    steps: tuple[Step, ...]
    first: tuple[Ranked, ...]  # models with one law, best first


def _grown(base: ComponentFit, pieces: tuple[LawPiece, ...], tests: int, progress: Progress) -> _SelectedLaws:
    """Forward selection until the residual is noise, or no law explains enough of it."""
    task, rules, given = base.task, base.task.rules, len(base.model.pieces)
    current = Ranked(base, 0.0, 0.0, effective_count(base.residual[: task.split]))
    steps: list[Step] = []
    first: tuple[Ranked, ...] = ()
    for number in range(rules.most + rules.per_signal * len(task.signals)):
        if current.fit.at_noise:
            break
        progress(f"laws beside {', '.join(p.effect for p in current.fit.model.pieces) or 'spring and damper'}")
        ranked = next_laws(current.fit, _beside(pieces, current.fit.model, given), rules)
        if number == 0:
            first = tuple(ranked)
        step = _accepted(current, ranked, base, rules, tests)
        if step is None:
            break
        steps.append(step)
        current = _formed(_swapped(step.chosen, pieces, rules, given), rules, given)
        if current is not step.chosen:  # an earlier law was exchanged, or one has another form
            steps = _renamed(steps, current, given, tests, rules)
    return _SelectedLaws(current, tuple(steps), first)


def _plainer_of(one: _SelectedLaws, other: _SelectedLaws, rules: ComponentRules) -> _SelectedLaws:
    """The one that predicts the held-out part better; of two equal ones, that of commoner laws."""
    fits = [grown.current.fit for grown in (one, other)]
    best = min(fit.held_out for fit in fits)
    alike = [
        g for g, fit in zip((one, other), fits, strict=True) if fit.held_out <= rules.as_well * best or fit.at_noise
    ]
    return min(alike, key=lambda g: (sum(p.commoner for p in g.current.fit.model.pieces), g.current.fit.model.count))


def _beside(pieces: tuple[LawPiece, ...], model: ComponentModel, given: int) -> tuple[LawPiece, ...]:
    """Laws that are identifiable beside those found, which follow the `given` first ones.

    A sum of friction and hysteresis can imitate any loop, so at most one rate-independent hysteresis is added.
    """
    if not any(piece.dissipates for piece in model.pieces[given:]):
        return pieces
    return tuple(piece for piece in pieces if isinstance(piece, Following) or not piece.dissipates)


def _rank(fits: list[ComponentFit], before: ComponentFit, rules: ComponentRules) -> list[Ranked]:
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
    return _rank(list(best.values()), current, rules)


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


def _determined(fit: ComponentFit, *, by_all: bool = False) -> bool:
    """Whether the last law is determined.  by_all: with systematic errors."""
    full, names = covariance(fit)
    return determined(fit, len(fit.model.pieces) - 1, full + left_open(fit) if by_all else full, names)


def _accepted(
    current: Ranked, ranked: list[Ranked], base: ComponentFit, rules: ComponentRules, tests: int
) -> Step | None:
    """The next law, if one is significant, improves the held-out part and removes enough of the error.

    current: the model so far; ranked: models with one more law, best first; base: the model with the given laws alone.
    """
    alone = len(current.fit.model.pieces) == len(base.model.pieces)
    chosen, determined = _leading(ranked, current.fit, alone, rules)
    if chosen is None:
        return None
    p_value = chance(chosen.gain, chosen.fit.model.count - current.fit.model.count, tests)
    if p_value > rules.alpha or chosen.fit.held_out >= current.fit.held_out:
        return None
    if alone and not current.fit.leaves_more and not _determined(chosen.fit, by_all=True):
        return None  # where all may be noise, the law's value must be certain
    if current.fit.model.pieces and not (determined and _removes_enough(chosen.fit, current.fit, base, rules)):
        return None
    others = [r for r in ranked if r is not chosen]
    rivals = tuple(r for r in others if r.last.effect != chosen.last.effect)
    forms = tuple(r for r in others if r.last.effect == chosen.last.effect)
    return Step(chosen, current, rivals, p_value, forms)


def _leading(
    ranked: list[Ranked], current: ComponentFit, alone: bool, rules: ComponentRules
) -> tuple[Ranked | None, bool]:
    """The plainest of the best models, and whether any of these is determined by the record.

    alone: whether `current` has no laws but the given ones.
    """
    near = _near_best(ranked, rules)
    if not near:
        return None, False
    determined = [r for r in near if _determined(r.fit)] or _determined_rival(ranked)
    near = _without_doubtful_lags(determined or near, current, alone, rules)
    if not near and (not alone or current.leaves_more):  # else a mere delay within the noise: no law in its place
        near = [r for r in ranked if not isinstance(r.last, Lag) and r.evidence > 0][:1]
    return (_plainest(near, rules) if near else None), bool(determined)


def _near_best(ranked: list[Ranked], rules: ComponentRules) -> list[Ranked]:
    """Models within the naming margin of the best one, and all that leave nothing but noise."""
    if not ranked:
        return []
    least = max(0.0, ranked[0].evidence - rules.naming_margin)
    return [r for r in ranked if r.evidence > least or (r.evidence > 0 and r.fit.at_noise)]


def _determined_rival(ranked: list[Ranked]) -> list[Ranked]:
    """The first model, best first, with a determined law that leaves hardly more error than the best model.

    Only where the best model leaves more than noise: it then is not the true one, but more flexible.
    """
    best = ranked[0].fit
    if not best.leaves_more:
        return []
    close = (r for r in ranked if r.fit.leaves_hardly_more(best) and _determined(r.fit))
    return list(islice(close, 1))


def _without_doubtful_lags(
    near: list[Ranked], before: ComponentFit, alone: bool, rules: ComponentRules
) -> list[Ranked]:
    """Models without lags of the force's channel that may be physics.

    Beside a valve or hysteresis a lag may be compliance of oil or rubber, and a filter always is, since oil behind
    valves filters their force likewise.  alone: whether no law was found so far.
    """
    most = 1 - rules.by_lag if alone else rules.together
    return [
        r
        for r in near
        if not isinstance(r.last, Lag) or ((alone or not r.last.filters) and _leaves_nothing(r.fit, before, most))
    ]


def _removes_enough(fit: ComponentFit, before: ComponentFit, base: ComponentFit, rules: ComponentRules) -> bool:
    """Whether a further law removes enough of the held-out error."""
    removed = before.held_out - fit.held_out
    return removed >= max(rules.least_share * before.held_out, rules.minor * base.held_out)


def _plainest(near: list[Ranked], rules: ComponentRules) -> Ranked:
    """The model that predicts the held-out part best; of equal ones, the commonest law with fewest parameters.

    All models at the noise level count as equal.
    """
    best = min(ranked.fit.held_out for ranked in near)
    alike = [ranked for ranked in near if ranked.fit.held_out <= rules.as_well * best or ranked.fit.at_noise]
    return min(alike, key=lambda ranked: (ranked.last.commoner, ranked.fit.model.count, ranked.fit.held_out))


def _leaves_nothing(lag: ComponentFit, before: ComponentFit, most: float) -> bool:
    """Whether a lag explains nearly all of the error; a lag that explains a part of it may be hysteresis.

    most: share of the previous power beyond noise that may be left.
    """
    floor = lag.floor**2
    if before.held_out < before.task.rules.above * floor:
        return False
    return all(
        after - floor < most * max(was - floor, 0.0)
        for after, was in ((lag.error, before.error), (lag.held_out, before.held_out))
    )


def _swapped(chosen: Ranked, pieces: tuple[LawPiece, ...], rules: ComponentRules, given: int) -> Ranked:
    """The same with one earlier, not given law exchanged, if that gains the naming margin in evidence."""
    model = chosen.fit.model
    if len(model.pieces) < 2:
        return chosen
    best = chosen
    for index in range(given, len(model.pieces) - 1):
        rest = fitted(chosen.fit.task, model.without(index))
        others = tuple(p for p in _beside(pieces, rest.model, given) if not isinstance(p, Lag))  # see `_accepted`
        for rival in next_laws(rest, others, rules)[:2]:
            same = _rank([rival.fit, best.fit], rest, rules)
            if same[0].fit is rival.fit and same[0].evidence > same[1].evidence + rules.naming_margin:
                best = same[0]
    return best


def _formed(chosen: Ranked, rules: ComponentRules, given: int) -> Ranked:
    """The same with laws that follow a signal in another form, if that gains the naming margin in evidence."""
    best = chosen
    for index in range(given, len(chosen.fit.model.pieces)):
        others = _other_forms(best.fit, index)
        if not others:
            continue
        rest = fitted(chosen.fit.task, best.fit.model.without(index))
        ranked = _rank([*others, best.fit], rest, rules)
        own = next(r for r in ranked if r.fit is best.fit)
        better = ranked[0].evidence > own.evidence + rules.naming_margin
        best = ranked[0] if better and ranked[0].fit.held_out < own.fit.held_out else best
    return best


def _other_forms(fit: ComponentFit, index: int) -> list[ComponentFit]:
    """Fits with another dependence of a law on its signal."""
    model, piece = fit.model, fit.model.pieces[index]
    if not isinstance(piece, Following):
        return []
    strengths, shape = fit.strengths_of(index), model.shapes[index]
    starts = ((form, start) for form in piece.forms for start in form.starts(strengths, shape))
    others = [refined(fit.task, model.replaced(index, form, start)) for form, start in starts]
    return [other for other in others if plausible(other, index)]


def _renamed(steps: list[Step], current: Ranked, given: int, tests: int, rules: ComponentRules) -> list[Step]:
    """Steps of a model after an exchange: every law, and its rivals, over the model without it."""
    model = current.fit.model
    result = []
    for index in range(given, len(model.pieces)):
        piece = model.pieces[index]
        known = next((s for s in steps if s.piece.effect == piece.effect), None)
        rivals, forms = (known.rivals, known.forms) if known else ((), ())
        without = fitted(current.fit.task, model.without(index))
        ranked = _rank([current.fit, *(r.fit for r in (*rivals, *forms))], without, rules)
        chosen = next(r for r in ranked if r.fit is current.fit)
        p_value = chance(chosen.gain, len(piece.signs) + len(piece.shapes), tests)
        others = [r for r in ranked if r is not chosen]
        before = Ranked(without, 0.0, 0.0, chosen.count)
        same = tuple(r for r in others if r.last.effect == piece.effect)
        result.append(Step(chosen, before, tuple(r for r in others if r not in same), p_value, same, index))
    return result
