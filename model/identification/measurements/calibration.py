"""Evidence of a window on the measurements themselves: gain and delay of every channel.

A channel reads `(1 + g) y(t - tau)` of the true signal y.  At the refined parameters the simulated outputs are known,
so sensitivities cost almost nothing: to a sensor's gain it is the sensor's output, to its delay minus the derivative
of that; to an input's gain and delay the same with the response of the sensors to that input, and the opposite sign (a
reading that is too large is a motion that is too small).  Loads are refined with the parameters.

    r = J_x dx + J_h dh + noise,    free responses eliminated as in the refinement

The likelihood of a window, with the parameters x profiled out, is then quadratic in the deviations h:

    x^(h) = x^ + D h,   D = -C Jx' Jh,        log L(h) = b' h - h' M h / 2,   M = Jh' Jh - Jh' Jx C Jx' Jh

Redundant sensors enter here with the part that the refinement drops because it depends on no parameter: it does depend
on gains and delays, and distinguishes them from springs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from sprung.model.identification.likelihood.gauss_newton import WindowBatch
from sprung.model.identification.likelihood.linearise import WindowModel, as_rows, as_spectra
from sprung.model.identification.measurements.deviations import deviations
from sprung.model.identification.measurements.redundancy import Redundancy
from sprung.model.signals import FloatArray
from sprung.model.simulate.drives import drives_of
from sprung.model.simulate.linear import ElementValues

_ROUNDING = 1e-6  # of sums in single precision, relative


@dataclass(frozen=True, slots=True)
class Evidence:
    """Quadratic log-likelihood of deviations (H of them) with the parameters profiled out; B windows."""

    cross: Tensor  # D, change of the estimate per deviation, shape (B, P, H)
    information: Tensor  # M, shape (B, H, H)
    score: Tensor  # b, shape (B, H)

    def numpy(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        return self.cross.numpy(), self.information.numpy(), self.score.numpy()


class NormalProducts(Protocol):
    """Normal equations of windows at an iterate, linear or with laws; U unknowns, K residuals."""

    @property
    def whiten(self) -> Tensor:
        """Shape (B, F, R, R)."""

    @property
    def free(self) -> Tensor:
        """Whitened responses to the first state, normalised, (B, N, K)."""

    @property
    def sensitivities(self) -> Tensor:
        """Whitened, (B, U, K)."""

    @property
    def factor(self) -> Tensor:
        """Cholesky factor of the free responses' products, (B, N, N)."""

    @property
    def across(self) -> Tensor:
        """Free responses solved for the sensitivities, (B, N, U)."""

    @property
    def covariance(self) -> Tensor:
        """Of the unknowns, weak prior included, (B, U, U)."""


class MiddleIterate(Protocol):
    """The iterate between the two steps of an iteration."""

    @property
    def residual(self) -> Tensor:
        """Whitened, before the step, (B, K, 1)."""

    @property
    def step(self) -> Tensor:
        """Of the unknowns, (B, U)."""

    @property
    def outputs(self) -> Tensor:
        """Simulated, before the step, (B, T, S')."""


