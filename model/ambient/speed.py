"""Which way and how fast a vehicle runs over a track, for the windows of one system."""

from __future__ import annotations

import numpy as np

from sprung.model.ambient.excitation import Prior
from sprung.model.ambient.fit import fit
from sprung.model.ambient.periodogram import Spectra
from sprung.model.ambient.response import Responses
from sprung.model.ambient.sensing import Sensing
from sprung.model.ambient.track import Running, TrackExcitation
from sprung.model.ambient.whittle import Whittle
from sprung.model.ambient.window import BLURS, WindowFit
from sprung.model.schema import TrackInput
from sprung.model.signals import FloatArray
from sprung.model.system import System

SPEED_STD = 0.01  # of a speed that the file states or that an odometer measures, at the least, relative
FASTEST = 100.0  # m/s, that is tried where the speed is unknown
SLOWNESS_STEP = 1.5e-3  # s/m between the speeds that are tried: a quarter of a period over 20 m at 8 Hz
TRIED_BELOW = 8.0  # Hz, the part of the band in which speeds are compared
TRIED_GROUPS = 60  # of that part, at the most
CANDIDATES = 4  # speeds that are looked at closely


class Track:
    """What is assumed about a window of a system whose inputs are all of kind `track`."""

    def __init__(self, system: System, window: WindowFit) -> None:
        wheels = [source for source in system.file.inputs.values() if isinstance(source, TrackInput)]
        self.system, self.window = system, window
        self.position = np.array([wheel.position[0] for wheel in wheels])
        self.left = np.array([wheel.rail == "left" for wheel in wheels])

    def excitation(self, inputs: FloatArray, found: Spectra, sensed: Sensing) -> TrackExcitation | None:
        """Wheels at the speed of the window; None where it is too slow.

        inputs: the measured speed (T, 1), NaN where it is missing, or (T, 0) if the file states it or it is unknown.
        """
        stated, measured = self.system.file.speed, inputs[np.isfinite(inputs)]
        speed = float(measured.mean()) if measured.size else (None if stated is None else stated.value)
        if speed is None:
            return self._under(found, Running(self._search(found, sensed, None), np.inf))
        if abs(speed) < self.window.rules.slowest:
            return None
        scatter = float(measured.std()) if measured.size else 0.0
        directed = self._search(found, sensed, speed)
        return self._under(found, Running(directed, float(np.hypot(SPEED_STD * speed, scatter))))

    def _under(self, found: Spectra, running: Running) -> TrackExcitation:
        return TrackExcitation(self.position, self.left, found, running)

    def _search(self, found: Spectra, sensed: Sensing, speed: float | None) -> float:
        """The direction, and the speed if unknown, with which the nominal vehicle explains a window best.

        GNSS and odometers measure a speed without its direction.
        """
        low = np.flatnonzero(found.frequency < max(TRIED_BELOW, 2 * found.frequency[0]))
        coarse = found.part(low[:: max(1, len(low) // TRIED_GROUPS)])
        responses = Responses(self.system, sensed, self.window.loads)
        excitation = self._under(coarse, Running(FASTEST, np.inf))
        likelihood = Whittle(responses, excitation, coarse, BLURS[0])
        P = self.window.P
        z = excitation.start(self.window.power(responses, excitation, coarse))
        own = excitation.prior(z)
        x = np.concatenate([np.zeros(P), z])
        prior = Prior(np.concatenate([np.zeros(P), own.mean]), np.concatenate([self.window.prior_std, own.std]))
        magnitudes = (
            np.arange(1 / FASTEST, 1 / self.window.rules.slowest, SLOWNESS_STEP)
            if speed is None
            else np.array([1 / abs(speed)])
        )
        tried = [np.append(x[:-1], u) for u in (*-magnitudes[::-1], *magnitudes)]
        cost = np.array([likelihood.cost(at) for at in tried])
        lowest = np.flatnonzero((cost <= np.roll(cost, 1)) & (cost <= np.roll(cost, -1)))
        chosen = np.arange(2) if speed is not None else lowest[np.argsort(cost[lowest])][:CANDIDATES]
        unknowns = np.arange(len(x)) >= P
        best = min((fit(likelihood, tried[i], prior, free=unknowns, limit=8) for i in chosen), key=lambda one: one.cost)
        return float(1 / best.x[-1]) if speed is None else float(np.copysign(speed, best.x[-1]))
