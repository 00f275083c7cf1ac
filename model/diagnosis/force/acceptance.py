"""Which law, if any, is added to a component's: significant, determined by the record, and the plainest of equals."""

from __future__ import annotations

from itertools import islice

from sprung.model.diagnosis.force.fit import ComponentFit
from sprung.model.diagnosis.force.lag import Lag
from sprung.model.diagnosis.force.ranking import Ranked, Step, is_last_determined
from sprung.model.diagnosis.rules import ComponentRules
from sprung.model.diagnosis.selection.evidence import chance


def accepted(
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
    if alone and not current.fit.leaves_more and not is_last_determined(chosen.fit, by_all=True):
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
    close = _near_best(ranked, rules)
    if not close:
        return None, False
    determined = [r for r in close if is_last_determined(r.fit)] or _determined_rival(ranked)
    close = _without_doubtful_lags(determined or close, current, alone, rules)
    if not close and (not alone or current.leaves_more):  # else a mere delay within the noise: no law in its place
        close = [r for r in ranked if not isinstance(r.last, Lag) and r.evidence > 0][:1]
    return (_plainest(close, rules) if close else None), bool(determined)


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
    as_good = (r for r in ranked if r.fit.leaves_hardly_more(best) and is_last_determined(r.fit))
    return list(islice(as_good, 1))


def _without_doubtful_lags(
    close: list[Ranked], before: ComponentFit, alone: bool, rules: ComponentRules
) -> list[Ranked]:
    """Models without lags of the force's channel that may be physics.

    Beside a valve or hysteresis a lag may be compliance of oil or rubber, and a filter always is, since oil behind
    valves filters their force likewise.  alone: whether no law was found so far.
    """
    most = 1 - rules.by_lag if alone else rules.together
    return [
        r
        for r in close
        if not isinstance(r.last, Lag) or ((alone or not r.last.filters) and _leaves_nothing(r.fit, before, most))
    ]


def _removes_enough(fit: ComponentFit, before: ComponentFit, base: ComponentFit, rules: ComponentRules) -> bool:
    """Whether a further law removes enough of the held-out error."""
    removed = before.held_out - fit.held_out
    return removed >= max(rules.least_share * before.held_out, rules.minor * base.held_out)


def _plainest(close: list[Ranked], rules: ComponentRules) -> Ranked:
    """The model that predicts the held-out part best; of equal ones, the commonest law with fewest parameters.

    All models at the noise level count as equal.
    """
    best = min(ranked.fit.held_out for ranked in close)
    alike = [ranked for ranked in close if ranked.fit.held_out <= rules.as_well * best or ranked.fit.at_noise]
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
