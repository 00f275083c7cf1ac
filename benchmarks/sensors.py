"""`sensors`: one wrong measurement on a healthy vehicle. It must be named, and no spring accused.

Rides of two minutes of `benchmarks/generator`; one channel reads too much, late, reversed, not at all, or another's,
sends nothing, zeros or much noise, or a whole node sends nothing, from the first window or from the middle of the ride
on.  Counted are alarms on springs and dampers, whether what is wrong is named (channel and kind), values that are off
by more than three stated deviations without anything said, and rides at whose end what is left is monitored.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sprung.benchmarks.generator import track
from sprung.benchmarks.generator.exact import VehicleTransfer, filtered
from sprung.benchmarks.generator.integrate import SAMPLE_RATE
from sprung.benchmarks.generator.ride import SYSTEM
from sprung.benchmarks.generator.vehicle import read_vehicle
from sprung.benchmarks.keeping import keep, kept
from sprung.model.identification.identify import Identifier
from sprung.model.signals import Channel
from sprung.model.system import BUNDLED, System, load_system
from sprung.model.tracking.tracker import Tracker, TrackerState
from sprung.service.monitoring.engine import WEIGHED_OF, make_tracker

Array = NDArray[np.float64]

SECONDS = 120.0
SIZES: dict[str, tuple[float, ...]] = {
    "gain": (0.01, 0.02, 0.05, 0.1),
    "delay": (0.5e-3, 1e-3, 3e-3, 30e-3),
    "frozen": (0.0,),
    "inverted": (0.0,),
    "swapped": (0.0,),
    "silent": (0.0,),
    "zero": (0.0,),
    "silent node": (0.0,),
    "silent wheels": (0.0,),
    "noisy": (5.0, 20.0),  # times its noise
}
CALLED = {"zero": "frozen", "silent node": "silent", "silent wheels": "silent"}  # where the kind's name is another
NAMED_FROM = {"gain": 0.02, "delay": 1e-3}  # what the target asks to be named
SILENT = 3.0  # stated deviations
START = 1_800_000_000_000_000_000  # ns


@dataclass(frozen=True)
class WrongChannel:
    """What is wrong with one channel."""

    kind: str
    size: float
    channel: int
    others: tuple[int, ...]  # with which it is exchanged, or which are silent with it
    begins: float  # s


@dataclass(frozen=True)
class RideVerdict:
    """What came of a ride."""

    accused: int  # springs and dampers with an alarm
    named: bool  # channel and kind, at the end or in an alarm
    said: bool  # that something is wrong with a measurement
    silent: int  # values off by more than three deviations, where nothing is said
    monitored: bool  # at the end


def run(
    cases: int = 6, seed: int = 5000, file: str = "manchester.yaml", kind: str = "all", folder: Path | None = None
) -> Iterator[dict[str, Any]]:
    """cases: of every kind, size and begin.  file: a bundled system; `axleboxes.yaml` has accelerations below.

    folder: where rides that are done are kept; the same command goes on with the others (empty it when the code
    changed).  A cell's figures come as soon as its rides are done.
    """
    system = load_system(BUNDLED / file)
    identifier, tracker = Identifier(system), make_tracker(system)
    for name, sizes in SIZES.items():
        for size in sizes if kind in ("all", name) else ():
            for when, begins in (("first window", 0.0), ("mid ride", SECONDS / 2)):
                found = []
                for number in range(cases):
                    draw = [seed, list(SIZES).index(name), int(1e6 * size), int(begins), number]
                    at = None if folder is None else folder / f"{'-'.join(str(n) for n in draw)}.json"
                    known = kept(at, [file, SECONDS])
                    if known is None:
                        rng = np.random.default_rng(draw)
                        fault = _drawn(system, name, size, begins, rng)
                        values, truth = ride(system, fault, rng)
                        known = asdict(judge(system, identifier, tracker, values, truth, fault))
                        keep(at, [file, SECONDS], known)
                    found.append(RideVerdict(**known))
                yield _figures(file, name, size, when, found)


def _figures(file: str, name: str, size: float, when: str, found: list[RideVerdict]) -> dict[str, Any]:
    asked = size >= NAMED_FROM.get(name, 0.0)
    return {
        "figure": "wrong measurement",
        "system": file,
        "kind": name,
        "size": size,
        "from": when,
        "rides": len(found),
        "rides_with_spring_alarms": sum(j.accused > 0 for j in found),
        "named": sum(j.named for j in found),
        "said": sum(j.said for j in found),
        "silent_errors": sum(j.silent for j in found),
        "monitored": sum(j.monitored for j in found),
        "target": "no spring alarm, no silent error" + (", named in 95 %" if asked else ""),
    }


def _drawn(system: System, kind: str, size: float, begins: float, rng: np.random.Generator) -> WrongChannel:
    """On any channel, either sign; exchanged channels are of one node and unit."""
    channels = system.channels
    sign = rng.choice([-1.0, 1.0])
    while True:
        channel = int(rng.integers(len(channels)))
        node = _node(channels[channel])
        alike = [
            i for i, c in enumerate(channels)
            if i != channel and _node(c) == node and c.unit == channels[channel].unit
        ]  # fmt: skip
        if kind == "swapped" and not alike:
            continue
        others: tuple[int, ...] = (int(rng.choice(alike)),) if alike else ()
        if kind != "swapped":
            others = ()
        if kind == "silent node":
            others = tuple(i for i, c in enumerate(channels) if i != channel and _node(c) == node)
        elif kind == "silent wheels":  # all but that of the drawn channel
            left = channels[channel].name.partition(".")[0]
            others = tuple(i for i, c in enumerate(system.inputs) if c.name.partition(".")[0] != left)
            if len(others) == len(system.inputs):
                continue
            channel, others = others[0], others[1:]
        return WrongChannel(kind, sign * size, channel, others, begins)


def _node(channel: Channel) -> str:
    """What sends a channel."""
    return (channel.mcap or "").rpartition(".")[0]


def ride(
    system: System, fault: WrongChannel | None, rng: np.random.Generator, seconds: float = SECONDS
) -> tuple[Array, Array]:
    """A measured ride (T, C) at constant speed, with a fault; log-ratios (P,) of the vehicle."""
    vehicle = read_vehicle(SYSTEM)
    orders = (2,) if len(system.inputs) == len(vehicle.inputs) else (0, 1)
    ratio = rng.uniform(0.8, 1.2, 2 * len(vehicle.elements))
    spectra, omega, samples = track.wheel_spectra(
        rng,
        seconds,
        rng.uniform(35.0, 50.0),
        np.exp(rng.uniform(np.log(track.LOW_TRACK), np.log(track.HIGH_TRACK))),
        vehicle.input_position,
        vehicle.input_side,
        own_share=0.05,
    )
    live = np.flatnonzero(omega < 2 * np.pi * 50.0)
    k, c = np.split(ratio, 2)
    transfer = VehicleTransfer(vehicle, vehicle.stiffness * k, vehicle.damping * c, omega[live])
    wheels = len(vehicle.inputs)
    order = np.arange(len(orders) * wheels).reshape(len(orders), wheels).T.ravel()  # wheel by wheel
    columns = [*order, *range(len(orders) * wheels, len(orders) * wheels + len(vehicle.sensors))]

    def recorded(late: float) -> Array:
        delayed = spectra[live] * np.exp(-1j * omega[live] * late)[:, None]
        return filtered(transfer, delayed, omega[live], samples, seconds, orders)[:, columns]

    clean = recorded(0.0)
    if fault is not None:
        first = round(fault.begins * SAMPLE_RATE)
        wrong = recorded(fault.size)[:, fault.channel] if fault.kind == "delay" else clean[:, fault.channel]
        if fault.kind == "gain":
            wrong = wrong * (1 + fault.size)
        elif fault.kind == "inverted":
            wrong = -wrong
        elif fault.kind == "swapped":
            wrong = clean[:, fault.others[0]].copy()
            clean[first:, fault.others[0]] = clean[first:, fault.channel]
        clean[first:, fault.channel] = wrong[first:]
    noise = np.array([channel.noise for channel in system.channels])
    values = clean + noise * rng.standard_normal(clean.shape)
    if fault is not None:
        first = round(fault.begins * SAMPLE_RATE)
        if fault.kind in ("frozen", "zero"):
            values[first:, fault.channel] = values[first, fault.channel] if fault.kind == "frozen" else 0.0
        elif fault.kind == "noisy":
            more = np.sqrt(fault.size**2 - 1) * noise[fault.channel]
            values[first:, fault.channel] += more * rng.standard_normal(len(values) - first)
        elif fault.kind.startswith("silent"):
            values[first:, [fault.channel, *fault.others]] = np.nan
    return values, np.log(ratio)


def judge(
    system: System, identifier: Identifier, tracker: Tracker, values: Array, truth: Array, fault: WrongChannel | None
) -> RideVerdict:
    """What the tracker says of a ride whose windows come as in the service."""
    T, hop = system.window, system.hop
    firsts = np.arange(0, len(values) - T + 1, hop)
    windows = np.array([values[first : first + T] for first in firsts])
    weigh = np.arange(len(windows)) % WEIGHED_OF == 0
    state = tracker.initial_state()
    for batch in np.array_split(np.arange(len(windows)), max(1, len(windows) // 64)):
        known = [tracker.known_faults(state)] * len(batch)
        for i, estimate in zip(batch, identifier.examine(windows[batch], weigh[batch], known), strict=True):
            state = tracker.update(state, estimate, START + round(firsts[i] / system.sample_rate * 1e9))
    named = fault is not None and _is_named(system, tracker, state, fault)
    said = bool(tracker.sensors(state)) or any(a.kind in ("sensor", "misfit") for a in state.alarms)
    level, std = tracker.posterior(state)
    off = int(np.sum(np.abs(level - truth) > SILENT * std))
    return RideVerdict(
        accused=sum(a.kind == "change" for a in state.alarms),
        named=named,
        said=said,
        silent=0 if said else off,
        monitored=state.coverage.monitored,
    )


def _is_named(system: System, tracker: Tracker, state: TrackerState, fault: WrongChannel) -> bool:
    """Whether all channels and the kind are reported, as a state or as an alarm, whatever else is."""
    names = [channel.name for channel in system.channels]
    reported: set[tuple[str, str]] = {(f.channel, f.kind) for f in tracker.sensors(state)}
    for alarm in state.alarms:
        if alarm.kind == "sensor":
            channel, _, kind = (alarm.parameter or "").rpartition(".")
            reported.add((channel, kind))
    kind = CALLED.get(fault.kind, fault.kind)
    every = {names[c] for c in (fault.channel, *fault.others)}
    if kind == "silent":
        return every <= {channel for channel, of in reported if of == kind}
    return any(of == kind and every == set(channel.split("|")) for channel, of in reported)
