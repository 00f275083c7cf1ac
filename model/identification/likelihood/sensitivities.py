"""Sensitivities of the whitened signals of windows: to springs and dampers, masses and loads, and to drives."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sprung.model.identification.likelihood.band import ComparedBand
from sprung.model.identification.likelihood.compression import Compression
from sprung.model.identification.likelihood.frequency import FrequencyModel
from sprung.model.identification.likelihood.gauss_newton import Linearisation, Transfer, WindowBatch
from sprung.model.mechanics import DEFLECTION
from sprung.model.simulate.linear import ElementValues
from sprung.model.simulate.loading import by_inertia


class WindowSensitivities:
    """Of one system over windows of a fixed length."""

    def __init__(self, frequency: FrequencyModel, compression: Compression, band: ComparedBand) -> None:
        self.simulator, self.frequency = frequency.simulator, frequency
        self.compression, self.band = compression, band

    def by_unknowns(
        self,
        count: int,
        values: ElementValues,
        transfer: Transfer,
        whiten: Tensor,
        states: Tensor,
        data: WindowBatch,
        moved: tuple[Tensor, Tensor],
    ) -> Tensor:
        """Whitened sensitivities of the spectra to `count` unknowns: springs and dampers, masses, loads."""
        s = self.simulator
        J, by_load = self.by_elements(values, whiten @ transfer.per_force, states, data, moved)
        masses, none = s.m_of[s.m_of.any(dim=1)], s.loading.pattern[:0]
        if len(masses):
            none = none.new_zeros(len(masses), *none.shape[1:])
            J = torch.cat([J, self.by_inertia(values, transfer, whiten, states, data, (masses, none), moved[0])], dim=3)
        loads = count - len(s.m_of)
        if loads > 0:
            terms = s.loading.exponents[:loads], s.loading.pattern[:loads]
            of_load = self.by_inertia(values, transfer, whiten, states, data, terms, moved[0], s.loading.reach[:loads])
            J = torch.cat([J, of_load if by_load is None else of_load + by_load[..., :loads]], dim=3)
        return J

    def by_elements(
        self,
        values: ElementValues,
        per_force: Tensor,
        states: Tensor,
        data: WindowBatch,
        moved: tuple[Tensor, Tensor],
    ) -> tuple[Tensor, Tensor | None]:
        """Whitened sensitivities to stiffnesses then dampings along the smoothed motion, (B, F, R, P'), and to loads
        through the stiffnesses that follow them, (B, F, R, X); None: none does.

        moved: what the residual says that the noise of the drives moves, see `WindowModel.moved_by`.
        """
        s = self.simulator
        n = s.H.shape[1]
        d = states[:, :, :n] @ s.H.T + data.w[:, :, s.supports] @ s.G.T
        v = states[:, :, n:] @ s.H.T + data.w[:, :, s.supports + 1] @ s.G.T
        spectra = self.band.spectra(torch.cat([d, v], dim=2))
        E = s.H.shape[0]
        kind = per_force.dtype
        of_noise = moved[0] @ s.H.T.to(kind) + moved[1]
        deflection = (spectra[:, :, :E] + of_noise) * values.stiffness[:, None]
        rate = (spectra[:, :, E:] + self.frequency.jw[:, None] * of_noise) * values.damping[:, None]
        at, powers = s.element_of, s.loading.stiffness
        return (
            per_force[..., at] * (s.by_stiffness * deflection[..., at] + s.by_damping * rate[..., at]).unsqueeze(2),
            (per_force * deflection.unsqueeze(2)) @ powers.T.to(kind) if bool(powers.any()) else None,
        )

    def by_inertia(
        self,
        values: ElementValues,
        transfer: Transfer,
        whiten: Tensor,
        states: Tensor,
        data: WindowBatch,
        terms: tuple[Tensor, Tensor],
        moved: Tensor,
        reach: Tensor | None = None,
    ) -> Tensor:
        """Whitened sensitivities to masses and loads, exponents (X, n) and couplings (X, n, n), (B, F, R, X).

        moved: what the noise of the drives moves of the coordinates, (B, F, n).  reach: (X, n), see `Loading.reach`.
        """
        s = self.simulator
        A, b_value, b_rate = s.continuous(values)
        n = s.H.shape[1]
        acceleration = (
            states @ A[:, n:].mT + data.w[:, :, 0::2] @ b_value[:, n:].mT + data.w[:, :, 1::2] @ b_rate[:, n:].mT
        )
        smooth = self.band.spectra(acceleration) + self.frequency.jw[:, None] ** 2 * moved
        force = by_inertia(smooth, values.mass, values.coupling, *terms)
        found = -(whiten @ transfer.per_load) @ force
        if reach is not None and bool(reach.any()):  # what accelerometers show of the angles themselves
            at = torch.nonzero(reach)  # rows: a term, and its coordinate
            Q = self.compression.rows(data.present, found.dtype) @ (s.S * self.frequency.accelerometers).to(found.dtype)
            found[..., at[:, 0]] += (whiten @ Q[:, at[:, 1]]) * smooth[:, :, None, at[:, 1]]
        return found

    def by_drive(self, at: Linearisation, motions: Sequence[tuple[Tensor, Tensor]], data: WindowBatch) -> list[Tensor]:
        """Contribution of each drive to the whitened signals, without free responses, each (B, F, R, W/2).

        motions: values and rates of the drives, each (B, T, W/2).  Over a finite window the spectrum of the rate is not
        j w times that of the value.  In single precision.
        """
        s, kind = self.simulator, torch.complex64
        values = s.element_values(at.x)
        whiten = at.whiten.to(kind)
        per_force = whiten @ at.transfer.per_force.to(kind)
        k, c = ((v[:, None, :, None] * s.G).to(kind) for v in (values.stiffness, values.damping))  # (B, 1, E, supports)
        found = []
        for value, rate in motions:
            U, V = (self.band.spectra(part).unsqueeze(2).to(kind) for part in (value, rate))  # (B, F, 1, W/2)
            shown = per_force.new_zeros(*per_force.shape[:3], s.W // 2)
            if len(s.supports):
                columns = s.supports // 2
                shown[..., columns] = per_force @ (k * U[..., columns] + c * V[..., columns])
                if self.frequency.element_sensors:
                    direct = torch.where((s.kind == DEFLECTION)[:, None], s.L, torch.zeros_like(s.L)) @ s.G
                    seen = whiten @ (self.compression.rows(data.present, kind) @ direct.to(kind))
                    shown[..., columns] += seen * U[..., columns]
            if len(s.forces):
                columns = s.forces // 2
                shown[..., columns] = whiten @ (at.transfer.per_load.to(kind) @ s.F.to(kind)) * U[..., columns]
            found.append(shown)
        return found
