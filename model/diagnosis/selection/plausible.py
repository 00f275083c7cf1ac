"""Plausibility of values: laws with implausible values are not named as findings, however well they fit.

A knee that the motion passes within one sample is indistinguishable from friction.  A sensor gain of six, a body of 2.7
times its mass, and a structural part beside which a spring keeps a tenth of its stiffness stand for something else.  A
periodic force at a multiple of the excitation's frequency is the response of some non-linearity.
"""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.record.highpass import slowest_mode
from sprung.model.diagnosis.record.signals import Part
from sprung.model.diagnosis.record.spectra import Grid
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import RULES, PlausibleRules
from sprung.model.laws import BodyLaw, reversal_step
from sprung.model.signals import FloatArray
from sprung.model.system import System

_MAINS = (50.0, 60.0)  # Hz


def doubt(fit: Fit, term: Term, rules: PlausibleRules = RULES.plausible, *, before: Fit | None = None) -> str | None:
    """Reason to doubt a fitted term, in words; None if there is none.

    before: the model without it, where that is known.
    """
    reason = out_of_range(term) or (displaced_spring(before, fit, term, rules) if before is not None else None)
    if reason is not None:
        return reason
    if term.law.corner is not None and _saturates(fit, term, rules):
        return "its transition is as wide as the rates of the motion, which is a saturating damper"
    if term.law.knees:
        return _unresolved(fit, term, rules)
    if term.law.adds_motion:
        return _unheard(fit.forward.part.grid, term) or _too_slow(fit.forward.system, term, rules)
    return harmonic(fit.forward.part, term, rules) or hum(fit.forward.part, term, rules)


def _unheard(grid: Grid, term: Term) -> str | None:
    """A resonance above the compared band; below it, it is indistinguishable from a heavier or softer body."""
    if term.law.frequency is None:
        return None
    highest = grid.omega[grid.band][-1] / (2 * np.pi)
    frequency = term.parameters[term.law.frequency]
    return (
        f"{frequency:.3g} Hz is above the compared band, which ends at {highest:.3g} Hz"
        if frequency > highest
        else None
    )


def _too_slow(system: System, term: Term, rules: PlausibleRules) -> str | None:
    """An elastic mode far below the modes of the suspension; above it, it is indistinguishable from a lighter body."""
    if not isinstance(term.law, BodyLaw) or term.law.frequency is None:
        return None
    slowest = slowest_mode(system, RULES.record.held)
    frequency = term.parameters[term.law.frequency]
    if frequency >= rules.slow_mode * slowest:
        return None
    return f"{frequency:.3g} Hz is far below the slowest mode of the suspension, {slowest:.3g} Hz"


def out_of_range(term: Term) -> str | None:
    """A parameter outside its plausible range, in words; None if there is none."""
    for spec, value in zip(term.law.parameters, term.parameters, strict=True):
        low, high = spec.plausible
        if not low <= value <= high:
            unit = "" if spec.unit == "1" else f" {spec.unit}"
            return f"{spec.name} {value:.3g}{unit} lies outside {low:g} to {high:g}"
    return None


def displaced_spring(before: Fit, fit: Fit, term: Term, rules: PlausibleRules = RULES.plausible) -> str | None:
    """A spring far from nominal with a linear part, but not without it: the part imitates something else.

    A law that yields or slips may replace a spring; a linear part leaves it the static load.
    """
    if not term.law.linear:
        return None
    most = np.log(rules.spring)
    for parameter, was, now in zip(fit.forward.system.parameters, before.point.theta, fit.point.theta, strict=True):
        if parameter.quantity == "stiffness" and abs(was) < most < abs(now):
            return f"{parameter.name} would be {np.exp(now):.2g} times nominal beside it"
    return None


def hardly_there(fit: Fit, rules: PlausibleRules = RULES.plausible, index: int = -1) -> bool:
    """Whether a term does not differ significantly from its absence; by default the last term.

    Of one with several parameters: whether none of them is determined.
    """
    term = fit.point.terms[index]
    if len(term.parameters) != 1:
        return term.law.named and _undetermined(fit, index)
    value, at = term.parameters[0], fit.place(index).start
    stated = np.hypot(np.sqrt(max(fit.covariance[at, at], 0.0)), rules.simulated * abs(value))
    if not np.isfinite(term.law.absent[0]):  # the inverse vanishes: a rigid connection has no compliance
        return bool(abs(value) < rules.apart * stated)
    return bool(abs(value - term.law.absent[0]) < rules.apart * stated)


