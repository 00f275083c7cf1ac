"""Weights of windows over frequency: covariances in closed form, lost drives, and spectra within the band."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sprung.model.identification.likelihood.band import ComparedBand
from sprung.model.identification.likelihood.noise import WindowNoise

B, F, R, D = 2, 5, 3, 2


def noise(*lost: bool) -> WindowNoise:
    """Two drives over five bins."""
    sizes = 0.5 + torch.rand(F, D, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    return WindowNoise(sizes, torch.tensor(lost), torch.linspace(0.5, 1.0, F, dtype=torch.float64))


def response() -> Tensor:
    """Of three signals to the drives."""
    return torch.randn(B, F, R, D, dtype=torch.complex128, generator=torch.Generator().manual_seed(2))


def test_whitened_signals_have_the_weight_of_their_bin_and_no_correlation() -> None:
    own = noise(False, False)
    carried = own.carried(response())
    covariance = torch.eye(R) + carried @ carried.mH
    whiten = own.whitening(carried)
    expected = own.weight[:, None, None] ** 2 * torch.eye(R)
    assert torch.allclose(whiten @ covariance @ whiten.mH, expected.to(whiten.dtype), atol=1e-12)


def test_nothing_that_a_lost_drive_brings_is_left_and_all_else_is() -> None:
    own = noise(True, False)
    carried = own.carried(response())
    whiten = own.whitening(carried)
    assert own.lost == 1 and own.instruments[:, 0].abs().max() == 0 < own.instruments[:, 1].min()
    assert (whiten @ carried[..., :1]).abs().max() < 1e-12
    assert torch.linalg.matrix_rank(whiten).tolist() == [[R - 1] * F] * B


def test_noise_of_the_drives_is_estimated_as_the_smoother_does() -> None:
    """S G^H (I + G S G^H)^-1 r, by the matrices themselves."""
    own, drive = noise(False, False), response()
    carried = own.carried(drive)
    residual = torch.randn(B, F, R, 1, dtype=torch.complex128, generator=torch.Generator().manual_seed(3))
    whiten = own.whitening(carried)
    found = own.estimated(whiten, carried, whiten @ residual)
    covariance = torch.eye(R) + carried @ carried.mH
    wanted = (own.drives**2)[:, :, None] * (drive.mH @ torch.linalg.solve(covariance, residual))
    assert torch.allclose(found, wanted.squeeze(3), atol=1e-12)


def test_a_lost_drive_is_believed_little() -> None:
    which, share = noise(False, True).believed(torch.complex128)
    assert which.real.tolist() == [[0.0, 1.0]] * F
    assert bool((share[:, 0] == 1.0).all()) and bool((share[:, 1] < 0.1).all())


def test_spectra_within_the_band_and_back_are_the_signal_without_its_mean() -> None:
    band = ComparedBand(100, 20, torch.complex128)
    time = torch.arange(100, dtype=torch.float64) / 100
    inside, outside = torch.sin(2 * math.pi * 7 * time), torch.sin(2 * math.pi * 33 * time)
    back = band.signals(band.spectra((3.0 + inside + outside)[None, :, None]))
    assert torch.allclose(back[0, :, 0], inside, atol=1e-12)
    assert band.spectra(torch.zeros(2, 100, 0)).shape == (2, 20, 0)


def test_white_noise_has_weighted_spectra_of_unit_size() -> None:
    band = ComparedBand(200, 60, torch.complex128)
    white = torch.randn(400, 200, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    weighted = band.weight[:, None] * band.spectra(white)
    parts = torch.view_as_real(weighted)
    assert float(parts.square().mean()) == pytest.approx(1.0, abs=0.02)
