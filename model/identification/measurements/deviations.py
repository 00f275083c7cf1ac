"""Deviations of measurements and loads from the system file, with their prior standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sprung.model.schema import ForceInput, MotionSensor, TrackInput
from sprung.model.signals import BoolArray, FloatArray, IntArray, MeasurementFault
from sprung.model.simulate.loading import load_terms
from sprung.model.system import System

# of a delay, and standard deviations: channels of a node that are apart by less than either are late together
_SAME_CLOCK, _SAME_SIGMAS = 0.3, 3.0

Kind = Literal["gain", "delay", "load", "roll_inertia", "pitch_inertia", "centre", "side", "own_roll", "own_pitch",
               "reach_x", "reach_y"]  # fmt: skip
CARGO: tuple[Kind, ...] = ("load", "roll_inertia", "pitch_inertia", "centre", "side")  # another after every stop
OWN: dict[Kind, str] = {  # of a body, always the same
    "own_roll": "roll inertia over mass",
    "own_pitch": "pitch inertia over mass",
    "reach_x": "distance of its accelerometers along x",
    "reach_y": "distance of its accelerometers along y",
}


@dataclass(frozen=True, slots=True)
class Deviation:
    """One thing that the system file states and that may be otherwise."""

    name: str  # of the channel, or of the body
    kind: Kind
    std: float  # what the data sheet leaves open: relative, or s; of loads see `model.simulate.loading`
    group: int  # channels that share a clock have the same number; -1 for a load
    node: int = -1  # clocks of one node have the same number; -1: not known
    support: int = -1  # channels that measure the motion of one support have the same number; -1: of none


def deviations(system: System) -> tuple[Deviation, ...]:
    """Gains of all channels, delays of all channels, what describes the loads of bodies with passengers or goods, and
    how bodies are built otherwise than the file says."""
    tracks = any(isinstance(source, TrackInput) for source in system.file.inputs.values())
    if tracks or not system.bodies:
        return ()  # unmeasured tracks and component tests have identifiers of their own
    channels = system.channels
    shared = (clock_groups(system), nodes(system), supports(system))
    clocks = list(zip(channels, system.tolerances, *shared, strict=True))
    return (
        *(Deviation(c.name, "gain", t.gain, g, n, s) for c, t, g, n, s in clocks),
        *(Deviation(c.name, "delay", t.delay, g, n, s) for c, t, g, n, s in clocks),
        *(Deviation(term.body, term.kind, term.std, -1) for term in load_terms(system)),
    )


def clock_groups(system: System) -> IntArray:
    """Channels of one message share its clock: the address up to its last part; shape (C,).

    Columns of a table say nothing of clocks: there, channels of one unit at one body are taken to have one, as they
    come through the same node and filter.
    """
    found: dict[str, int] = {}
    groups = []
    for channel, body in zip(system.channels, _bodies(system), strict=True):
        address = channel.mcap or channel.can
        message = address.rpartition(".")[0] if address else f"\0{body}\0{channel.unit}"
        groups.append(found.setdefault(message, len(found)))
    return np.array(groups, dtype=np.int64)


def nodes(system: System) -> IntArray:
    """Topics with one beginning come from one node: `/bogie1/acceleration`, `/bogie1/axlebox/velocity`; shape (C,).

    Where topics do not tell, what is measured at a body comes from one: cables are short.
    """
    found: dict[str, int] = {}
    numbers = []
    for channel, body in zip(system.channels, _bodies(system), strict=True):
        node, _, rest = (channel.mcap or "").strip("/").partition("/")
        numbers.append(found.setdefault(node if rest else f"\0{body}", len(found)))
    return np.array(numbers, dtype=np.int64)


def supports(system: System) -> IntArray:
    """The support that each channel measures the motion of, -1 where it is of none; shape (C,)."""
    measured = [name for name, source in system.file.inputs.items() if not isinstance(source, ForceInput)]
    names = [channel.name.partition(".")[0] for channel in system.inputs]
    of_inputs = [measured.index(name) if name in measured else -1 for name in names]
    return np.array([*of_inputs, *(-1 for _ in system.sensors)], dtype=np.int64)


def shared_directions(deviations: Sequence[Deviation]) -> FloatArray:
    """What several channels may have in common, as rows over the deviations (V, H), each once.

    The delay of a clock, of all clocks of a node, of all supports measured by one node; gain and delay of a support,
    whose quantities come from one instrument; the gain of all channels of a message, which have one reference.
    """
    kind = np.array([d.kind for d in deviations])
    group, node, support = (np.array([getattr(d, of) for d in deviations]) for of in ("group", "node", "support"))
    late, gain = kind == "delay", kind == "gain"
    below = late & (support >= 0)
    parts = [
        (late, group),
        (late & (node >= 0), node),
        (below, node),
        (below, support),
        (gain & (support >= 0), support),
        (gain, group),
    ]
    rows = [among & (number == one) for among, number in parts for one in np.unique(number[among])]
    found = list(dict.fromkeys(tuple(row.tolist()) for row in rows if row.sum() > 1))
    return np.array(found, dtype=np.float64).reshape(len(found), len(deviations))


def _bodies(system: System) -> list[str]:
    """The body at which each channel is measured: that on a support, and the lower one of an element."""
    file = system.file
    at = {name: e.lower if e.lower in file.bodies else e.upper for name, e in file.elements.items()}
    moved = {e.lower: e.upper for e in file.elements.values() if e.lower in file.inputs}
    moved |= {name: source.body for name, source in file.inputs.items() if isinstance(source, ForceInput)}
    shown = {n: s.body if isinstance(s, MotionSensor) else at[s.element] for n, s in file.sensors.items()}
    return [shown.get(c.name) or moved.get(c.name.partition(".")[0], "") for c in system.channels]


def named(
    deviations: Sequence[Deviation], values: FloatArray, std: FloatArray, chosen: BoolArray
) -> tuple[MeasurementFault, ...]:
    """Gains and delays among deviations (H,), those that are `chosen` (H,), as faults of channels.

    A delay that all channels of a clock share is one fault of them all.
    """
    found = [
        MeasurementFault(deviations[h].name, "gain", float(1 + values[h]), float(std[h]))
        for h in np.flatnonzero(chosen).tolist()
        if deviations[h].kind == "gain"
    ]
    group = np.array([d.group if d.kind == "delay" else -1 for d in deviations])
    done = np.zeros(len(values), dtype=bool)
    for h in np.flatnonzero(chosen & (group >= 0)).tolist():
        if done[h]:
            continue
        members = group == group[h]
        alike = members & (np.abs(values - values[h]) < np.maximum(_SAME_CLOCK * abs(values[h]), _SAME_SIGMAS * std[h]))
        if not alike[members].all():
            alike = np.arange(len(values)) == h
        done |= alike
        name = "|".join(deviations[i].name for i in np.flatnonzero(alike).tolist())
        found.append(MeasurementFault(name, "delay", float(values[alike].mean()), float(std[h])))
    return tuple(found)
