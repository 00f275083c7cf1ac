"""Forces of laws along the motion of windows, at the samples, and their sensitivities.

Deflections and rates are interpolated by Hermite polynomials on a grid `OVERSAMPLING` times finer; forces pass an
anti-alias filter and are decimated to the samples.  Slopes by the motion are local means with the weights of linear
interpolation between samples.  The motion that the forces cause above half the sample rate is added to the rates
(`add_motion_between_samples`).  The one state z of a law with memory is propagated from sample to sample by

    dz_{k+1} = keep_k dz_k + by_d0_k dd_k + by_d1_k dd_{k+1} + by_v0_k dv_k + by_v1_k dv_{k+1}.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.interpolate import CubicSpline

from sprung.model.laws import ElementLaw, Motion, SpringDamper
from sprung.model.laws.placed import PlacedLaw
from sprung.model.laws.trajectory import phi, recall
from sprung.model.signal_filters import firwin
from sprung.model.signals import FloatArray

OVERSAMPLING = 16  # steps per sample of laws without memory
_OVERSAMPLING_MEMORY = (
    4  # of those with, whose steps are of fourth order; with 2, hysteresis that yields within a step is off
)
_NODES = 4  # samples of each interpolating polynomial
_REACH = 8  # samples of the filter to each side
_SLOPE_STEP = 1e-4  # of the rms motion: step of the difference quotients by the motion
_VALUE_STEP = 1e-3  # of a value's logarithm: step of the difference quotients by values
_At = tuple[list[FloatArray], SpringDamper]  # values of a law and its element


@dataclass(frozen=True, slots=True)
class ActiveLaw:
    """One placed law that windows are identified with."""

    placed: PlacedLaw
    law: ElementLaw
    weights: FloatArray  # over the elements, (E,)
    element: int  # index of the element whose stiffness and damping enter the law
    free: tuple[int, ...]  # parameters that are estimated


@dataclass(frozen=True, slots=True)
class Slopes:
    """Derivatives of one law's force, (B, T), and of its memory over a sample, (B, T-1); zeros without memory."""

    by_deflection: FloatArray
    by_rate: FloatArray
    by_memory: FloatArray
    keep: FloatArray
    by_d0: FloatArray
    by_d1: FloatArray
    by_v0: FloatArray
    by_v1: FloatArray
    memory_size: FloatArray  # rms of the memory over a window, (B,)


