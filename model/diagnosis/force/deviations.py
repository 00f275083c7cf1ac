"""Uncertainty of the values of a fitted component, estimated from the record itself.

Random errors: errors that repeat with every cycle of a test do not average out, so the covariance is the sandwich

    (J^T J)^-1  [sum over bins of J_f^H J_f |r_f|^2]  (J^T J)^-1

with the residual's raw periodogram |r_f|^2 (White 1980, in the frequency domain), which counts errors at the test
frequency in full; at least as large as for white noise of the residual's level, and as the same sum over segments of
time, since loud segments dominate both estimates and errors.

Systematic errors (`left_open`) are estimated by perturbation: noise and sampling of the motion, the held-out part of
the record, a discrepancy force as large as the residual, a delay of the force channel, and look-alike laws.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.force.fit import ComponentFit, ComponentModel, refined
from sprung.model.diagnosis.force.lag import LAGS, Lag
from sprung.model.diagnosis.force.slider_surface import SURFACE
from sprung.model.laws import SpringDamper
from sprung.model.signals import FloatArray

_RELATIVE = 1e-4  # steps of finite differences
_SEEN = 1e-3  # of a column's norm, below which it is unobservable beside the laws
_SETTLED = 1e-10  # of the largest singular value, below which directions are unobservable


def covariance(fit: ComponentFit) -> tuple[FloatArray, list[str]]:
    """Random part of the covariance of preload, k, c (where free), strengths and shapes; names of the first ones."""
    task = fit.task
    jacobian, names = _jacobian(fit)
    train = slice(0, task.split)
    scale, inverse = _normal(jacobian[train])
    scaled, residual = jacobian[train] / scale, fit.residual[train]
    power = 2 * np.abs(np.fft.rfft(residual, norm="ortho")) ** 2
    of_bins = np.fft.rfft(scaled, axis=0, norm="ortho")
    sandwich = inverse @ np.real((of_bins.conj() * power[:, None]).T @ of_bins) @ inverse
    white = inverse * float(residual @ residual) / max(1, len(residual) - scaled.shape[1])
    score = scaled * residual[:, None]
    parts = np.array([part.sum(axis=0) for part in np.array_split(score, task.rules.stretches)])
    stretches = inverse @ (parts.T @ parts) @ inverse
    least = np.maximum(np.diag(white), np.diag(stretches))
    grow = np.sqrt(np.maximum(least / np.maximum(np.diag(sandwich), 1e-300), 1.0))
    full = sandwich * np.outer(grow, grow) / np.outer(scale, scale)
    return full + np.diag(np.where(np.any(scaled, axis=0), 0.0, _sought(fit) ** 2)), names


def _sought(fit: ComponentFit) -> FloatArray:
    """Prior widths: the search range of every shape, 0 for other values."""
    limits = [limit for piece in fit.model.pieces for limit in piece.limits(fit.task.seen)]
    linear = int(fit.task.linear[1].sum()) + len(fit.strengths)
    return np.concatenate([np.zeros(linear), [high - low for low, high in limits]])


def _normal(jacobian: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Norms of a Jacobian's columns, and (J^T J)^-1 of the normalised columns."""
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0] = 1.0
    unit = jacobian / scale
    return scale, np.asarray(np.linalg.pinv(unit.T @ unit, rcond=_SETTLED, hermitian=True))


def _jacobian(fit: ComponentFit) -> tuple[FloatArray, list[str]]:
    """Derivatives of the modelled force by all fitted values, (T, P), and the names of the first ones."""
    task, model = fit.task, fit.model
    shown, moved = task.through(model.channel), []
    base, free, _ = shown.linear
    for i, (piece, shape) in enumerate(zip(model.pieces, model.shapes, strict=True)):
        for j in range(len(shape)):
            step = _RELATIVE * max(abs(shape[j]), 1e-12) * 10
            if isinstance(piece, Lag):
                moved.append(_per_lag(fit, piece, shape))
                continue
            other = tuple(s + step * (k == j) for k, s in enumerate(shape))
            change = (shown.columns_of(piece, other) - shown.columns_of(piece, shape)) @ fit.strengths_of(i)
            moved.append(change / step)
    names = [name for name, is_free in zip(("preload", "stiffness", "damping"), free, strict=True) if is_free]
    return np.column_stack([base, model.columns(task), *moved]), names


