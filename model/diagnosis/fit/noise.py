"""Estimation of noise levels: of inputs from analytical redundancy, of sensors from their own part of the residual.

A measured force has no redundant measurement, and unmeasured effects lie between it and the body: ripple of the drive,
friction in the transmission, the amplifier.  Its noise level is estimated from the residual, which it colours through
the plant.

Unmodelled dynamics is concentrated in some bands and sensors, noise is white: the level of a sensor is the median over
frequency blocks, so that the misfit of a missing law is not taken for noise.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from sprung.model.diagnosis.fit.whitening import Whitener
from sprung.model.diagnosis.record.signals import Noise, Part
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.rules import NoiseRules
from sprung.model.signals import FloatArray

_ROUNDS = 4  # of levels and the weights that follow from them


def input_noise(part: Part, noise: Noise) -> Noise:
    """Levels of displacement and velocity channels from V / j w - D, by Fisher scoring per support.

    The part of the difference proportional to the motion or its derivative (gain error, lag) is removed first.
    """
    band = part.grid.band
    omega = part.grid.omega[band]
    displacement, velocity = noise.displacement.copy(), noise.velocity.copy()
    for at, support in enumerate(part.pairs):
        levels = np.array([displacement[support] ** 2, velocity[support] ** 2])
        weights = np.stack([np.ones(len(omega) - 1), 1 / omega[1:] ** 2])  # variance per bin = levels @ weights
        difference = part.redundancy[band, at][1:]
        motion = part.support[band, support][1:]
        for _ in range(8):
            variance = levels @ weights
            regressors = np.stack([motion, 1j * omega[1:] * motion], axis=1) / np.sqrt(variance)[:, None]
            target = difference / np.sqrt(variance)
            both = np.concatenate([regressors.real, regressors.imag])
            taken = np.linalg.lstsq(both, np.concatenate([target.real, target.imag]), rcond=None)[0]
            rest = np.abs(target - regressors @ taken) ** 2  # mean 1 at the truth
            relative = weights / variance
            score = relative @ (rest - 1)
            fisher = relative @ relative.T
            levels = np.maximum(levels + np.linalg.solve(fisher, score), 0.01 * levels)
        displacement[support], velocity[support] = np.sqrt(levels)
    return replace(noise, displacement=displacement, velocity=velocity)


def sensor_noise(forward: Forward, spectrum: ComplexArray, noise: Noise, rules: NoiseRules) -> Noise:
    """Levels of the sensors from the residual (F, S) of a fit."""
    band = forward.part.grid.band
    residual = spectrum[band][1:]
    variance = noise.sensor_variance(forward.part.grid, forward.part.differentiated)[band][1:] / noise.sensors**2
    for _ in range(_ROUNDS):
        factor = Whitener.of(forward, noise).factor[1:]
        precision = factor.conj().transpose(0, 2, 1) @ factor
        alone = np.real(np.einsum("fss->fs", precision))  # 1 / variance given the other sensors
        normalised = np.abs(np.einsum("fst,ft->fs", precision, residual)) ** 2 / alone  # mean 1 at the truth
        share = alone * variance * noise.sensors**2  # of the own noise in the variance given the others
        ratio = [_level(normalised[:, i], share[:, i], rules) for i in range(len(noise.sensors))]
        noise = replace(noise, sensors=np.maximum(noise.sensors * np.sqrt(ratio), noise.least))
    return noise


def _level(normalised: FloatArray, share: FloatArray, rules: NoiseRules) -> float:
    """Ratio of a sensor's noise power to the assumed one, from the bins (F,) with a significant share of own noise."""
    own = share > rules.own
    if np.sum(own) < 2 * rules.blocks:
        return 1.0
    normalised, share = normalised[own], share[own]
    edges = np.linspace(0, len(normalised), rules.blocks + 1).astype(int)
    blocks = np.array([normalised[a:b].mean() for a, b in pairwise(edges)])
    return max(1 + (_robust(blocks, np.diff(edges), rules) - 1) / float(np.median(share)), 0.05)


def force_noise(forward: Forward, spectrum: ComplexArray, noise: Noise, rules: NoiseRules) -> Noise:
    """Levels of the measured forces from the residual (F, S) of a fit, by Fisher scoring of its likelihood."""
    if not len(noise.force):
        return noise
    band = forward.part.grid.band
    response = forward.plant.sensor_of_measured_force[band] * forward.sensor_factor[band, :, None]
    for _ in range(_ROUNDS):
        factor = Whitener.of(forward, noise).factor
        seen = factor @ response  # whitened response to each force, (F, S, forces)
        copied = np.abs(np.einsum("fsi,fs->fi", seen.conj(), (factor @ spectrum[band, :, None])[:, :, 0])) ** 2
        size = np.sum(np.abs(seen) ** 2, axis=1)  # mean of `copied` at the truth
        score, fisher = np.sum(copied - size, axis=0), np.sum(size**2, axis=0)
        power = noise.force**2
        noise = replace(noise, force=np.sqrt(np.maximum(power + score / fisher, rules.fall * power)))
    return noise


def _robust(blocks: FloatArray, counts: np.ndarray, rules: NoiseRules) -> float:
    """Robust level over blocks, (blocks,): the mean of those that agree with the quieter half."""
    middle, quiet = np.median(blocks), np.quantile(blocks, rules.quieter)
    spread = 1 / np.sqrt(np.mean(counts))
    base = min(middle, quiet * (1 + 0.5 * rules.agree * spread))
    return float(np.mean(blocks[blocks <= base * (1 + rules.agree * spread)]))
