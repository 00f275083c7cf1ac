"""Judgement of windows without measured inputs: pooled values, errors, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from sprung.model.diagnosis.ambient.windows import WindowResult, displaced, independent
from sprung.model.diagnosis.investigation.state import Options
from sprung.model.diagnosis.investigation.verdict import HeldOutErrors, Verdict, kind_of, verdict_of
from sprung.model.diagnosis.record.channels import Prepared
from sprung.model.diagnosis.rules import RULES, AmbientRules
from sprung.model.identifier import PRIOR_STD
from sprung.model.laws import ElementLaw
from sprung.model.laws.drift import TIME_VARYING_DAMPING, TIME_VARYING_STIFFNESS
from sprung.model.laws.sensor_faults import SENSOR_STUCK
from sprung.model.signals import BoolArray, FloatArray
from sprung.model.system import System

VARYING: dict[str, ElementLaw] = {"stiffness": TIME_VARYING_STIFFNESS, "damping": TIME_VARYING_DAMPING}


@dataclass(frozen=True)
class PooledValues:
    """Values pooled over all windows."""

    log_ratio: FloatArray  # (P,)
    deviation: FloatArray  # standard deviation, (P,), scatter over windows included
    varying: BoolArray  # parameters that vary significantly over windows, (P,)
    chance: FloatArray  # p-value of their scatter, (P,)


@dataclass(frozen=True)
class AmbientJudgement:
    """Result of a recording without measured inputs."""

    errors: HeldOutErrors  # per sensor
    verdict: Verdict
    explained: float | None  # share of the excess error; None without findings
    left: FloatArray  # unexplained share of every sensor's power, (S,)
    band: tuple[float, float]  # Hz, main band of the unexplained power
    rejected: bool  # whether the structure differs from the file's


def pool(windows: list[WindowResult], rules: AmbientRules = RULES.ambient) -> PooledValues:
    """Weighted means over windows, and the parameters that vary."""
    theta = np.array([w.log_ratio for w in windows])
    sigma = np.sqrt(np.array([np.diag(w.covariance) for w in windows]))
    P = theta.shape[1]
    mean, deviation = np.zeros(P), np.full(P, PRIOR_STD)
    varying, chance = np.zeros(P, dtype=bool), np.ones(P)
    apart = independent(windows)
    for p in range(P):
        informative = sigma[:, p] < rules.undetermined
        if not informative.any():
            continue
        value, std = theta[informative, p], sigma[informative, p]
        one = apart & informative
        if one.sum() >= rules.independent:
            own, own_std = theta[one, p], sigma[one, p]
            centre = np.sum(own / own_std**2) / np.sum(1 / own_std**2)
            scatter = float(np.sum(((own - centre) / own_std) ** 2))
            chance[p] = float(chi2.sf(scatter, one.sum() - 1))
            wide = np.subtract(*np.quantile(own, [0.5 + 0.5 * rules.within, 0.5 - 0.5 * rules.within]))
            varying[p] = chance[p] < rules.alpha and wide > max(rules.varies, rules.spread * float(np.median(own_std)))
        mean[p] = float(np.median(value)) if varying[p] else float(np.sum(value / std**2) / np.sum(1 / std**2))
        number = max(1, int(one.sum()))
        inside = 1 / np.sqrt(np.sum(1 / std**2) * number / len(std))  # overlapping windows are not independent
        between = float(np.std(value)) / np.sqrt(number) if number >= rules.independent else 0.0
        deviation[p] = max(inside, between)
    return PooledValues(mean, deviation, varying, chance)


def errors_of(
    before: list[WindowResult], after: list[WindowResult], rules: AmbientRules
) -> tuple[HeldOutErrors, tuple[float, float]]:
    """Errors with constant parameters (before), and with the varying ones free (after)."""
    one, chance, _ = displaced([w for w, good in zip(before, independent(before), strict=True) if good], rules.parts)
    own, _, band = displaced([w for w, good in zip(after, independent(after), strict=True) if good], rules.parts)
    return HeldOutErrors(np.sqrt(one), np.sqrt(own), np.sqrt(chance)), band


def judged(
    prepared: Prepared,
    system: System,
    pooled: PooledValues,
    errors: HeldOutErrors,
    band: tuple[float, float],
    options: Options,
) -> AmbientJudgement:
    """The verdict of all windows."""
    rules = options.rules
    kinds = [kind_of(SENSOR_STUCK)] * len(prepared.stuck)
    kinds += [kind_of(VARYING[system.parameters[int(p)].quantity]) for p in np.flatnonzero(pooled.varying)]
    verdict = verdict_of(
        kinds, errors, replace(rules.verdict, gross=1.0)
    )  # errors are shares of power, not of a simulation
    return AmbientJudgement(
        errors=errors,
        verdict=verdict,
        explained=errors.explained(rules.verdict) if kinds else None,
        left=errors.unexplained(rules.verdict),
        band=band,
        rejected=verdict == "unknown_physics" and float(np.mean(errors.after**2)) > rules.ambient.rejected,
    )
