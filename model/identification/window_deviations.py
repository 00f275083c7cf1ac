"""What a refined window says about gains, delays and loads, for whoever estimates these over many windows.

P parameters, X loads and constants of bodies refined with them, C channels, H = 2 C + X deviations.
"""

from __future__ import annotations

import numpy as np

from sprung.model.identification.refinement.refine import Refined
from sprung.model.signals import Deviating, FloatArray


def deviating_of(
    refined: Refined, b: int, P: int, channels: int, spread: FloatArray, point: FloatArray | None
) -> Deviating | None:
    """What window `b` says about deviations; loads that were refined with the parameters are profiled apart.

    spread: standard deviations of the priors of what follows gains and delays.
    """
    X = refined.log_ratio.shape[1] - P  # of loads and bodies' own that were refined along
    whole = bool(refined.weighed[b])
    if not (whole or X > 0) and point is None:
        return None
    C, H = channels, 2 * channels + len(spread)
    at, covariance = np.zeros(H) if point is None else point.copy(), refined.covariance[b]
    cross = refined.cross[b] if whole else np.zeros((len(covariance), H))
    information = refined.information[b].copy() if whole else np.zeros((H, H))
    score = refined.score[b].copy() if whole else np.zeros(H)
    given = covariance[:P, :P]
    if X > 0:
        loads = slice(2 * C, 2 * C + X)
        prior = spread[:X] ** -2 / max(refined.chi_square[b], 1.0)  # in the refined values, not of the window
        at[loads], score[loads] = refined.log_ratio[b, P:], prior * refined.log_ratio[b, P:]
        given, cross, information = _profiled(covariance, cross, information, loads, P)
        information[loads, loads] -= np.diag(prior)
    if point is not None:  # samples were divided by the gain: a relative deviation of the rest counts less by it
        scale = np.ones(H)
        scale[:C] = 1 / (1 + at[:C])
        cross, score = cross * scale, score * scale
        information = information * np.outer(scale, scale)
    return Deviating(at, given, cross[:P], information, score, float(refined.freedom[b]), whole)


def _profiled(
    covariance: FloatArray, cross: FloatArray, information: FloatArray, loads: slice, P: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Loads that were refined after the P parameters, as deviations beside gains and delays.

    covariance (P + X, P + X) and cross (P + X, H): of what was refined, and per deviation; information (H, H) on gains
    and delays.  Returns the covariance of the parameters given the loads (P, P), `cross` of the parameters with the
    loads in place, (P, H), and the information with that on the loads, without a prior.
    """
    inverse = np.linalg.inv(covariance[P:, P:])
    per_load = covariance[:P, P:] @ inverse  # (P, X)
    moved = cross[P:, : loads.start]  # of the loads per gain or delay; 0 of windows that are not weighed
    information[: loads.start, : loads.start] += moved.T @ inverse @ moved
    information[: loads.start, loads] = -moved.T @ inverse
    information[loads, : loads.start] = information[: loads.start, loads].T
    information[loads, loads] = inverse
    cross = cross[:P].copy()
    cross[:, : loads.start] -= per_load @ moved
    cross[:, loads] = per_load
    return covariance[:P, :P] - per_load @ covariance[P:, :P], cross, information
