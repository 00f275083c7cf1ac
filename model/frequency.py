"""The linear system over frequency: dynamic stiffness, responses, sensitivities, noise of measured inputs.

    Z(w) = -w^2 M + j w C + K        Z q = -H^T (k + j w c) G s + F p

A change of k_e acts like the force -H_e^T d_e along its own element, a change of c_e like -H_e^T d_e', so the
inverse of Z (n x n, n = 9 for the vehicle) gives every sensitivity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from model.fusion import fused_noise
from model.signals import FloatArray
from model.simulate.linear import ElementValues, LinearSimulator, knot_columns


@dataclass(frozen=True, slots=True)
class Response:
    """Transfer functions of a batch of systems at F frequencies; W counts knots (value and slope of each drive)."""

    motion: Tensor  # degrees of freedom per knot, shape (B, F, n, W)
    output: Tensor  # sensors per knot, shape (B, F, S, W)
    compliance: Tensor  # Z^-1, m/N, shape (B, F, n, n)
    sensing: Tensor  # sensors per degree of freedom, shape (B, F, S, n)


class FrequencyModel:
    """Transfer functions of a system at fixed angular frequencies (F,), batched over element values."""

    def __init__(self, simulator: LinearSimulator, omega: FloatArray) -> None:
        self.simulator = simulator
        self.omega = torch.as_tensor(omega, dtype=simulator.nominal_k.dtype)
        self.jw = torch.complex(torch.zeros_like(self.omega), self.omega)
        order = {0: 2, 1: 1, 2: 0}
        factors = [self.jw ** order.get(int(kind), 0) for kind in simulator.kind]
        self.motion_sensing = torch.stack(factors, dim=1)[:, :, None] * simulator.S.to(self.jw.dtype)  # (F, S, n)
        self.element_sensors = bool((simulator.kind >= 3).any())

    def stiffness(self, values: ElementValues) -> Tensor:
        """Z, shape (B, F, n, n)."""
        s = self.simulator
        B, n = values.mass.shape
        K = (values.stiffness @ s.outer).reshape(B, 1, n, n)
        C = (values.damping @ s.outer).reshape(B, 1, n, n)
        w = self.omega[None, :, None, None]
        return torch.complex(K - w**2 * torch.diag_embed(values.mass)[:, None], w * C)

    def response(self, values: ElementValues) -> Response:
        """All transfer functions."""
        s = self.simulator
        compliance = torch.linalg.inv(self.stiffness(values))
        # Generalised force per knot: the value acts through k (or F), the slope through c.
        force = values.mass.new_zeros(len(values.mass), s.H.shape[1], s.W)
        if len(s.supports):
            force[:, :, s.supports] = -(s.H.T * values.stiffness[:, None, :]) @ s.G
            force[:, :, s.supports + 1] = -(s.H.T * values.damping[:, None, :]) @ s.G
        if len(s.forces):
            force[:, :, s.forces] = s.F
        motion = compliance @ force[:, None].to(compliance.dtype)
        sensing = self.sensing(values)
        output = sensing @ motion
        if self.element_sensors and len(s.supports):
            of_d, of_v = self.element_gain(values)
            output[:, :, :, s.supports] += (of_d @ s.G)[:, None].to(compliance.dtype)
            output[:, :, :, s.supports + 1] += (of_v @ s.G)[:, None].to(compliance.dtype)
        return Response(motion, output, compliance, sensing)

    def sensing(self, values: ElementValues) -> Tensor:
        """Sensors per degree of freedom, (B, F, S, n)."""
        motion = self.motion_sensing[None]
        if not self.element_sensors:
            return motion.expand(len(values.mass), -1, -1, -1)
        of_d, of_v = self.element_gain(values)
        H = self.simulator.H
        return motion + torch.complex(
            (of_d @ H)[:, None].expand_as(motion.real), self.omega[:, None, None] * (of_v @ H)[:, None]
        )

    def element_gain(self, values: ElementValues) -> tuple[Tensor, Tensor]:
        """Element sensors per deflection and per rate, each (B, S, E)."""
        s = self.simulator
        kind = s.kind[:, None]
        none = torch.zeros_like(s.L)
        deflection, force = torch.where(kind == 3, s.L, none), torch.where(kind == 4, s.L, none)
        return deflection + force * values.stiffness[:, None, :], force * values.damping[:, None, :]

    def sensitivities(
        self, values: ElementValues, response: Response, deflection: Tensor, rate: Tensor, acceleration: Tensor
    ) -> Tensor:
        """d outputs / d log-ratio, shape (B, F, S, P), along a motion.

        deflection, rate: spectra of the elements' deflections and rates (B, F, E); acceleration: of the degrees of
        freedom (B, F, n).  Each parameter acts like the force that its own term exerts along that motion.
        """
        s = self.simulator
        kind = response.compliance.dtype
        per_load = -response.sensing @ response.compliance  # (B, F, S, n)
        per_force = per_load @ s.H.T.to(kind)  # (B, F, S, E)
        if self.element_sensors:
            per_force = per_force + torch.where(s.kind[:, None] == 4, s.L, torch.zeros_like(s.L))
        by_k = per_force * (values.stiffness.unsqueeze(1) * deflection).unsqueeze(2)
        by_c = per_force * (values.damping.unsqueeze(1) * rate).unsqueeze(2)
        total = by_k @ s.k_of.T.to(kind) + by_c @ s.c_of.T.to(kind)
        if s.estimates_mass:
            by_m = per_load * (values.mass.unsqueeze(1) * acceleration).unsqueeze(2)
            total = total + by_m @ s.m_of.T.to(kind)
        return total

    def input_noise(self) -> FloatArray:
        """Noise of each drive per sample as its value's standard deviation over frequency, shape (F, W/2).

        Slopes follow their values (j w), measured or derived: see `model.fusion`.
        """
        system, omega = self.simulator.system, self.omega.numpy()
        noise = np.zeros((len(omega), self.simulator.W // 2))
        for i, (value, slope) in enumerate(zip(*knot_columns(system), strict=True)):
            noise[:, i] = system.inputs[value].noise
            pair = (system.inputs[value].noise, 0.0 if slope is None else system.inputs[slope].noise)
            if min(pair) > 0:
                noise[:, i] = fused_noise(omega, 1 / system.sample_rate, pair)
        return noise


def bin_frequencies(samples: int, sample_rate: float) -> FloatArray:
    """Angular frequencies of the real DFT of `samples`, rad/s, shape (samples // 2 + 1,)."""
    return 2 * np.pi * np.fft.rfftfreq(samples, 1 / sample_rate)
