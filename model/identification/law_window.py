"""Windows of a system with laws, linearised along their own non-linear motion.

The laws' forces f load the linear system of the other parts as generalised forces q = -H^T f.  Between samples they are
cubics like every drive, so that a step is exact for given forces,

    x_{k+1} = Ad x_k + G0 w_k + G1 w_{k+1} + P0 q_k + S0 q'_k + P1 q_{k+1} + S1 q'_{k+1}.

Forces and motion are brought together by Newton's method on the forces at the samples.  Sensitivities follow from the
same step along that motion: a change of the motion changes the forces by the laws' slopes, these the motion, and the
memories of the laws are states like the others (forward sensitivity analysis).  Whitened over bins of the DFT they take
the place of the linear model's columns in Gauss-Newton; the memories at the first sample are unknowns beside the
parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from sprung.model.identification.gauss_newton import WindowBatch
from sprung.model.identification.law_flow import Flow
from sprung.model.identification.law_forces import Acting, Along, shake, sharpened, slopes_of
from sprung.model.identification.law_point import Columns, Moved, Steps, WindowPoint
from sprung.model.identification.linearise import PRIOR_STD, WindowModel, as_rows, as_spectra, normalised
from sprung.model.laws import SpringDamper
from sprung.model.mechanics import ACCELERATION, FORCE
from sprung.model.signals import FloatArray
from sprung.model.simulate.linear import phi_functions
from sprung.model.simulate.loading import by_inertia
from sprung.model.system import System

_SWEEPS = 4  # of Newton's method on the forces, at most
_SETTLED = 0.05  # rms change of the outputs by a sweep, in the sensors' noise
_WILD = 1e4  # times what was measured: Newton's method has lost the motion
_RIDGE = 1e-11  # relative, on the normalised free responses
_AS_MEASURED: FloatArray = np.zeros((2, 1, 1, 1))  # no noise of the drives is taken from the elements' motion
_MEMORY_STD = 3.0  # of a memory at the first sample, in its rms over the window


class LawWindows:
    """Windows of one length of a system, `bare` of its laws, with the laws `acting`.

    loads: its loads are unknown, too.
    """

    def __init__(self, bare: System, acting: Sequence[Acting], model: WindowModel, loads: bool = False) -> None:
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
        self.sharpened = torch.tensor(sharpened(model.samples))
        self.slope = torch.tensor(slopes_of(model.samples)) / model.simulator.dt
        self.loads = len(model.simulator.loading) if loads else 0
        P = len(bare.parameters)
        self.first_load = P + len(self.free)
        self.told = self.first_load + self.loads  # log-ratios and loads; memories follow
        self.unknowns = self.told + len(self.memories)
        self.linear = torch.cat([torch.arange(P), torch.arange(self.first_load, self.told)])  # of the linear system

    def values(self, point: WindowPoint, law: int) -> FloatArray:
        """Values of one law, (B, values)."""
        found = np.tile(np.array(self.acting[law].placed.values), (len(point.unknowns), 1))
        for at, (of, i) in enumerate(self.free):
            if of == law:
                found[:, i] *= np.exp(point.unknowns[:, len(self.system.parameters) + at].numpy())
        return found

    def first_memory(self, point: WindowPoint, law: int) -> FloatArray:
        """Memory of one law at the first sample, (B,)."""
        if law not in self.memories:
            return np.zeros(len(point.unknowns))
        at = self.told + self.memories.index(law)
        found: FloatArray = point.unknowns[:, at].numpy()
        return found

    def steps(self, point: WindowPoint, data: WindowBatch) -> Steps:
        """The linear step at a point."""
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
        push = (G[:, 0, 0], G[:, 0, 1], G[:, 1, 0], G[:, 1, 1])
        kind = torch.as_tensor(self.system.mechanics.sensor_kind)
        direct = torch.where((kind == ACCELERATION)[:, None], s.S, 0.0)[at] @ inverse
        shown = torch.where((kind == FORCE)[:, None], s.L, 0.0)[at]
        present = replace(discrete, C=discrete.C[:, at], D=discrete.D[:, at])
        return Steps(values, present, push, inverse, direct, shown)

    def simulate(self, steps: Steps, force: Tensor, x0: Tensor, data: WindowBatch) -> tuple[Tensor, Tensor]:
        """States (B, T, N) and outputs (B, T, S') under given forces of the laws (B, T, L)."""
        s, q = self.model.simulator, -force @ self.pull
        sharp = self.sharpened @ q
        slope = self.slope @ sharp
        P0, S0, P1, S1 = steps.push
        discrete = replace(
            steps.discrete,
            G0=torch.cat([steps.discrete.G0, P0, S0], dim=2),
            G1=torch.cat([steps.discrete.G1, P1, S1], dim=2),
        )
        states = s.states(discrete, torch.cat([data.w, sharp, slope], dim=2), x0)
        outputs = states @ steps.discrete.C.mT + data.w @ steps.discrete.D.mT + q @ steps.direct.mT
        return states, outputs + force @ (self.weights @ steps.shown.T)

    def site_motion(self, states: Tensor, data: WindowBatch, smooth: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Deflections and rates of the sites, each (B, T, L).

        smooth: what the noise of the drives adds to those of the elements, (2, B, T, E).
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

    def _element(self, steps: Steps, law: int) -> SpringDamper:
        """Stiffness and damping that a law sees, each (B,)."""
        at = self.acting[law].element
        return SpringDamper(steps.values.stiffness[:, at].numpy(), steps.values.damping[:, at].numpy())

    def settle(
        self, point: WindowPoint, steps: Steps, data: WindowBatch, flow: Flow | None = None
    ) -> tuple[WindowPoint, Moved, Flow]:
        """Bring forces and motion together; flow: of a motion nearby, by default of the one that they begin with.

        Drives are taken as measured: what a residual tells of their noise when laws are left out is wrong by as much as
        these make it larger, and would come back as motion.
        """
        force, moving = point.force.clone(), torch.arange(len(point.force))
        lost = torch.zeros(len(force), dtype=torch.bool)
        for _ in range(_SWEEPS):
            if not len(moving):
                break
            everything = len(moving) == len(force)
            some = replace(point if everything else point.take(moving), force=force[moving])
            their_steps, theirs = (steps, data) if everything else (steps.take(moving), data.take(moving))
            states, outputs = self.simulate(their_steps, some.force, some.x0, theirs)
            if bool((wild := self._wild(outputs, theirs)).any()):
                force[moving[wild]] = point.force[moving[wild]]
                lost[moving[wild]] = True
                moving = moving[~wild]
                continue
            along = self.along(states, theirs, _AS_MEASURED, some, their_steps)
            if flow is None:
                flow = self.flow(along, some, their_steps).spread(moving, len(force))
            near = flow if everything else flow.take(moving)
            change = near.answer(self.forces_along(along, some, their_steps) - some.force)
            force[moving] += change
            moving = moving[self._shown_at_once(change, their_steps, theirs) >= _SETTLED]
        states, outputs = self.simulate(steps, force, point.x0, data)
        for usable in (point.force, torch.zeros_like(force)):
            if not bool((wild := self._wild(outputs, data)).any()):
                break
            force[wild], lost[wild] = usable[wild], True
            states, outputs = self.simulate(steps, force, point.x0, data)
        point = replace(point, force=force)
        if flow is None:
            flow = self.flow(self.along(states, data, _AS_MEASURED, point, steps), point, steps)
        return point, Moved(states, outputs, lost), flow

    def _wild(self, outputs: Tensor, data: WindowBatch) -> Tensor:
        """Windows whose simulated outputs (B, T, S') have left all bounds, (B,)."""
        usual = (data.measured.abs() + self.noise[torch.as_tensor(data.present)]).amax(dim=(1, 2))
        return ~(outputs.abs().amax(dim=(1, 2)) <= _WILD * usual)

    def _shown_at_once(self, change: Tensor, steps: Steps, data: WindowBatch) -> Tensor:
        """rms of what the sensors show of a change of forces, the motion's answer apart, in their noise, (B,)."""
        load = change @ self.pull
        shown = change @ (self.weights @ steps.shown.T) - load @ steps.direct.mT
        carried = (load @ steps.compliance.mT * self.model.simulator.dt) / self.rate_noise
        at_once = torch.cat([shown / self.noise[torch.as_tensor(data.present)], carried], dim=2)
        return at_once.square().mean(dim=1).amax(dim=1).sqrt()

    def along(
        self, states: Tensor, data: WindowBatch, smooth: FloatArray, point: WindowPoint, steps: Steps
    ) -> list[Along]:
        """The laws along given states, and what their own forces make of the motion between samples."""
        d, v = self.site_motion(states, data, smooth)
        rate = self.system.sample_rate
        along = [Along(a.law, d[:, :, i], v[:, :, i], rate) for i, a in enumerate(self.acting)]
        if self.quick:
            mobility = (self.pull[self.quick] @ steps.compliance @ self.pull[self.quick].T).numpy()
            shaken = [along[i] for i in self.quick], [self._at(i, point, steps) for i in self.quick]
            shake(*shaken, mobility)
        return along

    def forces_along(self, along: list[Along], point: WindowPoint, steps: Steps) -> Tensor:
        """The laws' forces, (B, T, L)."""
        shape = point.force.shape[:2]
        found = [path.force(*self._at(i, point, steps)) for i, path in enumerate(along)]
        return torch.as_tensor(np.stack([np.broadcast_to(f, shape) for f in found], axis=2))

    def slopes_along(self, along: list[Along], point: WindowPoint, steps: Steps) -> tuple[Tensor, Tensor]:
        """Slopes of the laws' forces by deflection and by rate, each (B, T, L)."""
        found = [path.slopes(*self._at(i, point, steps)) for i, path in enumerate(along)]
        by_d, by_v = ([getattr(s, of) for s in found] for of in ("by_deflection", "by_rate"))
        return torch.as_tensor(np.stack(by_d, axis=2)), torch.as_tensor(np.stack(by_v, axis=2))

    def _at(self, law: int, point: WindowPoint, steps: Steps) -> tuple[list[FloatArray], SpringDamper, FloatArray]:
        """Values of a law and of its element, that broadcast with (B, fine), and its memory at the first sample."""
        k, c = self._element(steps, law)
        values = list(self.values(point, law).T[:, :, None])
        return values, SpringDamper(k[:, None], c[:, None]), self.first_memory(point, law)

    def flow(self, along: list[Along], point: WindowPoint, steps: Steps) -> Flow:
        """What a motion does with changes."""
        slopes = [path.slopes(*self._at(i, point, steps)) for i, path in enumerate(along)]
        return Flow(slopes, self.memories, self.pull, steps, self.model.simulator.dt)

    def residual(self, outputs: Tensor, data: WindowBatch, whiten: Tensor) -> Tensor:
        """Whitened residual of simulated outputs (B, T, S'), (B, K, 1)."""
        compressed = (data.measured - outputs) @ self.model.compression.matrix(data.present).mT
        return as_rows(whiten @ self.model.spectra(compressed).unsqueeze(3)).mT

    def columns(
        self, point: WindowPoint, steps: Steps, motion: Moved, data: WindowBatch, smooth: FloatArray
    ) -> tuple[Columns, Flow]:
        """Everything that Gauss-Newton needs at a settled point, and what its motion does with changes."""
        along = self.along(motion.states, data, smooth, point, steps)
        flow = self.flow(along, point, steps)
        transfer = self.model.transfer(steps.values, data)
        carried = transfer.drive * self.model.drive_noise[:, None]
        whiten = self.model.whitening(carried)
        shown = self.shown(point, steps, motion, data, smooth, along, flow)
        white = as_rows(whiten @ self._by_bin(shown))
        sound = white.isfinite().all(dim=2).all(dim=1)  # a motion that has run away, and its law's memory, tell nothing
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
            precision[:, self.told :] = (_MEMORY_STD * torch.where(sound[:, None], flow.memory_size, 1.0)) ** -2.0
        covariance = torch.linalg.inv(information + torch.diag_embed(precision))
        told = (information, covariance, precision)
        return Columns(whiten, carried, transfer.compliance, free, free_scale, J, factor, across, *told), flow

    def shown(
        self,
        point: WindowPoint,
        steps: Steps,
        motion: Moved,
        data: WindowBatch,
        smooth: FloatArray,
        along: list[Along],
        flow: Flow,
    ) -> Tensor:
        """What the compressed signals show of the first state and of the unknowns, (B, T, R, N + U)."""
        B, T, N = motion.states.shape
        Q = self.model.compression.matrix(data.present)
        columns, memories = self.unknowns, len(self.memories)
        load, slope, which = self._element_loads(steps, motion, data, smooth)  # (B, T, P'), elements of them
        P0, S0, P1, S1 = (-(push @ self.model.simulator.H[which].T).unsqueeze(1) for push in steps.push)
        linear = slice(len(which))
        push = load.new_zeros(B, T - 1, N, columns)
        push[..., linear] = P0 * load[:, :-1, None]
        push[..., linear] += S0 * slope[:, :-1, None]
        push[..., linear] += P1 * load[:, 1:, None]
        push[..., linear] += S1 * slope[:, 1:, None]
        by_mass = self._mass_loads(point, steps, motion, data)  # (B, n, T, M)
        masses = self.linear[len(which) :]
        springs = self._spring_loads(steps, motion, data, smooth) if self.loads else None  # (B, E, T, X)
        if springs is not None:
            weight = -self.model.simulator.H.T @ springs.flatten(2)
            by_mass[..., -self.loads :] += weight.view(B, -1, T, self.loads)
        if by_mass.shape[3]:
            by_slope = self.slope @ by_mass
            series = (by_mass[:, :, :-1], by_slope[:, :, :-1], by_mass[:, :, 1:], by_slope[:, :, 1:])
            for gain, values in zip(steps.push, series, strict=True):
                push[..., masses] += (gain @ values.flatten(2)).view(B, N, T - 1, -1).transpose(1, 2)
        first, memory = load.new_zeros(B, N, N + columns), load.new_zeros(B, memories, N + columns)
        first[:, :, :N] = torch.eye(N, dtype=torch.float64)
        memory[:, :, N + self.told :] = torch.eye(memories, dtype=torch.float64)
        path = flow.run(push, self._force_sources(along, point, steps, N), first, memory=memory)  # (B, T, N + L, X)
        found = self._shown_by(path, steps, Q)
        changed = found[..., N:]
        direct = Q @ (steps.shown[:, which] - steps.direct @ self.model.simulator.H[which].T)  # (B, R, P')
        changed[..., linear] += direct.unsqueeze(1) * load.unsqueeze(2)
        if by_mass.shape[3]:
            changed[..., masses] += (Q @ steps.direct @ by_mass.flatten(2)).view(B, len(Q), T, -1).transpose(1, 2)
        if springs is not None:
            loads = slice(self.first_load, self.told)
            changed[..., loads] += (Q @ steps.shown @ springs.flatten(2)).view(B, len(Q), T, -1).transpose(1, 2)
        return found

    def by_drive(
        self, columns: Columns, steps: Steps, flow: Flow, motions: Sequence[tuple[Tensor, Tensor]], data: WindowBatch
    ) -> list[Tensor]:
        """What each drive alone makes the whitened signals show through the laws, too, each (B, F, R, W/2).

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
        force, remembered = flow.along(value.unsqueeze(2) * site, rate.unsqueeze(2) * site)
        G0, G1 = steps.discrete.G0, steps.discrete.G1
        push = torch.zeros(B, T - 1, G0.shape[1], X, dtype=torch.float64)
        for gain, at in ((G0, slice(0, T - 1)), (G1, slice(1, T))):
            push += gain[:, :, 2 * of].unsqueeze(1) * value[:, at, None]
            push += gain[:, :, 2 * of + 1].unsqueeze(1) * rate[:, at, None]
        path = flow.run(push, force, torch.zeros(B, G0.shape[1], X, dtype=torch.float64), remembered)
        shown = self._shown_by(path, steps, Q)
        D = Q @ steps.discrete.D
        for gain, given in ((D[:, :, 2 * of], value), (D[:, :, 2 * of + 1], rate)):
            shown += gain.unsqueeze(1) * given.unsqueeze(2)
        return list((columns.whiten @ self._by_bin(shown)).to(torch.complex64).split(half, dim=3))

    def _shown_by(self, path: Tensor, steps: Steps, Q: Tensor) -> Tensor:
        """What the compressed signals show of changes of states and of the laws' forces (B, T, N + L, X):
        (B, T, R, X)."""
        at_once = (steps.shown @ self.weights.T) - steps.direct @ self.pull.T  # of laws' forces, (B, S', L)
        return torch.cat([Q @ steps.discrete.C, Q @ at_once], dim=2).unsqueeze(1) @ path

    def _by_bin(self, shown: Tensor) -> Tensor:
        """Spectra within the band of signals (B, T, R, X), (B, F, R, X)."""
        found: Tensor = torch.fft.rfft(shown, dim=1)[:, 1 : self.model.bins + 1]
        return found

    def _element_loads(
        self, steps: Steps, motion: Moved, data: WindowBatch, smooth: FloatArray
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

    def _spring_loads(self, steps: Steps, motion: Moved, data: WindowBatch, smooth: FloatArray) -> Tensor | None:
        """Forces of air springs by the loads that their stiffness follows, (B, E, T, X); None: none does."""
        powers = self.model.simulator.loading.stiffness
        if not bool(powers.any()):
            return None
        deflection, _ = self.element_motion(motion.states, data, smooth)
        force = torch.as_tensor(deflection) * steps.values.stiffness[:, None]
        return force.mT.unsqueeze(3) * powers.T[None, :, None]

    def _mass_loads(self, point: WindowPoint, steps: Steps, motion: Moved, data: WindowBatch) -> Tensor:
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

    def _force_sources(self, along: list[Along], point: WindowPoint, steps: Steps, before: int) -> Tensor:
        """Laws' forces by the unknowns along the given motion, memories apart, (B, T, L, before + U)."""
        names = [(p.element, p.quantity) for p in self.system.parameters]
        B, T = point.force.shape[:2]
        found = torch.zeros((B, T, len(along), before + self.unknowns), dtype=torch.float64)
        at = before + len(names)
        for i, (acting, path) in enumerate(zip(self.acting, along, strict=True)):
            start = self.first_memory(point, i)
            changes = path.changes(self.values(point, i), acting.free, self._element(steps, i), start)
            for change in changes[:-2]:
                found[:, :, i, at] = torch.as_tensor(change)
                at += 1
            element = self.system.elements[acting.element]
            for quantity, change in zip(("stiffness", "damping"), changes[-2:], strict=True):
                if (element, quantity) in names:
                    found[:, :, i, before + names.index((element, quantity))] = torch.as_tensor(change)
        return found

    def smoothed(self, columns: Columns, residual: Tensor, step: Tensor, dx0: Tensor, steps: Steps) -> FloatArray:
        """What the residual after a step says of the drives' noise, as motion of the elements: (2, B, T, E)."""
        model, s = self.model, self.model.simulator
        left = residual - columns.free.mT @ (columns.free_scale * dx0).unsqueeze(2)  # (B, K, 1)
        left = left - columns.sensitivities.mT @ step.unsqueeze(2)
        noise = model.noise_told(columns.whiten, columns.carried, as_spectra(left, columns.whiten))
        motion, support = model.moved_by(steps.values, columns.compliance, noise)
        moved = motion @ s.H.T.to(motion.dtype) + support  # (B, F, E)
        found = torch.stack([model.signals(moved), model.signals(model.frequency.jw[:, None] * moved)])
        return np.asarray(found.numpy())
