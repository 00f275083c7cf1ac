"""Signals of windows within the compared band: their spectra, and back."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class ComparedBand:
    """Bins 1 to F of windows of T samples.

    The mean is left out: every signal may have an offset (gravity, curves, drifting electronics).
    """

    samples: int
    bins: int
    kind: torch.dtype  # complex

    @property
    def weight(self) -> Tensor:
        """What brings a spectrum of white noise to its standard deviation, (F,)."""
        return torch.full((self.bins,), math.sqrt(2 / self.samples), dtype=torch.float64)

    def spectra(self, signals: Tensor) -> Tensor:
        """Bins within the band of signals (B, T, ...), (B, F, ...)."""
        if signals.numel() == 0:  # no redundant sensor: a transform of nothing is an error
            return signals.new_zeros((len(signals), self.bins, *signals.shape[2:]), dtype=self.kind)
        found: Tensor = torch.fft.rfft(signals, dim=1)[:, 1 : self.bins + 1]
        return found

    def signals(self, spectra: Tensor) -> Tensor:
        """Signals (B, T, X) of bins within the band (B, F, X)."""
        whole = spectra.new_zeros(len(spectra), self.samples // 2 + 1, spectra.shape[2])
        whole[:, 1 : self.bins + 1] = spectra
        found: Tensor = torch.fft.irfft(whole, n=self.samples, dim=1)
        return found
