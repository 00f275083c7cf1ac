"""Windows of a system with laws, linearised along their own non-linear motion.

The laws' forces f act on the linear rest of the system as generalised forces q = -H^T f.  Between samples they are
interpolated by cubics like every drive, so that a step is exact for given forces,

    x_{k+1} = Ad x_k + G0 w_k + G1 w_{k+1} + P0 q_k + S0 q'_k + P1 q_{k+1} + S1 q'_{k+1}.

Forces and motion are made consistent by Newton's method on the forces at the samples.  Sensitivities follow from the
tangent-linear model along that motion, in which the memories of the laws are states like the others (forward
sensitivity analysis).  Whitened over bins of the DFT they replace the linear model's sensitivities in the normal
equations; the memories at the first sample are unknowns beside the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from sprung.model.identification.likelihood.gauss_newton import WindowBatch
from sprung.model.identification.likelihood.linearise import PRIOR_STD, WindowModel, as_rows, as_spectra, normalised
from sprung.model.identification.nonlinear.forces import (
    ActiveLaw,
    LawAlongMotion,
    add_motion_between_samples,
    spline_compensation,
    spline_slopes,
)
from sprung.model.identification.nonlinear.iterate import Iterate, LinearStep, NormalEquations, SimulatedMotion
from sprung.model.identification.nonlinear.tangent import TangentModel
from sprung.model.laws import SpringDamper
from sprung.model.mechanics import ACCELERATION, FORCE
from sprung.model.signals import FloatArray
from sprung.model.simulate.linear import phi_functions
from sprung.model.simulate.loading import by_inertia
from sprung.model.system import System

_NEWTON_STEPS = 4  # at most, for the forces
_NEWTON_TOLERANCE = 0.05  # rms change of the outputs by a Newton step, in the sensors' noise
_DIVERGED = 1e4  # times the measured amplitude: Newton's method has diverged
_RIDGE = 1e-11  # relative, on the normalised free responses
_DRIVES_AS_MEASURED: FloatArray = np.zeros(
    (2, 1, 1, 1)
)  # the motion of the elements is not corrected for noise of the drives
_MEMORY_STD = 3.0  # prior of a memory at the first sample, in its rms over the window


class LawWindows:
    """Non-linear window model: the linear system `bare` with the laws `acting`; loads: estimate the loads, too."""

    def __init__(self, bare: System, acting: Sequence[ActiveLaw], model: WindowModel, loads: bool = False) -> None:
        self.system, self.acting, self.model = bare, acting, model
        m = bare.mechanics
        self.rows = np.array([a.weights for a in acting]) @ m.H  # deflections of the sites by the coordinates, (L, n)
        self.pull = torch.as_tensor(self.rows)
        self.weights = torch.as_tensor(np.array([a.weights for a in acting]))  # (L, E)
        self.free = [(law, i) for law, a in enumerate(acting) for i in a.free]
        self.memories = [i for i, a in enumerate(acting) if a.law.memory]
        self.quick = [i for i, a in enumerate(acting) if not a.law.memory]
        noise = bare.sensor_noise
        self.noise = torch.as_tensor(noise)
        moving = m.sensor_kind == ACCELERATION
        # of a rate over one sample, by the least noise of an accelerometer; where there is none by that of a sensor
        self.rate_noise = float(noise[moving].min() if moving.any() else noise.min()) / bare.sample_rate
        self.spline_compensation = torch.tensor(spline_compensation(model.samples))
        self.slope = torch.tensor(spline_slopes(model.samples)) / model.simulator.dt
        self.loads = len(model.simulator.loading) if loads else 0
        P = len(bare.parameters)
        self.first_load = P + len(self.free)
        self.reported = self.first_load + self.loads  # log-ratios and loads; memories follow
        self.unknowns = self.reported + len(self.memories)
        self.linear = torch.cat([torch.arange(P), torch.arange(self.first_load, self.reported)])  # of the linear system

    def values(self, point: Iterate, law: int) -> FloatArray:
        """Values of one law, (B, values)."""
        found = np.tile(np.array(self.acting[law].placed.values), (len(point.unknowns), 1))
        for at, (of, i) in enumerate(self.free):
            if of == law:
                found[:, i] *= np.exp(point.unknowns[:, len(self.system.parameters) + at].numpy())
        return found

    def first_memory(self, point: Iterate, law: int) -> FloatArray:
        """Memory of one law at the first sample, (B,)."""
        if law not in self.memories:
            return np.zeros(len(point.unknowns))
        at = self.reported + self.memories.index(law)
        found: FloatArray = point.unknowns[:, at].numpy()
        return found

    def steps(self, point: Iterate, data: WindowBatch) -> LinearStep:
        """The linear step at an iterate."""
        s, x = self.model.simulator, point.unknowns[:, self.linear]
        values = s.element_values(x)
        discrete = s.discretise(values)
        at = torch.as_tensor(np.flatnonzero(data.present))
        A, *_ = s.continuous(values)
        N, n = A.shape[1], A.shape[1] // 2
        phi = phi_functions(A * s.normalised_step)  # (B, 5, N, N)
        inverse = values.accelerated(torch.eye(n, dtype=torch.float64).expand(len(x), n, n))
        load = torch.cat([torch.zeros_like(inverse), inverse], dim=1) / s.scale[:, None]
        psi = (phi.flatten(1, 2) @ load).reshape(len(x), 5, N, n)[:, 1:] * s.dt
        G = (s.hermite @ psi.flatten(2)).reshape(len(x), 2, 2, N, n) * s.scale[:, None]
        force_response = (G[:, 0, 0], G[:, 0, 1], G[:, 1, 0], G[:, 1, 1])
        kind = torch.as_tensor(self.system.mechanics.sensor_kind)
        direct = torch.where((kind == ACCELERATION)[:, None], s.S, 0.0)[at] @ inverse
        force_rows = torch.where((kind == FORCE)[:, None], s.L, 0.0)[at]
        present = replace(discrete, C=discrete.C[:, at], D=discrete.D[:, at])
        return LinearStep(values, present, force_response, inverse, direct, force_rows)

    def simulate(self, steps: LinearStep, force: Tensor, x0: Tensor, data: WindowBatch) -> tuple[Tensor, Tensor]:
        """States (B, T, N) and outputs (B, T, S') under given forces of the laws (B, T, L)."""
        s, q = self.model.simulator, -force @ self.pull
        sharp = self.spline_compensation @ q
        slope = self.slope @ sharp
        P0, S0, P1, S1 = steps.force_response
        discrete = replace(
            steps.discrete,
            G0=torch.cat([steps.discrete.G0, P0, S0], dim=2),
            G1=torch.cat([steps.discrete.G1, P1, S1], dim=2),
        )
        states = s.states(discrete, torch.cat([data.w, sharp, slope], dim=2), x0)
        outputs = states @ steps.discrete.C.mT + data.w @ steps.discrete.D.mT + q @ steps.direct.mT
        return states, outputs + force @ (self.weights @ steps.force_rows.T)

    def site_motion(self, states: Tensor, data: WindowBatch, smooth: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Deflections and rates of the sites, each (B, T, L).

        smooth: correction of the elements' motion for noise of the drives, (2, B, T, E).
        """
        d, v = self.element_motion(states, data, smooth)
        weights = self.weights.numpy().T
        return d @ weights, v @ weights

    def element_motion(self, states: Tensor, data: WindowBatch, smooth: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The same of all elements, (B, T, E)."""
        s = self.model.simulator
        n = s.H.shape[1]
        d = (states[:, :, :n] @ s.H.T + data.w[:, :, s.supports] @ s.G.T).numpy()
        v = (states[:, :, n:] @ s.H.T + data.w[:, :, s.supports + 1] @ s.G.T).numpy()
        return d + smooth[0], v + smooth[1]

    def element(self, steps: LinearStep, law: int) -> SpringDamper:
        """Stiffness and damping that a law sees, each (B,)."""
        at = self.acting[law].element
        return SpringDamper(steps.values.stiffness[:, at].numpy(), steps.values.damping[:, at].numpy())

    def settle(
        self, point: Iterate, steps: LinearStep, data: WindowBatch, tangent: TangentModel | None = None
    ) -> tuple[Iterate, SimulatedMotion, TangentModel]:
        """Make forces and motion consistent; tangent: of a nearby motion, by default of the initial one.

        Drives are taken as measured: an estimate of their noise from residuals that still contain missing law forces
        would turn these forces into motion.
        """
        force, moving = point.force.clone(), torch.arange(len(point.force))
        lost = torch.zeros(len(force), dtype=torch.bool)
        for _ in range(_NEWTON_STEPS):
            if not len(moving):
                break
            everything = len(moving) == len(force)
            some = replace(point if everything else point.take(moving), force=force[moving])
            their_steps, theirs = (steps, data) if everything else (steps.take(moving), data.take(moving))
            states, outputs = self.simulate(their_steps, some.force, some.x0, theirs)
            if bool((diverging := self._has_diverged(outputs, theirs)).any()):
                force[moving[diverging]] = point.force[moving[diverging]]
                lost[moving[diverging]] = True
                moving = moving[~diverging]
                continue
            along = self.along(states, theirs, _DRIVES_AS_MEASURED, some, their_steps)
            if tangent is None:
                tangent = self.tangent(along, some, their_steps).spread(moving, len(force))
            their_tangent = tangent if everything else tangent.take(moving)
            change = their_tangent.closed_loop(self.forces_along(along, some, their_steps) - some.force)
            force[moving] += change
            moving = moving[self._immediate_effect(change, their_steps, theirs) >= _NEWTON_TOLERANCE]
        states, outputs = self.simulate(steps, force, point.x0, data)
        for usable in (point.force, torch.zeros_like(force)):
            if not bool((diverging := self._has_diverged(outputs, data)).any()):
                break
            force[diverging], lost[diverging] = usable[diverging], True
            states, outputs = self.simulate(steps, force, point.x0, data)
        point = replace(point, force=force)
        if tangent is None:
            tangent = self.tangent(self.along(states, data, _DRIVES_AS_MEASURED, point, steps), point, steps)
        return point, SimulatedMotion(states, outputs, lost), tangent

    def _has_diverged(self, outputs: Tensor, data: WindowBatch) -> Tensor:
        """Whether the simulated outputs (B, T, S') of windows have left all bounds, (B,)."""
        usual = (data.measured.abs() + self.noise[torch.as_tensor(data.present)]).amax(dim=(1, 2))
        return ~(outputs.abs().amax(dim=(1, 2)) <= _DIVERGED * usual)

    def _immediate_effect(self, change: Tensor, steps: LinearStep, data: WindowBatch) -> Tensor:
        """rms effect of a change of forces on the sensors, without the response of the motion, in their noise, (B,)."""
        load = change @ self.pull
        shown = change @ (self.weights @ steps.force_rows.T) - load @ steps.direct.mT
        carried = (load @ steps.compliance.mT * self.model.simulator.dt) / self.rate_noise
        at_once = torch.cat([shown / self.noise[torch.as_tensor(data.present)], carried], dim=2)
        return at_once.square().mean(dim=1).amax(dim=1).sqrt()

    def along(
        self, states: Tensor, data: WindowBatch, smooth: FloatArray, point: Iterate, steps: LinearStep
    ) -> list[LawAlongMotion]:
        """The laws along given states, with the motion that their own forces cause between samples."""
        d, v = self.site_motion(states, data, smooth)
        rate = self.system.sample_rate
        along = [LawAlongMotion(a.law, d[:, :, i], v[:, :, i], rate) for i, a in enumerate(self.acting)]
        if self.quick:
            mobility = (self.pull[self.quick] @ steps.compliance @ self.pull[self.quick].T).numpy()
            shaken = [along[i] for i in self.quick], [self._at(i, point, steps) for i in self.quick]
            add_motion_between_samples(*shaken, mobility)
        return along

    def forces_along(self, along: list[LawAlongMotion], point: Iterate, steps: LinearStep) -> Tensor:
        """The laws' forces, (B, T, L)."""
        shape = point.force.shape[:2]
        found = [path.force(*self._at(i, point, steps)) for i, path in enumerate(along)]
        return torch.as_tensor(np.stack([np.broadcast_to(f, shape) for f in found], axis=2))

    def slopes_along(self, along: list[LawAlongMotion], point: Iterate, steps: LinearStep) -> tuple[Tensor, Tensor]:
        """Slopes of the laws' forces by deflection and by rate, each (B, T, L)."""
        found = [path.slopes(*self._at(i, point, steps)) for i, path in enumerate(along)]
        by_d, by_v = ([getattr(s, of) for s in found] for of in ("by_deflection", "by_rate"))
        return torch.as_tensor(np.stack(by_d, axis=2)), torch.as_tensor(np.stack(by_v, axis=2))

    def _at(self, law: int, point: Iterate, steps: LinearStep) -> tuple[list[FloatArray], SpringDamper, FloatArray]:
        """Values of a law and of its element, that broadcast with (B, fine), and its memory at the first sample."""
        k, c = self.element(steps, law)
        values = list(self.values(point, law).T[:, :, None])
        return values, SpringDamper(k[:, None], c[:, None]), self.first_memory(point, law)

    def tangent(self, along: list[LawAlongMotion], point: Iterate, steps: LinearStep) -> TangentModel:
        """The tangent-linear model along a motion."""
        slopes = [path.slopes(*self._at(i, point, steps)) for i, path in enumerate(along)]
        return TangentModel(slopes, self.memories, self.pull, steps, self.model.simulator.dt)

    def residual(self, outputs: Tensor, data: WindowBatch, whiten: Tensor) -> Tensor:
        """Whitened residual of simulated outputs (B, T, S'), (B, K, 1)."""
        compressed = (data.measured - outputs) @ self.model.compression.matrix(data.present).mT
        return as_rows(whiten @ self.model.band.spectra(compressed).unsqueeze(3)).mT

    def normal_equations(
        self, point: Iterate, steps: LinearStep, motion: SimulatedMotion, data: WindowBatch, smooth: FloatArray
    ) -> tuple[NormalEquations, TangentModel]:
        """Normal equations at a consistent iterate, and its tangent-linear model."""
        along = self.along(motion.states, data, smooth, point, steps)
        tangent = self.tangent(along, point, steps)
        transfer = self.model.transfer(steps.values, data)
        carried = self.model.noise.carried(transfer.drive)
        whiten = self.model.noise.whitening(carried)
        shown = self.output_sensitivities(point, steps, motion, data, smooth, along, tangent)
        white = as_rows(whiten @ self._spectra(shown))
        sound = white.isfinite().all(dim=2).all(dim=1)  # a diverged motion carries no information
        white = torch.where(sound[:, None, None], white, 0.0)
        N = point.x0.shape[1]
        free, J = white[:, :N], white[:, N:]
        free, free_scale = normalised(free)
        products = free @ free.mT
        factor = torch.linalg.cholesky(products + _RIDGE * torch.eye(N, dtype=torch.float64))
        across_products = free @ J.mT
        across = torch.cholesky_solve(across_products, factor)
        information = J @ J.mT - across_products.mT @ across
        precision = torch.full((len(J), self.unknowns), 1 / PRIOR_STD**2, dtype=torch.float64)
        precision[:, self.linear] = self.model.precision[: len(self.linear)]
        if self.memories:
            precision[:, self.reported :] = (
                _MEMORY_STD * torch.where(sound[:, None], tangent.memory_size, 1.0)
            ) ** -2.0
        covariance = torch.linalg.inv(information + torch.diag_embed(precision))
        inverses = (information, covariance, precision)
        return NormalEquations(
            whiten, carried, transfer.compliance, free, free_scale, J, factor, across, *inverses
        ), tangent

    def output_sensitivities(
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
        B, T, N = motion.states.shape
        Q = self.model.compression.matrix(data.present)
        columns, memories = self.unknowns, len(self.memories)
        load, slope, which = self._element_loads(steps, motion, data, smooth)  # (B, T, P'), elements of them
        linear = slice(len(which))
        excitation = load.new_zeros(B, T - 1, N, columns)
        excitation[..., linear] = self._by_element_loads(steps, load, slope, which)
        by_mass = self._mass_loads(point, steps, motion, data)  # (B, n, T, M)
        masses = self.linear[len(which) :]
        springs = self._spring_loads(steps, motion, data, smooth) if self.loads else None  # (B, E, T, X)
        if springs is not None:
            weight = -self.model.simulator.H.T @ springs.flatten(2)
            by_mass[..., -self.loads :] += weight.view(B, -1, T, self.loads)
        if by_mass.shape[3]:
            excitation[..., masses] += self._by_body_loads(steps, by_mass)
        first, memory = load.new_zeros(B, N, N + columns), load.new_zeros(B, memories, N + columns)
        first[:, :, :N] = torch.eye(N, dtype=torch.float64)
        memory[:, :, N + self.reported :] = torch.eye(memories, dtype=torch.float64)
        given = self._force_sources(along, point, steps, N)
        excitation += self._between_samples(given[..., N:], steps, tangent)
        path = tangent.run(excitation, given, first, memory=memory)  # (B, T, N + L, X)
        found = self._compressed_outputs(path, steps, Q)
        changed = found[..., N:]
        direct = Q @ (steps.force_rows[:, which] - steps.direct @ self.model.simulator.H[which].T)  # (B, R, P')
        changed[..., linear] += direct.unsqueeze(1) * load.unsqueeze(2)
        if by_mass.shape[3]:
            changed[..., masses] += (Q @ steps.direct @ by_mass.flatten(2)).view(B, len(Q), T, -1).transpose(1, 2)
        if springs is not None:
            loads = slice(self.first_load, self.reported)
            changed[..., loads] += (Q @ steps.force_rows @ springs.flatten(2)).view(B, len(Q), T, -1).transpose(1, 2)
        return found

    def _by_element_loads(self, steps: LinearStep, load: Tensor, slope: Tensor, which: Tensor) -> Tensor:
        """Changes of the states over each step (B, T - 1, N, P') by loads of the elements `which`, and their slopes."""
        P0, S0, P1, S1 = (-(block @ self.model.simulator.H[which].T).unsqueeze(1) for block in steps.force_response)
        excitation = P0 * load[:, :-1, None]
        excitation += S0 * slope[:, :-1, None]
        excitation += P1 * load[:, 1:, None]
        excitation += S1 * slope[:, 1:, None]
        return excitation

    def _by_body_loads(self, steps: LinearStep, load: Tensor) -> Tensor:
        """The same (B, T - 1, N, M) by loads of the coordinates (B, n, T, M)."""
        B, _, T, _ = load.shape
        slope = self.slope @ load
        series = (load[:, :, :-1], slope[:, :, :-1], load[:, :, 1:], slope[:, :, 1:])
        first, *others = (gain @ values.flatten(2) for gain, values in zip(steps.force_response, series, strict=True))
        for other in others:
            first += other
        return first.view(B, -1, T - 1, load.shape[3]).transpose(1, 2)

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
        s, Q = self.model.simulator, self.model.compression.matrix(data.present)
        value, rate = (torch.cat(part, dim=2) for part in zip(*motions, strict=True))  # (B, T, X)
        B, T, X = value.shape
        half, copies = s.W // 2, len(motions)
        of = torch.arange(half).repeat(copies)  # the drive of every column
        site = torch.zeros(len(self.acting), half, dtype=torch.float64)
        site[:, s.supports // 2] = self.weights @ s.G
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
        return list((columns.whiten @ self._spectra(shown)).to(torch.complex64).split(half, dim=3))

    def _between_samples(self, force: Tensor, steps: LinearStep, tangent: TangentModel) -> Tensor:
        """What known variations of the laws' forces (B, T, L, X) change of the states (B, T-1, N, X) over a sample
        because between samples they are splines, as in `simulate`, and not straight lines, as in the tangent model."""
        B, T, L, X = force.shape
        sharp = (self.spline_compensation @ force.reshape(B, T, L * X)).view(B, T, L, X)
        slope = (self.slope @ sharp.view(B, T, L * X)).view(B, T, L, X)
        gains = [-block @ self.pull.T for block in steps.force_response]
        gain = torch.cat([*gains, -tangent.g0, -tangent.g1], dim=2).unsqueeze(1)  # (B, 1, N, 6L)
        ends = (sharp[:, :-1], slope[:, :-1], sharp[:, 1:], slope[:, 1:], force[:, :-1], force[:, 1:])
        found: Tensor = gain @ torch.cat(ends, dim=2)
        return found

    def _compressed_outputs(self, path: Tensor, steps: LinearStep, Q: Tensor) -> Tensor:
        """Variations of the compressed signals (B, T, R, X) for those of states and laws' forces (B, T, N + L, X)."""
        at_once = (steps.force_rows @ self.weights.T) - steps.direct @ self.pull.T  # of laws' forces, (B, S', L)
        return torch.cat([Q @ steps.discrete.C, Q @ at_once], dim=2).unsqueeze(1) @ path

    def _spectra(self, shown: Tensor) -> Tensor:
        """Spectra within the band of signals (B, T, R, X), (B, F, R, X)."""
        found: Tensor = torch.fft.rfft(shown, dim=1)[:, 1 : self.model.band.bins + 1]
        return found

    def _element_loads(
        self, steps: LinearStep, motion: SimulatedMotion, data: WindowBatch, smooth: FloatArray
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Forces of elements by the logarithms of their parameters: values, slopes (B, T, P'), elements."""
        s = self.model.simulator
        d, v = (torch.as_tensor(x) for x in self.element_motion(motion.states, data, smooth))
        at = s.element_of
        K = (steps.values.stiffness[:, at] * s.by_stiffness).unsqueeze(1)
        C = (steps.values.damping[:, at] * s.by_damping).unsqueeze(1)
        load = d[:, :, at] * K + v[:, :, at] * C
        slope = v[:, :, at] * K + (self.slope @ v)[:, :, at] * C
        return load, slope, at

    def _spring_loads(
        self, steps: LinearStep, motion: SimulatedMotion, data: WindowBatch, smooth: FloatArray
    ) -> Tensor | None:
        """Forces of air springs by the loads that their stiffness follows, (B, E, T, X); None: none does."""
        powers = self.model.simulator.loading.stiffness
        if not bool(powers.any()):
            return None
        deflection, _ = self.element_motion(motion.states, data, smooth)
        force = torch.as_tensor(deflection) * steps.values.stiffness[:, None]
        return force.mT.unsqueeze(3) * powers.T[None, :, None]

    def _mass_loads(self, point: Iterate, steps: LinearStep, motion: SimulatedMotion, data: WindowBatch) -> Tensor:
        """Generalised forces by the logarithms of masses, then by the loads, (B, n, T, M)."""
        s = self.model.simulator
        masses = s.m_of[s.m_of.any(dim=1)]
        exponents, pattern = masses, s.loading.pattern.new_zeros(len(masses), *s.loading.pattern.shape[1:])
        if self.loads:
            exponents = torch.cat([masses, s.loading.exponents])
            pattern = torch.cat([pattern, s.loading.pattern])
        A, b_value, b_rate = s.continuous(steps.values)
        n = A.shape[1] // 2
        moved = motion.states @ A[:, n:].mT
        moved = moved + data.w[:, :, 0::2] @ b_value[:, n:].mT + data.w[:, :, 1::2] @ b_rate[:, n:].mT
        moved = moved - (point.force @ self.pull) @ steps.compliance.mT
        values = steps.values
        return -by_inertia(moved, values.mass, values.coupling, exponents, pattern).permute(0, 2, 1, 3)

    def _force_sources(self, along: list[LawAlongMotion], point: Iterate, steps: LinearStep, before: int) -> Tensor:
        """Laws' forces by the unknowns along the given motion, memories apart, (B, T, L, before + U)."""
        names = [(p.element, p.quantity) for p in self.system.parameters]
        B, T = point.force.shape[:2]
        found = torch.zeros((B, T, len(along), before + self.unknowns), dtype=torch.float64)
        at = before + len(names)
        for i, (acting, path) in enumerate(zip(self.acting, along, strict=True)):
            start = self.first_memory(point, i)
            changes = path.value_sensitivities(self.values(point, i), acting.free, self.element(steps, i), start)
            for change in changes[:-2]:
                found[:, :, i, at] = torch.as_tensor(change)
                at += 1
            element = self.system.elements[acting.element]
            for quantity, change in zip(("stiffness", "damping"), changes[-2:], strict=True):
                if (element, quantity) in names:
                    found[:, :, i, before + names.index((element, quantity))] = torch.as_tensor(change)
        return found

    def smoothed(
        self, columns: NormalEquations, residual: Tensor, step: Tensor, dx0: Tensor, steps: LinearStep
    ) -> FloatArray:
        """Noise of the drives as estimated from the residual after a step, as motion of the elements: (2, B, T, E)."""
        model, s = self.model, self.model.simulator
        left = residual - columns.free.mT @ (columns.free_scale * dx0).unsqueeze(2)  # (B, K, 1)
        left = left - columns.sensitivities.mT @ step.unsqueeze(2)
        noise = model.noise.estimated(columns.whiten, columns.carried, as_spectra(left, columns.whiten))
        motion, support = model.moved_by(steps.values, columns.compliance, noise)
        moved = motion @ s.H.T.to(motion.dtype) + support  # (B, F, E)
        found = torch.stack([model.band.signals(moved), model.band.signals(model.frequency.jw[:, None] * moved)])
        return np.asarray(found.numpy())