class LawAlongMotion:
    """One law along the motion of B windows of T samples."""

    def __init__(self, law: ElementLaw, deflection: FloatArray, rate: FloatArray, sample_rate: float) -> None:
        """deflection, rate: (B, T)."""
        self.law, self.parts = law, _OVERSAMPLING_MEMORY if law.memory else OVERSAMPLING
        self.samples, self.step = deflection.shape[1], 1 / (sample_rate * self.parts)
        self.d, change = _hermite(deflection, rate / sample_rate, self.parts)
        self.v = change * sample_rate
        self.time: FloatArray = np.arange(self.d.shape[1], dtype=np.float64) * self.step
        self.size_d = np.sqrt(np.mean(deflection**2, axis=1, keepdims=True)) + 1e-12
        self.size_v = np.sqrt(np.mean(rate**2, axis=1, keepdims=True)) + 1e-12
        self._last: tuple[bytes, FloatArray] | None = None

    def memory(self, p: Sequence[FloatArray], element: SpringDamper, first: FloatArray) -> FloatArray:
        """The law's state on the fine grid, (1, ..., fine), from `first` (...,); values broadcast with (..., 1)."""
        key = b"".join(np.asarray(part).tobytes() for part in (*p, *element, first))
        if self._last is None or self._last[0] != key:  # force and slopes are asked for at one point
            memory = recall(self.law, p, self.d, self.v, time=self.time, element=element, first=first[None])
            self._last = key, memory
        return self._last[1]

    def fine(self, p: Sequence[FloatArray], element: SpringDamper, first: FloatArray) -> FloatArray:
        """The force on the fine grid, (..., B, fine)."""
        memory = self.memory(p, element, first) if self.law.memory else ()
        return np.asarray(self.law.force(Motion(self.d, self.v, 0.0, memory), p, element), dtype=np.float64)

    def force(self, p: Sequence[FloatArray], element: SpringDamper, first: FloatArray) -> FloatArray:
        """The force at the samples, (..., B, T)."""
        return band_limited(self.fine(p, element, first), self.parts)

    def impulse_between_samples(self, p: Sequence[FloatArray], element: SpringDamper, first: FloatArray) -> FloatArray:
        """Impulse of the force less its interpolation from the samples, N s, (B, fine)."""
        return _between_samples(np.broadcast_to(self.fine(p, element, first), self.d.shape), self.step, self.parts)

    def value_sensitivities(
        self, p: FloatArray, free: Sequence[int], element: SpringDamper, first: FloatArray
    ) -> FloatArray:
        """Derivatives of the force by the logarithms of the free values, then of stiffness and damping, (X, B, T).

        p: (B, values); stiffness, damping and first: (B,).
        """
        values, whole = list(p.T[:, :, None]), SpringDamper(*(np.asarray(x)[:, None] for x in element))
        memory = self.memory(values, whole, first) if self.law.memory else np.zeros((0, *self.d.shape))
        motion = Motion(self.d, self.v, 0.0, memory)
        around = [_perturbed(values, whole, i) for i in (*free, *range(len(values), len(values) + 2))]
        found = np.stack([self._difference(self.law.force, motion, *pair) for pair in around])
        if self.law.memory:
            rates = np.stack([self._difference(self.law.memory_rate, motion, *pair) for pair in around])
            if rates.any():
                step = _memory_step(memory)
                force, rate = (
                    self._slope(of, "z", step, motion, values, whole) for of in (self.law.force, self.law.memory_rate)
                )
                found += force * self._memory_sensitivity(rates, rate)
        return band_limited(found, self.parts)

    def _difference(self, function: Callable[..., Any], motion: Motion, up: _At, down: _At) -> FloatArray:
        """Central difference quotient, (B, fine)."""
        found = np.asarray(function(motion, *up) - function(motion, *down), dtype=np.float64) / (2 * _VALUE_STEP)
        return np.broadcast_to(found.reshape(found.shape[-2:]) if found.ndim > 2 else found, self.d.shape)

    def _slope(
        self,
        function: Callable[..., Any],
        of: str,
        step: FloatArray,
        motion: Motion,
        p: Sequence[FloatArray],
        element: SpringDamper,
    ) -> FloatArray:
        """Derivative of a function of the motion by deflection "d", rate "v" or memory "z", (B, fine)."""
        d, v, time, memory = motion
        up, down = (
            np.asarray(
                function(
                    Motion(
                        d + sign * step if of == "d" else d,
                        v + sign * step if of == "v" else v,
                        time,
                        memory + sign * step if of == "z" else memory,
                    ),
                    p,
                    element,
                )
            )
            for sign in (1.0, -1.0)
        )
        found = np.asarray((up - down) / (2 * step), dtype=np.float64)
        return np.broadcast_to(found.reshape(found.shape[-2:]), self.d.shape)

    def _memory_sensitivity(self, rates: FloatArray, by_z: FloatArray) -> FloatArray:
        """Variation of the memory (X, B, fine) for variations of its rate at constant memory; by_z: (B, fine)."""
        keep, mean, *_ = phi(np.clip(self.step * 0.5 * (by_z[:, 1:] + by_z[:, :-1]), -700.0, 0.0).T)
        added = mean[:, None] * np.moveaxis(self.step * 0.5 * (rates[..., 1:] + rates[..., :-1]), -1, 0)
        found = np.zeros((rates.shape[-1], *rates.shape[:-1]))
        for i, (kept, more) in enumerate(zip(keep, added, strict=True)):
            found[i + 1] = kept * found[i] + more
        return np.moveaxis(found, 0, -1)

    def slopes(self, p: Sequence[FloatArray], element: SpringDamper, first: FloatArray) -> Slopes:
        """Derivatives by the motion; values and element (B, 1)."""
        law, memory = self.law, self.memory(p, element, first) if self.law.memory else np.zeros((0, *self.d.shape))
        steps = {"d": _SLOPE_STEP * self.size_d, "v": _SLOPE_STEP * self.size_v}
        if law.memory:
            steps["z"] = _memory_step(memory)

        motion = Motion(self.d, self.v, 0.0, memory)

        def slope(of: str, function: Callable[..., Any]) -> FloatArray:
            return self._slope(function, of, steps[of], motion, p, element)

        by_d, by_v = (self._local_mean(slope(of, law.force)) for of in "dv")
        zero = np.zeros((len(self.d), self.samples - 1))
        if not law.memory:
            return Slopes(by_d, by_v, np.zeros_like(by_d), zero, zero, zero, zero, zero, zero[:, 0])
        by_z = self._local_mean(slope("z", law.force))
        carried = self._memory_transition(*(slope(of, law.memory_rate) for of in "zdv"))
        return Slopes(by_d, by_v, by_z, *carried, steps["z"][:, 0] / _SLOPE_STEP)

    def _local_mean(self, fine: FloatArray) -> FloatArray:
        """Local means (B, T) with triangular weights that reach to the neighbouring samples."""
        M = self.parts
        part = (np.arange(M) + 0.5) / M
        middle = 0.5 * (fine[:, 1:] + fine[:, :-1]).reshape(len(fine), self.samples - 1, M)
        found = np.zeros((len(fine), self.samples))
        weight = np.zeros(self.samples)
        found[:, :-1] += middle @ (1 - part)
        found[:, 1:] += middle @ part
        weight[:-1] += (1 - part).sum()
        weight[1:] += part.sum()
        return found / weight

    def _memory_transition(
        self, by_z: FloatArray, by_d: FloatArray, by_v: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Transition of the memory over one sample, from the derivatives of its rate on the fine grid."""
        M = self.parts
        z, d, v = (0.5 * (x[:, 1:] + x[:, :-1]).reshape(len(x), self.samples - 1, M) for x in (by_z, by_d, by_v))
        keep = np.ones(z.shape[:2])
        found = np.zeros((4, *keep.shape))
        for j in reversed(range(M)):
            half = np.exp(np.clip(0.5 * self.step * z[:, :, j], -50.0, 0.0))
            late = (j + 0.5) / M
            for i, (rate, share) in enumerate(((d, 1 - late), (d, late), (v, 1 - late), (v, late))):
                found[i] += keep * half * self.step * rate[:, :, j] * share
            keep = keep * half**2
        return keep, *found


def add_motion_between_samples(
    along: Sequence[LawAlongMotion], at: Sequence[tuple[Any, ...]], mobility: FloatArray
) -> None:
    """Add to the motion of laws the part that their own forces cause above half the sample rate.

    Samples do not resolve it, but friction depends on it while its force changes sign within less than a sample: the
    reaction of the bodies rounds the corner.  Springs and dampers are negligible beside the inertia at these
    frequencies, and so is the effect of the added motion on the forces.  at: values, element and first memory of each
    law; mobility: accelerations of the sites by forces at them, 1/kg, (B, L, L).
    """
    impulses = np.stack(
        [path.impulse_between_samples(*given) for path, given in zip(along, at, strict=True)]
    )  # (L, B, fine)
    for path, added in zip(along, np.einsum("bml,lbt->mbt", mobility, impulses), strict=True):
        path.v = path.v - added
        path.d = path.d - _between_samples(added, path.step, path.parts)


def _perturbed(p: Sequence[FloatArray], element: SpringDamper, at: int) -> tuple[_At, _At]:
    """Values of a law and its element with number `at` (values, stiffness, damping) one step up and down."""
    found = []
    for factor in (np.exp(_VALUE_STEP), np.exp(-_VALUE_STEP)):
        values = [value * factor if i == at else value for i, value in enumerate((*p, *element))]
        found.append((values[: len(p)], SpringDamper(*values[len(p) :])))
    return found[0], found[1]


def _memory_step(memory: FloatArray) -> FloatArray:
    """Step of the difference quotients by a memory (1, B, fine), (B, 1)."""
    found: FloatArray = _SLOPE_STEP * (np.sqrt(np.mean(memory[0] ** 2, axis=1, keepdims=True)) + 1e-12)
    return found


@lru_cache(maxsize=8)
def spline_slopes(samples: int) -> FloatArray:
    """Matrix (T, T) from samples to the derivatives, per sample, of the cubic spline through them."""
    time = np.arange(samples)
    matrix = np.asarray(CubicSpline(time, np.eye(samples))(time, 1))
    matrix.setflags(write=False)
    return matrix


@lru_cache(maxsize=8)
def spline_compensation(samples: int) -> FloatArray:
    """Matrix (T, T) that compensates the attenuation of a force by cubic spline interpolation.

    Of a tone at the share f of the sample rate a spline keeps sinc(f)^4 / sum over k of sinc(f - k)^4, and the images
    f - k are added; the resulting motion, which falls with 1/f^2, is 0.4 % too small at f = 0.2 and 3 % at 0.3.  Fourth
    and sixth differences, fitted up to 0.35, compensate that; the three samples at either end are left unchanged.
    """
    f = np.linspace(0.05, 0.35, 31)
    k = np.arange(-6, 7)[:, None]
    images = np.sinc(f - k) ** 4
    answered = (images / (f - k) ** 2).sum(axis=0) * f**2 / images.sum(axis=0)
    twice = 2 - 2 * np.cos(2 * np.pi * f)
    gains = np.linalg.lstsq(np.stack([twice**2, twice**3], axis=1), 1 / answered - 1, rcond=None)[0]
    second = np.array([-1.0, 2.0, -1.0])
    fourth = np.convolve(second, second)
    taps = gains[0] * np.pad(fourth, 1) + gains[1] * np.convolve(fourth, second)
    matrix = np.eye(samples)
    for row in range(3, samples - 3):
        matrix[row, row - 3 : row + 4] += taps
    matrix.setflags(write=False)
    return matrix


@lru_cache(maxsize=8)
def _weights(parts: int, before: int) -> tuple[FloatArray, FloatArray]:
    """Weights of Hermite interpolation through `_NODES` values and derivatives per sample, for values and derivatives
    on the fine grid after node `before`, each (2 nodes, parts)."""
    nodes, power = np.arange(_NODES) - (_NODES - 1) / 2, np.arange(2 * _NODES)
    lower = power * 1.0, np.maximum(power - 1, 0)
    given = np.vstack([nodes[:, None] ** power, lower[0] * nodes[:, None] ** lower[1]])
    at = (np.arange(parts) / parts + before + nodes[0])[:, None]
    inverse = np.linalg.inv(given)
    return (at**power @ inverse).T, (lower[0] * at ** lower[1] @ inverse).T


def _hermite(value: FloatArray, slope: FloatArray, parts: int) -> tuple[FloatArray, FloatArray]:
    """Values and derivatives per sample (B, T) interpolated on the fine grid, each (B, (T-1) parts + 1).

    Knowing both is worth twice the sample rate: motions at 0.4 of the sample rate are followed to one per cent, where
    cubics through the rate alone err by a third.
    """
    samples = value.shape[1]
    known = np.concatenate([sliding_window_view(x, _NODES, axis=1) for x in (value, slope)], axis=2)  # (B, T-3, 8)
    middle = _NODES // 2 - 1
    spans = [(slice(0, 1), k) for k in range(middle)] + [(slice(None), middle)]
    spans += [(slice(-1, None), k) for k in range(middle + 1, _NODES - 1)]
    found = []
    for which, last in ((0, value), (1, slope)):
        pieces = [known[:, at] @ _weights(parts, before)[which] for at, before in spans]
        inner = np.concatenate(pieces, axis=1).reshape(len(value), (samples - 1) * parts)
        found.append(np.concatenate([inner, last[:, -1:]], axis=1))
    return found[0], found[1]


def _between_samples(rate: FloatArray, step: float, parts: int) -> FloatArray:
    """Integral over time of `rate` less its interpolation from the samples, (B, fine)."""
    whole = np.zeros(rate.shape)
    np.cumsum(0.5 * step * (rate[:, 1:] + rate[:, :-1]), axis=1, out=whole[:, 1:])
    shown, per_sample = (band_limited(x, parts) for x in (whole, rate * step * parts))
    return whole - _hermite(shown, per_sample, parts)[0]


@lru_cache(maxsize=4)
def _low_pass(parts: int) -> tuple[FloatArray, float]:
    """Taps of a filter at half the sample rate, on a grid `parts` times finer: (parts, samples), and the last one."""
    taps = np.asarray(firwin(2 * _REACH * parts + 1, 1 / parts, window=("kaiser", 6.0)))
    return taps[:-1].reshape(2 * _REACH, parts).T.copy(), float(taps[-1])


def band_limited(fine: FloatArray, parts: int) -> FloatArray:
    """Signals (..., fine grid) low-passed at half the sample rate, at the samples (..., T).

    The contributions of the fine grid between two samples to all samples around it are one matrix product.
    """
    reach, samples = _REACH * parts, (fine.shape[-1] - 1) // parts + 1
    padded = np.concatenate(
        [2 * fine[..., :1] - fine[..., reach:0:-1], fine, 2 * fine[..., -1:] - fine[..., -2 : -reach - 2 : -1]], -1
    )
    by_stretch, last = _low_pass(parts)
    stretches = padded[..., : (samples + 2 * _REACH - 1) * parts].reshape(*fine.shape[:-1], -1, parts) @ by_stretch
    shown: FloatArray = last * padded[..., 2 * reach :: parts][..., :samples]
    for k in range(2 * _REACH):
        shown += stretches[..., k : k + samples, k]
    return shown
