"""What passengers and goods change of a body: its mass, how that is spread, where its centre of gravity lies.

With m0, J0, I0 the body's mass, roll and pitch inertia without them, and one load's five numbers l, r, p, c, s,

    m = m0 exp(l)    J = J0 exp(l + r)    I = I0 exp(l + p)    x_c = c sqrt(I / m)    y_c = s sqrt(J / m)

J and I are about the body's `position`, and x_c, y_c is how far its centre of gravity lies from there, so that the
mass matrix of [z, roll, pitch] has m x_c = c sqrt(m I) between z and pitch, and m y_c = s sqrt(m J) between z and roll
(m x_c y_c between roll and pitch is of second order and left out).  All five are zero for the empty body, of the size
of a relative change, and give a positive mass matrix for c^2 + s^2 < 1.

An air spring that a valve keeps at its height has a pressure, and so a stiffness, in proportion to the weight on it: an
element with `by_load: a` under the body is stiffer by exp(a l).

Bodies below, bogies, are never quite those of their drawing, either.  Four numbers more are a body's own, the same in
all windows: the logarithms of its roll and pitch inertia, and how much further from its middle its accelerometers are,
along x and along y, than the file says.  Their masses are the scale of all forces, which no window identifies.  A wheel
base that is a little longer is, in angles that are a little smaller, a smaller pitch inertia and accelerometers
that are closer together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from sprung.model.mechanics import ACCELERATION
from sprung.model.signals import FloatArray
from sprung.model.system import System

Kind = Literal["load", "roll_inertia", "pitch_inertia", "centre", "side", "own_roll", "own_pitch", "reach_x",
               "reach_y"]  # fmt: skip
COUPLED: dict[Kind, str] = {"centre": "pitch", "side": "roll"}  # what couples heave to which angle
SPREAD_STD = 0.1  # of r and p: seated passengers have 0.6 times the inertia of a load spread like the body
CENTRE_STD = 0.04  # of c: one metre off the middle of a car that carries 30 % is 0.03
SIDE_STD = 0.03  # of s: a load of 15 % of the car that sits 30 cm off its middle line is 0.03
REACHING: dict[Kind, str] = {"reach_x": "pitch", "reach_y": "roll"}  # the angle that accelerometers show through it
OWN_STD: dict[
    Kind, float
] = {  # of deviations of bodies from the file: drawings and weighed prototypes agree to some per cent
    "own_roll": 0.03,
    "own_pitch": 0.03,
    "reach_x": 0.015,
    "reach_y": 0.015,
}
_MOST = 0.7  # of |c| and |s|: a step of the refinement does not leave the masses that there are


@dataclass(frozen=True, slots=True)
class LoadTerm:
    """One number of one load, or of one body's own."""

    body: str
    kind: Kind
    std: float  # before any window


def load_terms(system: System) -> tuple[LoadTerm, ...]:
    """What loads are described by, in order: the masses of all of them, then how each is spread, where it has axes.

    How far each lies to the side comes after: states of trackers from before it was known are continued.  Bodies' own
    values are last.
    """
    found = [LoadTerm(load.body, "load", load.std) for load in system.loads]
    for load in system.loads:
        body = system.file.bodies[load.body]
        if body.roll_inertia is not None:
            found.append(LoadTerm(load.body, "roll_inertia", SPREAD_STD))
        if body.pitch_inertia is not None:
            found.append(LoadTerm(load.body, "pitch_inertia", SPREAD_STD))
            found.append(LoadTerm(load.body, "centre", CENTRE_STD))
    rolling = (load for load in system.loads if system.file.bodies[load.body].roll_inertia is not None)
    return (*found, *(LoadTerm(load.body, "side", SIDE_STD) for load in rolling), *_own_terms(system))


def _own_terms(system: System) -> Iterator[LoadTerm]:
    """What is estimated of bodies beside loads, after these: older states of trackers, which lack it, are continued."""
    mechanics = system.mechanics
    shown = mechanics.S[mechanics.sensor_kind == ACCELERATION].any(axis=0)  # coordinates that accelerometers show
    for name in system.built:
        body = system.file.bodies[name]
        kinds: list[Kind] = ["own_roll"] if body.roll_inertia is not None else []
        kinds += ["own_pitch"] if body.pitch_inertia is not None else []
        dofs = {kind: f"{name}.{angle}" for kind, angle in REACHING.items()}
        kinds += [kind for kind, dof in dofs.items() if dof in mechanics.dofs and shown[mechanics.dofs.index(dof)]]
        yield from (LoadTerm(name, kind, OWN_STD[kind]) for kind in kinds)