def left_open(fit: ComponentFit, alike: Sequence[FloatArray] = ()) -> FloatArray:
    """Systematic part of the covariance (K, K), in the order of `covariance`.

    alike: changes of the values with look-alike laws (`moved_in_common`).
    """
    jacobian, _ = _jacobian(fit)
    moved = [*_by_motion(fit), _by_the_rest(fit, jacobian), *alike]
    found: FloatArray = sum(
        (np.outer(change, change) for change in moved if np.all(np.isfinite(change))),
        np.zeros((jacobian.shape[1],) * 2),
    )
    return found + _by_what_is_left(fit, jacobian) + _by_delay(fit, jacobian)


def _by_motion(fit: ComponentFit) -> Iterator[FloatArray]:
    """Changes by noise and sampling of the motion, which both bias fits along a measured motion.

    Adding noise of the same level changes the values about as much as the noise present (simulation-extrapolation,
    Cook and Stefanski 1994); halving the sample rate at least as much as the sampling.
    """
    task = fit.task
    half = task.every(2)
    others = [replace(task, motion=task.motion.noisier()), replace(half, motion=half.motion.undersampled())]
    for other in others:
        yield _numbers(refined(other, fit.model)) - _numbers(fit)


def _by_the_rest(fit: ComponentFit, jacobian: FloatArray) -> FloatArray:
    """Changes by a Gauss-Newton step on the whole record, whose held-out part has other amplitudes and rates."""
    scale, inverse = _normal(jacobian)
    rest = slice(fit.task.split, None)
    return np.asarray(inverse @ ((jacobian[rest] / scale).T @ fit.residual[rest]) / scale)


def _by_what_is_left(fit: ComponentFit, jacobian: FloatArray) -> FloatArray:
    """Covariance (P, P) due to a discrepancy force as large as the residual beyond noise (Kennedy and O'Hagan 2001).

    The discrepancy is a function of deflection, rate and memory with random amplitudes.  The laws absorb part of it;
    the variance of the amplitudes explains the rest, which is observable.
    """
    columns = fit.task.through(fit.model.channel).columns_of(SURFACE, ())
    columns = columns / np.maximum(np.sqrt(np.mean(columns**2, axis=0)), 1e-300)
    scale, inverse = _normal(jacobian)
    taken = inverse @ ((jacobian / scale).T @ columns)
    seen = columns - jacobian / scale @ taken
    basis, sizes, _ = np.linalg.svd(seen, full_matrices=False)
    basis = basis[:, sizes > _SEEN * np.sqrt(len(seen))]
    inside, whole = float(np.sum((basis.T @ fit.residual) ** 2)), float(fit.residual @ fit.residual)
    chance = (
        basis.shape[1] * (whole - inside) / max(1, len(seen) - basis.shape[1])
    )  # share of noise, which is isotropic
    power = max(inside - chance, 0.0) / max(float(np.sum(sizes**2)), 1e-300)
    moved = taken / scale[:, None]
    return np.asarray(power * moved @ moved.T)


def _by_delay(fit: ComponentFit, jacobian: FloatArray) -> FloatArray:
    """Covariance (P, P) due to an unmodelled delay of the force channel.

    Its standard deviation is that of the instruments, limited by what the residual allows; at a single frequency
    spring and damper absorb a delay completely.
    """
    task = fit.task
    if task.delay_std == 0.0 or any(isinstance(piece, Lag) for piece in fit.model.pieces):
        return np.zeros((jacobian.shape[1],) * 2)
    per_second = _per_lag(fit, LAGS[0], (0.0,))
    scale, inverse = _normal(jacobian)
    taken = inverse @ ((jacobian / scale).T @ per_second)
    seen = per_second - jacobian / scale @ taken
    passes = (task.rules.at_noise - 1) * float(np.mean(fit.residual**2))
    moved = taken / scale / np.sqrt(task.delay_std**-2 + float(np.mean(seen**2)) / max(passes, 1e-300))
    return np.outer(moved, moved)


def moved_in_common(other: ComponentFit, found: ComponentFit) -> FloatArray:
    """Changes (K,) of the values that both models share with another law in one place, ordered as `covariance`."""
    there, here = _in_common(other, found.model), _in_common(found, found.model)
    return np.where(there == 0.0, 0.0, there - here)


