"""Update of gains, delays and loads by a window, and of the deviations under which the baseline was learned.

Mean and covariance of the deviations are part of the filter's belief (levels, rates, deviations); `DeviationRecord`
holds the rest.  H deviations, V directions (`deviation_model`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import expit

from sprung.model.signals import BoolArray, Deviating, FloatArray
from sprung.model.tracking.deviation_model import DeviationModel
from sprung.model.tracking.deviation_record import LATELY, DeviationRecord
from sprung.model.tracking.filter import Belief
from sprung.model.tracking.jumps import Jump, reopen_jumped, tested_for_jumps

MEMORY = 0.3  # weight of the newest window in the mean sensitivities
LINEARISATION_ERROR = 0.5  # of the square of a gain: error of a window that was linearised without correcting the gain
CORRECTED_GAIN = 0.06  # gain from which windows are corrected before they are linearised
UNLIKE_DATA_SHEET = 4.0  # times its tolerance: standard deviation of a gain (6 %), or a delay (8 ms), of a defect
LIKELY_DEFECT = 1.0  # log-likelihood ratio of a defect; little is lost where there is none
DEFECTIVE = 0.3  # of the channels at most: the others must tell what is right


def update(
    calibration: DeviationRecord, model: DeviationModel, belief: Belief, found: Deviating, share: float, time: int
) -> tuple[DeviationRecord, Belief, Jump | None, bool]:
    """Record, belief, a significant jump, and whether window and belief agree, after a window with sensitivities.

    share: of the window that no earlier window with sensitivities contains.
    """
    H = model.size
    calibration, belief = _drift_opened(calibration, model, belief)
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
    calibration, jump = tested_for_jumps(calibration, model, along, information, bounded, time)
    agrees = bounded == 1.0 or jump is not None
    if jump is not None:
        belief = reopen_jumped(belief, model, calibration.cross, jump)
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


def faded(record: DeviationRecord, model: DeviationModel, belief: Belief, added: FloatArray) -> DeviationRecord:
    """The record when the believed deviations become less certain by the relative variances `added` (H,).

    Smoothing at a fixed point: of a correction of a random walk now, the share cov(then, now) / var(now) belongs to its
    value at an earlier time, too.  It is multiplied by var / (var + added) whenever the value may have changed.
    """
    variance = model.relative_variance(belief.covariance[-model.size :, -model.size :])
    share = variance / np.maximum(variance + added, 1e-300)
    return replace(record, following=record.following * np.where(added > 0, share, 1.0))


def update_reference(
    record: DeviationRecord,
    model: DeviationModel,
    belief: Belief,
    before: FloatArray,
    *,
    armed: bool,
    settled: bool,
) -> DeviationRecord:
    """Refines the deviations under which the baseline was learned (`reference`).

    before: relative variances (H,) of the deviations before the window.  The reference takes its share of the belief's
    corrections, which `faded` lessens.  Until the baseline is known (`armed`), deviations are found but do not jump.
    Afterwards it rests while a jump may still be shared out among channels (not `settled`), and one that is moved far
    from the value that was known first has followed a drift, and returns to it.
    """
    value, free = belief.mean[-model.size :], model.refined
    variance = model.relative_variance(belief.covariance[-model.size :, -model.size :])
    if armed and not settled:
        return record
    moved, limit = record.moved > 0, model.drift_limit
    by = value - record.followed
    # A value common to all channels is not identifiable: when it wanders, all references follow it.
    common = model.common_value(by, ~moved)
    opened = before / np.maximum(variance, before) if armed else 1.0  # where the filter has lost a parameter
    share = np.where(moved, 0.0, record.following * opened)
    step = share * (by - common)
    reference = np.where(free, value, record.reference + step + common)
    lately = np.where(moved, record.lately, record.lately * (1 - 1 / LATELY) + step)
    smoothed = record.reference_variance - share**2 * (before - variance)
    std = np.sqrt(variance)
    known, here = np.isfinite(record.origin), armed & ~model.cargo & (std < model.rules.known * limit)
    origin = np.where(known, record.origin + common, np.where(here & ~moved, value, np.nan))
    off = np.where(known, reference - origin, 0.0)
    dragged = (
        known & ~moved & ~free & (np.abs(off - model.common_value(off, known & ~moved)) > model.rules.drifted * limit)
    )
    away = value - reference
    left = (
        armed
        & ~moved
        & ~free
        & (std < model.rules.known * limit)
        & (np.abs(away - model.common_value(away, ~moved)) > limit)
    )
    first = np.where(dragged, (model.rules.known * limit) ** 2, smoothed)
    return replace(
        record,
        reference=np.where(dragged, origin, reference),
        reference_variance=np.where(moved, record.reference_variance, np.maximum(first, share**2 * variance)),
        following=share,
        followed=value,
        lately=np.where(dragged, 0.0, lately),
        moved=np.maximum(record.moved, dragged | left),
        origin=origin,
    )


def change_variance(record: DeviationRecord, model: DeviationModel, belief: Belief) -> FloatArray:
    """Variances (H,) of the differences between the believed deviations and the reference of the baseline.

    Both less what is common to their group.  The reference is as uncertain as what determined it, and may have followed
    a drift that was not seen yet.
    """
    now = model.relative_variance(belief.covariance[-model.size :, -model.size :])
    shared = np.where(record.moved > 0, 0.0, record.following) * now
    apart = now + record.reference_variance - 2 * shared
    return np.asarray(apart.clip(0.0) + record.lately**2)


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
    """Variance (H,) of gains and delays for a suspected jump, or a drift, in the most significant direction.

    The belief tracks the slow drift of electronics; faster changes it tracks late, until a jump is found.
    """
    ratio = np.where(model.channel_directions, record.ratio, 0.0)
    if not ratio.max(initial=0.0) > 0:
        return np.zeros(model.size)
    best = int(np.argmax(ratio))
    size = record.slope[best] / record.curvature[best]
    jumped = (model.directions[best] != 0) * expit(ratio[best] - model.rules.doubt) * size**2
    return np.asarray(np.maximum(jumped, _lag_variance(record, model)))


def _lag_variance(record: DeviationRecord, model: DeviationModel) -> FloatArray:
    """Variance (H,) of gains and delays that drift faster than they are followed, as far as windows show that."""
    lag = record.lag(model)
    doubtful = np.where(model.channel_directions, expit(0.5 * record.trend * lag - model.rules.drifting) * lag**2, 0.0)
    return np.asarray((np.abs(model.directions) * doubtful[:, None]).max(axis=0, initial=0.0))


def _drift_opened(record: DeviationRecord, model: DeviationModel, belief: Belief) -> tuple[DeviationRecord, Belief]:
    """Record and belief before a window, where the last windows lie to one side of what is believed.

    What then drifts does so faster than its random walk: it is followed late, and would be stated as too certain.  Its
    variance, and that of the parameters that take up the rest, grows by the square of the lag in LATELY windows.
    """
    size = record.lag(model)
    ratio = np.where(model.channel_directions, 0.5 * record.trend * size, 0.0)
    best = int(np.argmax(ratio)) if len(ratio) else -1
    if best < 0 or ratio[best] < model.rules.drifting:
        return record, belief
    lag = model.directions[best] * (size[best] / np.sqrt(LATELY))
    along = np.zeros(len(belief.mean))
    along[-model.size :], along[: belief.size] = lag, record.cross @ lag
    opened = replace(belief, covariance=belief.covariance + np.outer(along, along))
    return faded(record, model, belief, lag**2), opened


def without_data_sheets(
    record: DeviationRecord, model: DeviationModel, belief: Belief
) -> tuple[FloatArray, FloatArray]:
    """Deviations (H,) and their covariance (H, H) as reported, where channels may be defective.

    Held by a tolerance of 1.5 %, a gain that has been 1.05 from the beginning would seem to be 1.035, and the rest in
    other channels.  The tolerance of a channel for which a defect is likelier is therefore taken back out of the
    belief, as far as it is still in it (`following`); a jump has left none.
    """
    H, at = model.size, model.of_channels
    mean, covariance = belief.mean[-H:], belief.covariance[-H:, -H:]
    sheet, own = model.prior_information[:, at], model.prior_information[at, at]
    wide = UNLIKE_DATA_SHEET**2 * model.prior.diagonal()[at]
    taken = np.where(record.moved[at] > 0, 0.0, record.following[at]) * wide / (1 + wide * own)
    for _ in range(int(DEFECTIVE * model.gains.sum())):
        along, moved = mean @ sheet, covariance @ sheet
        left = np.maximum(1 - taken * (sheet * moved).sum(axis=0), 1e-9)
        gained = 0.5 * taken * along**2 / left - 0.5 * np.log((1 + wide * own) * left)
        best = int(np.argmax(gained))
        if gained[best] < LIKELY_DEFECT:
            break
        size = taken[best] / left[best]
        mean = mean + moved[:, best] * size * along[best]
        covariance = covariance + size * np.outer(moved[:, best], moved[:, best])
        taken = taken * (np.arange(len(at)) != best)
    return mean, covariance


def linearisation_std(gain: FloatArray) -> FloatArray:
    """Standard deviations (H,) of gains (H,) that come from linearising windows without correcting them."""
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


def reopen(belief: Belief, model: DeviationModel) -> Belief:
    """Belief after the filter lost a parameter: perhaps a sensor's fault: adds 1/9 of the prior variance."""
    H = model.size
    covariance = belief.covariance.copy()
    covariance[-H:, -H:] += model.prior / 9 * ~(model.refined[:, None] | model.refined[None, :])
    return replace(belief, covariance=covariance)
