"""The noise floor of an investigation on its held-out part, and whether more than that is left."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import refreshed
from sprung.model.diagnosis.fit.misfit import misfit
from sprung.model.diagnosis.investigation.measurements.excess_noise import later_power, upper_ratio
from sprung.model.diagnosis.investigation.state import Investigation, NoiseFault
from sprung.model.diagnosis.investigation.verdict import HeldOutErrors, bounded_noise
from sprung.model.diagnosis.record.signals import Noise, declared_noise
from sprung.model.diagnosis.rules import RULES, VerdictRules
from sprung.model.diagnosis.selection.holdout import FreeRun
from sprung.model.signals import FloatArray


def with_noise_anew(state: Investigation) -> Investigation:
    """An investigation with noise levels estimated anew, also for its held-out part."""
    problem, fit = refreshed(state.problem, state.fit)
    return replace(state, problem=problem, fit=fit, held=replace(state.held, noise=problem.noise))


def leaves_more_than_noise(state: Investigation, of: Sequence[str] | None = None) -> bool:
    """Whether the findings so far leave an unexplained share, of the given sensors or of all."""
    run, rules = state.held.run(state.fit.point), state.options.rules.verdict
    errors = held_out_errors(run, run, state.held.noise_rms(state.fit, bounded(state)), rules)
    if of is not None:
        errors = errors.at([state.signals.sensor_names.index(name) for name in of])
    return bool(np.any(errors.unexplained(rules) > 0))


def is_unexplained(state: Investigation) -> bool:
    """Whether candidates are significant, or more than noise is left."""
    alpha = state.options.rules.acceptance.alpha
    significant = any(state.last.p_value(one) <= alpha for one in state.last.candidates)
    return significant or leaves_more_than_noise(state)


def leaves_what_sampling_leaves(state: Investigation) -> bool:
    """Whether every sensor errs by no more than sampling makes a perfect model err, however little noise there is.

    What is left then is no physics of the rig: filters before the sampling, resonances of mountings.
    """
    least = state.options.rules.verdict.least
    if np.any(misfit(state.fit) > least**2):  # costs nothing
        return False
    return bool(np.all(state.held.run(state.fit.point).per_sensor <= least))


def held_out_errors(before: FreeRun, after: FreeRun, floor: FloatArray, rules: VerdictRules) -> HeldOutErrors:
    """Errors of free runs without and with the findings beside the noise (C,) that is expected, rms."""
    size = np.sqrt(np.mean(before.measured**2, axis=0))
    expected = floor / np.where(size > 0, size, 1.0)
    return HeldOutErrors(before.per_sensor, after.per_sensor, realised_floor(expected, after, rules))


def bounded(state: Investigation, noisy: Sequence[NoiseFault] = ()) -> Noise:
    """Noise levels for the floor: estimated ones, at most as declared or observed above the compared band.

    Friction, stops and what a rig is driven with move sensors there, too: what a file declares is believed to be wrong
    by a slip of ten, and not by more.  noisy: sensors with a noise that only their peers speak against; it may
    have begun in the held-out part.
    """
    prepared, rules = state.prepared.signals, state.options.rules
    declared = declared_noise(state.system, prepared, rules)
    present = np.isin(prepared.sensor_index, state.signals.sensor_index)
    known = declared.sensors[present]
    seen = upper_ratio(state, known)
    seen = np.where(np.isfinite(seen), seen, 0.0)
    apart = {fault.location for fault in noisy}
    seen = np.where(_declares(state, apart), np.minimum(seen, rules.noise.misdeclared), seen) * known
    noise, slack = state.problem.noise, rules.verdict.slack
    noisier, later = np.array([name in apart for name in state.signals.sensor_names]), np.sqrt(later_power(state))
    began = np.where(noisier & np.isfinite(later), later, 0.0)
    sensors = bounded_noise(np.maximum(noise.sensors, began), known, np.maximum(seen, began), slack)
    force = bounded_noise(noise.force, declared.force, np.zeros(len(noise.force)), slack)
    return replace(noise, sensors=sensors, force=force)


def _declares(state: Investigation, apart: Container[str]) -> np.ndarray:
    """Whether the file declares the noise of the compared sensors, except of those named, (S,)."""
    stated = list(state.system.file.sensors.values())
    pairs = zip(state.signals.sensor_index.tolist(), state.signals.sensor_names, strict=True)
    return np.array([stated[index].noise > 0 and name not in apart for index, name in pairs])


def realised_floor(expected: FloatArray, after: FreeRun, rules: VerdictRules = RULES.verdict) -> FloatArray:
    """Noise floor (S,) of each sensor on the held-out samples themselves, in its unit.

    `expected` is the mean for the estimated noise.  If the error of the free run agrees with it within sampling error,
    it is noise, and the floor of these samples; if it is smaller, so is the noise, which is part of it.
    """
    spread = rules.spread * np.sqrt(1 / (2 * len(after.measured)))
    return np.where(after.per_sensor / expected - 1 < spread, after.per_sensor, expected)
