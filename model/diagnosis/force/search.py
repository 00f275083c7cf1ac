"""Forward selection of a component's laws beside spring, damper and preload, by evidence (`ranking`, `acceptance`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from sprung.model.diagnosis.force.acceptance import accepted
from sprung.model.diagnosis.force.fit import (
    NO_LAWS,
    ComponentFit,
    ComponentModel,
    ComponentTask,
    fitted,
    refined,
)
from sprung.model.diagnosis.force.following import Following
from sprung.model.diagnosis.force.lag import LAGS, Lag
from sprung.model.diagnosis.force.parts import LawPiece
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.diagnosis.force.pieces_following import pieces_following
from sprung.model.diagnosis.force.ranking import Ranked, Step, is_last_determined, next_laws, plausible, rank
from sprung.model.diagnosis.rules import ComponentRules
from sprung.model.diagnosis.selection.evidence import chance, effective_count

Progress = Callable[[str], None]


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
    quick = task.thinned(rules.search)
    fine = task.thinned(rules.fit)
    base = refined(quick, given)
    grown = _grown(base, pieces, tests, progress)
    composite = {piece.key for piece in grown.current.fit.model.pieces[len(given.pieces) :] if piece.commoner > 0}
    if composite:  # a law with many parameters may anticipate a sum of common ones
        progress(f"without {', '.join(sorted(composite))}")
        plainer = _grown(base, tuple(p for p in pieces if p.key not in composite), tests, progress)
        grown = replace(_plainer_of(grown, plainer, base, rules), first=grown.first)
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
        step = _late_beside_another(current, ranked, base, pieces, tests)
        step = step or accepted(current, ranked, base, rules, tests)
        if step is None and number == 0:
            step = _second_of_two(current, ranked, base, pieces, tests)
        if step is None:
            break
        steps.append(step)
        known = step.chosen if step.before is current else None
        current = _formed(_swapped(step.chosen, pieces, rules, given), rules, given)
        if current is not known:  # a law was exchanged, has another form, or came with the last one
            steps = _renamed(steps, current, given, tests, rules)
    return _SelectedLaws(current, tuple(steps), first)


def _late_beside_another(
    current: Ranked, ranked: list[Ranked], base: ComponentFit, pieces: tuple[LawPiece, ...], tests: int
) -> Step | None:
    """A lag that leads, with one earlier law exchanged: late friction looks like hysteresis until its lag is known."""
    rules, given = base.task.rules, len(base.model.pieces)
    if not ranked or not isinstance(ranked[0].last, Lag):
        return None
    exchanged = _swapped(ranked[0], pieces, rules, given)
    if exchanged is ranked[0]:
        return None
    model = exchanged.fit.model
    lag = next(index for index, piece in enumerate(model.pieces) if isinstance(piece, Lag))
    rest, task = model.without(lag), exchanged.fit.task
    before, beside = refined(task, rest), fitted(task, rest.plus(model.pieces[lag], model.shapes[lag]))
    return accepted(replace(current, fit=before), rank([beside], before, rules), base, rules, tests)


def _second_of_two(
    current: Ranked, ranked: list[Ranked], base: ComponentFit, pieces: tuple[LawPiece, ...], tests: int
) -> Step | None:
    """The second of two laws that predict better than none, while either alone does not.

    What one of them makes, the damper takes up beside the other: friction at the rates of the fitted part passes for
    damping that falls with the rate, and so hides one that grows with it.
    """
    rules, given = base.task.rules, len(base.model.pieces)
    firsts = [r for r in ranked if not isinstance(r.last, Lag) and r.evidence > 0 and is_last_determined(r.fit)]
    found = []
    for first in firsts[: rules.firsts]:
        beside = tuple(piece for piece in _beside(pieces, first.fit.model, given) if not isinstance(piece, Lag))
        step = accepted(first, next_laws(first.fit, beside, rules), base, rules, tests)
        if step is not None and step.chosen.fit.held_out < current.fit.held_out:
            found.append(step)
    return min(found, key=lambda step: step.chosen.fit.error, default=None)


def _plainer_of(one: _SelectedLaws, other: _SelectedLaws, base: ComponentFit, rules: ComponentRules) -> _SelectedLaws:
    """The one that predicts the held-out part better; of two equal ones that of commoner laws.

    other: found without the laws of many values in the first one; several likelier ones are what such a law stands for.
    """
    fits = [grown.current.fit for grown in (one, other)]
    best = min(fit.held_out for fit in fits)
    alike = [
        g for g, fit in zip((one, other), fits, strict=True) if fit.held_out <= rules.as_well * best or fit.at_noise
    ]
    if len(alike) > 1 and len(other.steps) > len(one.steps):
        likelier, less_likely = rank(fits, base, rules)
        if likelier.fit is other.current.fit and likelier.evidence > less_likely.evidence + rules.naming_margin:
            return other
    return min(alike, key=lambda g: (sum(p.commoner for p in g.current.fit.model.pieces), g.current.fit.model.count))


def _beside(pieces: tuple[LawPiece, ...], model: ComponentModel, given: int) -> tuple[LawPiece, ...]:
    """Laws that are identifiable beside those found, which follow the `given` first ones.

    A sum of friction and hysteresis can imitate any loop, so at most one rate-independent hysteresis is added.
    """
    if not any(piece.dissipates for piece in model.pieces[given:]):
        return pieces
    return tuple(piece for piece in pieces if isinstance(piece, Following) or not piece.dissipates)


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
            same = rank([rival.fit, best.fit], rest, rules)
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
        ranked = rank([*others, best.fit], rest, rules)
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
        ranked = rank([current.fit, *(r.fit for r in (*rivals, *forms))], without, rules)
        chosen = next(r for r in ranked if r.fit is current.fit)
        p_value = chance(chosen.gain, len(piece.signs) + len(piece.shapes), tests)
        others = [r for r in ranked if r is not chosen]
        before = Ranked(without, 0.0, 0.0, chosen.count)
        same = tuple(r for r in others if r.last.effect == piece.effect)
        result.append(Step(chosen, before, tuple(r for r in others if r not in same), p_value, same, index))
    return result
