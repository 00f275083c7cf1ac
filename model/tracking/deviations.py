"""Update of gains, delays and loads by a window, and a sequential test for jumps of one of them.

Mean and covariance of the deviations are part of the filter's belief (levels, rates, deviations).  `DeviationRecord`
holds the rest: mean sensitivities of the last windows, the deviations under which the baseline was learned, and the
statistics of the test.  The test uses only the information on deviations that remains after the parameters are profiled
out, so that a changed spring is not mistaken for a sensor fault.  H deviations, V directions (`deviation_model`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from sprung.model.signals import BoolArray, Deviating, FloatArray, IntArray
from sprung.model.tracking.deviation_model import DeviationModel
from sprung.model.tracking.filter import Belief

MEMORY = 0.3  # weight of the newest window in the mean sensitivities
REFERENCE_TIME = 600.0  # s of used windows during which the reference of the baseline is still refined
LINEARISATION_ERROR = 0.5  # of the square of a gain: error of a window that was linearised without correcting the gain
CORRECTED_GAIN = 0.06  # gain from which windows are corrected before they are linearised
STOPPED = 5.0  # s without a used window after which passengers may have boarded


@dataclass(frozen=True, slots=True, eq=False)
class DeviationRecord:
    """State of the deviations that is not part of the filter's belief."""

    cross: FloatArray  # mean sensitivity of the log-ratios to the deviations, shape (P, H)
    base_cross: FloatArray  # the same over the windows of the baseline, shape (P, H)
    reference: FloatArray  # deviations while the baseline was learned, shape (H,)
    moved: FloatArray  # 1 where a deviation has jumped, or drifted away, since, shape (H,)
    origin: FloatArray  # gains and delays when they were first known, shape (H,); NaN: not yet
    slope: FloatArray  # recent evidence for a jump along each direction, shape (V,)
    curvature: FloatArray  # its information, shape (V,)
    since: IntArray  # ns, when the evidence began to rise, shape (V,)
    excess: FloatArray  # part of chi-square that known deviations explain, mean over windows, shape (1,)
    recent: IntArray  # ns, the last windows with sensitivities of their own, shape (3,); 0: none

    @property
    def ratio(self) -> FloatArray:
        """Log-likelihood ratio of a jump along each direction, shape (V,)."""
        return np.asarray(self.slope**2 / (2 * np.maximum(self.curvature, 1e-12)))


def start(parameters: int, model: DeviationModel) -> DeviationRecord:
    H, V = model.size, len(model.directions)
    zeros = np.zeros
    return DeviationRecord(
        zeros((parameters, H)), zeros((parameters, H)), zeros(H), zeros(H), np.full(H, np.nan), zeros(V), zeros(V),
        zeros(V, dtype=np.int64), zeros(1), zeros(3, dtype=np.int64),
    )  # fmt: skip


def extended(record: DeviationRecord, belief: Belief, model: DeviationModel) -> tuple[DeviationRecord, Belief]:
    """An older state, extended by the model's deviations and directions that it does not have yet."""
    old, H, V = belief.deviations, model.size, len(model.directions)
    zeros = np.zeros(V)
    if len(record.slope) != V:
        record = replace(record, slope=zeros, curvature=zeros, since=zeros.astype(np.int64))
    if old >= H:
        return record, belief
    more, first = H - old, len(belief.mean)
    covariance = np.zeros((first + more, first + more))
    covariance[:first, :first] = belief.covariance
    covariance[first:, first:] = model.prior[old:, old:]
    wider = {name: np.pad(getattr(record, name), ((0, 0), (0, more))) for name in ("cross", "base_cross")}
    longer = {name: np.pad(getattr(record, name), (0, more)) for name in ("reference", "moved", "origin")}
    return (
        replace(record, **wider, **longer),
        Belief(np.pad(belief.mean, (0, more)), covariance, H),
    )


@dataclass(frozen=True, slots=True)
class Jump:
    """A deviation that has jumped."""

    direction: FloatArray  # shape (H,)
    size: float
    since: int  # ns
    kind: str


