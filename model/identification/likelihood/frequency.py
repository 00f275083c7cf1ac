"""The linear system over frequency: dynamic stiffness, sensing, responses, noise of the measured drives.

Z(w) = -w^2 M + j w C + K        Z q = -H^T (k + j w c) G s + F p
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sprung.model.mechanics import ACCELERATION, DEFLECTION, FORCE
from sprung.model.signals import FloatArray
from sprung.model.simulate.drives import drives_of
from sprung.model.simulate.linear import ElementValues, LinearSimulator


class FrequencyModel:
    """Transfer functions of a system at fixed angular frequencies (F,), batched over element values."""

    def __init__(self, simulator: LinearSimulator, omega: FloatArray) -> None:
        self.simulator = simulator
        self.omega = torch.as_tensor(omega, dtype=simulator.nominal_k.dtype)
        self.jw = torch.complex(torch.zeros_like(self.omega), self.omega)
        order = {0: 2, 1: 1, 2: 0}  # derivatives that a sensor takes of the motion
        factors = [self.jw ** order.get(int(kind), 0) for kind in simulator.kind]
        self.motion_sensing = torch.stack(factors, dim=1)[:, :, None] * simulator.S.to(self.jw.dtype)  # (F, S, n)
        self.accelerometers = torch.as_tensor(simulator.kind == ACCELERATION)[:, None]
        self.element_sensors = bool((simulator.kind >= DEFLECTION).any())

    def stiffness(self, values: ElementValues) -> Tensor:
        """Z, shape (B, F, n, n)."""
        s = self.simulator
        B, n = values.mass.shape
        K = (values.stiffness @ s.outer).reshape(B, 1, n, n)
        C = (values.damping @ s.outer).reshape(B, 1, n, n)
        w = self.omega[None, :, None, None]
        return torch.complex(K - w**2 * values.inertia[:, None], w * C)

    def dynamic(self, values: ElementValues) -> Tensor:
        """Dynamic stiffness k + j w c of the elements, (B, F, E)."""
        rate = self.omega[:, None] * values.damping[:, None]
        return torch.complex(values.stiffness[:, None].expand_as(rate), rate)

    def sensing(self, values: ElementValues) -> Tensor:
        """Sensors per degree of freedom, (B, F, S, n)."""
        motion = self.motion_sensing.expand(len(values.mass), -1, -1, -1)
        if values.reach is not None:
            motion = motion * torch.where(self.accelerometers, values.reach[:, None, None], 1.0)
        return motion + self.element_response(values, self.simulator.H) if self.element_sensors else motion

    def element_response(self, values: ElementValues, deflection: Tensor) -> Tensor:
        """Element sensors per motion that deflects the elements by `deflection` (E, X); shape (B, F, S, X)."""
        s = self.simulator
        kind = s.kind[:, None]
        none = torch.zeros_like(s.L)
        of_deflection = torch.where(kind == DEFLECTION, s.L, none).to(self.jw.dtype)
        of_force = torch.where(kind == FORCE, s.L, none).to(self.jw.dtype)
        gain = of_deflection + of_force * self.dynamic(values).unsqueeze(2)
        return gain @ deflection.to(gain.dtype)

    def response(self, values: ElementValues) -> Tensor:
        """Sensors per unit of every drive that follows its own slope, (B, F, S, W/2)."""
        s = self.simulator
        kind = self.jw.dtype
        load = torch.zeros(len(values.mass), len(self.omega), s.H.shape[1], s.W // 2, dtype=kind)
        if len(s.supports):
            per_element = self.dynamic(values).unsqueeze(3) * s.G.to(kind)
            load[..., s.supports // 2] = -(s.H.T.to(kind) @ per_element)
        if len(s.forces):
            load[..., s.forces // 2] = s.F.to(kind)
        output = self.sensing(values) @ torch.linalg.solve(self.stiffness(values), load)
        if self.element_sensors and len(s.supports):
            output[..., s.supports // 2] += self.element_response(values, s.G)
        found: Tensor = output
        return found

    def drive_noise(self) -> FloatArray:
        """Noise of each drive per sample as its value's standard deviation over frequency, shape (F, W/2).

        Slopes follow their values (j w), measured or derived: see `model.simulate.fusion`.  That of an acceleration
        grows with 1 / w^2 towards low frequencies, as its integral's does.
        """
        drives = drives_of(self.simulator.system)
        noise = [drive.noise_at(self.omega.numpy(), self.simulator.dt) for drive in drives]
        return np.array(noise).reshape(-1, len(self.omega)).T.copy()


def bin_frequencies(samples: int, sample_rate: float) -> FloatArray:
    """Angular frequencies of the real DFT of `samples`, rad/s, shape (samples // 2 + 1,)."""
    return np.asarray(2 * np.pi * np.fft.rfftfreq(samples, 1 / sample_rate), dtype=np.float64)
