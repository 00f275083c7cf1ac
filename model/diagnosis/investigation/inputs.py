"""Faults of input channels: estimated from their witness, mended before anything else is judged."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sprung.model.diagnosis.record.signals import Noise, Signals
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.screening.screen import Hit, Screening, screen
from sprung.model.laws import SensorLaw

if TYPE_CHECKING:
    from sprung.model.diagnosis.investigation.diagnose import Course

_ROUNDS = 3


@dataclass(frozen=True)
class InputFault:
    """A fault of an input channel and what it explains."""

    term: Term
    std: float
    score: float
    p_value: float
    runner_up: tuple[str, float] | None


def best_input_fault(screening: Screening, alpha: float) -> Hit | None:
    """The input fault that leads the screening, if one does."""
    good = [h for h in screening.hits if screening.p_value(h) <= alpha]
    if not good:
        return None
    top = max(good, key=lambda h: h.score)
    return top if top.family == "input" else None


def input_faults_of(course: Course, hit: Hit, declared: Noise) -> tuple[InputFault | None, Signals]:
    """Estimate the leading input fault by mending, screening again and mending the rest."""
    from sprung.model.diagnosis.investigation.diagnose import baseline

    rivals = [h for h in course.first.hits if h.family == "input" and h.term.key != hit.term.key]
    rivals.sort(key=lambda h: -h.score)
    candidates = [hit, *[h for h in rivals if h.score > 0.3 * hit.score][:3]]
    best: tuple[float, InputFault, Signals] | None = None
    for candidate in candidates:
        signals, term, std = course.signals, candidate.term, 0.0
        value = term.parameters[0]
        for _ in range(_ROUNDS):
            signals = mended(course.signals, term.at(np.array([value])))
            problem, fit = baseline(course.system, signals, declared, course.split)
            rest = screen(problem, fit, (term.law,), course.options.project)
            again = next((h for h in rest.hits if h.term.key == term.key), None)
            if again is None or again.score < 0.01:
                break
            change = again.term.parameters[0]
            neutral = 1.0 if term.law.name == "sensor_gain" else 0.0
            std = abs(change - neutral) / max(np.sqrt(again.score), 1e-12)
            value = value * change if neutral else value + change
        rho = problem.part.redundancy
        band = problem.part.grid.band
        omega = problem.part.grid.omega[band][1:, None]
        level = course.noise.displacement**2 + (course.noise.velocity / omega) ** 2
        witness = 2 * float(np.sum(np.abs(rho[band][1:]) ** 2 / level[:, problem.part.pairs])) if rho.size else 0.0
        total = fit.chi_square + witness
        fault = InputFault(term.at(np.array([value])), float(std), hit.score, course.first.p_value(hit), None)
        if best is None or total < best[0]:
            best = (total, fault, mended(course.signals, fault.term))
    assert best is not None
    return best[1], best[2]


def mended(signals: Signals, term: Term) -> Signals:
    """Signals with the fault of an input channel taken out."""
    assert isinstance(term.law, SensorLaw) and term.law.restore is not None
    if term.location in signals.force_names:
        force = signals.force.copy()
        i = signals.force_names.index(term.location)
        force[:, i] = term.law.restore(force[:, i], term.parameters, signals.sample_rate)
        return replace(signals, force=force)
    if "." in term.location:
        name, channel = term.location.rsplit(".", 1)
        supports, channels = [name], [channel]
    else:  # an axle: all that is measured of its wheels
        supports, channels = term.location.split("|"), ["displacement", "velocity"]
    at = [signals.support_names.index(name) for name in supports]
    result = {channel: getattr(signals, channel).copy() for channel in channels}
    for series in result.values():
        series[:, at] = term.law.restore(series[:, at].T, term.parameters, signals.sample_rate).T
    return replace(signals, **result)
