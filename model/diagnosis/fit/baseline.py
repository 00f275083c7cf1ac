"""Identification of the nominal structure on a recording, including noise levels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.jacobian import linearise
from sprung.model.diagnosis.fit.memory import FitMemory
from sprung.model.diagnosis.fit.noise import force_noise, input_noise, sensor_noise
from sprung.model.diagnosis.fit.optimise import Fit, optimise, try_optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.fit.smoothing import Working
from sprung.model.diagnosis.fit.whitening import Whitener
from sprung.model.diagnosis.record.channels import DiagnosisError
from sprung.model.diagnosis.record.signals import Noise, Signals, drifting, seen_noise, transform
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import given_terms
from sprung.model.diagnosis.rules import RULES, Rules
from sprung.model.signals import FloatArray
from sprung.model.system import System
from sprung.model.work import WorkBudget

_STRETCHES, _FEWEST, _STEPS = (16, 8, 4, 2), 60, 8  # divisors of a free decay fitted first; least samples; iterations
_DIVERGED = (
    "the structure of the system file cannot be fitted to this recording: the estimates diverge; "
    "check units, signs and order of the channels, and the masses and stiffnesses of the system file"
)


def baseline(
    system: System,
    signals: Signals,
    declared: Noise,
    split: int,
    rules: Rules = RULES,
    memory: FitMemory | None = None,
    work: WorkBudget | None = None,
    *,
    roughly: bool = False,
) -> tuple[Problem, Fit]:
    """The system file's model, laws included, fitted to the first `split` samples with estimated noise levels.

    roughly: without refining the noise of measured forces that the initial misfit suggests.
    Errors: `DiagnosisError` if the fit diverges, since system file and recording contradict each other.
    """
    try:
        with np.errstate(all="ignore"):  # diverging fits are recognised by their chi-square
            problem, fit = _begun(system, signals, declared, split, rules, memory, work)
            if not roughly:
                problem, fit = refreshed(problem, fit)
    except (np.linalg.LinAlgError, FloatingPointError):
        raise DiagnosisError(_DIVERGED) from None
    if not np.isfinite(fit.chi_square):
        raise DiagnosisError(_DIVERGED)
    return problem, fit


def _begun(
    system: System,
    signals: Signals,
    declared: Noise,
    split: int,
    rules: Rules,
    memory: FitMemory | None,
    work: WorkBudget | None,
) -> tuple[Problem, Fit]:
    first = signals.part(0, split)
    declared = seen_noise(first, declared, rules)
    noise = input_noise(transform(first, declared, rules.record), declared)
    part = transform(first, noise, rules.record, differentiated=drifting(system, signals.sensor_index))
    problem = Problem(system, part, signals.sensor_index, noise, rules, memory, work)
    start = Point(np.zeros(len(system.parameters)), given_terms(system), np.zeros(0))
    start = replace(start, state=np.zeros(problem.forward(start).plant.structure.states))
    if len(noise.force):
        # far from the optimum of a lightly damped system there is no descent; force noise then accounts for the misfit
        problem = with_force_noise(problem, start)
    if not system.file.inputs:
        start = replace(start, theta=_from_the_beginning(problem, first, declared, start))
    return problem, optimise(problem, start)


def with_force_noise(problem: Problem, start: Point) -> Problem:
    """A problem with the levels of its forces by what a start leaves."""
    lin = linearise(problem, start, Working(Whitener.of(problem.forward(start), problem.noise)))
    noise = force_noise(lin.forward, lin.spectrum, problem.noise, problem.rules.noise)
    band = problem.part.grid.band
    size = np.sqrt(np.mean(np.abs(problem.part.force[band]) ** 2, axis=0))
    most = np.where(size > 0, np.maximum(size, problem.noise.force), np.inf)  # with more, a force would not be measured
    return replace(problem, noise=replace(noise, force=np.minimum(noise.force, most)))


def _from_the_beginning(problem: Problem, signals: Signals, declared: Noise, start: Point) -> FloatArray:
    """Parameters of a free decay, (P,): from its first periods, then from segments of doubled length.

    The objective has local minima where frequencies differ by more than the inverse length of a segment.
    """
    theta = start.theta
    for share in _STRETCHES:
        count = signals.samples // share
        if count < _FEWEST:
            continue
        differentiated = drifting(problem.system, problem.sensors)
        part = transform(signals.part(0, count), declared, problem.rules.record, differentiated=differentiated)
        fit = try_optimise(replace(problem, part=part), replace(start, theta=theta), _STEPS)
        if fit is not None:
            theta = fit.point.theta
    return theta


def settled(problem: Problem, fit: Fit) -> Fit:
    """An unconverged fit, continued: the misfit of an unconverged fit looks like a further finding."""
    for _ in range(problem.rules.fit.restarts):
        if fit.converged:
            break
        on = try_optimise(problem, fit.point, problem.rules.fit.restarted)
        if on is None or on.deviance >= fit.deviance:
            break
        fit = on
    return fit


def finished(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """An unconverged fit, continued, and the noise levels at its end; not where unmeasured forces take its misfit."""
    if fit.converged or problem.process_noise:
        return problem, fit
    return refreshed(problem, settled(problem, fit))


def refreshed(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """Noise levels and whitening estimated at a fit, and the fit repeated with them.

    Levels of forces come before those of sensors: beside an overestimated force noise, sensors seem to have no noise
    of their own.
    """
    settled, moved, rules = 0, np.inf, problem.rules.fit
    for _ in range(rules.renewals):
        before = problem.noise
        try:
            noise = force_noise(fit.forward, fit.spectrum, before, problem.rules.noise)
            # a level that vanishes goes on falling, without any effect
            if np.all(np.abs(noise.force / before.force - 1) < rules.renewed) or moved < rules.numerical:
                settled += 1
                noise = sensor_noise(fit.forward, fit.spectrum, noise, problem.rules.noise)
        except np.linalg.LinAlgError:  # a fit whose responses are out of range keeps its levels
            break
        renewed = replace(problem, noise=noise)
        enough = settled == (2 if problem.process_noise else 1)
        again = try_optimise(renewed, fit.point, 6 if enough else 2)
        if again is None:
            break
        moved = abs(again.deviance - fit.deviance)
        problem, fit = renewed, again
        if enough:
            break
    return problem, fit
