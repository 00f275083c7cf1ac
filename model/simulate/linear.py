"""Exact discrete solution of the linear system, batched over windows and parameters, differentiable.

Between samples every drive is a cubic through its values and slopes at both ends (Hermite), see
`model.simulate.drives`.  With z = A h,

    x(h) = e^z x(0) + sum_j a_j Psi_j,    Psi_j = j! (h phi_{j+1}(z) b + phi_j(z) b')

where a_j are the cubic's coefficients, b the input column of the value, b' that of the rate, and phi_l the
functions of exponential integrators, phi_0 = exp, phi_l(z) = z phi_{l+1}(z) + 1/l!.  No error is made in time
for such inputs; the only error is in the interpolation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sprung.model.mechanics import ACCELERATION, DEFLECTION, DISPLACEMENT, FORCE, VELOCITY
from sprung.model.ratios import parameter_powers
from sprung.model.signals import FloatArray
from sprung.model.simulate.drives import knots
from sprung.model.simulate.loading import Loading
from sprung.model.system import System

_TAYLOR_NORM = 1.0  # 1-norm up to which the Taylor polynomial of degree 15 is exact to double precision
_TAYLOR = torch.tensor([[1.0 / math.factorial(4 * i + j + 4) for j in range(4)] for i in range(4)], dtype=torch.float64)
_MIX = torch.tensor(  # how much of phi_k a doubling adds to phi_l
    [[1.0 / math.factorial(l - k) if 0 < k <= l else 0.0 for k in range(5)] for l in range(5)],  # noqa: E741
    dtype=torch.float64,
)
_SCALE = torch.tensor([[2.0**-order] for order in range(5)], dtype=torch.float64)


@dataclass(frozen=True, slots=True)
class ElementValues:
    """What a batch of parameter vectors makes of a system."""

    stiffness: Tensor  # N/m, shape (B, E)
    damping: Tensor  # N s/m, shape (B, E)
    mass: Tensor  # kg or kg m^2 per degree of freedom, shape (B, n)
    coupling: Tensor | None = None  # K of the mass matrix sqrt(m) (1 + K) sqrt(m), (B, n, n); None: diagonal
    reach: Tensor | None = None  # what accelerometers show of each coordinate, times this, (B, n); None: 1

    @property
    def inertia(self) -> Tensor:
        """The mass matrix, (B, n, n)."""
        if self.coupling is None:
            return torch.diag_embed(self.mass)
        root = self.mass.sqrt()
        return torch.diag_embed(self.mass) + root[:, :, None] * self.coupling * root[:, None]

    def take(self, at: Tensor) -> ElementValues:
        """Some of the vectors."""
        coupling, reach = (None if part is None else part[at] for part in (self.coupling, self.reach))
        return ElementValues(self.stiffness[at], self.damping[at], self.mass[at], coupling, reach)

    def accelerated(self, forces: Tensor) -> Tensor:
        """Accelerations under generalised forces (B, n, X)."""
        if self.coupling is None:
            return forces / self.mass[:, :, None]
        root, whole = (
            self.mass.sqrt().unsqueeze(2),
            self.coupling + torch.eye(self.mass.shape[1], dtype=self.mass.dtype),
        )
        accelerations: Tensor = torch.linalg.solve(whole, forces / root) / root
        return accelerations


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

        # Value and slope at the left end, then at the right end, in a cubic's coefficients; times j! of Psi_j.
        left_and_right = np.array([[1, 0, -3, 2], [0, 1, -2, 1], [0, 0, 3, -2], [0, 0, -1, 1]]) * [1, 1, 2, 6]
        self.hermite = constant(left_and_right * np.array([1, self.dt, 1, self.dt])[:, None])
        self.not_constant = constant(np.array([0.0, 1.0, 1.0, 1.0])[:, None, None])

        self.nominal_k = constant(mechanics.stiffness)
        self.nominal_c = constant(mechanics.damping)
        self.nominal_m = constant(mechanics.mass)
        self.H, self.G, self.F = constant(mechanics.H), constant(mechanics.G), constant(mechanics.F)
        self.S, self.L = constant(mechanics.S), constant(mechanics.L)
        self.outer = torch.einsum("ea,eb->eab", self.H, self.H).reshape(len(self.nominal_k), -1)
        self.kind = torch.as_tensor(mechanics.sensor_kind, device=device)
        self.supports = torch.as_tensor([_knot_of(system, u) for u in mechanics.support_drive], dtype=torch.long)
        self.forces = torch.as_tensor([_knot_of(system, u) for u in mechanics.force_drive], dtype=torch.long)
        self.W = 2 * (len(self.supports) + len(self.forces))
        self._assemble(constant)
        # Powers of the parameters: of stiffnesses (P, E), of dampings (P, E), of masses and inertias (P, n)
        self.k_of, self.c_of, self.m_of = (constant(powers) for powers in parameter_powers(system))
        self.loading = Loading(system, constant)
        self.estimated_masses = int(self.m_of.any(dim=1).sum())
        self.estimates_mass = self.estimated_masses > 0
        index = {name: i for i, name in enumerate(system.elements)}
        self.estimated_elements = tuple(  # indices of elements, in the order of the parameters
            torch.as_tensor([index[p.element] for p in system.parameters if p.quantity == q], dtype=torch.long)
            for q in ("stiffness", "damping")
        )
        # Of the parameters before those of masses: their element, and the powers of its stiffness and damping
        of_elements = len(self.m_of) - self.estimated_masses
        both = torch.stack([self.k_of[:of_elements], self.c_of[:of_elements]])
        self.element_of = both.abs().sum(dim=0).argmax(dim=1) if of_elements else torch.zeros(0, dtype=torch.long)
        self.by_stiffness, self.by_damping = both.gather(2, self.element_of.expand(2, -1).unsqueeze(2)).squeeze(2)
        omega = math.sqrt(float(torch.linalg.eigvalsh(self._normalised_stiffness()).max().clamp_min(1e-12)))
        root = self.nominal_m.rsqrt()
        # Mass-normalised states with rates in units of the fastest mode: the norm of A h is then about omega h.
        self.scale = torch.cat([root, root * max(omega, 1e-6)])
        self.normalised_step = self.dt * self.scale / self.scale[:, None]

    def _assemble(self, constant: Callable[[FloatArray], Tensor]) -> None:
        """Everything that is linear in the element values, as matrices; columns are [q, q', values, rates]."""
        m, half = self.mechanics, self.W // 2
        E, n = m.H.shape
        deflection, rate = np.zeros((2, E, 2 * n + self.W))  # of the elements, per column
        deflection[:, :n], rate[:, n : 2 * n] = m.H, m.H
        at = 2 * n + self.supports.numpy() // 2
        deflection[:, at], rate[:, at + half] = m.G, m.G
        applied = np.zeros((n, 2 * n + self.W))
        applied[:, 2 * n + self.forces.numpy() // 2] = m.F
        by_value = np.concatenate([deflection, rate])  # per stiffness, then per damping, (2E, columns)
        self.loads = constant(np.einsum("en,ec->enc", -np.tile(m.H, (2, 1)), by_value).reshape(2 * E, -1))
        self.applied = constant(applied.reshape(-1))
        self.rates = constant(np.eye(n, 2 * n + self.W, n))
        kind = m.sensor_kind[:, None]
        self.acceleration = constant(np.where(kind == ACCELERATION, m.S, 0.0))
        sensing = np.zeros((len(kind), 2 * n + self.W))
        sensing[:, n : 2 * n] = np.where(kind == VELOCITY, m.S, 0.0)
        sensing[:, :n] = np.where(kind == DISPLACEMENT, m.S, 0.0)
        self.motion_sensing = constant(sensing + np.where(kind == DEFLECTION, m.L, 0.0) @ deflection)
        force = np.tile(np.where(kind == FORCE, m.L, 0.0), (1, 2))  # (S, 2E)
        self.force_sensing = (
            constant(np.einsum("se,ec->esc", force, by_value).reshape(2 * E, -1)) if force.any() else None
        )

    def _normalised_stiffness(self) -> Tensor:
        root = self.nominal_m.rsqrt()
        return (self.H * self.nominal_k[:, None]).T @ self.H * root[:, None] * root[None, :]

    def element_values(self, log_ratio: Tensor) -> ElementValues:
        """theta = nominal exp(log_ratio) put in place; log_ratio (B, P), or (B, P + X) with what describes the loads,
        see `model.simulate.loading`; those that are left out at the end are zero."""
        log_ratio, load = log_ratio[:, : len(self.k_of)], log_ratio[:, len(self.k_of) :]
        k = self.nominal_k * torch.exp(log_ratio @ self.k_of)
        c = self.nominal_c * torch.exp(log_ratio @ self.c_of)
        m = self.nominal_m.expand(len(log_ratio), -1)
        if self.estimates_mass:
            m = m * torch.exp(log_ratio @ self.m_of)
        if not load.shape[1]:
            return ElementValues(k, c, m)
        loading = self.loading
        k = k * torch.exp(load @ loading.stiffness[: load.shape[1]])
        return ElementValues(k, c, m * loading.factors(load), loading.coupling(load), loading.lengthened(load))

    def continuous(self, values: ElementValues) -> tuple[Tensor, Tensor, Tensor]:
        """A (B, N, N), input columns of the knots' values and rates, each (B, N, W/2)."""
        N, half = 2 * values.mass.shape[1], self.W // 2
        dynamics = self._dynamics(values)
        return dynamics[..., :N], dynamics[..., N : N + half], dynamics[..., N + half :]

    def _dynamics(self, values: ElementValues) -> Tensor:
        """[A, input columns of the knots' values, of their rates], (B, N, N + W)."""
        B, n = values.mass.shape
        forces = torch.cat([values.stiffness, values.damping], dim=1) @ self.loads + self.applied
        accelerations = values.accelerated(forces.reshape(B, n, -1))
        return torch.cat([self.rates.expand(B, -1, -1), accelerations], dim=1)

    def _outputs(self, values: ElementValues, dynamics: Tensor) -> tuple[Tensor, Tensor]:
        """C (B, S, N) and D (B, S, W) of the sensors."""
        n = values.mass.shape[1]
        accelerations = dynamics[:, n:] if values.reach is None else dynamics[:, n:] * values.reach.unsqueeze(2)
        rows = self.motion_sensing + self.acceleration @ accelerations
        if self.force_sensing is not None:
            force = torch.cat([values.stiffness, values.damping], dim=1) @ self.force_sensing
            rows = rows + force.reshape(rows.shape)
        value_then_rate = rows[..., 2 * n :].reshape(*rows.shape[:2], 2, self.W // 2)
        return rows[..., : 2 * n], value_then_rate.mT.flatten(2)

    def discretise(self, values: ElementValues) -> Discrete:
        """The exact step over one sample."""
        dynamics = self._dynamics(values)
        C, D = self._outputs(values, dynamics)
        B, N, _ = dynamics.shape
        half = self.W // 2
        phi = phi_functions(dynamics[..., :N] * self.normalised_step)  # (B, 5, N, N)
        responses = (phi.flatten(1, 2) @ (dynamics[..., N:] / self.scale[:, None])).reshape(B, 5, N, 2 * half)
        # Psi_j / j!, j = 0..3; the constant of a cubic has no rate
        psi = responses[:, 1:, :, :half] * self.dt + responses[:, :4, :, half:] * self.not_constant
        G = (self.hermite @ psi.flatten(2)).reshape(B, 2, 2, N, half) * self.scale[:, None]
        G0, G1 = G.permute(1, 0, 3, 4, 2).flatten(3)
        return Discrete(phi[:, 0] * (self.scale[:, None] / self.scale), G0, G1, C, D)

    def knots(self, windows: FloatArray) -> FloatArray:
        """Values and slopes of all drives, (B, T, W), from windows (B, T, C) in the system's channel order."""
        return knots(self.system, windows)

    def states(self, discrete: Discrete, w: Tensor, x0: Tensor) -> Tensor:
        """States (B, T, N) from knots (B, T, W) and the first state (B, N).

        Samples go in blocks of about sqrt(T), a step in all blocks at once: first from rest, which with the free motion
        over a block gives the blocks' first states one from the other, then from these.
        """
        (B, T, _), N, Ad = w.shape, x0.shape[1], discrete.Ad
        length = 2 ** round(math.log2(T) / 2)
        blocks = -(-T // length)
        push = w[:, :-1] @ discrete.G0.mT + w[:, 1:] @ discrete.G1.mT  # (B, T-1, N)
        push = torch.nn.functional.pad(push, (0, 0, 0, blocks * length - T + 1))
        steps = push.reshape(B, blocks, length, N).permute(2, 0, 3, 1).contiguous().unbind()  # each (B, N, blocks)
        ends = steps[0]
        for step in steps[1:]:
            ends = torch.baddbmm(step, Ad, ends)
        over_block = torch.linalg.matrix_power(Ad, length)
        first = [x0.unsqueeze(2)]
        for end in ends.unsqueeze(3).unbind(2)[:-1]:
            first.append(torch.baddbmm(end, over_block, first[-1]))
        path = [torch.cat(first, dim=2)]
        for step in steps[:-1]:
            path.append(torch.baddbmm(step, Ad, path[-1]))
        return torch.stack(path, dim=3).flatten(2)[:, :, :T].mT

    def free_states(self, discrete: Discrete, x0: Tensor, samples: int) -> Tensor:
        """Ad^k x0 for k < samples, shape (B, T, N), by doubling."""
        path, power = x0.unsqueeze(2), discrete.Ad
        while path.shape[2] < samples:
            path = torch.cat([path, power @ path[:, :, : samples - path.shape[2]]], dim=2)
            power = power @ power if path.shape[2] < samples else power
        return path.mT

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


def phi_functions(z: Tensor) -> Tensor:
    """phi_0 (the exponential) to phi_4 of a batch of matrices (B, N, N), shape (B, 5, N, N).

    Taylor polynomial with scaling and doubling: phi_l(2z) = 2^-l (phi_l(z) phi_0(z) + sum_{k=1..l} phi_k(z) / (l-k)!)
    (Hochbruck and Ostermann, Exponential integrators, Acta Numerica 2010).
    """
    norm = float(z.detach().abs().sum(dim=1).max()) if z.numel() else 0.0
    doublings = max(0, math.ceil(math.log2(max(norm, 1e-300) / _TAYLOR_NORM)))
    z = z / 2**doublings
    B, N, _ = z.shape
    eye = torch.eye(N, dtype=z.dtype, device=z.device).expand(B, N, N)
    taylor, mix, scale = (c.to(z) for c in (_TAYLOR, _MIX, _SCALE))
    z2 = z @ z
    powers = torch.stack([eye, z, z2, z2 @ z], dim=1).flatten(2)
    pieces = torch.matmul(taylor, powers).reshape(B, 4, N, N)  # of phi_4, to be joined by Horner's rule in z^4
    z4, phi_4 = z2 @ z2, pieces[:, 3]
    for piece in (2, 1, 0):
        phi_4 = torch.baddbmm(pieces[:, piece], z4, phi_4)
    orders = [phi_4]
    for order in (3, 2, 1, 0):
        orders.insert(0, torch.baddbmm(eye, z, orders[0], beta=1.0 / math.factorial(order)))
    phi = torch.stack(orders, dim=1)
    for _ in range(doublings):
        product = (phi.flatten(1, 2) @ phi[:, 0]).reshape(B, 5, N * N)
        phi = (torch.baddbmm(product, mix.expand(B, 5, 5), phi.flatten(2)) * scale).reshape(B, 5, N, N)
    return phi


def _knot_of(system: System, drive: int) -> int:
    """Index in the knot vector of the value of the drive that starts at position `drive` of u."""
    at = 0
    for i, source in enumerate(system.file.inputs.values()):
        if at == drive:
            return 2 * i
        at += 1 if source.kind == "force" else 2
    raise AssertionError(drive)
