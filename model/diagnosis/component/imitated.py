"""Whether laws imitate another force: most of what they leave is itself a force of the motion.

True laws leave noise, and what has nothing to do with the motion.  A law that resembles the true one leaves their
difference, which an unnamed force over deflection, rate and memory makes beside it.  Along a motion that repeats one
loop that force follows the loop whatever its origin, so that nothing is told.
"""

from __future__ import annotations

from sprung.model.diagnosis.force.fit import ComponentFit, fitted
from sprung.model.diagnosis.force.slider_surface import SURFACE
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