class Loading:
    """The loads of a system as constant tensors: X terms over n degrees of freedom."""

    def __init__(self, system: System, constant: Callable[[FloatArray], Tensor]) -> None:
        self.terms = load_terms(system)
        mechanics = system.mechanics
        dofs = mechanics.dofs
        exponents = np.zeros((len(self.terms), len(dofs)))
        pattern = np.zeros((len(self.terms), len(dofs), len(dofs)))
        reach = np.zeros((len(self.terms), len(dofs)))
        for i, term in enumerate(self.terms):
            if term.kind == "load":
                exponents[i] = mechanics.body_of_dof == system.bodies.index(term.body)
            elif term.kind in REACHING:
                reach[i, dofs.index(f"{term.body}.{REACHING[term.kind]}")] = 1.0
            elif term.kind in COUPLED:
                z, angle = dofs.index(f"{term.body}.z"), dofs.index(f"{term.body}.{COUPLED[term.kind]}")
                pattern[i, z, angle] = pattern[i, angle, z] = 1.0
            else:
                axis = term.kind.removesuffix("_inertia").removeprefix("own_")
                exponents[i, dofs.index(f"{term.body}.{axis}")] = 1.0
        stiffness = np.zeros((len(self.terms), len(mechanics.stiffness)))
        for e, element in enumerate(system.file.elements.values()):
            for i, term in enumerate(self.terms):
                if term.kind == "load" and term.body == element.upper:
                    stiffness[i, e] = element.by_load
        self.stiffness = constant(stiffness)  # powers of each stiffness, of air springs under a load, (X, E)
        self.exponents = constant(exponents)  # powers of each mass and inertia, (X, n)
        self.pattern = constant(pattern)  # where each couples degrees of freedom, (X, n, n)
        self.reach = constant(reach)  # 1 where each lengthens what accelerometers show of an angle, (X, n)
        self.reaches = any(term.kind in REACHING for term in self.terms)
        self.couples = any(term.kind in COUPLED for term in self.terms)

    def __len__(self) -> int:
        return len(self.terms)

    @property
    def of_loads(self) -> int:
        """How many of the terms, the first ones, are of loads; the others are of bodies' own."""
        return sum(term.kind not in OWN_STD for term in self.terms)

    def factors(self, load: Tensor) -> Tensor:
        """What masses and inertias are multiplied by, (B, n), for terms (B, X), or the first of them."""
        return torch.exp(load @ self.exponents[: load.shape[1]])

    def lengthened(self, load: Tensor) -> Tensor | None:
        """What accelerometers show of each coordinate, times this, (B, n); None where all are where the file says."""
        return 1 + load @ self.reach[: load.shape[1]] if self.reaches else None

    def coupling(self, load: Tensor) -> Tensor | None:
        """K of the mass matrix sqrt(m) (1 + K) sqrt(m), (B, n, n); None where no centre can move."""
        if not self.couples:
            return None
        return torch.einsum("bx,xij->bij", load.clamp(-_MOST, _MOST), self.pattern[: load.shape[1]])

    def terms_of(self, linear: Tensor) -> Tensor:
        """The first X terms (B, X), which change masses and couplings by `linear` (B, X) times their slopes at none."""
        exponents, pattern = self.exponents[: linear.shape[1]], self.pattern[: linear.shape[1]]
        factors = (1 + linear @ exponents).clamp(1 - _MOST, 1 / (1 - _MOST))  # (B, n)
        terms = factors.log() @ torch.linalg.pinv(exponents)
        root = factors.sqrt()
        scale = torch.einsum("xij,bi,bj->bx", pattern, 1 / root, 1 / root)
        pairs = pattern.sum(dim=(1, 2))
        return torch.where(pairs > 0, (linear * scale / pairs.clamp_min(1)).clamp(-_MOST, _MOST), terms)


def by_inertia(
    acceleration: Tensor, mass: Tensor, coupling: Tensor | None, exponents: Tensor, pattern: Tensor
) -> Tensor:
    """Derivative of the inertia forces M q'' with respect to terms, (B, F, n, X).

    acceleration: spectra (B, F, n); mass (B, n); exponents (X, n) and pattern (X, n, n) of the terms.
    """
    kind = acceleration.dtype
    root = mass.sqrt()[:, None, :, None]
    moved = root * acceleration.unsqueeze(3)  # sqrt(m) q'', (B, F, n, 1)
    if coupling is None:
        scaled = moved * exponents.T.to(kind)
    else:
        powers = exponents.T.to(kind)
        whole = (torch.eye(mass.shape[1], dtype=mass.dtype) + coupling)[:, None].to(kind)
        scaled = 0.5 * (powers * (whole @ moved) + whole @ (powers * moved))
    at = pattern.flatten(1).any(dim=1).nonzero().squeeze(1)
    if len(at):
        scaled[..., at] += torch.einsum("xij,bfj->bfix", pattern[at].to(kind), moved.squeeze(3))
    return root * scaled
