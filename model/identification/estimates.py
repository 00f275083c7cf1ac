"""Estimates from refined windows, with their goodness of fit and whether they are informative."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.identification.fault_isolation.explanation import fit_limit
from sprung.model.identification.refinement.refine import Refined
from sprung.model.identifier import without_values
from sprung.model.signals import Deviating, Estimate, FloatArray

EXCITED = 20.0  # power of an input over its noise; below, what sensors show is not the response to the inputs


WITHOUT_VALUES = "cannot be simulated", "not identified"  # how reasons begin that lie with the model
DIVERGED = f"{WITHOUT_VALUES[0]}: the forces of the model's laws leave all bounds along the measured motion"


def estimates(
    refined: Refined, P: int, states: bool, deviating: list[Deviating | None], limit: str = "what is allowed"
) -> list[Estimate]:
    """One `Estimate` per window of a refined batch; the first P of what was refined are its parameters.

    limit: of the work for a window, in words.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        per_sensor = np.where(refined.rms > 0, refined.error / refined.rms, np.nan)
    fits = refined.chi_square < fit_limit(refined.freedom)
    # Uninformative: a window that fits and yet determines no parameter, and one whose inputs stand still
    unknown = refined.diverged | refined.ended
    determined = np.where(fits & ~unknown, refined.identifiable[:, :P].any(axis=1) & refined.converged, True)
    moved = refined.excitation > EXCITED
    informative = moved & determined
    return [
        Estimate(
            log_ratio=refined.log_ratio[b, :P],
            covariance=refined.covariance[b, :P, :P],
            identifiable=refined.identifiable[b, :P],
            nrmse=pooled_nrmse(per_sensor[b]),
            per_sensor=per_sensor[b],
            chi_square=float(refined.chi_square[b]),
            adequate=bool(fits[b] and refined.converged[b]),
            converged=bool(refined.converged[b]),
            iterations=int(refined.iterations[b]),
            states=refined.states[b] if states else None,
            outputs=refined.outputs[b] if states else None,
            informative=bool(informative[b]),
            running=bool(moved[b] and not informative[b]),
            deviating=deviating[b],
            noise=float(refined.noise[b]),
            identified=not unknown[b],
            reason=DIVERGED if refined.diverged[b] else longer_than(limit) if refined.ended[b] else None,
        )
        for b in range(len(refined.log_ratio))
    ]


def not_identified(P: int, S: int, reason: str) -> Estimate:
    """That of a window of P parameters and S sensors that has no values, for a reason."""
    return replace(
        without_values(P, S),
        chi_square=float("nan"),
        adequate=False,
        converged=False,
        informative=True,
        identified=False,
        reason=reason,
    )


def longer_than(limit: str) -> str:
    """Why a window has no values whose search was ended."""
    return f"{WITHOUT_VALUES[1]}: took longer than {limit}"


def pooled_nrmse(per_sensor: FloatArray) -> float:
    """rms over sensors (S,) of each sensor's error divided by its own rms; NaN sensors are absent."""
    shown = per_sensor[np.isfinite(per_sensor)]
    return float(np.sqrt(np.mean(shown**2))) if len(shown) else float("nan")
