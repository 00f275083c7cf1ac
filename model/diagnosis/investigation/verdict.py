"""The verdict: one pure function of errors, bounded noise and findings, decided before anything is written.

Three errors are distinguished on the held-out part, as shares of every sensor's measured power:

    before - after          explained by the findings
    floor                   noise, bounded by what was declared or measured independently of the model
    after - floor           unexplained

`consistent` requires no unexplained share.  A noise level estimated from the misfit alone is no bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sprung.model.diagnosis.investigation.configuration.effects import SetupEffect
from sprung.model.diagnosis.kinds import EffectKind, kind_of_law
from sprung.model.diagnosis.rules import RULES, VerdictRules
from sprung.model.laws import Law
from sprung.model.signals import FloatArray

Verdict = Literal["consistent", "missing_physics", "sensor_fault", "unknown_physics"]


def kind_of(effect: Law | SetupEffect) -> EffectKind:
    """The kind of a law or of a set-up fault."""
    return EffectKind.FAULT if isinstance(effect, SetupEffect) else kind_of_law(effect)


@dataclass(frozen=True)
class HeldOutErrors:
    """Held-out errors over the measured signal, rms over rms, per sensor (S,)."""

    before: FloatArray  # of the nominal structure identified again
    after: FloatArray  # with the findings
    floor: FloatArray  # bounded noise

    def at(self, sensors: Sequence[int]) -> HeldOutErrors:
        """The errors of some sensors."""
        chosen = list(sensors)
        return HeldOutErrors(self.before[chosen], self.after[chosen], self.floor[chosen])

    def bounded(self, rules: VerdictRules = RULES.verdict) -> FloatArray:
        """The floor, with the sampling error of a perfect model, (S,)."""
        return np.hypot(self.floor, rules.least)

    def unexplained(self, rules: VerdictRules = RULES.verdict) -> FloatArray:
        """Share of every sensor's power that neither model nor bounded noise explains, (S,); 0 if insignificant."""
        floor = self.bounded(rules)
        pooled = np.sqrt(np.mean(self.after**2)) > rules.clear * np.sqrt(np.mean(floor**2))
        left = (self.after > rules.clear_sensor * floor) | (pooled & (self.after > rules.clear * floor))
        return np.where(left, np.maximum(self.after**2 - floor**2, 0.0), 0.0)

    def explained(self, rules: VerdictRules = RULES.verdict) -> float | None:
        """Share of the error power beyond the bounded floor that the findings remove; None: there was none."""
        floor = float(np.mean(self.bounded(rules) ** 2))
        excess = float(np.mean(self.before**2)) - floor
        left = max(0.0, float(np.mean(self.after**2)) - floor)
        return float(np.clip(1 - left / excess, -1.0, 1.0)) if excess > 0 else None

    def reject(self, rules: VerdictRules = RULES.verdict) -> bool:
        """Whether the errors reject the model, whatever the noise."""
        return float(np.sqrt(np.mean(self.after**2))) > rules.rejected

    def outweigh_findings(self, rules: VerdictRules = RULES.verdict) -> bool:
        """Whether more is left unexplained than findings with a name may leave."""
        left = self.unexplained(rules)
        share = self.explained(rules)
        carried_too_little = bool(np.any(left > 0)) and share is not None and share < rules.carried
        return carried_too_little or float(np.max(left, initial=0.0)) > rules.gross


def verdict_of(
    kinds: Sequence[EffectKind],
    errors: HeldOutErrors,
    rules: VerdictRules = RULES.verdict,
    *,
    other_structure: bool = False,
    imitated: bool = False,
    ended: bool = False,
) -> Verdict:
    """The verdict for findings of the given kinds, best first, and the errors that they leave.

    other_structure: the findings imitate another structure than the system file's.
    imitated: a law among them imitates another force.
    ended: the search ended at its limit, so that effects may have been missed.
    """
    if other_structure or imitated:
        return "unknown_physics"
    kinds = [kind for kind in kinds if kind is not EffectKind.NUISANCE]
    physics = [kind for kind in kinds if kind is not EffectKind.FAULT]
    left = bool(np.any(errors.unexplained(rules) > 0))
    if errors.reject(rules) and (left or physics or not kinds):
        return "unknown_physics"
    if not kinds:
        return "unknown_physics" if left or ended else "consistent"
    if errors.outweigh_findings(rules):
        return "unknown_physics"
    if not physics:
        return "sensor_fault"
    return "unknown_physics" if physics[0] is EffectKind.UNLISTED else "missing_physics"


def bounded_noise(
    learnt: FloatArray, declared: FloatArray, measured: FloatArray, slack: float = RULES.verdict.slack
) -> FloatArray:
    """Noise levels (S,) for the floor: as estimated, but at most as declared or independently measured, all (S,).

    slack: factor on declarations, which are round numbers.
    """
    return np.minimum(learnt, slack * np.maximum(declared, measured))