def update(
    calibration: DeviationRecord, model: DeviationModel, belief: Belief, found: Deviating, share: float, time: int
) -> tuple[DeviationRecord, Belief, Jump | None, bool]:
    """Record, belief, a significant jump, and whether window and belief agree, after a window with sensitivities.

    share: of the window that no earlier window with sensitivities contains.
    """
    H = model.size
    here = belief.mean[-H:]
    P = belief.covariance[-H:, -H:]
    M = found.information * share
    u = (found.score - found.information @ (here - found.point)) * share
    solved = np.linalg.solve(np.eye(H) + M @ P, np.column_stack([u, M]))
    slope, curvature = solved[:, 0], 0.5 * (solved[:, 1:] + solved[:, 1:].T)
    along = model.directions @ slope
    information = ((model.directions @ curvature) * model.directions).sum(axis=1).clip(1e-12)
    largest = float(np.max(np.abs(along) / np.sqrt(information), initial=0.0))
    bounded = min(1.0, model.rules.most / max(largest, 1e-12))
    calibration, jump = _test_jumps(calibration, model, along, information, bounded, time)
    agrees = bounded == 1.0 or jump is not None
    if jump is not None:
        belief = _reopen_jumped(belief, model, calibration.cross, jump)
        P = belief.covariance[-H:, -H:]
    elif bounded < 1.0:  # one window does not overturn the belief; several do, or a jump is found
        M, u = M * bounded**2, u * bounded**2
    if jump is not None or bounded < 1.0:
        solved = np.linalg.solve(np.eye(H) + M @ P, np.column_stack([u, M]))
        slope, curvature = solved[:, 0], 0.5 * (solved[:, 1:] + solved[:, 1:].T)
    across = belief.covariance[:, -H:]
    covariance = belief.covariance - across @ curvature @ across.T
    covariance = 0.5 * (covariance + covariance.T)
    belief = replace(belief, mean=belief.mean + across @ slope, covariance=covariance)
    mixed = MEMORY if calibration.recent[-1] else 1.0
    return (
        replace(
            calibration,
            cross=calibration.cross + mixed * (found.cross - calibration.cross),
            excess=calibration.excess + mixed * (explained_chi_square(belief, found) - calibration.excess),
            recent=np.array([*calibration.recent[1:], time], dtype=np.int64),
        ),
        belief,
        jump,
        agrees,
    )


def update_reference(
    record: DeviationRecord, model: DeviationModel, belief: Belief, here: BoolArray
) -> DeviationRecord:
    """Refines the deviations under which the baseline was learned (`reference`).

    The current belief replaces the reference, except for deviations that have drifted since: these keep the value at
    which they were first known.  here: deviations (H,) whose current value may become the first known one.
    """
    value, moved = belief.mean[-model.size :], record.moved > 0
    known, origin = np.isfinite(record.origin), record.origin
    if not (known | moved | ~here).all():
        std = model.relative_std(belief.covariance[-model.size :, -model.size :])
        origin = np.where(here & ~known & ~moved & (std < model.rules.known * model.drift_limit), value, origin)
        known = np.isfinite(origin)
    off = np.where(known, value - origin, 0.0)
    away = np.abs(off - model.common_value(off, known & ~moved))
    shifted = known & ~moved & (away > model.rules.drifted * model.drift_limit)
    # A value common to all channels is not identifiable: when it wanders, references of moved deviations follow it.
    kept = np.where(shifted, origin, record.reference)
    kept = kept + model.common_value(value - record.reference, ~(moved | shifted))
    return replace(
        record,
        origin=origin,
        moved=np.maximum(record.moved, shifted),
        reference=np.where(moved | shifted, kept, value),
    )


def drifted(record: DeviationRecord, model: DeviationModel, belief: Belief) -> tuple[FloatArray, BoolArray]:
    """Differences (H,) from the reference of the baseline, less the common value, and which exceed the drift limit."""
    off = belief.mean[-model.size :] - record.reference
    off = off - model.common_value(off, record.moved == 0)
    far = np.abs(off) > model.drift_limit
    if far.any():
        std = model.relative_std(belief.covariance[-model.size :, -model.size :])
        far &= std < model.rules.known * model.drift_limit
    return off, far


def pending_variance(record: DeviationRecord, model: DeviationModel) -> FloatArray:
    """Variance (H,) of gains and delays for a suspected jump in the most significant direction.

    The belief tracks the slow drift of electronics; faster changes it tracks late, until a jump is found.
    """
    ratio = np.where(model.channel_directions, record.ratio, 0.0)
    if not ratio.max(initial=0.0) > 0:
        return np.zeros(model.size)
    best = int(np.argmax(ratio))
    size = record.slope[best] / record.curvature[best]
    return np.asarray((model.directions[best] != 0) * expit(ratio[best] - model.rules.doubt) * size**2)


def linearisation_std(gain: FloatArray) -> FloatArray:
    """Standard deviations of gains of this size that come from linearising windows without correcting them."""
    return np.asarray(LINEARISATION_ERROR * np.minimum(np.abs(gain), CORRECTED_GAIN) ** 2)


def explained_chi_square(belief: Belief, found: Deviating) -> float:
    """Part of a window's chi-square per degree of freedom that the believed deviations explain."""
    off = belief.mean[-len(found.point) :] - found.point
    gained = float(2 * found.score @ off - off @ found.information @ off)
    return max(0.0, gained) / max(found.freedom, 1.0)


def level_variance(belief: Belief, model: DeviationModel, cross: FloatArray) -> FloatArray:
    """Variances of the levels (P,) without the part that uncertain constants of bodies contribute.

    cross: sensitivities (P, H).  That part shifts all windows and the believed levels alike.
    """
    variance = belief.level_variance
    if not model.constant.any():
        return variance
    at, p = np.flatnonzero(model.constant), belief.size
    rows, cross = at + 2 * p, cross[:, at]
    with_levels, among = belief.covariance[:p, rows], belief.covariance[rows][:, rows]
    return np.asarray((variance + (cross * (cross @ among - 2 * with_levels)).sum(axis=1)).clip(1e-12))


