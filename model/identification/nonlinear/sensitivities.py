"""Sensitivities of what sensors show of windows with laws, through the tangent-linear model along their motion.

Sensitivities to the initial state, parameters, laws' values, loads and memories, and to each drive.  The memories of
the laws are states like the others (forward sensitivity analysis).  B windows, T samples, R compressed signals, N
states, U unknowns, L laws.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sprung.model.identification.likelihood.gauss_newton import WindowBatch
from sprung.model.identification.nonlinear.forces import LawAlongMotion
from sprung.model.identification.nonlinear.iterate import Iterate, LinearStep, NormalEquations, SimulatedMotion
from sprung.model.identification.nonlinear.tangent import TangentModel
from sprung.model.identification.nonlinear.window import LawWindows
from sprung.model.signals import FloatArray
from sprung.model.simulate.loading import by_inertia


class LawSensitivities:
    """Sensitivities of one non-linear window model."""

    def __init__(self, windows: LawWindows) -> None:
        self.windows = windows

    def outputs(
        self,
        point: Iterate,
        steps: LinearStep,
        motion: SimulatedMotion,
        data: WindowBatch,
        smooth: FloatArray,
        along: list[LawAlongMotion],
        tangent: TangentModel,
    ) -> Tensor:
        """Sensitivities of the compressed signals to the initial state and the unknowns, (B, T, R, N + U)."""
        w = self.windows
        B, T, N = motion.states.shape
        Q = w.model.compression.matrix(data.present)
        columns, memories = w.unknowns, len(w.memories)
        load, slope, which = self._element_loads(steps, motion, data, smooth)  # (B, T, P'), elements of them
        linear = slice(len(which))
        excitation = load.new_zeros(B, T - 1, N, columns)
        excitation[..., linear] = self._by_element_loads(steps, load, slope, which)
        by_mass = self._mass_loads(point, steps, motion, data)  # (B, n, T, M)
        masses = w.linear[len(which) :]
        springs = self._spring_loads(steps, motion, data, smooth) if w.loads else None  # (B, E, T, X)
        if springs is not None:
            weight = -w.model.simulator.H.T @ springs.flatten(2)
            by_mass[..., -w.loads :] += weight.view(B, -1, T, w.loads)
        if by_mass.shape[3]:
            excitation[..., masses] += self._by_body_loads(steps, by_mass)
        first, memory = load.new_zeros(B, N, N + columns), load.new_zeros(B, memories, N + columns)
        first[:, :, :N] = torch.eye(N, dtype=torch.float64)
        memory[:, :, N + w.reported :] = torch.eye(memories, dtype=torch.float64)
        given = self._force_sources(along, point, steps, N)
        excitation += self._between_samples(given[..., N:], steps, tangent)
        path = tangent.run(excitation, given, first, memory=memory)  # (B, T, N + L, X)
        found = self._compressed_outputs(path, steps, Q)
        changed = found[..., N:]
        direct = Q @ (steps.force_rows[:, which] - steps.direct @ w.model.simulator.H[which].T)  # (B, R, P')
        changed[..., linear] += direct.unsqueeze(1) * load.unsqueeze(2)
        if by_mass.shape[3]:
            changed[..., masses] += (Q @ steps.direct @ by_mass.flatten(2)).view(B, len(Q), T, -1).transpose(1, 2)
        if springs is not None:
            loads = slice(w.first_load, w.reported)
            changed[..., loads] += (Q @ steps.force_rows @ springs.flatten(2)).view(B, len(Q), T, -1).transpose(1, 2)
        return found

    def by_drive(
        self,
        columns: NormalEquations,
        steps: LinearStep,
        tangent: TangentModel,
        motions: Sequence[tuple[Tensor, Tensor]],
        data: WindowBatch,
    ) -> list[Tensor]:
        """Contribution of each drive to the whitened signals, through the laws, too, each (B, F, R, W/2).

        motions: values and rates of the drives, each (B, T, W/2).
        """
        w = self.windows
        s, Q = w.model.simulator, w.model.compression.matrix(data.present)
        value, rate = (torch.cat(part, dim=2) for part in zip(*motions, strict=True))  # (B, T, X)
        B, T, X = value.shape
        half, copies = s.W // 2, len(motions)
        of = torch.arange(half).repeat(copies)  # the drive of every column
        site = torch.zeros(len(w.acting), half, dtype=torch.float64)
        site[:, s.supports // 2] = w.weights @ s.G
        site = site[:, of]  # (L, X)
        force, memory_source = tangent.along(value.unsqueeze(2) * site, rate.unsqueeze(2) * site)
        G0, G1 = steps.discrete.G0, steps.discrete.G1
        excitation = torch.zeros(B, T - 1, G0.shape[1], X, dtype=torch.float64)
        for gain, at in ((G0, slice(0, T - 1)), (G1, slice(1, T))):
            excitation += gain[:, :, 2 * of].unsqueeze(1) * value[:, at, None]
            excitation += gain[:, :, 2 * of + 1].unsqueeze(1) * rate[:, at, None]
        excitation += self._between_samples(force, steps, tangent)
        path = tangent.run(excitation, force, torch.zeros(B, G0.shape[1], X, dtype=torch.float64), memory_source)
        shown = self._compressed_outputs(path, steps, Q)
        D = Q @ steps.discrete.D
        for gain, given in ((D[:, :, 2 * of], value), (D[:, :, 2 * of + 1], rate)):
            shown += gain.unsqueeze(1) * given.unsqueeze(2)
        return list((columns.whiten @ self.spectra(shown)).to(torch.complex64).split(half, dim=3))

    def _by_element_loads(self, steps: LinearStep, load: Tensor, slope: Tensor, which: Tensor) -> Tensor:
        """Changes of the states over each step (B, T - 1, N, P') by loads of the elements `which`, and their slopes."""
        w = self.windows
        P0, S0, P1, S1 = (-(block @ w.model.simulator.H[which].T).unsqueeze(1) for block in steps.force_response)
        excitation = P0 * load[:, :-1, None]
        excitation += S0 * slope[:, :-1, None]
        excitation += P1 * load[:, 1:, None]
        excitation += S1 * slope[:, 1:, None]
        return excitation

    def _by_body_loads(self, steps: LinearStep, load: Tensor) -> Tensor:
        """The same (B, T - 1, N, M) by loads of the coordinates (B, n, T, M)."""
        w = self.windows
        B, _, T, _ = load.shape
        slope = w.slope @ load
        series = (load[:, :, :-1], slope[:, :, :-1], load[:, :, 1:], slope[:, :, 1:])
        first, *others = (gain @ values.flatten(2) for gain, values in zip(steps.force_response, series, strict=True))
        for other in others:
            first += other
        return first.view(B, -1, T - 1, load.shape[3]).transpose(1, 2)

    def _between_samples(self, force: Tensor, steps: LinearStep, tangent: TangentModel) -> Tensor:
        """What known variations of the laws' forces (B, T, L, X) change of the states (B, T-1, N, X) over a sample
        because between samples they are splines, as in `simulate`, and not straight lines, as in the tangent model."""
        w = self.windows
        B, T, L, X = force.shape
        sharp = (w.spline_compensation @ force.reshape(B, T, L * X)).view(B, T, L, X)
        slope = (w.slope @ sharp.view(B, T, L * X)).view(B, T, L, X)
        gains = [-block @ w.pull.T for block in steps.force_response]
        gain = torch.cat([*gains, -tangent.g0, -tangent.g1], dim=2).unsqueeze(1)  # (B, 1, N, 6L)
        ends = (sharp[:, :-1], slope[:, :-1], sharp[:, 1:], slope[:, 1:], force[:, :-1], force[:, 1:])
        found: Tensor = gain @ torch.cat(ends, dim=2)
        return found

    def _compressed_outputs(self, path: Tensor, steps: LinearStep, Q: Tensor) -> Tensor:
        """Variations of the compressed signals (B, T, R, X) for those of states and laws' forces (B, T, N + L, X)."""
        w = self.windows
        at_once = (steps.force_rows @ w.weights.T) - steps.direct @ w.pull.T  # of laws' forces, (B, S', L)
        return torch.cat([Q @ steps.discrete.C, Q @ at_once], dim=2).unsqueeze(1) @ path

    def spectra(self, shown: Tensor) -> Tensor:
        """Spectra within the band of signals (B, T, R, X), (B, F, R, X)."""
        w = self.windows
        found: Tensor = torch.fft.rfft(shown, dim=1)[:, 1 : w.model.band.bins + 1]
        return found

    def _element_loads(
        self, steps: LinearStep, motion: SimulatedMotion, data: WindowBatch, smooth: FloatArray
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Forces of elements by the logarithms of their parameters: values, slopes (B, T, P'), elements."""
        w = self.windows
        s = w.model.simulator
        d, v = (torch.as_tensor(x) for x in w.element_motion(motion.states, data, smooth))
        at = s.element_of
        K = (steps.values.stiffness[:, at] * s.by_stiffness).unsqueeze(1)
        C = (steps.values.damping[:, at] * s.by_damping).unsqueeze(1)
        load = d[:, :, at] * K + v[:, :, at] * C
        slope = v[:, :, at] * K + (w.slope @ v)[:, :, at] * C
        return load, slope, at

    def _spring_loads(
        self, steps: LinearStep, motion: SimulatedMotion, data: WindowBatch, smooth: FloatArray
    ) -> Tensor | None:
        """Forces of air springs by the loads that their stiffness follows, (B, E, T, X); None: none does."""
        w = self.windows
        powers = w.model.simulator.loading.stiffness
        if not bool(powers.any()):
            return None
        deflection, _ = w.element_motion(motion.states, data, smooth)
        force = torch.as_tensor(deflection) * steps.values.stiffness[:, None]
        return force.mT.unsqueeze(3) * powers.T[None, :, None]

    def _mass_loads(self, point: Iterate, steps: LinearStep, motion: SimulatedMotion, data: WindowBatch) -> Tensor:
        """Generalised forces by the logarithms of masses, then by the loads, (B, n, T, M)."""
        w = self.windows
        s = w.model.simulator
        masses = s.m_of[s.m_of.any(dim=1)]
        exponents, pattern = masses, s.loading.pattern.new_zeros(len(masses), *s.loading.pattern.shape[1:])
        if w.loads:
            exponents = torch.cat([masses, s.loading.exponents])
            pattern = torch.cat([pattern, s.loading.pattern])
        A, b_value, b_rate = s.continuous(steps.values)
        n = A.shape[1] // 2
        moved = motion.states @ A[:, n:].mT
        moved = moved + data.w[:, :, 0::2] @ b_value[:, n:].mT + data.w[:, :, 1::2] @ b_rate[:, n:].mT
        moved = moved - (point.force @ w.pull) @ steps.compliance.mT
        values = steps.values
        return -by_inertia(moved, values.mass, values.coupling, exponents, pattern).permute(0, 2, 1, 3)

    def _force_sources(self, along: list[LawAlongMotion], point: Iterate, steps: LinearStep, before: int) -> Tensor:
        """Laws' forces by the unknowns along the given motion, memories apart, (B, T, L, before + U)."""
        w = self.windows
        names = [(p.element, p.quantity) for p in w.system.parameters]
        B, T = point.force.shape[:2]
        found = torch.zeros((B, T, len(along), before + w.unknowns), dtype=torch.float64)
        at = before + len(names)
        for i, (acting, path) in enumerate(zip(w.acting, along, strict=True)):
            start = w.first_memory(point, i)
            changes = path.value_sensitivities(w.values(point, i), acting.free, w.element(steps, i), start)
            for change in changes[:-2]:
                found[:, :, i, at] = torch.as_tensor(change)
                at += 1
            element = w.system.elements[acting.element]
            for quantity, change in zip(("stiffness", "damping"), changes[-2:], strict=True):
                if (element, quantity) in names:
                    found[:, :, i, before + names.index((element, quantity))] = torch.as_tensor(change)
        return found
