"""Exact discrete solution of the linear system, batched over windows and parameters, differentiable.

Between samples every drive is a cubic through its values and slopes at both ends (Hermite).  A support brings its
slope along (the measured velocity); a force's slope comes from a spline through its samples.  With z = A h,

    x(h) = e^z x(0) + sum_j a_j Psi_j,    Psi_j = j! (h phi_{j+1}(z) b + phi_j(z) b')

where a_j are the cubic's coefficients, b the input column of the value, b' that of the rate, and phi_l the
functions of exponential integrators, phi_0 = exp, phi_l(z) = z phi_{l+1}(z) + 1/l!.  No error is made in time
for such inputs; the only error is in the interpolation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from model.fusion import fuse
from model.signals import FloatArray
from model.system import System

_TAYLOR_NORM = 1.0  # 1-norm up to which the Taylor polynomial of degree 15 is exact to double precision
_COEFFICIENTS = [1.0 / math.factorial(k + 4) for k in range(16)]  # phi_4


@dataclass(frozen=True, slots=True)
class ElementValues:
    """What a batch of parameter vectors makes of a system."""

    stiffness: Tensor  # N/m, shape (B, E)
    damping: Tensor  # N s/m, shape (B, E)
    mass: Tensor  # kg or kg m^2 per degree of freedom, shape (B, n)


@dataclass(frozen=True, slots=True)
class Discrete:
    """x_{k+1} = Ad x_k + G0 w_k + G1 w_{k+1};  y_k = C x_k + D w_k, with knots w = [value, slope, ...]."""

    Ad: Tensor  # shape (B, N, N)
    G0: Tensor  # shape (B, N, W)
    G1: Tensor  # shape (B, N, W)
    C: Tensor  # shape (B, S, N)
    D: Tensor  # shape (B, S, W)


class LinearSimulator:
    """The linear system of a `System` as constant tensors; every method is batched and differentiable."""

    def __init__(self, system: System, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> None:
        mechanics = system.mechanics
        self.system, self.mechanics = system, mechanics
        self.dt = 1.0 / system.sample_rate

        def constant(array: np.ndarray) -> Tensor:
            return torch.as_tensor(array, dtype=dtype, device=device)

        self.nominal_k = constant(mechanics.stiffness)
        self.nominal_c = constant(mechanics.damping)
        self.nominal_m = constant(mechanics.mass)
        self.H, self.G, self.F = constant(mechanics.H), constant(mechanics.G), constant(mechanics.F)
        self.S, self.L = constant(mechanics.S), constant(mechanics.L)
        self.outer = torch.einsum("ea,eb->eab", self.H, self.H).reshape(len(self.nominal_k), -1)
        self.kind = torch.as_tensor(mechanics.sensor_kind, device=device)
        self.value_knots, self.slope_knots = knot_columns(system)
        self.supports = torch.as_tensor([_knot_of(system, u) for u in mechanics.support_drive], dtype=torch.long)
        self.forces = torch.as_tensor([_knot_of(system, u) for u in mechanics.force_drive], dtype=torch.long)
        self.W = 2 * (len(self.supports) + len(self.forces))
        index = {name: i for i, name in enumerate(system.elements)}
        quantity = [p.quantity for p in system.parameters]
        self.k_of = _scatter(system, "stiffness", index, len(index), constant)
        self.c_of = _scatter(system, "damping", index, len(index), constant)
        bodies = {name: i for i, name in enumerate(system.bodies)}
        per_body = _scatter(system, "mass", bodies, len(bodies), constant)
        self.m_of = per_body[:, torch.as_tensor(mechanics.body_of_dof)]
        self.estimates_mass = "mass" in quantity
        self.estimated_masses = quantity.count("mass")
        self.estimated_elements = tuple(  # indices of elements, in the order of the parameters
            torch.as_tensor([index[p.element] for p in system.parameters if p.quantity == q], dtype=torch.long)
            for q in ("stiffness", "damping")
        )
        omega = math.sqrt(float(torch.linalg.eigvalsh(self._normalised_stiffness()).max().clamp_min(1e-12)))
        root = self.nominal_m.rsqrt()
        # Mass-normalised states with rates in units of the fastest mode: the norm of A h is then about omega h.
        self.scale = torch.cat([root, root * max(omega, 1e-6)])

    def _normalised_stiffness(self) -> Tensor:
        root = self.nominal_m.rsqrt()
        return (self.H * self.nominal_k[:, None]).T @ self.H * root[:, None] * root[None, :]

    def element_values(self, log_ratio: Tensor) -> ElementValues:
        """theta = nominal exp(log_ratio) put in place; log_ratio (B, P)."""
        k = self.nominal_k * torch.exp(log_ratio @ self.k_of)
        c = self.nominal_c * torch.exp(log_ratio @ self.c_of)
        m = self.nominal_m.expand(len(log_ratio), -1)
        if self.estimates_mass:
            m = m * torch.exp(log_ratio @ self.m_of)
        return ElementValues(k, c, m)

    def continuous(self, values: ElementValues) -> tuple[Tensor, Tensor, Tensor]:
        """A (B, N, N), input columns of the knots' values and rates, each (B, N, W/2)."""
        B, n = values.mass.shape
        inverse = 1.0 / values.mass
        A = values.mass.new_zeros(B, 2 * n, 2 * n)
        A[:, :n, n:] = torch.eye(n, dtype=A.dtype, device=A.device)
        A[:, n:, :n] = -(values.stiffness @ self.outer).reshape(B, n, n) * inverse[:, :, None]
        A[:, n:, n:] = -(values.damping @ self.outer).reshape(B, n, n) * inverse[:, :, None]
        b_value = A.new_zeros(B, 2 * n, self.W // 2)
        b_rate = torch.zeros_like(b_value)
        if len(self.supports):
            at = self.supports // 2
            b_value[:, n:, at] = -(self.H.T * values.stiffness[:, None, :]) @ self.G * inverse[:, :, None]
            b_rate[:, n:, at] = -(self.H.T * values.damping[:, None, :]) @ self.G * inverse[:, :, None]
        if len(self.forces):
            b_value[:, n:, self.forces // 2] = self.F * inverse[:, :, None]
        return A, b_value, b_rate

    def outputs(self, values: ElementValues, A: Tensor, b_value: Tensor, b_rate: Tensor) -> tuple[Tensor, Tensor]:
        """C (B, S, N) and D (B, S, W) of the sensors."""
        n = values.mass.shape[1]
        kind = self.kind[:, None]
        S, zero = self.S, torch.zeros((), dtype=A.dtype, device=A.device)
        acceleration = torch.where(kind == 0, S, zero)
        C = acceleration @ A[:, n:]
        C[:, :, n:] += torch.where(kind == 1, S, zero)
        C[:, :, :n] += torch.where(kind == 2, S, zero)
        D = A.new_zeros(len(A), len(S), self.W)
        D[:, :, 0::2] = acceleration @ b_value[:, n:]
        D[:, :, 1::2] = acceleration @ b_rate[:, n:]
        if bool((self.kind >= 3).any()):
            deflection, force = torch.where(kind == 3, self.L, zero), torch.where(kind == 4, self.L, zero)
            of_d = deflection + force * values.stiffness[:, None, :]
            of_v = force * values.damping[:, None, :]
            C[:, :, :n] += of_d @ self.H
            C[:, :, n:] += of_v @ self.H
            D[:, :, self.supports] += of_d @ self.G
            D[:, :, self.supports + 1] += of_v @ self.G
        return C, D

    def discretise(self, values: ElementValues) -> Discrete:
        """The exact step over one sample."""
        A, b_value, b_rate = self.continuous(values)
        C, D = self.outputs(values, A, b_value, b_rate)
        h = self.dt
        phi = phi_functions(A * h * (self.scale[None, :] / self.scale[:, None]))
        columns = torch.cat([b_value, b_rate], dim=2) / self.scale[:, None]
        half = self.W // 2
        # Psi_j = j! (h phi_{j+1} b + phi_j b')
        psi = []
        for j in range(4):
            term = h * phi[j + 1] @ columns[:, :, :half]
            if j:
                term = term + phi[j] @ columns[:, :, half:]
            psi.append(math.factorial(j) * term * self.scale[:, None])
        G0 = torch.stack([psi[0] - 3 * psi[2] + 2 * psi[3], h * (psi[1] - 2 * psi[2] + psi[3])], dim=3)
        G1 = torch.stack([3 * psi[2] - 2 * psi[3], h * (psi[3] - psi[2])], dim=3)
        Ad = phi[0] * (self.scale[:, None] / self.scale[None, :])
        return Discrete(Ad, G0.flatten(2), G1.flatten(2), C, D)

    def knots(self, windows: FloatArray) -> FloatArray:
        """Values and slopes of all drives, (B, T, W), from windows (B, T, C) in the system's channel order."""
        return knots(self.system, windows)

    def states(self, discrete: Discrete, w: Tensor, x0: Tensor) -> Tensor:
        """States (B, T, N) from knots (B, T, W) and the first state (B, N)."""
        push = w[:, :-1] @ discrete.G0.mT + w[:, 1:] @ discrete.G1.mT  # (B, T-1, N)
        x = x0.unsqueeze(2)
        path = [x]
        for drive in push.unsqueeze(3).unbind(1):
            x = torch.baddbmm(drive, discrete.Ad, x)
            path.append(x)
        return torch.cat(path, dim=2).mT

    def simulate(self, log_ratio: Tensor, w: Tensor, x0: Tensor) -> tuple[Tensor, Tensor]:
        """Sensor outputs (B, T, S) and states (B, T, N)."""
        discrete = self.discretise(self.element_values(log_ratio))
        x = self.states(discrete, w, x0)
        return x @ discrete.C.mT + w @ discrete.D.mT, x

    def free_response(self, discrete: Discrete, samples: int) -> Tensor:
        """C Ad^k for k < samples, shape (B, T, S, N), by doubling."""
        B, S, N = discrete.C.shape
        blocks, power = discrete.C.new_empty(B, samples * S, N), discrete.Ad
        blocks[:, :S] = discrete.C
        done = 1
        while done < samples:
            more = min(done, samples - done)
            torch.bmm(blocks[:, : more * S], power, out=blocks[:, done * S : (done + more) * S])
            done += more
            if done < samples:
                power = power @ power
        return blocks.reshape(B, samples, S, N)


def phi_functions(z: Tensor) -> list[Tensor]:
    """phi_0 (the exponential) to phi_4 of a batch of matrices, by Taylor polynomial with scaling and doubling.

    Doubling: phi_l(2z) = 2^-l (phi_0(z) phi_l(z) + sum_{k=1..l} phi_k(z) / (l-k)!)
    (Hochbruck and Ostermann, Exponential integrators, Acta Numerica 2010).
    """
    norm = float(z.detach().abs().sum(dim=1).max()) if z.numel() else 0.0
    doublings = max(0, math.ceil(math.log2(max(norm, 1e-300) / _TAYLOR_NORM)))
    z = z / 2**doublings
    eye = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device)
    z2 = z @ z
    z3, z4 = z2 @ z, z2 @ z2
    top = None
    for block in (12, 8, 4, 0):
        a, b, c, d = _COEFFICIENTS[block : block + 4]
        polynomial = a * eye + b * z + c * z2 + d * z3
        top = polynomial if top is None else polynomial + z4 @ top
    assert top is not None
    phi = [top]
    for order in (3, 2, 1, 0):
        phi.insert(0, z @ phi[0] + eye / math.factorial(order))
    for _ in range(doublings):
        phi = [
            (phi[0] @ phi[order] + sum((phi[k] / math.factorial(order - k) for k in range(1, order + 1)), 0 * eye))
            / 2**order
            for order in range(5)
        ]
    return phi


def knot_columns(system: System) -> tuple[list[int], list[int | None]]:
    """For each drive (a support or a force) the window column of its value and of its slope (None: derived)."""
    values: list[int] = []
    slopes: list[int | None] = []
    columns = system.drive_channels
    at = 0
    for source in system.file.inputs.values():
        value = columns[at]
        assert value is not None
        values.append(value)
        support = source.kind == "displacement"
        slopes.append(columns[at + 1] if support else None)
        at += 2 if support else 1
    return values, slopes


def knots(system: System, windows: FloatArray) -> FloatArray:
    """Values and slopes of all drives at the samples, (B, T, W) = [value, slope, value, slope, ...].

    Where a support's displacement and velocity are both measured with noise they are fused (`model.fusion`); slopes
    that are not measured come from the cubic spline through the samples (not-a-knot ends).
    """
    values, slopes = knot_columns(system)
    out = np.empty((*windows.shape[:2], 2 * len(values)))
    derived = [i for i, column in enumerate(slopes) if column is None]
    alike: dict[tuple[float, float], list[int]] = {}  # supports to fuse, by the noises of their two signals
    for i, (value, slope) in enumerate(zip(values, slopes, strict=True)):
        out[:, :, 2 * i] = windows[:, :, value]
        if slope is not None:
            out[:, :, 2 * i + 1] = windows[:, :, slope]
            noise = system.inputs[value].noise, system.inputs[slope].noise
            if min(noise) > 0:
                alike.setdefault(noise, []).append(2 * i)
    for noise, at in alike.items():
        d, v = (np.moveaxis(out[:, :, [i + part for i in at]], 1, 2) for part in (0, 1))
        d, v = fuse(d, v, 1 / system.sample_rate, noise)
        out[:, :, at], out[:, :, [i + 1 for i in at]] = np.moveaxis(d, 2, 1), np.moveaxis(v, 2, 1)
    if derived:
        samples = out[:, :, [2 * i for i in derived]]
        time = np.arange(windows.shape[1]) / system.sample_rate
        out[:, :, [2 * i + 1 for i in derived]] = CubicSpline(time, samples, axis=1)(time, 1)
    return out


def _knot_of(system: System, drive: int) -> int:
    """Index in the knot vector of the value of the drive that starts at position `drive` of u."""
    at = 0
    for i, source in enumerate(system.file.inputs.values()):
        if at == drive:
            return 2 * i
        at += 2 if source.kind == "displacement" else 1
    raise AssertionError(drive)


def _scatter(system: System, quantity: str, index: dict[str, int], size: int, constant) -> Tensor:  # type: ignore[no-untyped-def]
    """Matrix (P, size) that puts the parameters of one quantity in their places."""
    matrix = np.zeros((len(system.parameters), size))
    for row, parameter in enumerate(system.parameters):
        if parameter.quantity == quantity:
            matrix[row, index[parameter.element]] = 1.0
    return constant(matrix)
