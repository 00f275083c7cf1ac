"""The nominal structure identified on a recording, with noise levels estimated on the way."""

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
from sprung.model.diagnosis.fit.work import WorkBudget
from sprung.model.diagnosis.record.channels import DiagnosisError
from sprung.model.diagnosis.record.signals import Noise, Signals, drifting, seen_noise, transform
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import given_terms
from sprung.model.diagnosis.rules import RULES, Rules
from sprung.model.signals import FloatArray
from sprung.model.system import System

_STRETCHES, _FEWEST, _STEPS = (16, 8, 4, 2), 60, 8  # shares of a free decay that are fitted first; samples; iterations
_REFITS, _SETTLED = 12, 0.05  # of force noise and fit, which weighs by it; change of the level
_ROUNDS, _MORE = 5, 10  # of a fit that still falls, and its iterations
_DIVERGED = (
    "the system file's structure cannot be fitted to this recording: the numbers diverge; "
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
    """The system of the file, its laws included, on the first `split` samples; noise levels estimated on the way.

    roughly: with the noise of measured forces as their whole misfit suggests, which is where every fit begins.
    Errors: `DiagnosisError` where the numbers of system file and recording fit each other so badly that none comes out.
    """
    try:
        with np.errstate(all="ignore"):  # what diverges is judged by its chi-square
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
    declared = seen_noise(first, declared, rules.noise.misdeclared)
    noise = input_noise(transform(first, declared), declared)
    part = transform(first, noise, differentiated=drifting(system, signals.sensor_index))
    problem = Problem(system, part, signals.sensor_index, noise, rules, memory, work)
    start = Point(np.zeros(len(system.parameters)), given_terms(system), np.zeros(0))
    start = replace(start, state=np.zeros(problem.forward(start).plant.structure.states))
    if len(noise.force):
        # far from the truth a lightly damped system fits no better in any direction: their noise accounts for it
        lin = linearise(problem, start, Working(Whitener.of(problem.forward(start), noise)))
        problem = replace(problem, noise=force_noise(lin.forward, lin.spectrum, noise, rules.noise))
    if not system.file.inputs:
        start = replace(start, theta=_from_the_beginning(problem, first, declared, start))
    return problem, optimise(problem, start)


def _from_the_beginning(problem: Problem, signals: Signals, declared: Noise, start: Point) -> FloatArray:
    """Parameters of a free decay, (P,): from its first periods, then of stretches twice as long each time.

    Frequencies that differ by more than the inverse of a stretch leave no way downhill from one to the other.
    """
    theta = start.theta
    for share in _STRETCHES:
        count = signals.samples // share
        if count < _FEWEST:
            continue
        part = transform(signals.part(0, count), declared, differentiated=drifting(problem.system, problem.sensors))
        fit = try_optimise(replace(problem, part=part), replace(start, theta=theta), _STEPS)
        if fit is not None:
            theta = fit.point.theta
    return theta


def settled(problem: Problem, fit: Fit) -> Fit:
    """A fit that still falls, fitted on: what a misfit leaves when steps run out passes for another finding."""
    for _ in range(_ROUNDS):
        if fit.converged:
            break
        on = try_optimise(problem, fit.point, _MORE)
        if on is None or on.deviance >= fit.deviance:
            break
        fit = on
    return fit


def refreshed(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """Noise levels and whitening at a fit, and the fit again.

    Sensors come after the forces: beside a force that is still taken for far too noisy, a sensor seems to have no
    noise of its own, and then the force has to answer for that of the sensor.
    """
    settled = 0
    for _ in range(_REFITS):
        before = problem.noise
        noise = force_noise(fit.forward, fit.spectrum, before, problem.rules.noise)
        if np.all(np.abs(noise.force / before.force - 1) < _SETTLED):
            settled += 1
            noise = sensor_noise(fit.forward, fit.spectrum, noise, problem.rules.noise)
        renewed = replace(problem, noise=noise)
        enough = settled == (2 if problem.process_noise else 1)
        again = try_optimise(renewed, fit.point, 6 if enough else 2)
        if again is None:
            break
        problem, fit = renewed, again
        if enough:
            break
    return problem, fit
