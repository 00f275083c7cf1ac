"""Log-ratios of parameters to their nominal values, put in place: theta = nominal exp(x)."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sprung.model.mechanics import Mechanics
from sprung.model.signals import FloatArray
from sprung.model.system import System


class ParameterPowers(NamedTuple):
    """Powers of P parameters of which the values of E elements and n degrees of freedom are made; mostly 0 and 1."""

    stiffness: FloatArray  # (P, E)
    damping: FloatArray  # (P, E)
    mass: FloatArray  # masses and inertias, (P, n)


def parameter_powers(system: System) -> ParameterPowers:
    """Which values each parameter of a system scales."""
    mechanics, P = system.mechanics, len(system.parameters)
    k, c = np.zeros((2, P, len(mechanics.stiffness)))
    m = np.zeros((P, mechanics.n))
    followers = {follower.parameter.name: follower for follower in system.followers}
    for row, parameter in enumerate(system.parameters):
        follower = followers.get(parameter.name)
        if follower is not None and follower.element >= 0:
            k[row, follower.element], c[row, follower.element] = follower.stiffness, follower.damping
        elif follower is not None or parameter.quantity == "mass":
            body = system.bodies.index(parameter.element) if follower is None else follower.body
            m[row] = mechanics.body_of_dof == body
        else:
            (k if parameter.quantity == "stiffness" else c)[row, system.elements.index(parameter.element)] = 1.0
    return ParameterPowers(k, c, m)


def mechanics_at(system: System, log_ratio: FloatArray) -> Mechanics:
    """The mechanics of a system at log-ratios (P,) of its parameters; those of a mass scale inertias, too."""
    mechanics, powers = system.mechanics, parameter_powers(system)
    return replace(
        mechanics,
        stiffness=mechanics.stiffness * np.exp(log_ratio @ powers.stiffness),
        damping=mechanics.damping * np.exp(log_ratio @ powers.damping),
        mass=mechanics.mass * np.exp(log_ratio @ powers.mass),
    )
