"""The most likely deviations of a window from its score and information: one alone, those of clocks, all at once."""

from __future__ import annotations

import numpy as np

from sprung.model.identification.fault_isolation.corrections import Corrections
from sprung.model.identification.measurements.deviations import clock_groups, shared_directions
from sprung.model.signals import FloatArray
from sprung.model.system import System

EVIDENT = 12.5  # log-likelihood ratio of a step: five standard deviations
_FAR = (0.03, 1e-3, 0.03)  # gain, delay (s), load: beyond, a window is refined there rather than extrapolated


class DeviationSteps:
    """Steps of H deviations that the score (H,) and information (H, H) of a refined window ask for."""

    def __init__(self, system: System, corrections: Corrections) -> None:
        deviations, self._channels = corrections.deviations, corrections.channels
        self._measured = corrections.measured
        self.std = np.array([d.std for d in deviations])  # what data sheets leave open, shape (H,)
        # Simple explanations as rows: each deviation alone, and what several channels have in common, shape (V, H)
        self.directions = np.concatenate([np.eye(len(deviations)), shared_directions(deviations)])
        groups = clock_groups(system)
        late = self.directions[:, self._channels : 2 * self._channels]
        whole = [(late[:, groups == group] > 0).all(axis=1) for group in np.unique(groups)]
        alone = (late > 0).sum(axis=1) == np.array([[np.sum(groups == g)] for g in np.unique(groups)])
        self.clocks = self.directions[(np.array(whole) & alone).any(axis=0)]  # one delay for each clock
        parts = [(late[:, groups == group] > 0).any(axis=1) for group in np.unique(groups)]
        # Delays of one clock or several, each as a whole
        self.late_clocks = self.directions[(late > 0).any(axis=1) & (np.array(whole) == np.array(parts)).all(axis=0)]

    def strongest(self, score: FloatArray, information: FloatArray) -> tuple[FloatArray, float]:
        """The simple deviation with the most evidence at its most likely size, shape (H,), and that evidence."""
        V = self.directions
        slope = V @ score
        curvature = ((V @ information) * V).sum(axis=1).clip(1e-12)
        best = int(np.argmax(slope**2 / curvature))
        return np.asarray(V[best] * slope[best] / curvature[best]), float(slope[best] ** 2 / curvature[best] / 2)

    def of_clocks(self, score: FloatArray, information: FloatArray) -> FloatArray:
        """The delays of all clocks at their most likely sizes, shape (H,)."""
        V = self.clocks
        w = (V * self.std).max(axis=1)
        precision = np.eye(len(w)) + V @ information @ V.T * np.outer(w, w)
        return np.asarray(V.T @ (w * np.linalg.solve(precision, w * (V @ score))))

    def of_all(self, score: FloatArray, information: FloatArray) -> FloatArray:
        """All gains and delays at their most likely sizes within what data sheets leave open, shape (H,)."""
        try:
            return np.where(self._measured, self.most_likely(score, information), 0.0)
        except np.linalg.LinAlgError:  # of a window whose motion has run away under a law
            return np.zeros(len(score))

    def most_likely(self, score: FloatArray, information: FloatArray) -> FloatArray:
        """Deviations (H,) at their most likely sizes within what data sheets leave open, which may be nothing."""
        S = self.std
        precision = np.eye(len(S)) + information * np.outer(S, S)
        return np.asarray(S * np.linalg.solve(precision, S * score))

    def apart(self, score: FloatArray, information: FloatArray) -> bool:
        """Whether a window that fits should be refined elsewhere: it speaks clearly for a sizeable deviation."""
        step, evidence = self.strongest(score, information)
        C = self._channels
        scale = np.concatenate([np.full(C, _FAR[0]), np.full(C, _FAR[1]), np.full(len(step) - 2 * C, _FAR[2])])
        return bool(evidence > EVIDENT and np.max(np.abs(step) / scale) > 1)
