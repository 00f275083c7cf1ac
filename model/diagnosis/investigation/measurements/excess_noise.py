"""Excess noise of single channels, judged against the other sensors, or against the same channel of other supports."""

from __future__ import annotations

import numpy as np
from scipy import stats

from sprung.model.diagnosis.investigation.state import Investigation, NoiseFault
from sprung.model.diagnosis.record.signals import declared_noise
from sprung.model.diagnosis.rules import NoiseRules
from sprung.model.diagnosis.selection.holdout import FreeRun


def noise_faults(state: Investigation, before: FreeRun, after: FreeRun) -> tuple[NoiseFault, ...]:
    """Sensors and input channels that are significantly noisier than their peers.

    before, after: free runs without and with the findings.  A share of the power that the findings changed at a sensor
    may be their inaccuracy, and does not count as noise; nor does a level that is not about what the model leaves: this
    is the misfit of another structure.
    """
    declared = declared_noise(state.system, state.prepared.signals, state.options.rules)
    noise, rules = state.problem.noise, state.options.rules.noise
    grid = state.problem.part.grid
    count = grid.band.stop
    found: list[NoiseFault] = []
    names = list(state.signals.sensor_names)
    known = declared.sensors[np.isin(state.prepared.signals.sensor_index, state.signals.sensor_index)]
    inside = noise.sensors / known
    # noise extends above the compared band, unmodelled dynamics does not
    white = upper_ratio(state, known) > 1 + rules.white * (inside - 1)
    inaccuracy = rules.inaccuracy * np.mean((after.simulated - before.simulated) ** 2, axis=0)
    white &= (inside**2 - np.median(inside) ** 2) * known**2 > inaccuracy
    error = np.mean((after.measured - after.simulated) ** 2, axis=0)
    white &= is_what_is_left(noise.sensors**2, error, rules) | is_what_is_left(later_power(state), error, rules)
    found += outliers(names, inside, white, count, rules)
    pairs = state.problem.part.pairs
    if len(pairs):
        supports = [state.signals.support_names[i] for i in pairs]
        d = (noise.displacement / declared.displacement)[pairs]
        v = (noise.velocity / declared.velocity)[pairs]
        reach = reaching_sensors(state)[pairs]
        found += outliers([f"{n}.displacement" for n in supports], d, reach, rules.displacement * count, rules)
        found += outliers([f"{n}.velocity" for n in supports], v, reach, rules.velocity * count, rules)
    return tuple(found)


def reaching_sensors(state: Investigation) -> np.ndarray:
    """Whether the noise of a support's motion is part of what any sensor shows, (supports,).

    Where it is not, as with motions that were computed, displacement and velocity differ by their interpolation alone.
    """
    part, noise, forward = state.problem.part, state.problem.noise, state.fit.forward
    bins = slice(1, part.grid.band.stop)
    response = forward.of_inputs[bins][:, :, : len(noise.displacement)]
    through = np.abs(response) ** 2 * noise.support_variance(part.grid.omega[bins])[:, None, :]
    own = noise.sensor_variance(part.grid, part.differentiated)[bins, :, None]
    share = np.mean(through / (own + np.sum(through, axis=2, keepdims=True)), axis=0)
    found: np.ndarray = np.max(share, axis=0) > state.options.rules.noise.reach
    return found


def is_what_is_left(noise: np.ndarray, error: np.ndarray, rules: NoiseRules) -> np.ndarray:
    """Whether noise is about as large as the error of a free run, both as powers (S,); (S,)."""
    found: np.ndarray = (noise > rules.of_error * error) & (error > rules.of_error * noise)
    return found


def upper_ratio(state: Investigation, declared: np.ndarray) -> np.ndarray:
    """Noise over declared noise (S,) above the compared band, up to where anti-alias filters cut, (S,).

    It is the residual's there, but at most the measured signal's: a wrong structure may resonate where nothing moves.
    Nor does an instrument hum more than it shows in the held-out part, in which a rig may have come to rest.
    """
    grid, plant = state.problem.part.grid, state.fit.forward.plant
    upper = slice(grid.band.stop, int(state.options.rules.noise.upper * grid.samples))
    if upper.stop - upper.start < state.options.rules.noise.bins:
        return np.full(len(declared), np.inf)
    variance = state.problem.noise.support_variance(grid.omega[upper])
    through = np.einsum("fsi,fi->fs", np.abs(plant.sensor_of_support[upper]) ** 2, variance).mean(axis=0)
    residual, measured = state.fit.spectrum[upper], state.problem.part.sensors[upper]
    power = np.minimum(np.mean(np.abs(residual) ** 2, axis=0), np.mean(np.abs(measured) ** 2, axis=0))
    found: np.ndarray = np.sqrt(np.maximum(np.minimum(power, later_power(state)) - through, 0.0)) / declared
    return found


def later_power(state: Investigation) -> np.ndarray:
    """Power of the sensors above the compared band in the held-out part, per sample, (S,): noise may begin in it.

    Infinite where the part is too short to tell.
    """
    later, rules = state.held.later, state.options.rules.noise
    beyond = later.sensors[later.grid.band.stop : int(rules.upper * later.grid.samples)]
    few = len(beyond) < rules.bins
    return np.full(beyond.shape[1], np.inf) if few else np.asarray(np.mean(np.abs(beyond) ** 2, axis=0))


def outliers(
    names: list[str], ratio: np.ndarray, white: np.ndarray, count: float, rules: NoiseRules
) -> list[NoiseFault]:
    """Outliers among ratios (N,) of noise to declared noise, each by the others' median; fewer than two say nothing.

    white (N,): whether it is noise that counts; that of a sensor goes on above the compared band.
    count: bins that inform on it.
    """
    found = []
    for i, name in enumerate(names):
        peers = [j for j in range(len(names)) if j != i]
        if len(peers) < 2 or not white[i]:
            continue
        usual = float(np.median(ratio[peers]))
        relative = float(ratio[i]) / usual
        sigma = 1 / np.sqrt(2 * max(count, 2.0))
        z = float(np.log(relative) / sigma)
        if relative > rules.least and z > rules.sigmas:
            p_value = float(min(1.0, len(names) * stats.norm.sf(z)))
            found.append(NoiseFault(name, float(ratio[i]), float(ratio[i] * sigma), usual, z, p_value))
    return found
