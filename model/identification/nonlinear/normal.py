"""Normal equations of windows with laws, and the noise of their drives as estimated from what a step leaves."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sprung.model.identification.likelihood.gauss_newton import WindowBatch
from sprung.model.identification.likelihood.linearise import PRIOR_STD, as_rows, as_spectra, normalised
from sprung.model.identification.nonlinear.iterate import Iterate, LinearStep, NormalEquations, SimulatedMotion
from sprung.model.identification.nonlinear.sensitivities import LawSensitivities
from sprung.model.identification.nonlinear.tangent import TangentModel
from sprung.model.identification.nonlinear.window import LawWindows
from sprung.model.signals import FloatArray

_RIDGE = 1e-11  # relative, on the normalised free responses
_MEMORY_STD = 3.0  # prior of a memory at the first sample, in its rms over the window


def normal_equations(
    sensitivities: LawSensitivities,
    point: Iterate,
    steps: LinearStep,
    motion: SimulatedMotion,
    data: WindowBatch,
    smooth: FloatArray,
) -> tuple[NormalEquations, TangentModel]:
    """Normal equations at a consistent iterate, and its tangent-linear model."""
    w = sensitivities.windows
    along = w.along(motion.states, data, smooth, point, steps)
    tangent = w.tangent(along, point, steps)
    transfer = w.model.transfer(steps.values, data)
    carried = w.model.noise.carried(transfer.drive)
    whiten = w.model.noise.whitening(carried)
    shown = sensitivities.outputs(point, steps, motion, data, smooth, along, tangent)
    white = as_rows(whiten @ sensitivities.spectra(shown))
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
    precision = torch.full((len(J), w.unknowns), 1 / PRIOR_STD**2, dtype=torch.float64)
    precision[:, w.linear] = w.model.precision[: len(w.linear)]
    if w.memories:
        precision[:, w.reported :] = (_MEMORY_STD * torch.where(sound[:, None], tangent.memory_size, 1.0)) ** -2.0
    covariance = torch.linalg.inv(information + torch.diag_embed(precision))
    inverses = (information, covariance, precision)
    return NormalEquations(
        whiten, carried, transfer.compliance, free, free_scale, J, factor, across, *inverses
    ), tangent


def smoothed(
    w: LawWindows, columns: NormalEquations, residual: Tensor, step: Tensor, dx0: Tensor, steps: LinearStep
) -> FloatArray:
    """Noise of the drives as estimated from the residual after a step, as motion of the elements: (2, B, T, E)."""
    model, s = w.model, w.model.simulator
    left = residual - columns.free.mT @ (columns.free_scale * dx0).unsqueeze(2)  # (B, K, 1)
    left = left - columns.sensitivities.mT @ step.unsqueeze(2)
    noise = model.noise.estimated(columns.whiten, columns.carried, as_spectra(left, columns.whiten))
    motion, support = model.moved_by(steps.values, columns.compliance, noise)
    moved = motion @ s.H.T.to(motion.dtype) + support  # (B, F, E)
    found = torch.stack([model.band.signals(moved), model.band.signals(model.frequency.jw[:, None] * moved)])
    return np.asarray(found.numpy())
