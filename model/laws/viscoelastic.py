"""Rubber: a stiffness that grows with the frequency, with damping in proportion, over decades; material damping.

A fractional derivative (Bagley and Torvik, 1983), K(w) = k (j w / w1)^a with w1 of 1 Hz, as five Maxwell branches:

    s^a = sin(pi a) / pi  int s / (s + e^u) e^(a u) du  ~  sum_i w_i s / (s + x_i),   w_i = sin(pi a) / pi  D x_i^a

with poles x_i a factor e^D = 5 apart around 3.5 Hz.  What is left out below them is a stiffness and above them a
damping, which the element's own take up.

Metal, concrete and joints lose about the same share of their energy in every cycle, at any frequency (structural or
hysteretic damping): a loss factor h, the limit of small a with h = pi a / 2, as seven branches with poles x_i a factor
e^D = 4 apart from 0.03 to 110 Hz,

    h k = sum_i (2 D / pi) h k  w x_i / (w^2 + x_i^2)        to 0.3 % well between the outer poles

It is a property of the material, and the springs of a structure have it together.  No material is as even as that: h
may grow with a small power of the frequency, h (x_i / w1)^b in place of it.
"""

from __future__ import annotations

import numpy as np

from sprung.model.laws.base import RARE, ElementLaw, Maxwell, ParameterSpec, Values, grid
from sprung.model.laws.kinds import Foothold, StructureLaw
from sprung.model.laws.motion import Motion, Observed, SpringDamper
from sprung.model.mechanics import Mechanics
from sprung.model.signal_filters import lfilter_from
from sprung.model.signals import FloatArray

_APART = 5.0
_UNIT = 2 * np.pi  # rad/s, of 1 Hz
_POLES = _UNIT * 3.5 * _APART ** np.arange(-2.0, 3.0)  # 1/s
_FOLLOWED = 0.03  # of size and order, that five branches make of the power law over a decade or two, orders above 0.2


def _weights(stiffness: FloatArray, order: FloatArray) -> list[FloatArray]:
    """Stiffness of every branch."""
    size = stiffness * np.sin(np.pi * order) / np.pi * np.log(_APART)
    return [size * (pole / _UNIT) ** order for pole in _POLES]


def _force(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    parts = _weights(*(np.asarray(value, dtype=float) for value in p))
    found: FloatArray = sum((part * z for part, z in zip(parts, motion.memory, strict=True)), np.zeros(()))
    return found


def _rate(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    return np.stack([motion.rate - pole * z for pole, z in zip(_POLES, motion.memory, strict=True)])


def _decay(p: Values, element: SpringDamper) -> FloatArray:
    shape = np.shape(p[0])
    return np.broadcast_to(_POLES.reshape(5, *(1 for _ in shape)), (5, *shape))


# the same as text: force and rate of the state of every branch
_PARTS = tuple(
    (
        f"stiffness * sin({np.pi!r} * order) * {float(np.log(_APART) / np.pi)!r} * {float(pole / _UNIT)!r}**order * z",
        f"v - {float(pole)!r} * z",
    )
    for pole in _POLES
)


def _path(motion: Motion, p: Values) -> FloatArray:
    time, d = np.asarray(motion.time), np.asarray(motion.deflection)
    step = float(time[1] - time[0])
    force = np.zeros(len(d))
    for pole, part in zip(_POLES, _weights(np.asarray(p[0]), np.asarray(p[1])), strict=True):
        kept = float(np.exp(-pole * step))
        gain = (1 - kept) / (pole * step)  # of a straight line between samples
        force += part * lfilter_from([gain, -gain], [1.0, -kept], d, [-gain * d[0]])
    return force


def _shapes(seen: Observed) -> FloatArray:
    return grid([0.1 * max(seen.stiffness, 1e-12)], [0.2, 0.35, 0.55])


FRACTIONAL_STIFFNESS = ElementLaw(
    name="fractional_stiffness",
    title="a stiffness that grows with the frequency (rubber)",
    parameters=(
        ParameterSpec(
            "stiffness",
            "N/m",
            0.0,
            1e12,
            "size of the growing part at 1 Hz",
            lambda s: 0.1 * s.stiffness,
            accuracy=_FOLLOWED,
        ),
        ParameterSpec("order", "1", 0.02, 0.95, "power of the frequency", lambda seen: 0.3, accuracy=_FOLLOWED),
    ),
    force=_force,
    shapes=_shapes,
    absent=(0.0, 0.3),
    looks_like="stiffer at every higher frequency and damped everywhere, without a corner; linear",
    confused_with=("air_spring", "series_stiffness"),
    sentence="a part of {stiffness} at 1 Hz that grows with the frequency to the power {order}",
    parts=_PARTS,
    memory=5,
    memory_rate=_rate,
    memory_decay=_decay,
    path=_path,
    prior_cost=RARE,
)


_LOSSY_APART = 4.0
_LOSSY_FOLLOWED = 0.01  # of a loss factor that seven branches read from dense ones, over half a decade or two
_POWER_FOLLOWED = 0.2  # of 0.1, the same of the power
_LOSSY = _UNIT * 1.75 * _LOSSY_APART ** np.arange(-3.0, 4.0)  # 1/s, poles
_AT_1_HZ = _UNIT**2 + _LOSSY**2  # normalises the response of the branches there


def _unchanged(mechanics: Mechanics, sites: tuple[Foothold, ...], p: Values, variant: str) -> Mechanics:
    return mechanics


def _lossy(p: Values, element: SpringDamper) -> tuple[Maxwell, ...]:
    """Branches beside a spring that loses the same share of its energy at every frequency."""
    loss, power = (float(value) for value in p)
    shares = 2 * np.log(_LOSSY_APART) / np.pi * (_LOSSY / _UNIT) ** power
    lost, kept = (float(shares @ part) for part in (_UNIT * _LOSSY / _AT_1_HZ, _UNIT**2 / _AT_1_HZ))
    size = float(element.stiffness) * loss / (lost - loss * kept)  # of the spring with its branches, at 1 Hz
    return tuple(Maxwell(float(size * s), float(1 / x), of_spring=True) for s, x in zip(shares, _LOSSY, strict=True))


STRUCTURAL_DAMPING = StructureLaw(
    name="structural_damping",
    title="material damping of all springs",
    parameters=(
        ParameterSpec(
            "loss_factor",
            "1",
            0.0,
            0.25,
            "energy lost per radian over the energy stored, at 1 Hz",
            lambda seen: 0.02,
            accuracy=_LOSSY_FOLLOWED,
        ),
        ParameterSpec(
            "power",
            "1",
            -0.1,
            0.5,
            "of the frequency, with which it grows",
            lambda seen: 0.1,
            minor=True,
            accuracy=_POWER_FOLLOWED,
        ),
    ),
    where="elements",
    modify=_unchanged,
    absent=(0.0, 0.0),
    looks_like="every resonance is damped about alike, high ones more and low ones less than dampers would have them",
    confused_with=("fractional_stiffness", "air_spring", "suspended_mass"),
    sentence="all springs lose energy at any frequency, as materials and joints do, by a loss factor of {loss_factor} "
    "at 1 Hz",
    strengths=(0,),
    branches=_lossy,
    prior_cost=RARE,
)
