"""A set-up with the structure fitted, a fault of it that was fitted beside the structure, and its refined estimate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import baseline, refreshed
from sprung.model.diagnosis.fit.misfit import misfit, total_misfit
from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation.configuration.changes import Undo
from sprung.model.diagnosis.investigation.configuration.effects import CorrectedFit, Hypothesis, SetupEffect, SetupPlace
from sprung.model.diagnosis.investigation.configuration.response import ModelResponse
from sprung.model.diagnosis.investigation.configuration.scores import SetupScores
from sprung.model.diagnosis.record.channels import DiagnosisError
from sprung.model.diagnosis.record.signals import Noise, Signals
from sprung.model.diagnosis.rules import SetupRules
from sprung.model.system import System


@dataclass(frozen=True)
class SetupFault:
    """One fault of the set-up."""

    effect: SetupEffect
    site: SetupPlace
    value: float | None  # time s, ratio, offset m
    std: float
    before: float  # misfit of all sensors without and with it
    after: float


@dataclass(frozen=True)
class FittedSetup:
    """A system file and recorded signals, with the structure fitted."""

    system: System
    signals: Signals
    split: int  # number of fitted samples
    declared: Noise
    problem: Problem
    fit: Fit

    @property
    def rules(self) -> SetupRules:
        """Of the search for faults."""
        return self.problem.rules.setup

    @property
    def misfit(self) -> float:
        """Of all sensors; a prediction of nothing leaves 1 of every sensor."""
        return float(np.sum(np.minimum(misfit(self.fit), 1.0)))

    @property
    def fits(self) -> bool:
        """Whether no sensor shows a fault of the set-up."""
        return float(np.max(misfit(self.fit))) <= self.rules.misfit

    @property
    def rough(self) -> bool:
        """Whether only the best hypotheses get noise levels of their own; under measured forces every fit does."""
        return not self.problem.process_noise

    def changed(self, undo: Undo, *, roughly: bool) -> FittedSetup:
        """With another system file or other signals, fitted with the same settings.

        Errors: `DiagnosisError` if the fit diverges.
        """
        system, signals = undo(self.system, self.signals)
        split = self.split - (self.signals.samples - signals.samples) // 2  # a shift costs samples at both ends
        like = self.problem
        problem, fit = baseline(
            system, signals, self.declared, split, like.rules, like.memory, like.work, roughly=roughly
        )
        return replace(self, system=system, signals=signals, split=split, problem=problem, fit=fit)

    def tried(self, hypothesis: Hypothesis, before: float) -> FittedFault | None:
        """A hypothesis fitted; None if it diverges, or leaves more of the misfit `before` than spectra promise."""
        try:
            other = self.changed(hypothesis.undo, roughly=self.rough)
        except DiagnosisError:
            return None
        after = total_misfit(other.fit)
        if after >= self.rules.promising * before:
            return None
        value = hypothesis.value
        std = 0.0 if value is None else float(abs(value) * np.sqrt(after) / 3)  # roughly, from the remaining misfit
        fault = SetupFault(hypothesis.effect, hypothesis.site, value, std, before, after)
        return FittedFault(fault, other, hypothesis.by_mass)


@dataclass(frozen=True)
class FittedFault:
    """A fault of the set-up, and the set-up corrected for it."""

    fault: SetupFault
    setup: FittedSetup
    by_mass: bool = False  # read from frequencies above all modes

    @property
    def after(self) -> float:
        """Misfit that it leaves."""
        return self.fault.after

    def refined(self) -> FittedFault:
        """With its value estimated again on the structure fitted without it, which had absorbed part of it."""
        fault, setup = self.fault, self.setup
        if setup.rough:
            problem, fit = refreshed(setup.problem, setup.fit)
            setup = replace(setup, problem=problem, fit=fit)
        effect, value, std = fault.effect, fault.value, fault.std
        if value is not None and effect.remaining is not None:
            for _ in range(setup.rules.rounds):
                response = ModelResponse.of(setup.problem, setup.fit.forward)
                scores = SetupScores(setup.problem, setup.fit)
                found, unit = effect.remaining(fault.site, CorrectedFit(scores, response, setup.system))
                change, std = found.amount * unit, found.std * unit
                value = effect.further(value, change)
                setup = setup.changed(effect.remainder(fault.site, change), roughly=False)
            std *= value if effect.relative else 1.0
        fault = replace(fault, value=value, std=std, after=total_misfit(setup.fit))
        return replace(self, fault=fault, setup=setup)
