"""Faults of input channels: estimated from a redundant measurement, compensated before anything else is judged."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation.state import InputFault, Nominal, Options
from sprung.model.diagnosis.record.fused import QUANTITIES
from sprung.model.diagnosis.record.signals import Noise, Signals
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.screening.families import INPUT
from sprung.model.diagnosis.screening.score import Candidate, Screening
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.laws import Law, SensorLaw
from sprung.model.signals import FloatArray
from sprung.model.simulate.drives import ORDERS
from sprung.model.system import System


def nominal(
    system: System, signals: Signals, declared: Noise, split: int, options: Options, laws: tuple[Law, ...] | None = None
) -> Nominal:
    """The nominal structure on the first `split` samples, and all candidates (or those of `laws`) screened on its
    residual."""
    problem, fit = baseline(system, signals, declared, split, options.rules, options.memory, options.work)
    return Nominal(signals, problem, fit, screen(problem, fit, laws or system.catalogue, options.project))


def best_input_fault(screening: Screening, alpha: float) -> Candidate | None:
    """The input fault that leads the screening, if one does."""
    good = [h for h in screening.candidates if screening.p_value(h) <= alpha]
    if not good:
        return None
    top = max(good, key=lambda h: h.score)
    return top if top.family is INPUT else None


def compensate(
    system: System, present: Nominal, candidate: Candidate, declared: Noise, options: Options
) -> tuple[InputFault, Signals]:
    """The leading input fault, chosen among its rivals and estimated, and the signals without it."""
    rules = options.rules.acceptance
    rivals = [h for h in present.screening.candidates if h.family is INPUT and h.term.key != candidate.term.key]
    rivals.sort(key=lambda h: -h.score)
    candidates = [
        candidate,
        *[h for h in rivals if h.score > rules.input_rival * candidate.score][: rules.input_rivals],
    ]
    tried = [_estimated(system, present, one, declared, options) for one in candidates]
    _, term, std = min(tried, key=lambda one: one[0])
    fault = InputFault(term, std, candidate.score, present.screening.p_value(candidate), None)
    return fault, compensated(present.signals, term)


def _estimated(
    system: System, present: Nominal, candidate: Candidate, declared: Noise, options: Options
) -> tuple[float, Term, float]:
    """Estimate an input fault by compensating, screening again and compensating the rest.

    Chi-square of sensors and redundant inputs without the fault, the fault, and its standard deviation.
    """
    term, law = candidate.term, candidate.term.law
    assert isinstance(law, SensorLaw)
    value = term.parameters[0]
    std = abs(value - law.absent[0]) / np.sqrt(max(candidate.score, options.rules.acceptance.input_done))
    for _ in range(options.rules.acceptance.input_rounds):
        signals = compensated(present.signals, term.at(np.array([value])))
        rest = nominal(system, signals, declared, present.split, options, (law,))
        again = _of_key(rest.screening.candidates, term)
        if again is None or again.score < options.rules.acceptance.input_done:
            break
        change = again.term.parameters[0]
        std = abs(change - law.absent[0]) / np.sqrt(again.score)
        value = law.combined(value, change)
    total = rest.fit.chi_square + _redundant(present.problem.noise, rest.problem)
    return total, term.at(np.array([value])), float(std)


def _of_key(candidates: Iterable[Candidate], term: Term) -> Candidate | None:
    return next((h for h in candidates if h.term.key == term.key), None)


def _redundant(noise: Noise, problem: Problem) -> float:
    """Chi-square of the differences between inputs that are measured twice."""
    part = problem.part
    rho, band = part.redundancy, part.grid.band
    fused = sum(one.chi_square for one in part.parity)
    if not rho.size:
        return fused
    offsets = float(np.sum(part.rate_offset**2 / noise.rate_offset_variance(part)))
    omega = problem.part.grid.omega[band][1:, None]
    level = noise.displacement**2 + (noise.velocity / omega) ** 2
    return 2 * float(np.sum(np.abs(rho[band][1:]) ** 2 / level[:, part.pairs])) + offsets + fused


def compensated(signals: Signals, term: Term) -> Signals:
    """Signals with the fault of an input channel taken out."""
    if term.location in signals.force_names:
        force = signals.force.copy()
        i = signals.force_names.index(term.location)
        force[:, i] = _restored(force[:, i], term, signals)
        return replace(signals, force=force)
    if "." in term.location:
        name, channel = term.location.rsplit(".", 1)
        supports, channels = [name], [channel]
    else:  # an axle: all that is measured of its wheels
        supports, channels = term.location.split("|"), list(QUANTITIES.values())
    columns = {"displacement": signals.displacement.copy(), "velocity": signals.velocity.copy()}
    fused = {one.support: one for one in signals.fused}
    for i in map(signals.support_names.index, supports):
        if i in fused:
            faulty = fused[i].series.keys() & {ORDERS[channel] for channel in channels}
            right = {order: _restored(fused[i].series[order], term, signals) for order in faulty}
            fused[i] = replace(fused[i], series={**fused[i].series, **right})
            columns["displacement"][:, i] = fused[i].displacement(1 / signals.sample_rate)
            continue
        for channel in columns.keys() & set(channels):
            columns[channel][:, i] = _restored(columns[channel][:, i], term, signals)
    return replace(
        signals, displacement=columns["displacement"], velocity=columns["velocity"], fused=tuple(fused.values())
    )


def _restored(shown: FloatArray, term: Term, signals: Signals) -> FloatArray:
    assert isinstance(term.law, SensorLaw)
    return term.law.restore(shown, term.parameters, signals.sample_rate)
