"""Noise of windows over frequency: what that of the drives brings to the signals, and the weights that follow.

The signals have unit noise of their own; with what the drives carry to them, R(w) = I + G S_u G^H.
"""

from __future__ import annotations

import torch
from torch import Tensor

_BELIEVED = 0.01  # of the motion that a lost input may have at most: its prior where it is estimated
_APART = 1e-6  # of the largest, below which what a lost input brings to the signals is no direction of its own


class WindowNoise:
    """Of the W/2 drives of a system over the F bins of windows; some of them may be lost: not measured at all."""

    def __init__(self, drives: Tensor, lost: Tensor, weight: Tensor) -> None:
        """drives: standard deviations of their spectra, (F, W/2); lost: which are, (W/2,); weight: (F,) of spectra."""
        self.drives, self.weight = drives, weight
        self.lost = int(lost.sum())
        self.lost_at = torch.nonzero(lost)[:, 0]
        self.instruments = drives * ~lost  # without what is not measured at all, (F, W/2)

    def carried(self, drive: Tensor) -> Tensor:
        """What the noise of the drives brings to signals (B, F, R, W/2) that respond to them by `drive`, likewise."""
        return drive * self.drives[:, None]

    def whitening(self, carried: Tensor) -> Tensor:
        """Whitening matrices (B, F, R, R) where the drives' noise brings `carried` (B, F, R, W/2) to the signals.

        What any motion of lost drives may bring to them is projected out.
        """
        if not self.lost:
            return self.by_noise(carried)
        measured = carried.clone()
        measured[..., self.lost_at] = 0.0
        whiten = self.by_noise(measured)
        directions = self.span(whiten @ carried)
        left: Tensor = whiten - directions @ (directions.mH @ whiten)
        return left

    def span(self, carried: Tensor) -> Tensor:
        """Orthonormal directions (B, F, R, X) that what lost drives bring to the signals spans; zero where fewer."""
        u, size, _ = torch.linalg.svd(carried[..., self.lost_at], full_matrices=False)
        seen = size > _APART * size.amax(dim=2, keepdim=True)
        found: Tensor = u * seen.unsqueeze(2).to(u.dtype)
        return found

    def by_noise(self, carried: Tensor) -> Tensor:
        """Whitening matrices (B, F, R, R) for noise `carried` (B, F, R, W/2) beside that of the signals."""
        R = carried.shape[2]
        covariance = torch.eye(R, dtype=carried.dtype) + carried @ carried.mH
        factor = torch.linalg.cholesky(covariance)
        unit = torch.diag_embed(self.weight[:, None].expand(-1, R)).to(carried.dtype).expand_as(factor)
        found: Tensor = torch.linalg.solve_triangular(factor, unit, upper=False)
        return found

    def believed(self, kind: torch.dtype) -> tuple[Tensor, Tensor]:
        """Which drives are lost, as complex numbers, and how far their estimates are believed, each (F, W/2)."""
        lost = self.drives != self.instruments
        return lost.to(kind), torch.where(lost, _BELIEVED, 1.0)

    def estimated(self, whiten: Tensor, carried: Tensor, left: Tensor) -> Tensor:
        """Noise of the drives (B, F, W/2) as estimated from a whitened residual (B, F, R, 1) without free responses."""
        found: Tensor = ((whiten @ carried).mH @ left).squeeze(3) / self.weight[:, None] ** 2
        return found * self.drives