def update_loads(belief: Belief, model: DeviationModel, found: Deviating, share: float) -> Belief:
    """Belief after a window with information on loads and constants of bodies only."""
    at = model.refined_at
    rows = at + len(belief.mean) - model.size
    M = found.information[at][:, at] * share
    u = found.score[at] * share - M @ (belief.mean[rows] - found.point[at])
    across = belief.covariance[:, rows]
    gain = np.linalg.solve(np.eye(len(at)) + M @ across[rows], np.column_stack([u, M]))
    covariance = belief.covariance - across @ gain[:, 1:] @ across.T
    return replace(belief, mean=belief.mean + across @ gain[:, 0], covariance=0.5 * (covariance + covariance.T))


def _test_jumps(
    calibration: DeviationRecord,
    model: DeviationModel,
    along: FloatArray,
    information: FloatArray,
    bounded: float,
    time: int,
) -> tuple[DeviationRecord, Jump | None]:
    """Test statistics after a window whose scores are scaled by `bounded`, and a significant jump."""
    # Directions without evidence restart: quiet windows before a jump must not outweigh it.
    old, rules = calibration.slope, model.rules
    lasting = old**2 > 2 * calibration.curvature * rules.restart
    keep = np.where(lasting & (old * (rules.forgetting * old + along * bounded) > 0), rules.forgetting, 0.0)
    slope = keep * old + along * bounded
    curvature = keep * calibration.curvature + information
    ratio = slope**2 / (2 * curvature)
    since = np.where((ratio >= rules.onset) & (calibration.ratio < rules.onset), time, calibration.since)
    best = int(np.argmax(ratio)) if len(ratio) else -1
    jump = None
    if best >= 0 and ratio[best] >= rules.evidence:
        direction = model.directions[best]
        kind = model.kinds[int(np.argmax(direction))]
        size = slope[best] / curvature[best] if bounded == 1.0 else along[best] / information[best]
        jump = Jump(direction, float(size), int(since[best]), kind)
        slope, curvature = np.zeros_like(slope), np.zeros_like(curvature)
    return replace(calibration, slope=slope, curvature=curvature, since=since), jump


def _reopen_jumped(belief: Belief, model: DeviationModel, cross: FloatArray, jump: Jump) -> Belief:
    """Belief after a jump: variance is added to the deviation, and to the parameters that had absorbed part of it."""
    H = model.size
    open_ = np.zeros(len(belief.mean))
    open_[-H:] = 2 * jump.size * jump.direction
    taken = np.zeros(len(belief.mean))
    taken[: belief.size] = cross @ jump.direction * jump.size
    return replace(belief, covariance=belief.covariance + np.outer(open_, open_) + np.outer(taken, taken))


def reset_loads(
    belief: Belief, model: DeviationModel, mean: FloatArray | None = None, variance: FloatArray | None = None
) -> Belief:
    """Belief after a stop: loads at their prior, or with masses of known `mean` and `variance` (L,)."""
    covariance, state = belief.covariance.copy(), belief.mean.copy()
    first = len(belief.mean) - model.size
    at = model.cargo_at + first
    covariance[at, :] = covariance[:, at] = 0.0
    state[at], covariance[at, at] = 0.0, np.diag(model.prior)[model.cargo]
    if mean is not None and variance is not None:
        masses = model.loads_at + first
        state[masses], covariance[masses, masses] = mean, variance
    return replace(belief, mean=state, covariance=covariance)


def loads_changed(belief: Belief, model: DeviationModel, found: Deviating) -> bool:
    """Whether a window contradicts the believed loads: something was loaded or unloaded without a stop."""
    at, along = model.cargo_at, model.refined_at
    if not len(at):
        return False
    values, vectors = np.linalg.eigh(found.information[at][:, at])
    observed = values > 1e-9 * max(float(values[-1]), 1e-300)
    root = vectors[:, observed] / np.sqrt(values[observed])  # observable directions; constants of bodies as believed
    rows = along + len(belief.mean) - model.size
    M = root.T @ found.information[at][:, along]
    seen = M @ (found.point[along] - belief.mean[rows]) + root.T @ found.score[at]
    spread = np.eye(len(seen)) + M @ belief.covariance[rows][:, rows] @ M.T
    return bool(seen @ np.linalg.solve(spread, seen) > model.rules.load**2)


def reopen(belief: Belief, model: DeviationModel) -> Belief:
    """Belief after the filter lost a parameter: perhaps a sensor's fault: adds 1/9 of the prior variance."""
    H = model.size
    covariance = belief.covariance.copy()
    covariance[-H:, -H:] += model.prior / 9 * ~(model.refined[:, None] | model.refined[None, :])
    return replace(belief, covariance=covariance)
