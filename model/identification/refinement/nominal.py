"""Cost of windows at the nominal values: what fits badly there is judged without a search."""

from __future__ import annotations

import numpy as np
import torch

from sprung.model.identification.likelihood.gauss_newton import WindowBatch
from sprung.model.identification.likelihood.linearise import as_rows
from sprung.model.identification.refinement.any_inputs import RefinerOfAnyInputs
from sprung.model.signals import BoolArray, FloatArray


def nominal_cost(of_any: RefinerOfAnyInputs, windows: FloatArray) -> FloatArray:
    """Weighted squares (B,) of windows (B, T, C) at the nominal values with the best initial state.

    All lack the inputs and the sensors that the first one lacks.
    """
    lost = of_any.lacks(windows[:1])[0]
    refiner = of_any.without(lost)
    model, windows = refiner.model, windows.copy()
    windows[:, :, np.flatnonzero(lost)] = 0.0
    present: BoolArray = np.asarray(~np.isnan(windows[0, :, len(lost) :]).any(axis=0))
    with torch.no_grad():
        data = model.batch(model.knots(windows), windows, present)
        nominal = torch.zeros(1, len(model.system.parameters), dtype=torch.float64)
        at = model.linearise(nominal, WindowBatch(data.w[:1], data.measured[:1], present, data.inputs[:1]))
        s = model.simulator
        discrete = model.compressed(s.discretise(s.element_values(nominal)), data)
        rest = torch.zeros(len(windows), discrete.Ad.shape[1], dtype=torch.float64)
        parts = (discrete.Ad, discrete.G0, discrete.G1, discrete.C, discrete.D)
        every = type(discrete)(*(part.expand(len(windows), -1, -1) for part in parts))
        residual = (
            data.measured @ model.compression.matrix(present).mT
            - s.states(every, data.w, rest) @ discrete.C.mT
            - data.w @ discrete.D.mT
        )
        r = as_rows(at.whiten @ model.band.spectra(residual).unsqueeze(3))[:, 0]  # (B, K)
        along = r @ at.free[0].mT  # (B, N)
        left = r.square().sum(dim=1) - (along * torch.cholesky_solve(along.mT, at.factor[0]).mT).sum(dim=1)
        dropped = refiner.calibration.dropped(present)
        over = model.band.spectra(data.measured @ dropped.mT) * model.noise.weight[:, None]
        return np.asarray((left + over.abs().square().sum(dim=(1, 2))).numpy())
