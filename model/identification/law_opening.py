"""Where windows of a system with laws begin: at a motion that the sensors show and that their laws nearly allow.

A linear fit knows no law: its motion goes far inside a stop, where the law's force is many times what it was.  Here the
forces f at the samples are unknown like the first state x0, and may differ from the laws' along the motion,

    f = law(d, v) + error,    sensors = responses to x0 + responses to f + noise,

by less and less from round to round (weak-constraint estimation: Tremolet, Q. J. R. Meteorol. Soc. 132, 2006), each a
step of Gauss-Newton.  The windows of a batch share the responses, those of the middle of their values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sprung.model.identification.gauss_newton import WindowBatch
from sprung.model.identification.law_point import Steps, WindowPoint
from sprung.model.identification.law_window import LawWindows
from sprung.model.identification.linearise import as_rows
from sprung.model.signals import FloatArray

_ERRORS = 1.0, 0.1  # of the laws' forces, round by round, in their rms along the linear motion
_RIDGE = 1e-9  # relative, on the responses
_STRETCHES = 5  # of a window, each without the columns of forces after it: half of the work
_SPREAD = 12  # samples before a force that a spline moves, by 0.27 from one to the next


@dataclass(frozen=True, slots=True)
class _Responses:
    """To first states, then to unit forces at each sample: X = N + T L of them."""

    shown: Tensor  # whitened, of the compressed signals, (X, K)
    deflection: Tensor  # of the sites, (T, L, X)
    rate: Tensor


def opened(w: LawWindows, start: WindowPoint, data: WindowBatch) -> WindowPoint:
    """The windows at the values of `start`, with first states and forces to begin with."""
    B, T, L = start.force.shape
    steps, whiten = _middle(w, start, data)
    by = _responses(w, steps, data, whiten)
    N = len(by.shown) - T * L
    steps = steps.take(torch.zeros(B, dtype=torch.long))
    smooth = np.zeros((2, B, T, len(w.system.mechanics.stiffness)))
    point = replace(start, x0=torch.zeros_like(start.x0), force=torch.zeros_like(start.force))
    residual = w.residual(w.simulate(steps, point.force, point.x0, data)[1], data, whiten)
    x0, singular = torch.linalg.solve_ex(_ridged(by.shown[:N] @ by.shown[:N].T), by.shown[:N] @ residual)
    sound = (singular == 0) & x0.isfinite()  # values that no vehicle has: their windows begin at rest
    point = replace(point, x0=x0.where(sound, 0.0).squeeze(2))
    products = _ridged(by.shown @ by.shown.T)
    size = None
    for error in _ERRORS:
        states, outputs = w.simulate(steps, point.force, point.x0, data)
        along = w.along(states, data, smooth, point, steps)
        law = w.forces_along(along, point, steps)
        size = law.square().mean(dim=(0, 1)).sqrt().clamp_min(1e-9) if size is None else size
        squares, pull = _errors(w.slopes_along(along, point, steps), by, point.force - law, (error * size) ** -1)
        gradient = by.shown @ w.residual(outputs, data, whiten) - pull
        factor, failed = torch.linalg.cholesky_ex(products + squares)
        step = torch.cholesky_solve(gradient, factor).squeeze(2)
        sound = (failed == 0) & step.isfinite().all(dim=1)  # sensors that show nonsense: such a window stays
        step = step.where(sound[:, None], 0.0)
        point = replace(point, x0=point.x0 + step[:, :N], force=point.force + step[:, N:].view(B, T, L))
    return point


def _errors(slopes: tuple[Tensor, Tensor], by: _Responses, off: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Squares (B, X, X) of the laws' errors, weighed, by the unknowns, and their products with `off`, (B, X, 1).

    slopes: of the laws by deflection and rate, off: forces less the laws' (B, T, L); weight: of the errors, (L,).  A
    force moves nothing before it, but for what the spline through the samples spreads: the first samples depend on few
    unknowns.
    """
    (B, T, L), X = off.shape, len(by.shown)
    N = X - T * L
    squares, pull = off.new_zeros(B, X, X), off.new_zeros(B, X, 1)
    for times in torch.arange(T).tensor_split(_STRETCHES):
        first, last = int(times[0]), int(times[-1]) + 1
        seen = min(X, N + (last + _SPREAD) * L)
        by_d, by_v = (slope[:, first:last].unsqueeze(3) for slope in slopes)
        bend = by_d * by.deflection[first:last, :, :seen]
        bend = bend.addcmul_(by_v, by.rate[first:last, :, :seen]).neg_().flatten(1, 2)
        own = torch.arange((last - first) * L)
        bend[:, own, N + first * L + own] += 1.0
        bend *= weight.repeat(last - first)[:, None]
        squares[:, :seen, :seen] += bend.mT @ bend
        pull[:, :seen] += bend.mT @ (off[:, first:last] * weight).flatten(1, 2).unsqueeze(2)
    return squares, pull


def _middle(w: LawWindows, start: WindowPoint, data: WindowBatch) -> tuple[Steps, Tensor]:
    """The linear step (of one window) and the whitening at the middle of the windows' values."""
    point = start.take(torch.zeros(1, dtype=torch.long))
    steps = w.steps(replace(point, unknowns=start.unknowns.median(dim=0, keepdim=True).values), data)
    transfer = w.model.transfer(steps.values, data)
    return steps, w.model.whitening(transfer.drive * w.model.drive_noise[:, None])


def _responses(w: LawWindows, steps: Steps, data: WindowBatch, whiten: Tensor) -> _Responses:
    T, N, L = data.w.shape[1], w.model.states_count, len(w.acting)
    X = N + T * L
    x0, force = torch.eye(X, N, dtype=torch.float64), torch.zeros(X, T, L, dtype=torch.float64)
    force[N:] = torch.eye(T * L, dtype=torch.float64).view(T * L, T, L)
    still = replace(data, w=torch.zeros(X, *data.w.shape[1:], dtype=torch.float64))
    states, outputs = w.simulate(steps.take(torch.zeros(X, dtype=torch.long)), force, x0, still)
    shown = w.model.spectra(outputs @ w.model.compression.matrix(data.present).mT)
    none: FloatArray = np.zeros((2, 1, 1, len(w.system.mechanics.stiffness)))
    d, v = (torch.as_tensor(part).permute(1, 2, 0) for part in w.site_motion(states, still, none))
    return _Responses(as_rows(whiten @ shown.unsqueeze(3)).squeeze(1), d, v)


def _ridged(products: Tensor) -> Tensor:
    return products + torch.diag(_RIDGE * torch.diagonal(products))
