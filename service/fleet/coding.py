"""Compact encoding of estimates; `service.fleet.message` defines their contents.

Everything is rounded in units of its own uncertainty, so that what rounding adds is known beforehand.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sprung.model.signals import FloatArray

Ints = NDArray[np.int64]
LOG_STEP = 1 / 64  # of the logarithm of a scale: 1.6 %
PARTIAL_STEP = 1 / 16  # of atanh(partial correlation)
MOST_PARTIAL = 5.0  # atanh(0.9999)


def pack_ints(values: Ints) -> list[Any]:
    """Whole numbers of shape (n, ...), as differences along n, byte planes apart: small numbers become runs of 0."""
    steps = np.diff(values, axis=0, prepend=np.zeros_like(values[:1]))
    zigzag = (steps << 1) ^ (steps >> 63)
    width = max(1, (int(zigzag.max(initial=0)).bit_length() + 7) // 8)
    planes = zigzag.astype("<u8").reshape(-1).view(np.uint8).reshape(-1, 8).T[:width]
    return [list(values.shape), np.ascontiguousarray(planes).tobytes()]


def unpack_ints(data: list[Any]) -> Ints:
    """The inverse of `pack_ints`."""
    shape, planes = data
    count = int(np.prod(shape))
    if not count:
        return np.zeros(shape, dtype=np.int64)
    found = np.zeros((8, count), dtype=np.uint8)
    given = np.frombuffer(planes, np.uint8).reshape(-1, count)
    found[: len(given)] = given
    zigzag = np.ascontiguousarray(found.T).view("<u8").reshape(shape).astype(np.uint64)
    steps = (zigzag >> np.uint64(1)).astype(np.int64) ^ -(zigzag & np.uint64(1)).astype(np.int64)
    return np.cumsum(steps, axis=0)


def pack_floats(values: FloatArray) -> list[Any]:
    """Float64 of any shape as they are."""
    return [list(values.shape), np.ascontiguousarray(values, dtype="<f8").tobytes()]


def unpack_floats(data: list[Any]) -> FloatArray:
    """The inverse of `pack_floats`, of the same shape."""
    shape, content = data
    return np.frombuffer(content, "<f8").reshape(shape).astype(np.float64)


def log_steps(values: FloatArray) -> Ints:
    """Positive numbers (...) in steps of 1.6 % (...); 0 and NaN have numbers of their own."""
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.round(np.log(values) / LOG_STEP)
    finite = np.clip(np.nan_to_num(steps, posinf=9000.0), -9000, 9000)
    return np.where(values == 0, 9999, np.where(np.isnan(values), 9998, finite)).astype(np.int64)


def from_log_steps(steps: Ints) -> FloatArray:
    """The inverse of `log_steps`, elementwise."""
    found = np.exp(np.minimum(steps, 9000) * LOG_STEP)
    return np.where(steps == 9999, 0.0, np.where(steps == 9998, np.nan, found))


def pack_spd(matrices: FloatArray) -> list[Any]:
    """Symmetric positive semi-definite matrices, shape (n, k, k), as scales and partial correlations."""
    scale = np.sqrt(np.maximum(np.diagonal(matrices, axis1=1, axis2=2), 0.0))
    rounded = from_log_steps(log_steps(scale))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = matrices / (scale[:, :, None] * scale[:, None, :])
    partial = np.array([_partials(one) for one in correlation]).reshape(len(matrices), -1)
    steps = np.round(np.clip(np.arctanh(partial), -MOST_PARTIAL, MOST_PARTIAL) / PARTIAL_STEP).astype(np.int64)
    return [matrices.shape[1], pack_ints(log_steps(rounded)), pack_ints(steps)]


def unpack_spd(data: list[Any]) -> FloatArray:
    """The inverse of `pack_spd`, shape (n, k, k): positive definite wherever its scale is not 0."""
    size, packed_scale, packed_steps = data
    scale = from_log_steps(unpack_ints(packed_scale))
    partial = np.tanh(unpack_ints(packed_steps) * PARTIAL_STEP)
    correlation = np.array([_from_partials(one, size) for one in partial]).reshape(-1, size, size)
    return correlation * scale[:, :, None] * scale[:, None, :]


def _partials(correlation: FloatArray) -> FloatArray:
    """Of parameter i with j < i, given those before j: rows of the Cholesky factor over what is left of them."""
    clean = np.where(np.isfinite(correlation), correlation, 0.0)
    np.fill_diagonal(clean, 1.0 + 1e-7)  # semi-definite ones, too
    try:
        factor = np.linalg.cholesky(clean)
    except np.linalg.LinAlgError:  # not positive semi-definite, by rounding: the nearest that is
        value, vector = np.linalg.eigh(clean)
        clean = (vector * np.maximum(value, 1e-6)) @ vector.T
        scale = np.sqrt(np.diag(clean))
        factor = np.linalg.cholesky(clean / np.outer(scale, scale))
    left = 1.0 - np.cumsum(factor**2, axis=1) + factor**2  # 1 - sum of squares before column j
    with np.errstate(divide="ignore", invalid="ignore"):
        partial = factor / np.sqrt(np.maximum(left, 1e-12))
    rows, columns = np.tril_indices(len(clean), -1)
    return np.clip(partial[rows, columns], -0.99999, 0.99999)


def _from_partials(partial: FloatArray, size: int) -> FloatArray:
    rows, columns = np.tril_indices(size, -1)
    given = np.zeros((size, size))
    given[rows, columns] = partial
    left = np.cumprod(np.concatenate([np.ones((size, 1)), 1.0 - given**2], axis=1), axis=1)[:, :-1]
    factor = given * np.sqrt(left)
    factor[np.arange(size), np.arange(size)] = np.sqrt(np.diagonal(left))
    return factor @ factor.T
