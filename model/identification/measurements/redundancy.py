"""Evidence of two measurements of one support's motion on each other's gains and delays.

Displacement, velocity and acceleration of a support are fused into one motion, the least-squares spline (see
`model.simulate.fusion`).  What that fit leaves depends on no parameter and on no initial state; it depends on the
channels' gains and delays: a displacement that reads 2 % too much is not the integral of its velocity.  With Q what the
fit leaves of the samples z in units of their noise (an orthogonal projection),

    Q z = Q X h + noise,       X = [u^ / sigma, -u^' / sigma] of every channel along the fitted motion u^

restricted to the band of the likelihood.  The fit and what it leaves do not correlate, so that noise biases nothing.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from sprung.model.identification.likelihood.linearise import as_rows
from sprung.model.signals import FloatArray
from sprung.model.simulate.drives import drives_of
from sprung.model.simulate.fusion import left_by_motion, used
from sprung.model.system import System


class Redundancy:
    """Supports of a system that are measured more than once; C channels, of which H >= 2 C deviations begin with gains
    and delays."""

    def __init__(self, system: System, samples: int, deviations: int) -> None:
        self.samples, self.dt, self.deviations = samples, 1 / system.sample_rate, deviations
        self.channels = len(system.channels)
        self._maps: dict[tuple[tuple[int, float], ...], FloatArray] = {}
        self.alike: dict[tuple[tuple[int, float], ...], list[list[int]]] = {}  # columns of supports, by their noises
        for drive in drives_of(system):
            if drive.support and drive.noise and len(used(drive.noise)) > 1 and min(drive.noise.values()) > 0:
                key = tuple(sorted(drive.noise.items()))
                self.alike.setdefault(key, []).append([drive.columns[order] for order, _ in key])

    def evidence(
        self, inputs: Tensor, slope: Tensor, spectra: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor] | None:
        """Information (B, H, H) on the deviations and score (B, H) of windows whose inputs (B, T, I) are given.

        slope: derivative of signals over their samples, (T, T); spectra: weighed bins of (B, T, X), (B, F, X).
        None: no support is measured twice.
        """
        if not self.alike:
            return None
        B, H = len(inputs), self.deviations
        information, score = inputs.new_zeros(B, H, H), inputs.new_zeros(B, H)
        for key, supports in self.alike.items():
            noise = np.array([std for _, std in key])
            z = np.moveaxis(inputs.numpy()[:, :, np.array(supports)], 1, 2) / noise  # (B, supports, T, Q)
            M, b = self._of_one(z.reshape(-1, *z.shape[2:]), key, slope, spectra)
            for i, columns in enumerate(supports):
                at = torch.tensor([*columns, *(self.channels + c for c in columns)])
                information[:, at[:, None], at] += M[i :: len(supports)]
                score[:, at] += b[i :: len(supports)]
        return information, score

    def relations(self, inputs: int) -> FloatArray:
        """One row over the I input channels per support that is measured twice, 1 at its channels, (X, I)."""
        supports = [columns for same in self.alike.values() for columns in same]
        rows = np.zeros((len(supports), inputs))
        for row, columns in zip(rows, supports, strict=True):
            row[columns] = 1.0
        return rows

    def parts(self, inputs: FloatArray, spectra: Callable[[Tensor], Tensor]) -> FloatArray:
        """What each channel of windows (B, T, I) adds to what the motion of its support leaves, (B, I, K).

        The parts of one support's channels add up to what is left; K is that of the support with most channels.
        """
        maps = {key: self._map(key, spectra) for key in self.alike}
        found = np.zeros((len(inputs), inputs.shape[2], max((of_key.shape[2] for of_key in maps.values()), default=0)))
        for key, supports in self.alike.items():
            for columns, of_channel in zip(np.transpose(supports), maps[key], strict=True):
                found[:, columns, : of_channel.shape[1]] = inputs[:, :, columns].transpose(0, 2, 1) @ of_channel
        return found

    def _map(self, key: tuple[tuple[int, float], ...], spectra: Callable[[Tensor], Tensor]) -> FloatArray:
        """From samples of each of Q channels of a support to the spectra of what their motion leaves, (Q, T, K)."""
        if key not in self._maps:
            Q, T = len(key), self.samples
            alone = np.zeros((Q, T, T, Q))
            for q, (_, noise) in enumerate(key):
                alone[q, :, :, q] = np.eye(T) / noise
            left = left_by_motion(alone.reshape(Q * T, T, Q), self.dt, key)
            rows = as_rows(spectra(torch.as_tensor(left)).unsqueeze(3))
            self._maps[key] = rows.reshape(Q, T, -1).numpy()
        return self._maps[key]

    def _of_one(
        self, z: FloatArray, key: tuple[tuple[int, float], ...], slope: Tensor, spectra: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Information (B, 2 Q, 2 Q) and score (B, 2 Q) on gains, then delays, of one support's Q channels z (B, T, Q),
        in units of their noise."""
        Q = z.shape[2]
        fitted = torch.as_tensor(z - left_by_motion(z, self.dt, key))
        motions = torch.cat([fitted, -(slope @ fitted)], dim=2)  # (B, T, 2 Q)
        shown = torch.as_tensor(self._map(key, spectra) * np.array([std for _, std in key])[:, None, None])  # (Q, T, K)
        rows = torch.stack([motions[:, :, x] @ shown[x % Q] for x in range(2 * Q)], dim=1)  # (B, 2 Q, K)
        r = torch.as_tensor(z).mT.flatten(1) @ shown.flatten(0, 1)  # (B, K)
        # Beyond its noise the fit leaves what is no gain and no delay: it counts as more noise.
        freedom = r.shape[1] * (Q - 1) / Q
        excess = (r.square().sum(dim=1) / freedom).clamp_min(1.0)[:, None]
        return rows @ rows.mT / excess.unsqueeze(2), (rows @ r.unsqueeze(2)).squeeze(2) / excess
