"""Friction and valve of one damper, read from the force that a friction changing with the rate shows."""

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.api import Options
from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.investigation.diagnose import begun
from sprung.model.diagnosis.response.terms import WIDER, Term
from sprung.model.diagnosis.screening.families import ELEMENT
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.selection.matched import matched_starts
from sprung.model.diagnosis.selection.starts import start_of
from sprung.model.laws import find_law
from tests.diagnosis_cases import DAMPING, quarter_car, simulate

FRICTION, KNEE, RATIO = 300.0, 0.02, 0.4


def _friction_and_valve(d: float, v: float) -> float:
    return FRICTION * np.tanh(v / 1e-3) + (RATIO - 1) * DAMPING["secondary"] * (v - min(max(v, -KNEE), KNEE))


def test_one_of_the_starts_is_near_both_laws_and_their_damper() -> None:
    state = begun(quarter_car(), simulate(_friction_and_valve, seconds=12, seed=2), Options(), lambda share, text: None)
    law = find_law("coulomb_friction")
    assert law.wider is not None
    narrow = Term(law, "secondary", (500.0, 0.006), scales=(500.0, 0.006))
    base = optimise(state.problem, start_of(state.fit, Candidate(narrow, 1.0, ELEMENT)), 8)
    wide = Term(law.wider, "secondary", (500.0, 1e-3, 200.0, 0.01), WIDER, scales=(500.0, 1e-3, 200.0, 0.01))
    widened = replace(base.point, terms=(wide,))
    shown = optimise(state.problem, widened, 12)
    valve = Term(find_law("damper_blowoff"), "secondary", (0.035, 0.9), scales=(0.02, 0.3))
    at = [p.name for p in state.system.parameters].index("secondary.damping")
    near = []
    for start in matched_starts(state.problem, base, shown, 0, Candidate(valve, 1.0, ELEMENT)):
        friction, other = start.terms
        damping = state.system.nominal[at] * np.exp(start.theta[at])
        found = (friction.parameters[0], *other.parameters, damping)
        near.append(found == pytest.approx((FRICTION, KNEE, RATIO, DAMPING["secondary"]), rel=0.3))
    assert any(near)
    assert base.point.terms[0].parameters[0] > 1.3 * FRICTION  # the narrow law alone is far off