class DeviationSensitivity:
    """Sensitivities of a window model to the deviations of its system."""

    def __init__(self, model: WindowModel) -> None:
        system = model.system
        self.model, self.deviations = model, deviations(system)
        self.inputs, self.measured = len(system.inputs), 2 * len(system.channels)  # gains and delays come first
        time = np.arange(model.samples) / system.sample_rate
        self.slope = torch.as_tensor(CubicSpline(time, np.eye(model.samples))(time, 1))
        drive, share = [], []
        omega = model.frequency.omega.numpy()
        for i, one in enumerate(drives_of(system)):
            for of_channel in one.shares_at(omega, 1 / system.sample_rate).values() if one.columns else ():
                drive.append(i)
                share.append(of_channel)
        self.drive = torch.as_tensor(drive)  # of every input channel
        self.share = torch.as_tensor(np.array(share).reshape(-1, len(omega)).T.copy())  # of its drive, (F, inputs)
        self._dropped: dict[bytes, Tensor] = {}
        self.redundancy = Redundancy(system, model.samples, self.measured)

    def motions(self, data: WindowBatch) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """Values and rates (B, T, W/2) of the drives as gains change them, and as delays do."""
        value, slope = data.w[:, :, 0::2], data.w[:, :, 1::2]
        return (value, slope), (slope, self.slope @ slope)

    def smoothed(
        self,
        at: NormalProducts,
        after: MiddleIterate,
        data: WindowBatch,
        carried: Tensor,
        compliance: Tensor,
        values: ElementValues,
    ) -> tuple[WindowBatch, Tensor]:
        """Windows and outputs (B, T, S') less what the residual says of the noise of the drives.

        The noise of a measured motion below is not in what the sensors show, but in what the model makes of it: along
        the motion as measured, all sensors would seem to show too little (errors in variables).
        carried: what that noise brings to the signals, (B, F, R, W/2); compliance: (B, F, n, n).
        """
        alone = torch.cholesky_solve(at.free @ after.residual, at.factor)  # (B, N, 1)
        step = after.step.unsqueeze(2)
        left = after.residual - at.free.mT @ (alone - at.across @ step) - at.sensitivities.mT @ step
        noise = self.model.noise.estimated(at.whiten, carried, as_spectra(left, at.whiten))
        return self.model.smoothed(values, compliance, noise, data, after.outputs)

    def evidence(
        self, at: NormalProducts, after: MiddleIterate, data: WindowBatch, by_drive: Sequence[Tensor]
    ) -> Evidence:
        """At the log-ratios that the chord step `after` of `at` leads to; of gains and delays, and zero of others.

        by_drive: what each drive makes the whitened signals show, (B, F, R, W/2), along each of `motions`.
        """
        # Known directions as orthonormal rows, so that single precision is enough for what follows.
        free = torch.linalg.solve_triangular(at.factor, at.free, upper=False)  # (B, N, K)
        J = at.sensitivities - at.across.mT @ at.free
        root = torch.linalg.cholesky(at.covariance)  # C = root root'
        known = torch.cat([free.to(torch.float32), (root.mT @ J).to(torch.float32)], dim=1)  # (B, N + P, K)
        r = after.residual.to(torch.float32)
        columns, redundant = self.columns(at, after, data, by_drive)
        rows = as_rows(columns)  # (B, H, K)
        with_known = known @ rows.mT  # (B, N + P, H)
        information = rows @ rows.mT - with_known.mT @ with_known
        left = r - free.to(torch.float32).mT @ (free.to(torch.float32) @ r)
        N = free.shape[1]
        with_x = root.to(torch.float32) @ with_known[:, N:]  # C Jx' Jh
        score = (rows @ left)[..., 0].double()
        # The residual is that before the chord's step, which belongs to x^.
        moved = torch.cholesky_solve(after.step.unsqueeze(2), root)
        score = score - (with_x.double().mT @ moved)[..., 0]
        if redundant is not None:
            over = as_rows(redundant)
            dropped = self.dropped(data.present)
            weighted = self.model.noise.weight[:, None] * self.model.band.spectra(data.measured @ dropped.mT)
            spectra = weighted.to(torch.complex64)
            information = information + over @ over.mT
            score = score + (over @ as_rows(spectra.unsqueeze(3)).mT)[..., 0].double()
        information = information.double()
        of_inputs = self.redundancy.evidence(data.inputs, self.slope, self.bins)
        if of_inputs is not None:
            information, score = information + of_inputs[0], score + of_inputs[1]
        information, score = self._relative(information, score)
        pad, more = torch.nn.functional.pad, len(self.deviations) - self.measured
        return Evidence(pad(-with_x.double(), (0, more)), pad(information, (0, more, 0, more)), pad(score, (0, more)))

    def bins(self, signals: Tensor) -> Tensor:
        """Weighed bins of signals (B, T, X), (B, F, X)."""
        return self.model.noise.weight[:, None] * self.model.band.spectra(signals)

    def _relative(self, information: Tensor, score: Tensor) -> tuple[Tensor, Tensor]:
        """Without what no record can identify: one gain, or one delay, that all channels share changes nothing."""
        C = len(self.model.system.channels)
        for part in (slice(0, C), slice(C, 2 * C)):
            common = torch.zeros(self.measured, 1, dtype=information.dtype)
            common[part] = 1.0
            along = information @ common  # (B, H, 1)
            size = common.mT @ along  # (B, 1, 1)
            # Below single precision's rounding the direction is empty already, and dividing by it would fill it.
            rounding = _ROUNDING * torch.diagonal(information, dim1=1, dim2=2)[:, part].sum(dim=1)[:, None, None]
            share = torch.where(size > rounding, 1 / size.clamp_min(1e-300), torch.zeros_like(size))
            score = score - (along * (score.unsqueeze(1) @ common) * share).squeeze(2)
            information = information - along @ along.mT * share
        return information, score

    def columns(
        self, at: NormalProducts, after: MiddleIterate, data: WindowBatch, by_drive: Sequence[Tensor]
    ) -> tuple[Tensor, Tensor | None]:
        """Whitened sensitivities of the compressed signals (B, F, R, 2 C), and of the dropped ones (B, F, X, 2 C)."""
        model = self.model
        kind = torch.complex64
        B, F, R = at.whiten.shape[:3]
        C = self.inputs + len(data.present)
        out = torch.zeros(B, F, R, self.measured, dtype=kind)
        # A reading is (1 + g) y(t - tau): the true motion below is that much smaller and earlier.
        share = self.share[:, None].to(kind)
        for first, sign, shown in zip((0, C), (-1, 1), by_drive, strict=True):
            out[..., first : first + self.inputs] = sign * shown[..., self.drive] * share
        columns = self.inputs + torch.as_tensor(np.flatnonzero(data.present))
        shown = model.band.spectra(after.outputs).to(kind)  # (B, F, S')
        late = -model.band.spectra(self.slope @ after.outputs).to(kind)
        by_sensor = (at.whiten @ model.compression.matrix(data.present).to(at.whiten.dtype)).to(kind)
        out[..., columns] = by_sensor * shown[:, :, None]
        out[..., C + columns] = by_sensor * late[:, :, None]
        dropped = self.dropped(data.present).to(kind)
        if not len(dropped):
            return out, None
        dropped = dropped * model.noise.weight[:, None, None].to(kind)
        over = torch.zeros(B, F, dropped.shape[1], self.measured, dtype=kind)
        over[..., columns] = dropped * shown[:, :, None]
        over[..., C + columns] = dropped * late[:, :, None]
        return out, over

    def dropped(self, present: np.ndarray) -> Tensor:
        """Rows (X, S') of unit noise, orthogonal to the compression: what redundant sensors say of each other."""
        key = present.tobytes()
        if key not in self._dropped:
            noise = torch.as_tensor(self.model.system.sensor_noise[present])
            kept = self.model.compression.matrix(present) * noise  # orthonormal rows
            u, _, _ = torch.linalg.svd(torch.eye(kept.shape[1], dtype=kept.dtype) - kept.mT @ kept)
            self._dropped[key] = u[:, : kept.shape[1] - kept.shape[0]].mT / noise
        return self._dropped[key]
