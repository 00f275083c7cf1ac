"""Predicted precision of a window: Fisher information at the nominal values."""

from __future__ import annotations

import numpy as np

from sprung.model.ambient.excitation import Excitation
from sprung.model.ambient.identify import AmbientIdentifier
from sprung.model.ambient.periodogram import spectra
from sprung.model.ambient.response import Responses
from sprung.model.ambient.sensing import sensing
from sprung.model.ambient.speed import SPEED_STD, Track
from sprung.model.ambient.track import Running, TrackExcitation
from sprung.model.ambient.whittle import Whittle
from sprung.model.identifier import PRIOR_STD
from sprung.model.signals import FloatArray
from sprung.model.system import System

SPEED = 42.0  # m/s, where the file states none
ROUGHNESS, KNEE = 2.741619e-7, 0.6803895  # ERRI B176, low level, without its longest waves
SHAKEN = 1e4  # power of the signals over their noise, of a structure under ambient forces


def foreseen(system: System) -> FloatArray:
    """Standard deviation of each parameter's log-ratio after one window, (P,); `PRIOR_STD` if not identifiable.

    An average track at the stated speed (or 42 m/s, unknown), or forces that lift the sensors far above their noise.
    """
    identifier = AmbientIdentifier(system)
    window, rate, rules = identifier.window, system.sample_rate, identifier.rules
    P = len(system.parameters)
    nothing = np.full(P, PRIOR_STD)
    low = window.low(system.window)
    if low is None:
        return nothing
    frame = spectra(np.zeros((system.window, len(system.sensors))), rate, (low, rules.highest * rate), window.sharpness)
    every = sensing(system.mechanics, np.arange(len(system.sensors)), system.sensor_noise)
    responses = Responses(system, every, window.loads)

    def excitation(groups: np.ndarray) -> tuple[Excitation, FloatArray]:
        part = frame.part(groups)
        if not isinstance(identifier.assumption, Track):
            assumed = identifier.assumption.excitation(np.empty((0, 0)), part, every)
            assert assumed is not None
            unit = responses.at(np.zeros(window.P), part.sides).signals
            sources = assumed.sources(assumed.start(np.ones(len(part.frequency)))).matrix
            power = np.einsum("fsx,fxy,fsy->fs", unit, sources, unit.conj(), optimize=True).real
            return assumed, assumed.start(np.full(len(part.frequency), SHAKEN / np.median(power)))
        stated = system.file.speed
        speed = SPEED if stated is None or stated.value is None else stated.value
        running = Running(speed, np.inf if stated is None else SPEED_STD * speed)
        track = TrackExcitation(identifier.assumption.position, identifier.assumption.left, part, running)
        wave = 2 * np.pi * part.frequency / speed
        level = ROUGHNESS / (wave**2 * (wave**2 + KNEE)) * 2 * np.pi / speed  # m^2/Hz
        return track, track.start(level * rate / 2)

    groups = np.arange(len(frame.frequency))
    for _ in range(2):  # once to see how far the signals stand out of their noise, once within that band
        assumed, z = excitation(groups)
        x = np.concatenate([np.zeros(window.P), z])
        at = Whittle(responses, assumed, frame.part(groups)).evaluate(x)
        audible = np.diagonal(at.covariance, axis1=1, axis2=2).real.max(axis=1) > 1 + rules.excess
        groups = groups[: len(audible) if audible.all() else int(np.argmin(audible))]
        if len(groups) < rules.groups:
            return nothing
    precision = np.concatenate([window.prior_std, assumed.prior(z).std]) ** -2.0
    scale = np.sqrt(np.diag(at.information) + precision)
    inverse = np.linalg.inv((at.information + np.diag(precision)) / np.outer(scale, scale))
    found: FloatArray = np.minimum(np.sqrt(np.diag(inverse))[:P] / scale[:P], PRIOR_STD)
    return found
