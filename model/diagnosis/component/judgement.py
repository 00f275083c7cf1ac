"""Judgement of component tests: held-out errors, and the common verdict."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sprung.model.diagnosis.component.alike import EquivalentModel, look_alikes
from sprung.model.diagnosis.component.measured import ComponentRecord
from sprung.model.diagnosis.force.deviations import covariance, left_open
from sprung.model.diagnosis.force.fit import ComponentFit
from sprung.model.diagnosis.force.ranking import Step
from sprung.model.diagnosis.force.search import Search
from sprung.model.diagnosis.investigation.configuration.effects import SIGN_REVERSED
from sprung.model.diagnosis.investigation.verdict import HeldOutErrors, Verdict, kind_of, verdict_of
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.rules import Rules
from sprung.model.signals import FloatArray


@dataclass(frozen=True)
class JudgedComponent:
    """One component with the results that are reported."""

    record: ComponentRecord
    found: Search
    base: ComponentFit
    final: ComponentFit
    floor: float  # N
    reversed: bool  # whether force or motion has the wrong sign
    surface: Step | None = None  # the unexplained force as an unnamed force
    named: bool = True  # whether the laws explain enough to be named; else they are the closest approximation

    @property
    def size(self) -> float:
        """Deviation of the held-out force, N."""
        return float(np.std(self.record.task.force[self.record.task.split :])) or 1.0

    @cached_property
    def by_chance(self) -> tuple[FloatArray, list[str]]:
        """Random part of the covariance of the final model, and names."""
        return covariance(self.final)

    @cached_property
    def covariance(self) -> tuple[FloatArray, list[str]]:
        """Covariance of the final model, systematic errors included, and names."""
        full, names = self.by_chance
        return full + left_open(self.final, [one.moved for one in self.alike]), names

    @cached_property
    def alike(self) -> tuple[EquivalentModel, ...]:
        """Look-alikes of the named laws."""
        return look_alikes(self.final, self.found.steps if self.named else (), len(self.record.given.pieces))

    @property
    def errors(self) -> HeldOutErrors:
        held = [np.sqrt(fit.held_out) / self.size for fit in (self.base, self.final)]
        return HeldOutErrors(np.array(held[:1]), np.array(held[1:]), np.array([self.floor / self.size]))

    @property
    def unnamed(self) -> Step | None:
        """The step that stands for the unexplained force; None if there is none."""
        first = None if self.named else next(iter(self.found.steps), None)
        return self.surface or first


@dataclass(frozen=True)
class ComponentJudgement:
    """Common result of the component tests of a recording."""

    errors: HeldOutErrors  # per force
    verdict: Verdict
    explained: float | None  # share of the excess error; None without findings other than nuisances
    left: FloatArray  # unexplained share of every force's power


def concluded(judged: Sequence[JudgedComponent], rules: Rules) -> ComponentJudgement:
    """The common verdict of all tests."""
    parts = [one.errors for one in judged]
    errors = HeldOutErrors(*(np.concatenate([getattr(e, key) for e in parts]) for key in ("before", "after", "floor")))
    kinds = sorted((pair for one in judged for pair in _speaks(one)), key=lambda pair: pair[1])
    deciding = replace(rules.verdict, carried=rules.component.named)
    found = any(kind is not EffectKind.NUISANCE for kind, _ in kinds)
    explained = errors.explained(deciding) if found else None
    verdict = verdict_of([kind for kind, _ in kinds], errors, deciding)
    return ComponentJudgement(errors, verdict, explained, errors.unexplained(deciding))


def _speaks(one: JudgedComponent) -> Iterator[tuple[EffectKind, float]]:
    """Kinds of all findings with their delta BIC, most negative first; preloads are nuisances."""
    if one.reversed:
        yield kind_of(SIGN_REVERSED), -np.inf
    given = len(one.record.given.pieces)
    for part, step in zip(one.final.model.pieces[given:], one.found.steps if one.named else (), strict=False):
        yield part.effect_kind, step.delta_bic
    if one.unnamed is not None:
        yield EffectKind.UNLISTED, one.unnamed.delta_bic
