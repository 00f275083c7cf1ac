"""Excess noise of single channels, judged against channels of the same kind."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from model.diagnosis.measured import declared_noise
from model.diagnosis.report import Finding, LawParameter

if TYPE_CHECKING:
    from model.diagnosis.diagnose import Course

_LEAST = 1.12  # ratio to its peers from which a noise level is a fault
_SIGMAS = 6.0


def noise_faults(course: Course) -> list[Finding]:
    """Sensors and input channels that are noisier than their peers by more than chance."""
    declared = declared_noise(course.system, course.prepared.signals)
    noise = course.problem.noise
    grid = course.problem.part.grid
    count = grid.band.stop
    findings = []
    names = list(course.signals.sensor_names)
    findings += _outliers(names, noise.sensors / declared.sensors, declared.sensors, count)
    pairs = course.problem.part.pairs
    if len(pairs):
        supports = [course.signals.support_names[i] for i in pairs]
        d = (noise.displacement / declared.displacement)[pairs]
        v = (noise.velocity / declared.velocity)[pairs]
        findings += _outliers([f"{n}.displacement" for n in supports], d, declared.displacement[pairs], 0.5 * count)
        findings += _outliers([f"{n}.velocity" for n in supports], v, declared.velocity[pairs], 0.15 * count)
    return findings


def _outliers(names: list[str], ratio: np.ndarray, kind: np.ndarray, count: float) -> list[Finding]:
    """Channels whose ratio of noise to declared noise leaves that of their peers (same declared noise)."""
    findings = []
    for i, name in enumerate(names):
        peers = [j for j in range(len(names)) if j != i and np.isclose(kind[j], kind[i])]
        if len(peers) < 2:
            continue
        usual = float(np.median(ratio[peers]))
        relative = float(ratio[i]) / usual
        sigma = 1 / np.sqrt(2 * max(count, 2.0))
        z = np.log(relative) / sigma
        if relative > _LEAST and z > _SIGMAS:
            findings.append(
                Finding(
                    location=name,
                    effect="sensor_noise",
                    parameters=(LawParameter("ratio", float(ratio[i]), float(ratio[i] * sigma), "1"),),
                    p_value=float(min(1.0, len(names) * stats.norm.sf(z))),
                    delta_bic=-float(z**2),
                    sentence=f"{name}: {ratio[i]:.3g} times the noise declared, its peers {usual:.3g} times",
                )
            )
    return findings