def _in_common(fit: ComponentFit, model: ComponentModel) -> FloatArray:
    """Values of a fit that it shares with another model; 0 for the others of that model."""
    strengths, shapes = [], []
    for index, (one, other) in enumerate(zip(fit.model.pieces, model.pieces, strict=True)):
        same = one.effect == other.effect
        own = fit.strengths_of(index).tolist() if same else []
        strengths += [value for value, _ in itertools.zip_longest(own[: len(other.signs)], other.signs, fillvalue=0.0)]
        named = dict(zip(one.shapes, fit.model.shapes[index], strict=True)) if same else {}
        shapes += [named.get(name, 0.0) for name in other.shapes]
    return np.concatenate([_linear(fit), strengths, shapes])


def _linear(fit: ComponentFit) -> FloatArray:
    """Preload, k and c, if free."""
    free: FloatArray = np.array([fit.preload, fit.element.stiffness, fit.element.damping])[fit.task.linear[1]]
    return free


def _numbers(fit: ComponentFit) -> FloatArray:
    """All fitted values, in the order of `covariance`."""
    return np.concatenate([_linear(fit), fit.strengths, *(np.array(shape, dtype=float) for shape in fit.model.shapes)])


def _per_lag(fit: ComponentFit, lag: Lag, shape: Sequence[float]) -> FloatArray:
    """Derivative of the modelled force by the lag's time, N/s, (T,)."""
    step = _RELATIVE * fit.task.motion.step

    def force(late: float) -> FloatArray:
        task = fit.task.through(lag.response((late,)))
        base, _, rest = task.linear
        pieces = zip(fit.model.pieces, fit.model.shapes, strict=True)
        found = [task.columns_of(piece, own) for piece, own in pieces]
        columns = np.column_stack([base, *found, np.zeros((len(rest), 0))])
        return np.asarray(columns @ np.concatenate([_linear(fit), fit.strengths]) - rest)

    return (force(shape[0] + step) - force(shape[0])) / step


def spread(fit: ComponentFit, index: int, full: FloatArray, names: list[str]) -> tuple[FloatArray, FloatArray]:
    """Standard deviations of a piece's law parameters (p,) and quoted values (q,), by linear propagation."""
    count = len(names)
    at = count + sum(len(p.signs) for p in fit.model.pieces[:index])
    own = list(range(at, at + len(fit.model.pieces[index].signs)))
    first = count + len(fit.strengths) + sum(len(p.shapes) for p in fit.model.pieces[:index])
    own += list(range(first, first + len(fit.model.pieces[index].shapes)))
    linear = [names.index(name) for name in ("stiffness", "damping") if name in names]
    block = full[np.ix_(own + linear, own + linear)]
    piece, shape, strengths = fit.model.pieces[index], fit.model.shapes[index], fit.strengths_of(index)
    start = np.concatenate([strengths, shape, [getattr(fit.element, names[i]) for i in linear]])

    def values(x: FloatArray, what: str) -> FloatArray:
        a, s = x[: len(strengths)], x[len(strengths) : len(strengths) + len(shape)]
        of = dict(zip([names[i] for i in linear], x[len(strengths) + len(shape) :], strict=True))
        element = SpringDamper(of.get("stiffness", fit.element.stiffness), of.get("damping", fit.element.damping))
        return np.array([value for value, _ in getattr(piece, what)(a, s, element).values()])

    result = []
    for what in ("values", "quoted"):
        centre = values(start, what)
        gradient = np.zeros((len(centre), len(start)))
        for j in range(len(start)):
            step = _RELATIVE * max(abs(start[j]), 1e-9)
            with np.errstate(over="ignore", invalid="ignore"):  # huge exponents have infinite deviations
                gradient[:, j] = (values(start + step * (np.arange(len(start)) == j), what) - centre) / step
        with np.errstate(over="ignore", invalid="ignore"):
            variance = np.diag(gradient @ block @ gradient.T) if len(centre) else centre
        result.append(np.sqrt(np.maximum(np.where(np.isfinite(variance), variance, np.inf), 0.0)))
    return result[0], result[1]
