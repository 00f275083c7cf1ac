"""Effects of gains, delays and loads on the estimates of windows, and on the baseline that these are compared with.

P parameters, H deviations; `cross` (P, H) is the sensitivity of the log-ratios to the deviations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.signals import BoolArray, Deviating, Estimate, FloatArray
from sprung.model.tracking import changes as change_test
from sprung.model.tracking import deviations as dev
from sprung.model.tracking import filter as kalman
from sprung.model.tracking.deviation_model import DeviationModel
from sprung.model.tracking.deviation_record import DeviationRecord
from sprung.model.tracking.settings import TrackerSettings
from sprung.model.tracking.state import TrackerState

LINEAR_SHIFT = 4.0  # standard deviations of a window up to which mean sensitivities may correct it
CROSS_ERROR = 0.5  # standard deviations of additional uncertainty per shift by mean sensitivities: the error is smaller
# than the shift, but the same in many windows, so that averaging does not reduce it


@dataclass(frozen=True)
class DeviationEffects:
    """What the believed deviations of one tracker's vehicle contribute to windows and baseline."""

    settings: TrackerSettings
    model: DeviationModel

    def too_large(self, state: TrackerState, estimate: Estimate) -> bool:
        """Whether a window without sensitivities of its own is shifted too far for a correction by mean ones."""
        if not self.model.size or (estimate.deviating is not None and estimate.deviating.whole):
            return False
        point = np.zeros(self.model.size) if estimate.deviating is None else estimate.deviating.point
        shift = self.channel_shift(state.calibration.cross, state.belief, point)
        return bool(np.any(np.abs(shift) > LINEAR_SHIFT * np.sqrt(estimate.covariance.diagonal())))

    def chi_square(self, state: TrackerState, estimate: Estimate) -> float:
        """Chi-square of a window, less the part that the believed deviations explain."""
        if not self.model.size or estimate.faults:
            return estimate.chi_square
        found = estimate.deviating
        known = (
            float(state.calibration.excess[0])
            if found is None or not found.whole
            else dev.explained_chi_square(state.belief, found)
        )
        return max(estimate.chi_square - known, 0.1 * estimate.chi_square)

    def corrected(
        self,
        estimate: Estimate,
        found: Deviating | None,
        calibration: DeviationRecord,
        belief: kalman.Belief,
        mask: BoolArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Log-ratios (P,) given the believed deviations, their covariance (P, P), and sensitivities (P, H)."""
        value = np.where(mask, estimate.log_ratio, 0.0)
        if not self.model.size:
            return value, estimate.covariance, np.zeros((len(value), 0))
        here = belief.mean[-self.model.size :]
        if found is None:  # loads were estimated with the window, and its covariance contains their uncertainty
            cross = np.where(self.model.refined, 0.0, calibration.cross)
            found_at, covariance = np.zeros(len(here)), estimate.covariance
        else:
            found_at, cross, covariance = found.point, found.cross, found.given
        if found is None or not found.whole:
            covariance = _with_cross_error(covariance, self.channel_shift(cross, belief, found_at))
        return value + np.where(mask, cross @ (here - found_at), 0.0), covariance, cross

    def channel_shift(self, cross: FloatArray, belief: kalman.Belief, point: FloatArray) -> FloatArray:
        """Shift (P,) of log-ratios that were found at the deviations `point` (H,) by the believed gains and delays."""
        return np.asarray(cross @ np.where(self.model.refined, 0.0, belief.mean[-self.model.size :] - point))

    def variance(self, belief: kalman.Belief, cross: FloatArray, chosen: BoolArray) -> FloatArray:
        """Variance (P,) of a window's values that the uncertainty of the `chosen` deviations (H,) contributes."""
        H = self.model.size
        if H == 0 or not chosen.any():
            return np.zeros(len(cross))
        at = np.flatnonzero(chosen)
        own = belief.covariance[-H:, -H:][at][:, at]
        return np.asarray(((cross[:, at] @ own) * cross[:, at]).sum(axis=1))

    def unshared_variance(self, calibration: DeviationRecord, belief: kalman.Belief, cross: FloatArray) -> FloatArray:
        """Variance (P,) from deviations that are not the same in this window as in those of the baseline."""
        return self.variance(belief, cross, (calibration.moved > 0) | self.model.cargo)

    def baseline_shift(self, state: TrackerState, calibration: DeviationRecord, cross: FloatArray) -> FloatArray:
        """Contribution (P,) of the reference deviations to the baseline; loads are corrected window by window.

        A baseline is learned with gains and delays as the system file states them, and compared at the reference.
        """
        if not self.model.size:
            return np.zeros(len(cross))
        stays = ~self.model.cargo
        learned = state.changes.learned >= self.settings.learning
        reference = np.where(stays, calibration.reference, 0.0)
        return np.where(learned, calibration.base_cross @ reference, cross @ reference)

    def learned(
        self,
        state: TrackerState,
        tested: change_test.Changes,
        calibration: DeviationRecord,
        cross: FloatArray,
    ) -> DeviationRecord:
        """Record with the sensitivities of the baseline after a window."""
        if not self.model.size:
            return calibration
        first = state.changes.learned < self.settings.learning  # later refinements use corrected windows
        more = (tested.weight - state.changes.weight) / np.maximum(tested.weight, 1e-300)
        gained = np.where(first & (tested.weight > 0), more, 0.0)
        return replace(
            calibration, base_cross=calibration.base_cross + gained[:, None] * (cross - calibration.base_cross)
        )


def _with_cross_error(covariance: FloatArray, shift: FloatArray) -> FloatArray:
    """Covariance (P, P) of a window that mean sensitivities shift by `shift` (P,), their error included.

    Sensitivities differ from window to window, most of all in windows with much information: what deviations hardly
    shift keeps its weight, the rest is left to windows with sensitivities of their own.
    """
    wide = np.sqrt(1 + (shift / CROSS_ERROR) ** 2 / covariance.diagonal())
    return np.asarray(covariance * np.outer(wide, wide))