def _undetermined(fit: Fit, index: int) -> bool:
    """Whether the standard deviation of every parameter of a term exceeds its value."""
    term, place = fit.point.terms[index], fit.place(index)
    spread = np.sqrt(np.maximum(np.diag(fit.covariance)[place], 0.0))
    determined = spread <= np.abs(term.parameters)  # not of what is not finite
    return not bool(np.any(determined))


def _saturates(fit: Fit, term: Term, rules: PlausibleRules) -> bool:
    """Whether the transition of a friction extends over most of the rates of the motion."""
    corner = term.element_law.corner
    rate = fit.element_motion[1] @ term.port(fit.forward.system)
    return corner is not None and term.parameters[corner] > rules.corner * float(np.std(rate))


def _unresolved(fit: Fit, term: Term, rules: PlausibleRules) -> str | None:
    """A knee over the rate that the sampling of the motion does not resolve."""
    rate = fit.element_motion[1] @ term.port(fit.forward.system)
    passed = reversal_step(rate[:: len(rate) // fit.forward.part.grid.samples])
    for index in term.element_law.knees:
        if term.parameters[index] < rules.knees * passed:
            return (
                f"the knee {term.parameters[index]:.2g} m/s is passed within a sample (the rate changes by "
                f"{passed:.2g} m/s in one)"
            )
    return None


def harmonic(part: Part, term: Term, rules: PlausibleRules = RULES.plausible) -> str | None:
    """A periodic force or movement at a multiple of one of the excitation's own frequencies."""
    if term.law.frequency is None or not term.law.drives:
        return None
    frequency = term.parameters[term.law.frequency]
    for line in excitation_lines(part, rules):
        multiple = round(frequency / line)
        if (
            1 <= multiple <= rules.harmonics
            and abs(frequency - multiple * line) * part.grid.length < rules.close + 0.5 * multiple
        ):
            return f"{frequency:.4g} Hz is {multiple} times a frequency of the excitation, {line:.4g} Hz"
    return None


def hum(part: Part, term: Term, rules: PlausibleRules = RULES.plausible) -> str | None:
    """A periodic force or movement at a frequency of the mains, which instruments show without any force."""
    if term.law.frequency is None or not term.law.drives:
        return None
    frequency = term.parameters[term.law.frequency]
    for mains in _MAINS:
        multiple = max(1, round(frequency / mains))
        if abs(frequency - multiple * mains) < multiple * rules.mains + rules.close / part.grid.length:
            times = "" if multiple == 1 else f"{multiple} times "
            return f"{frequency:.4g} Hz is {times}that of the mains: instruments hum"
    return None


def excitation_lines(part: Part, rules: PlausibleRules = RULES.plausible) -> list[float]:
    """Frequencies, Hz, of an excitation that consists of a few lines; empty if it is broadband."""
    found: list[float] = []
    omega = part.grid.omega[:, None]
    for spectrum in (*(1j * omega * part.support).T, *part.force.T):
        found += _lines_of(np.abs(spectrum) ** 2, part.grid.length, rules)
    return found


def _lines_of(power: FloatArray, length: float, rules: PlausibleRules) -> list[float]:
    """Lines that hold most of a power spectrum (F,) together."""
    left, total = power.copy(), float(power.sum())
    left[0] = 0.0
    lines: list[float] = []
    held = 0.0
    for _ in range(rules.lines if total > 0 else 0):
        top = int(np.argmax(left))
        around = slice(max(1, top - rules.bins), top + rules.bins + 1)
        weight = float(left[around].sum())
        if weight <= 0:
            break
        lines.append(float(np.arange(len(left))[around] @ left[around]) / weight / length)
        left[around] = 0.0
        held += weight
        if held > rules.pure * total:
            return lines
    return []
