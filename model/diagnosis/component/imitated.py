"""Whether laws imitate another force: most of what they leave is itself a force of the motion.

True laws leave noise, and what has nothing to do with the motion.  A law that resembles the true one leaves their
difference, which an unnamed force over deflection, rate and memory makes beside it.  Along a motion that repeats one
loop that force follows the loop whatever its origin, so that nothing is told.
"""

from __future__ import annotations

from collections.abc import Iterable

from sprung.model.diagnosis.component.alike import EquivalentModel
from sprung.model.diagnosis.force.fit import ComponentFit, fitted
from sprung.model.diagnosis.force.slider_surface import SURFACE
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.selection.evidence import chance, effective_count, level_gain


def imitates(fit: ComponentFit, base: ComponentFit) -> bool:
    """Whether the laws of a fit leave a force of the motion.  base: the model without them.

    It counts if it is a visible share of what that model leaves, in either part of the record, and if the held-out part
    does not refute it.
    """
    task, rules = fit.task, fit.task.rules
    if not fit.leaves_more or task.motion.repeats(rules):
        return False
    noise, beside = fit.floor**2, fitted(task, fit.model.plus(SURFACE, ()))
    if beside.held_out > max(fit.held_out, rules.above * noise):
        return False
    gain = level_gain(fit.error, beside.error, effective_count(fit.residual[: task.split]))
    if chance(gain, rules.surface, 1) > rules.alpha:
        return False
    return any(
        left - noise > rules.imitated * (without - noise) and rest - noise < rules.another_force * (left - noise)
        for without, left, rest in (
            (base.error, fit.error, beside.error),
            (base.held_out, fit.held_out, beside.held_out),
        )
    )


def approximate(fit: ComponentFit, base: ComponentFit, alike: Iterable[EquivalentModel]) -> bool:
    """Whether the laws of a fit are no more than approximations: others leave as much, and that is no noise.

    A true law leaves less than one that resembles it, and predicts the held-out part better.  base: the model without
    them; alike: the look-alikes.  Along a motion that repeats one loop the record may be too poor to tell them apart,
    whatever else the rig adds.
    """
    if not fit.leaves_more or fit.task.motion.repeats(fit.task.rules):
        return False
    noise, rules = fit.floor**2, fit.task.rules
    parts = (base.error, fit.error), (base.held_out, fit.held_out)
    if not any(left - noise > rules.together * (without - noise) for without, left in parts):
        return False
    laws, most = {piece.effect for piece in fit.model.pieces}, noise + rules.as_good * (fit.held_out - noise)
    return any(
        one.fit.model.pieces[one.index].effect_kind is EffectKind.LISTED
        for one in alike
        if one.effect not in laws and one.fit.leaves_more and one.fit.held_out <= most
    )
