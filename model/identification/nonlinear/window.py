"""Windows of a system with laws: their motion, with the laws' forces and the motion made consistent.

The laws' forces f act on the linear rest of the system as generalised forces q = -H^T f.  Between samples they are
interpolated by cubics like every drive, so that a step is exact for given forces,

    x_{k+1} = Ad x_k + G0 w_k + G1 w_{k+1} + P0 q_k + S0 q'_k + P1 q_{k+1} + S1 q'_{k+1}.

Newton's method on the forces at the samples makes forces and motion consistent.  Sensitivities follow from the
tangent-linear model along that motion (`sensitivities`).  Whitened over bins of the DFT they replace the linear model's
sensitivities in the normal equations (`normal`); the memories at the first sample are unknowns beside the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from sprung.model.identification.likelihood.gauss_newton import WindowBatch
from sprung.model.identification.likelihood.linearise import WindowModel, as_rows
from sprung.model.identification.nonlinear.forces import (
    ActiveLaw,
    LawAlongMotion,
    add_motion_between_samples,
    spline_compensation,
    spline_slopes,
)
from sprung.model.identification.nonlinear.iterate import Iterate, LinearStep, SimulatedMotion
from sprung.model.identification.nonlinear.tangent import TangentModel
from sprung.model.laws import SpringDamper
from sprung.model.mechanics import ACCELERATION, FORCE
from sprung.model.signals import FloatArray
from sprung.model.simulate.linear import phi_functions
from sprung.model.system import System

_NEWTON_STEPS = 4  # at most, for the forces
_NEWTON_TOLERANCE = 0.05  # rms change of the outputs by a Newton step, in the sensors' noise
_DIVERGED = 1e4  # times the measured amplitude: Newton's method has diverged
# the motion of the elements is not corrected for noise of the drives
_DRIVES_AS_MEASURED: FloatArray = np.zeros((2, 1, 1, 1))


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
