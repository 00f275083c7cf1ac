"""Posteriors over encoded states: Gaussian for translations, von Mises for angles, with pathwise sampling.

Gaussian, prior N(0, 1):        KL = (mu^2 + sigma^2 - 1) / 2 - log sigma
von Mises, prior vM(0, 1):      KL = A(k) (k - cos mu) - log I0(k) + log I0(1),   A(k) = I1(k) / I0(k)

A von Mises draw is mu + delta(k).  The dependence of delta on k has no closed form; its gradient comes from implicit
differentiation of the distribution function F(delta; k) (Figurnov, Mohamed, Mnih 2018):

    d delta / d k = -(dF / dk) / f(delta),   dF / dk = integral from 0 to delta of (cos t - A(k)) f(t) dt
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

_NODES, _WEIGHTS = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(24))
MAX_CONCENTRATION = 1e4  # a draw 0.01 rad wide; keeps exp(k) scaled functions accurate


class DivergedTraining(ValueError):
    """Weights that are no numbers any more; one line."""


def gaussian_sample(mean: Tensor, log_std: Tensor) -> Tensor:
    """Reparameterised draw of N(mean, exp(log_std)^2), any shape."""
    return mean + torch.exp(log_std) * torch.randn_like(mean)


def gaussian_divergence(mean: Tensor, log_std: Tensor) -> Tensor:
    """KL to the unit Gaussian, elementwise; both of one shape (...)."""
    return 0.5 * (mean.square() + torch.exp(2 * log_std) - 1) - log_std


def bessel_ratio(concentration: Tensor) -> Tensor:
    """A(k) = I1(k) / I0(k), the mean of cos delta, elementwise."""
    return torch.special.i1e(concentration) / torch.special.i0e(concentration)


def log_bessel(concentration: Tensor) -> Tensor:
    """log I0(k) without overflow, elementwise."""
    return torch.log(torch.special.i0e(concentration)) + concentration


def von_mises_divergence(angle: Tensor, concentration: Tensor) -> Tensor:
    """KL of vM(angle, concentration) to vM(0, 1), elementwise."""
    one = torch.ones((), dtype=concentration.dtype, device=concentration.device)
    ratio = bessel_ratio(concentration)
    return ratio * (concentration - torch.cos(angle)) - log_bessel(concentration) + log_bessel(one)


def von_mises_sample(angle: Tensor, concentration: Tensor) -> Tensor:
    """Reparameterised draw of vM(angle, concentration), any shape; gradients reach both arguments."""
    return angle + _Deviation.apply(concentration)  # type: ignore[no-untyped-call]  # torch's `apply`


class _Deviation(torch.autograd.Function):
    """A draw of vM(0, k) by Best and Fisher's rejection (1979), differentiable in k."""

    @staticmethod
    def forward(ctx, concentration: Tensor) -> Tensor:  # type: ignore[no-untyped-def]  # a context of torch's
        draw = _best_fisher(concentration.double())
        ctx.save_for_backward(concentration, draw)
        return draw.to(concentration.dtype)

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:  # type: ignore[no-untyped-def]  # a context of torch's
        concentration, draw = ctx.saved_tensors
        k = concentration.double()
        half = (draw / 2)[..., None]
        t = half * (1 + _NODES.to(draw.device))
        # f(t) / f(delta): the normalisation and the overflow cancel
        density = torch.exp(k[..., None] * (torch.cos(t) - torch.cos(draw)[..., None]))
        integrand = (torch.cos(t) - bessel_ratio(k)[..., None]) * density
        slope = -(half[..., 0] * (integrand * _WEIGHTS.to(draw.device)).sum(-1))
        return (grad.double() * slope).to(grad.dtype)


def _best_fisher(concentration: Tensor) -> Tensor:
    """Draws of vM(0, k), float64, by rejection from a wrapped Cauchy envelope.  Errors: `DivergedTraining`."""
    if not bool(torch.isfinite(concentration).all()):  # of which no draw would ever be accepted
        raise DivergedTraining("a posterior is no number any more: the training has diverged; lower its rates")
    k = concentration.clamp(1e-4, MAX_CONCENTRATION)
    tau = 1 + torch.sqrt(1 + 4 * k * k)
    rho = (tau - torch.sqrt(2 * tau)) / (2 * k)
    r = (1 + rho * rho) / (2 * rho)
    draw = torch.zeros_like(k)
    open_ = torch.ones_like(k, dtype=torch.bool)
    while bool(open_.any()):
        u1, u2, u3 = torch.rand(3, *k.shape, dtype=k.dtype, device=k.device)
        z = torch.cos(torch.pi * u1)
        f = ((1 + r * z) / (r + z)).clamp(-1, 1)
        c = k * (r - f)
        accept = (c * (2 - c) > u2) | (torch.log(c / u2) + 1 - c >= 0)
        angle = torch.sign(u3 - 0.5) * torch.acos(f)
        draw = torch.where(open_ & accept, angle, draw)
        open_ = open_ & ~accept
    return draw
