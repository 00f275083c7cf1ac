"""Advice to users: likely reasons if nothing fits, and limits of the recording."""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.investigation.state import Investigation, Outcome
from sprung.model.diagnosis.report.values import deviations
from sprung.model.text import some

LOST_PHASE = "the free run loses its phase: the verdict is based not on its errors but on the unmeasured forces"


def search_ended(limit: str) -> str:
    """Advice if a search ended at its budget of work or time limit."""
    return (
        f"the search ended at its {limit}: more candidates were left to be fitted, and what is still unexplained "
        "may have a name; a shorter recording, or one with fewer samples a second, is searched to the end"
    )


def nothing_fits(outcome: Outcome) -> str:
    """Advice if no model describes the recording, with likely reasons."""
    judgement = outcome.judgement
    if judgement.parts:
        return (
            f"the structure is another one than the file's: {judgement.parts} changes of it (connections, masses, "
            f"elements elsewhere, instruments) were found, which together imitate any other, and still err by "
            f"{100 * judgement.error:.0f} % of the signal; bodies, their degrees of freedom and what joins them should "
            "be stated anew"
        )
    share, likeliest = f"{100 * judgement.error:.0f} %", f"Likeliest: {'; '.join(likely_reasons(outcome))}"
    if not judgement.rejected:
        return f"nothing fits: {LOST_PHASE}, which are {share} of the inertia forces. {likeliest}"
    return (
        f"nothing fits: the best model still errs by {share} of the signal; the system file does not seem to "
        f"belong to this recording. {likeliest}"
    )


def likely_reasons(outcome: Outcome) -> list[str]:
    """Two or three likely reasons why nothing fits."""
    state, before = outcome.investigation, outcome.runs.before
    names, rules = state.signals.sensor_names, state.options.rules.report
    turned, scales = [], []
    for i, name in enumerate(names):
        measured, simulated = before.measured[:, i], before.simulated[:, i]
        power = float(np.sum(measured**2) * np.sum(simulated**2))
        alike = float(measured @ simulated) / np.sqrt(power) if power > 0 else 0.0
        if alike < -rules.alike:
            turned.append(name)
        elif alike > rules.alike:
            scale = float(np.sqrt(np.sum(measured**2) / np.sum(simulated**2)))
            if not 1 / rules.scale < scale < rules.scale:
                scales.append(f"{name} is {scale:.3g} times what it should show (a unit or a scale?)")
    doubted = [fault for fault in state.setup_faults if outcome.judgement.rejected and not fault.effect.model_free]
    reasons = [fault.effect.describe(fault.site, "") for fault in doubted if fault.value is None]
    reasons += [f"the sign of {', '.join(turned)}"] if turned else []
    reasons += scales[:1]
    sigma = np.sqrt(np.maximum(np.diag(state.base.covariance), 0))[: len(state.base.point.theta)]
    far = [
        i
        for i in np.argsort(-np.abs(state.base.point.theta))
        if abs(state.base.point.theta[i]) > rules.far * (1 + sigma[i])
    ]
    if far:
        parameter = state.system.parameters[int(far[0])]
        factor = float(np.exp(state.base.point.theta[int(far[0])]))
        reasons.append(f"{parameter.name} came out {factor:.2g} times nominal, which is not plausible: units, masses")
    reasons.append("an unmeasured excitation")
    reasons.append("channels swapped, sensors elsewhere than stated, or bodies that the file does not have")
    return reasons[:3]


def undecided(state: Investigation) -> list[str]:
    """Parameters that the recording cannot determine."""
    sigma = deviations(state.system, state.base)
    loose = [p.name for i, p in enumerate(state.system.parameters) if sigma[i] > state.options.rules.report.loose]
    if not loose:
        return []
    return [
        f"undecided: {some(loose, 6)}: the motion is too small or the recording too short to distinguish them from "
        "nominal; record longer, faster or on rougher track"
    ]
