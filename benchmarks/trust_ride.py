"""What is sent to a service under test: rides of a quarter car, as windows and as files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from sprung.model.signals import FloatArray
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import System, load_system

SYSTEM_FILE = Path(__file__).parent / "systems" / "quarter_car.yaml"
START_SECONDS = 1_790_000_000
ROAD, BAND = 0.004, (0.5, 25.0)  # m, rms of the road; Hz


class RestlessRide:
    """The same drive again and again: a periodic random road, at other times."""

    def __init__(self, seconds: float = 20.0, seed: int = 1) -> None:
        self.system: System = load_system(SYSTEM_FILE)
        rng = np.random.default_rng(seed)
        samples = round(seconds * self.system.sample_rate)
        inputs = _road(rng, samples, self.system.sample_rate)
        truth = {"strut.stiffness": 1.85e4, "strut.damping": 1190.0}
        ride = simulate_ride(self.system, np.tile(inputs, (2, 1)), truth, noise=rng)
        measured = np.tile(inputs, (2, 1)) + rng.standard_normal((2 * samples, 2)) * [1e-5, 1e-3]
        self.values: FloatArray = np.concatenate([measured, ride.sensors], axis=1)[samples:]  # settled, shape (T, C)

    def window(self, number: int, vehicle: str) -> dict[str, Any]:
        """Window `number` of a ride that never ends, as POST /identify takes it."""
        length, hop, rate = self.system.window, self.system.hop, self.system.sample_rate
        rows = (number * hop + np.arange(length)) % len(self.values)
        names = [channel.name for channel in self.system.channels]
        channels = {name: self.values[rows, i].tolist() for i, name in enumerate(names)}
        start = START_SECONDS + number * hop / rate
        return {"vehicle": vehicle, "sample_rate": rate, "channels": channels, "start": str(start)}

    def csv(self, number: int, seconds: float) -> bytes:
        """A recording that begins `number` hours later."""
        rows = round(seconds * self.system.sample_rate)
        time = START_SECONDS + 3600 * number + np.arange(rows) / self.system.sample_rate
        values = self.values[np.arange(rows) % len(self.values)]
        text = io.StringIO()
        text.write("time,z,vz,a1,a2,travel,load\n")
        np.savetxt(text, np.c_[time, values], fmt=["%.3f"] + ["%.7g"] * 6, delimiter=",")
        return text.getvalue().encode()


def _road(rng: np.random.Generator, samples: int, rate: float) -> FloatArray:
    """Displacement and velocity of a random road that repeats, shape (T, 2)."""
    frequency = np.fft.rfftfreq(samples, 1 / rate)
    shape = np.where((frequency > BAND[0]) & (frequency < BAND[1]), np.maximum(frequency, BAND[0]) ** -1.5, 0.0)
    road = np.fft.rfft(rng.standard_normal(samples)) * shape
    road *= ROAD / np.fft.irfft(road, samples).std()
    return np.stack([np.fft.irfft(road, samples), np.fft.irfft(2j * np.pi * frequency * road, samples)], axis=1)
