"""Initial iterate of windows of a system with laws: a motion that agrees with the sensors and nearly with the laws.

A linear fit ignores the laws: its motion goes far into a stop, where the law's force would be many times the true one.
Here the forces f at the samples are unknown like the initial state x0, and may differ from the laws' along the motion,

    f = law(d, v) + error,    sensors = responses to x0 + responses to f + noise,

with a standard deviation that decreases from one Gauss-Newton step to the next (weak-constraint estimation: Tremolet,
Q. J. R. Meteorol. Soc. 132, 2006).  Laws that are gentler than their elements are followed along the motion instead.
The windows of a batch share the responses of the system at their median values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sprung.model.identification.likelihood.gauss_newton import WindowBatch
from sprung.model.identification.likelihood.linearise import as_rows
from sprung.model.identification.nonlinear.forces import LawAlongMotion
from sprung.model.identification.nonlinear.iterate import Iterate, LinearStep
from sprung.model.identification.nonlinear.window import LawWindows
from sprung.model.signals import FloatArray

_ERRORS = 1.0, 0.1  # of the laws' forces, step by step, in their rms along the linear motion
_RIDGE = 1e-9  # relative, on the responses
_BLOCKS = 5  # of a window; later forces do not act on earlier blocks, which saves half of the work
_SPLINE_REACH = 12  # samples before a force on which the spline lets it act, by 0.27 less from one to the next


@dataclass(frozen=True, slots=True)
class _Responses:
    """Responses to X = N + T L' unit inputs: initial states, then forces of some of the laws at each sample."""

    shown: Tensor  # whitened, of the compressed signals, (X, K)
    deflection: Tensor  # of the sites of these laws, (T, L', X)
    rate: Tensor


def initial_iterate(w: LawWindows, start: Iterate, data: WindowBatch) -> Iterate:
    """The windows at the values of `start`, with estimated initial states and forces."""
    B, T, L = start.force.shape
    one, whiten = _median_model(w, start, data)
    steps = one.take(torch.zeros(B, dtype=torch.long))
    free = _responses(w, one, data, whiten, []).shown
    point, N = replace(start, x0=torch.zeros_like(start.x0), force=torch.zeros_like(start.force)), len(free)
    residual = w.residual(w.simulate(steps, point.force, point.x0, data)[1], data, whiten)
    x0, singular = torch.linalg.solve_ex(_regularised(free @ free.T), free @ residual)
    sound = (singular == 0) & x0.isfinite()  # not for absurd values, whose windows start at rest
    point = replace(point, x0=x0.where(sound, 0.0).squeeze(2))
    outputs, along, law = _motion(w, steps, point, data)
    free_to_differ = _stiff(w, steps, point, along, law)
    followed = [i for i in range(L) if i not in free_to_differ]
    by = _responses(w, one, data, whiten, free_to_differ)
    products = _regularised(by.shown @ by.shown.T).expand(B, -1, -1)
    size = law[..., free_to_differ].square().mean(dim=(0, 1)).sqrt().clamp_min(1e-9)
    for again, error in enumerate(_ERRORS):
        if again:
            outputs, along, law = _motion(w, steps, point, data)
        if followed:
            force = point.force.clone()
            force[..., followed] = law[..., followed]
            point = replace(point, force=force)
            outputs, along, law = _motion(w, steps, point, data)
        gradient, information = by.shown @ w.residual(outputs, data, whiten), products
        if free_to_differ:
            slopes = w.slopes_along(along, point, steps)
            slopes_there = slopes[0][..., free_to_differ], slopes[1][..., free_to_differ]
            squares, pull = _errors(slopes_there, by, (point.force - law)[..., free_to_differ], (error * size) ** -1)
            gradient, information = gradient - pull, products + squares
        factor, failed = torch.linalg.cholesky_ex(information)
        step = torch.cholesky_solve(gradient, factor).squeeze(2)
        sound = (failed == 0) & step.isfinite().all(dim=1)  # not for absurd signals, whose windows stay as they are
        step, force = step.where(sound[:, None], 0.0), point.force.clone()
        force[..., free_to_differ] += step[:, N:].view(B, T, len(free_to_differ))
        point = replace(point, x0=point.x0 + step[:, :N], force=force)
    return point


