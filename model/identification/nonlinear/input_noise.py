"""Covariance that noise of the drives adds to the estimates of windows through their laws.

Whitening accounts for how the linear system transmits that noise to the sensors.  A law transmits it, too, by its local
slope: a stop that is five times as stiff as its spring passes six times the noise while it is in contact.  The
Gauss-Newton step is linear in forces added to the laws', so the adjoint of the tangent-linear model gives its
sensitivity to that noise.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sprung.model.identification.likelihood.noise_share import moved_by_drives
from sprung.model.identification.nonlinear.iterate import LinearStep, NormalEquations
from sprung.model.identification.nonlinear.tangent import TangentModel
from sprung.model.identification.nonlinear.window import LawWindows
from sprung.model.signals import BoolArray


def input_noise_covariance(
    w: LawWindows, columns: NormalEquations, steps: LinearStep, tangent: TangentModel, present: BoolArray
) -> Tensor:
    """Covariance of the unknowns (B, U, U) that noise of the drives adds through the laws."""
    gain = columns.covariance @ (columns.sensitivities - columns.across.mT @ columns.free)
    (B, U, _), (F, R) = gain.shape, columns.whiten.shape[1:3]
    by_residual = torch.view_as_complex(gain.view(B, U, F, R, 2)).permute(0, 2, 3, 1)  # the step, (B, F, R, U)
    by_signal = columns.whiten.mH @ by_residual
    by_force, by_memory = tangent.adjoint(*_by_states_and_forces(w, by_signal, steps, present))
    by_deflection, by_rate = tangent.along_adjoint(by_force, by_memory)  # (B, T, L, U)
    jw = w.model.frequency.jw[:, None, None]
    spectrum = w.model.band.spectra(by_deflection).conj() + jw * w.model.band.spectra(by_rate).conj()  # (B, F, L, U)
    moved, direct = moved_by_drives(w.model, steps.values, columns.compliance)
    site = w.weights.to(moved.dtype) @ (w.model.simulator.H.to(moved.dtype) @ moved + direct)  # (B, F, L, W/2)
    share = 2 / w.model.samples  # of a bin in a signal
    through = share * (spectrum.mT @ site) * w.model.noise.drives[:, None]  # (B, F, U, W/2)
    linear = by_signal.mH @ columns.carried
    both = ((linear + through / 2) @ through.mH).real.sum(dim=1) / share
    return both + both.mT


def _by_states_and_forces(
    w: LawWindows, by_signal: Tensor, steps: LinearStep, present: BoolArray
) -> tuple[Tensor, Tensor]:
    """The step by states (B, T, N, U) and by the laws' forces at once (B, T, L, U).

    by_signal: by bins of the compressed signals, (B, F, R, U).
    """
    B, _, R, U = by_signal.shape
    signals = w.model.band.signals(by_signal.flatten(2)) * (w.model.samples / 2)
    by_output = w.model.compression.matrix(present).mT @ signals.view(B, -1, R, U)  # (B, T, S', U)
    at_once = (steps.force_rows @ w.weights.T) - steps.direct @ w.pull.T  # (B, S', L)
    return steps.discrete.C.mT.unsqueeze(1) @ by_output, at_once.mT.unsqueeze(1) @ by_output
