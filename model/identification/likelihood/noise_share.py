"""Share of a window's apparent information that is due to noise."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sprung.model.identification.likelihood.gauss_newton import Linearisation, Transfer, WindowBatch
from sprung.model.identification.likelihood.linearise import WindowModel
from sprung.model.signals import FloatArray
from sprung.model.simulate.linear import ElementValues
from sprung.model.simulate.loading import by_inertia


def noise_share(model: WindowModel, at: Linearisation, data: WindowBatch) -> Tensor:
    """Share of the power of every sensitivity that the noise of drives and sensors alone would give, (B, P).

    Near one, the window holds no excitation of the parameter, or of the load: what looks like information is noise.
    """
    s = model.simulator
    values = s.element_values(at.x)
    transfer = model.transfer(values, data)
    whiten = model.noise.whitening(model.noise.carried(transfer.drive))
    motion, direct = _motions(model, values, transfer, data)
    deflection = s.H.to(motion.dtype) @ motion + direct  # (B, F, E, Y)
    power = deflection.abs().square().sum(dim=3) * model.samples
    white = (whiten @ transfer.per_force).abs().square().sum(dim=2) * power  # (B, F, E)
    by_k = (white * values.stiffness.square().unsqueeze(1)).sum(dim=1)
    by_c = (white * (model.frequency.omega.square()[:, None] * values.damping.square().unsqueeze(1))).sum(dim=1)
    shown = at.sensitivities.square().sum(dim=2)
    noise = by_k[:, s.element_of] * s.by_stiffness.square() + by_c[:, s.element_of] * s.by_damping.square()
    if noise.shape[1] < shown.shape[1]:
        of_inertia = _of_inertia(model, values, whiten @ transfer.per_load, motion)
        noise = torch.cat([noise, of_inertia[:, : shown.shape[1] - noise.shape[1]]], dim=1)
    share: Tensor = noise / shown.clamp_min(1e-300)
    return share


def mean_share(share: Tensor) -> FloatArray:
    """Of the sensitivities to parameters, (B, P), as one number of each window, (B,)."""
    return np.asarray(share.clamp(max=1.0).mean(dim=1).numpy(), dtype=np.float64)


def _motions(model: WindowModel, values: ElementValues, transfer: Transfer, data: WindowBatch) -> tuple[Tensor, Tensor]:
    """Coordinates (B, F, n, Y) that noise of every drive and of every sensor moves, and deflections (B, F, E, Y) that
    its supports make beside.

    Sensor noise reaches the fitted motion, at the least, as the motion that it is indistinguishable from.
    """
    of_drives, direct = moved_by_drives(model, values, transfer.compliance)
    kind = of_drives.dtype
    of_sensors = torch.linalg.pinv(model.compression.rows(data.present, kind) @ model.frequency.sensing(values))
    noise = model.noise.instruments[:, None]
    beside = (direct * noise).expand(*of_drives.shape[:2], *direct.shape)
    none = beside.new_zeros(*beside.shape[:3], of_sensors.shape[3])
    return torch.cat([of_drives * noise, of_sensors], dim=3), torch.cat([beside, none], dim=3)


def moved_by_drives(model: WindowModel, values: ElementValues, compliance: Tensor) -> tuple[Tensor, Tensor]:
    """Response to unit drives: coordinates (B, F, n, W/2), and deflections (E, W/2) by the supports."""
    s, kind = model.simulator, compliance.dtype
    dynamic = model.frequency.dynamic(values)
    load = torch.zeros(*dynamic.shape[:2], s.H.shape[1], s.W // 2, dtype=kind)
    direct = torch.zeros(s.H.shape[0], s.W // 2, dtype=kind)
    if len(s.supports):
        load[..., s.supports // 2] = -(s.H.T.to(kind) @ (dynamic.unsqueeze(3) * s.G.to(kind)))
        direct[:, s.supports // 2] = s.G.to(kind)
    if len(s.forces):
        load[..., s.forces // 2] = s.F.to(kind)
    return compliance @ load, direct


def _of_inertia(model: WindowModel, values: ElementValues, per_load: Tensor, motion: Tensor) -> Tensor:
    """Power that noise gives the sensitivities to masses, then to what describes loads, (B, X)."""
    s = model.simulator
    masses = s.m_of[s.m_of.any(dim=1)]
    exponents = torch.cat([masses, s.loading.exponents])
    pattern = s.loading.pattern
    pattern = torch.cat([pattern.new_zeros(len(masses), *pattern.shape[1:]), pattern])
    acceleration = model.frequency.jw[:, None, None] ** 2 * motion
    found = motion.real.new_zeros(len(motion), len(exponents))
    for column in acceleration.unbind(dim=3):
        force = by_inertia(column, values.mass, values.coupling, exponents, pattern)
        found += (per_load @ force).abs().square().sum(dim=(1, 2)) * model.samples
    return found