def _motion(
    w: LawWindows, steps: LinearStep, point: Iterate, data: WindowBatch
) -> tuple[Tensor, list[LawAlongMotion], Tensor]:
    """Outputs under the forces of `point`, the laws along that motion and their forces there, (B, T, L)."""
    states, outputs = w.simulate(steps, point.force, point.x0, data)
    along = w.along(states, data, np.zeros((2, 1, 1, 1)), point, steps)
    return outputs, along, w.forces_along(along, point, steps)


def _stiff(w: LawWindows, steps: LinearStep, point: Iterate, along: list[LawAlongMotion], law: Tensor) -> list[int]:
    """Laws whose forces along the linear motion, (B, T, L), are no guide to the true ones: stiffer than their elements
    somewhere, or of larger forces."""
    by_deflection = w.slopes_along(along, point, steps)[0].abs().amax(dim=(0, 1))
    found = []
    for i, path in enumerate(along):
        element = w.element(steps, i)
        own = np.abs(element.stiffness[:, None] * path.d + element.damping[:, None] * path.v).max()
        if by_deflection[i] > element.stiffness.max() or law[..., i].abs().max() > own:
            found.append(i)
    return found


def _errors(slopes: tuple[Tensor, Tensor], by: _Responses, off: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Normal matrix (B, X, X) of the weighted law errors and its right-hand side for `off`, (B, X, 1).

    slopes: of the laws by deflection and rate; off: forces less the laws' (B, T, L); weight: of the errors, (L,).  A
    force acts on nothing before it, except within the reach of the spline: early samples depend on few unknowns.
    """
    (B, T, L), X = off.shape, len(by.shown)
    N = X - T * L
    squares, pull = off.new_zeros(B, X, X), off.new_zeros(B, X, 1)
    for times in torch.arange(T).tensor_split(_BLOCKS):
        first, last = int(times[0]), int(times[-1]) + 1
        active = min(X, N + (last + _SPLINE_REACH) * L)
        by_d, by_v = (slope[:, first:last].unsqueeze(3) for slope in slopes)
        bend = by_d * by.deflection[first:last, :, :active]
        bend = bend.addcmul_(by_v, by.rate[first:last, :, :active]).neg_().flatten(1, 2)
        own = torch.arange((last - first) * L)
        bend[:, own, N + first * L + own] += 1.0
        bend *= weight.repeat(last - first)[:, None]
        squares[:, :active, :active] += bend.mT @ bend
        pull[:, :active] += bend.mT @ (off[:, first:last] * weight).flatten(1, 2).unsqueeze(2)
    return squares, pull


def _median_model(w: LawWindows, start: Iterate, data: WindowBatch) -> tuple[LinearStep, Tensor]:
    """The linear step (of one window) and the whitening at the median of the windows' values."""
    point = start.take(torch.zeros(1, dtype=torch.long))
    steps = w.steps(replace(point, unknowns=start.unknowns.median(dim=0, keepdim=True).values), data)
    transfer = w.model.transfer(steps.values, data)
    return steps, w.model.noise.whitening(w.model.noise.carried(transfer.drive))


def _responses(w: LawWindows, steps: LinearStep, data: WindowBatch, whiten: Tensor, laws: list[int]) -> _Responses:
    """laws: those whose forces are unknown."""
    T, N, L = data.w.shape[1], w.model.states_count, len(w.acting)
    X = N + T * len(laws)
    x0, force = torch.eye(X, N, dtype=torch.float64), torch.zeros(X, T, L, dtype=torch.float64)
    force[N:, :, laws] = torch.eye(T * len(laws), dtype=torch.float64).view(T * len(laws), T, len(laws))
    at_rest = replace(data, w=torch.zeros(X, *data.w.shape[1:], dtype=torch.float64))
    states, outputs = w.simulate(steps.take(torch.zeros(X, dtype=torch.long)), force, x0, at_rest)
    shown = w.model.band.spectra(outputs @ w.model.compression.matrix(data.present).mT)
    none: FloatArray = np.zeros((2, 1, 1, len(w.system.mechanics.stiffness)))
    d, v = (torch.as_tensor(part).permute(1, 2, 0) for part in w.site_motion(states, at_rest, none))
    return _Responses(as_rows(whiten @ shown.unsqueeze(3)).squeeze(1), d[:, laws], v[:, laws])


def _regularised(products: Tensor) -> Tensor:
    return products + torch.diag(_RIDGE * torch.diagonal(products))
