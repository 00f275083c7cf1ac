"""`sprung bench cars [--count 18] [--seed 1]`: what cars do that their files leave out.

A quarter car on a measured road, and a body on two hubs of which only accelerations are measured.  Masses differ from
the file by some per cent, parameters by 8 %, gains of the instruments by 0.3 %.  The effects are those of road
vehicles: a stop in compression alone, dampers that blow off or are harder in extension, dry friction.  A finding is
right when place and effect are those of the truth; besides, other masses are right where masses differ.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from sprung.benchmarks.setup_rigs import FINER, SPREAD, SYSTEMS, RigRecord, in_band, interpolated
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import System, load_system, parse_system

Array = NDArray[np.float64]
MASSES, GAINS = 0.04, 0.003  # standard deviations of masses and gains from the file's, relative
_BAND, _ROUGH = (0.3, 25.0), 2.5e-3 * np.sqrt(10)  # of the road: Hz, and rms in m
_HUB = 69.0  # rad/s, of an unsprung mass on its tyre


@dataclass(frozen=True)
class Effect:
    """What a car does beside its file."""

    file: str
    place: str = ""  # element; "" : nothing
    law: str = ""
    values: Mapping[str, Any] | None = None


QUARTER, HUBS = "quarter_car.yaml", "car_on_hubs.yaml"
EFFECTS = (
    Effect(QUARTER),
    Effect(QUARTER, "strut", "bump_stop", {"gap": 0.016, "stiffness": 1.4e5, "variant": "compression"}),
    Effect(QUARTER, "strut", "damper_blowoff", {"knee": 0.12, "ratio": 0.3}),
    Effect(QUARTER, "strut", "damper_asymmetry", {"a": 0.35}),
    Effect(HUBS),
    Effect(HUBS, "front", "damper_asymmetry", {"a": 0.4}),
    Effect(HUBS, "rear", "coulomb_friction", {"force": 90.0, "smoothing": 0.004}),
    Effect(HUBS, "rear", "bump_stop", {"gap": 0.016, "stiffness": 1.2e5, "variant": "compression"}),
    Effect(HUBS, "rear", "damper_blowoff", {"knee": 0.15, "ratio": 0.35}),
)


def run(count: int = 18, seed: int = 1, first: int = 0) -> Iterator[dict[str, Any]]:
    """Yields one line per recording from number `first` on, and the rates."""
    right = false = done = 0
    for number in range(first, count):
        effect = EFFECTS[number % len(EFFECTS)]
        system, values = recorded(effect, np.random.default_rng([seed, number]))
        began = time.process_time()
        report = diagnose(system, RigRecord(values, system.sample_rate), Options(file=f"{effect.file}-{number}"))
        said = [(finding.location, finding.effect) for finding in report.findings]
        others = [one for one in said if one != (effect.place, effect.law) and one[1] != "mass_change"]
        hit = (effect.place, effect.law) in said if effect.law else not others
        right, false, done = right + hit, false + bool(others), done + 1
        yield {
            "number": number,
            "rig": effect.file,
            "truth": [effect.place, effect.law],
            "verdict": report.verdict,
            "said": said,
            "values": [parameter.words() for finding in report.findings for parameter in finding.parameters],
            "right": hit,
            "others": others,
            "cpu_seconds": round(time.process_time() - began, 1),
        }
    yield {"recordings": done, "right": right / max(done, 1), "with_other_findings": false}


def recorded(effect: Effect, random: np.random.Generator, seconds: float = 50.0) -> tuple[System, Array]:
    """A system, and what its channels show on a road, noise included, (T, C)."""
    system = load_system(SYSTEMS / effect.file)
    actual = _actual(effect, random)
    finer = parse_system(yaml.safe_dump({**actual, "sample_rate": system.sample_rate * FINER}, sort_keys=False))
    values = {p.name: p.nominal * float(np.exp(SPREAD * random.standard_normal())) for p in system.parameters}
    inputs = _driven(effect.file, round((seconds + 20) * system.sample_rate), system.sample_rate, random)
    shown = simulate_ride(finer, interpolated(inputs), values).sensors[::FINER]
    settled = round(10 * system.sample_rate)
    clean = np.column_stack([inputs, shown])[settled:-settled]
    gains = 1 + GAINS * random.standard_normal(clean.shape[1])
    noise = np.array([channel.noise for channel in system.channels])
    return system, gains * clean + noise * random.standard_normal(clean.shape)


def _actual(effect: Effect, random: np.random.Generator) -> dict[str, Any]:
    """The file's content with the masses that the car has, and its law."""
    content: dict[str, Any] = yaml.safe_load((SYSTEMS / effect.file).read_text())
    for body in content["bodies"].values():
        factor = 1 + MASSES * float(random.standard_normal())
        body |= {key: value * factor for key, value in body.items() if key != "position"}
    if effect.law:
        content["elements"][effect.place]["laws"] = [{effect.law: dict(effect.values or {})}]
    return content


def _driven(file: str, samples: int, rate: float, random: np.random.Generator) -> Array:
    """Input columns (T, C): road and its rate, or accelerations of two hubs 0.12 s apart."""
    omega = 2j * np.pi * np.fft.rfftfreq(samples, 1 / rate)
    tyre = 1 + 0.5 * omega / _HUB + (omega / _HUB) ** 2

    def road() -> Array:
        return in_band(samples, rate, _BAND, _ROUGH, random, slope=-1.0)

    def hub() -> Array:
        return np.asarray(np.fft.irfft(np.fft.rfft(road()) / tyre * omega**2, samples))

    if file == QUARTER:
        height = road()
        return np.column_stack([height, np.fft.irfft(np.fft.rfft(height) * omega, samples)])
    front = hub()
    return np.column_stack([front, 0.95 * np.roll(front, round(0.12 * rate)) + 0.3 * hub()])
