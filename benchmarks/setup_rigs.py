"""`sprung bench setup-rigs [--count 60] [--seed 1]`: wrong set-ups of rigs that are no train.

Half a lorry on two measured axles, a building on a shaking table that is measured by its acceleration, and a frame
under a measured force.  Parameters differ from the file by 8 %; motions are simulated at ten times the rate of the
recording, so that inputs are band-limited between samples.  A place is right when the first finding names exactly the
channels that were falsified; a clean recording is right when it is consistent; physics is right for none.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import System, load_system

Array = NDArray[np.float64]
SYSTEMS = Path(__file__).parent / "systems"
FINER, SPREAD = 10, 0.08  # steps per sample; standard deviation of the parameters' logarithms
GRAVITY = 9.80665


@dataclass(frozen=True)
class ChannelErrors:
    """What is wrong with the channels of a recording: their factor, delay in samples, or that they are exchanged."""

    effect: str  # "" : nothing
    channels: tuple[str, ...] = ()
    factor: float = 1.0
    late: int = 0
    exchanged: tuple[str, ...] = ()  # what stands in the place of the channels
    place: str = ""  # as the finding has it, where that is not the channels

    def of(self, names: list[str], values: Array) -> Array:
        """Columns (T, C) as they are recorded; those that are late lose their first samples with all others."""
        at = [names.index(name) for name in self.channels]
        there = [names.index(name) for name in self.exchanged or self.channels]
        shown = values[self.late :].copy()
        shown[:, at] = self.factor * values[: len(values) - self.late, there]
        return shown


@dataclass(frozen=True)
class Rig:
    """A system file, how long it is recorded, how it is driven, and what may be wrong."""

    file: str
    seconds: float
    drive: Callable[[int, float, np.random.Generator], Array]  # samples, their rate; input columns (T, C)
    wrong: tuple[ChannelErrors, ...]


@dataclass
class RigRecord:
    """A recording as the diagnosis takes it."""

    values: Array
    sample_rate: float
    lost: int = 0


def run(count: int = 60, seed: int = 1, first: int = 0) -> Iterator[dict[str, Any]]:
    """Yields one line per recording from number `first` on, and the rates."""
    cases = [(rig, wrong) for rig in RIGS for wrong in rig.wrong]
    right = false_physics = done = 0
    for number in range(first, count):
        rig, wrong = cases[number % len(cases)]
        system, values = recorded(rig, np.random.default_rng([seed, number]))
        record = RigRecord(wrong.of([channel.name for channel in system.channels], values), system.sample_rate)
        began = time.process_time()
        report = diagnose(system, record, Options(file=f"{rig.file}-{number}"))
        said = [(finding.location, finding.effect) for finding in report.findings]
        place = wrong.place or "|".join(wrong.channels)
        hit = said[:1] == [(place, wrong.effect)] if wrong.effect else report.verdict == "consistent"
        right, done = right + hit, done + 1
        false_physics += report.verdict == "missing_physics"
        yield {
            "number": number,
            "rig": rig.file,
            "truth": [place, wrong.effect],
            "verdict": report.verdict,
            "said": said,
            "right": bool(hit),
            "cpu_seconds": round(time.process_time() - began, 1),
        }
    yield {"recordings": done, "right": right / max(done, 1), "found_as_physics": false_physics}


def recorded(rig: Rig, random: np.random.Generator, spread: float = SPREAD) -> tuple[System, Array]:
    """A system, and what its channels show on a drive, noise included, (T, C)."""
    system = load_system(SYSTEMS / rig.file)
    samples, rate = round(rig.seconds * system.sample_rate), system.sample_rate
    inputs = rig.drive(samples, rate, random)
    values = {p.name: p.nominal * float(np.exp(spread * random.standard_normal())) for p in system.parameters}
    finer = replace(system, file=system.file.model_copy(update={"sample_rate": rate * FINER}))
    shown = simulate_ride(finer, interpolated(inputs), values).sensors[::FINER]
    clean = np.column_stack([inputs, shown])
    noise = np.array([channel.noise for channel in system.channels])
    return system, clean + noise * random.standard_normal(clean.shape)


def interpolated(series: Array) -> Array:
    """Columns (T, C) at `FINER` times their rate, band-limited and periodic."""
    spectrum = np.fft.rfft(series, axis=0)
    return np.asarray(FINER * np.fft.irfft(spectrum, len(series) * FINER, axis=0))


def in_band(
    samples: int, rate: float, band: tuple[float, float], rms: float, random: np.random.Generator, slope: float = 0.0
) -> Array:
    """Random series (T,) whose amplitude goes with frequency to the power of `slope` within a band, Hz."""
    frequency = np.fft.rfftfreq(samples, 1 / rate)
    inside = (frequency > band[0]) & (frequency < band[1])
    shape = np.where(inside, np.maximum(frequency, band[0]) ** slope, 0.0)
    series = np.fft.irfft(np.fft.rfft(random.standard_normal(samples)) * shape, samples)
    return np.asarray(series * rms / np.std(series))


def _roads(samples: int, rate: float, random: np.random.Generator) -> Array:
    """Displacement and velocity below two axles 4 m apart at 20 m/s, partly of their own, (T, 4)."""
    front = in_band(samples, rate, (0.3, 20.0), 0.006, random, -1.5)
    rear = 0.9 * np.roll(front, round(0.2 * rate)) + in_band(samples, rate, (0.3, 20.0), 0.003, random, -1.5)
    omega = 2j * np.pi * np.fft.rfftfreq(samples, 1 / rate)
    velocity = [np.fft.irfft(np.fft.rfft(road) * omega, samples) for road in (front, rear)]
    return np.column_stack([front, velocity[0], rear, velocity[1]])


def _table(samples: int, rate: float, random: np.random.Generator) -> Array:
    return in_band(samples, rate, (0.3, 20.0), 1.5, random)[:, None]


def _shaker(samples: int, rate: float, random: np.random.Generator) -> Array:
    return in_band(samples, rate, (1.0, 60.0), 300.0, random)[:, None]


_FRONT = ("road_front.displacement", "road_front.velocity")
_REAR = ("road_rear.displacement", "road_rear.velocity")
_FRAME, _AXLES = ("frame_front", "frame_rear"), ("axle_front", "axle_rear")
_FLOORS, _ACCELERATIONS = ("a1", "a2", "a3"), ("a1", "b1", "a2", "a3")
RIGS = (
    Rig(
        "half_car.yaml",
        30.0,
        _roads,
        (
            ChannelErrors(""),
            ChannelErrors("sign_reversed", ("frame_front",), factor=-1),
            ChannelErrors("sign_reversed", _REAR, factor=-1, place="road_rear"),
            ChannelErrors("channels_swapped", _AXLES, exchanged=_AXLES[::-1]),
            ChannelErrors("channels_swapped", _FRONT + _REAR, exchanged=_REAR + _FRONT, place="road_front|road_rear"),
            ChannelErrors("node_delay", _FRAME, late=4),
            ChannelErrors("node_delay", _FRONT, late=3),
            ChannelErrors("node_delay", _FRONT + _REAR, late=3),
            ChannelErrors("node_delay", _FRAME + _AXLES, late=3),
            ChannelErrors("wrong_scale", _FRAME + _AXLES, factor=1 / GRAVITY),
        ),
    ),
    Rig(
        "building.yaml",
        60.0,
        _table,
        (
            ChannelErrors(""),
            ChannelErrors("sign_reversed", ("a2",), factor=-1),
            ChannelErrors("sign_reversed", ("table.acceleration",), factor=-1, place="table"),
            ChannelErrors("channels_swapped", ("a1", "a3"), exchanged=("a3", "a1")),
            ChannelErrors("node_delay", ("table.acceleration",), late=5),
            ChannelErrors("node_delay", _FLOORS, late=3),
            ChannelErrors("wrong_scale", _FLOORS, factor=1 / GRAVITY),
            ChannelErrors("wrong_scale", ("table.acceleration",), factor=1 / GRAVITY),
            ChannelErrors("wrong_scale", ("a3",), factor=0.7),
            ChannelErrors("sensor_lag", ("a2",), late=3),
        ),
    ),
    Rig(
        "shaken_frame.yaml",
        30.0,
        _shaker,
        (
            ChannelErrors(""),
            ChannelErrors("sign_reversed", ("shaker",), factor=-1),
            ChannelErrors("sign_reversed", ("a2",), factor=-1),
            ChannelErrors("channels_swapped", ("a1", "a3"), exchanged=("a3", "a1")),
            ChannelErrors("node_delay", _ACCELERATIONS, late=3),
            ChannelErrors("sensor_lag", ("a2",), late=3),
            ChannelErrors("wrong_scale", ("shaker",), factor=1e-3),
            ChannelErrors("wrong_scale", _ACCELERATIONS, factor=1 / GRAVITY),
            ChannelErrors("sensor_gain", ("b1",), factor=1.4),
            ChannelErrors(""),
        ),
    ),
)
