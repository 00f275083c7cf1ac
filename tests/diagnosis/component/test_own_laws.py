"""Laws of a user's own are searched in component tests, and those that cannot be are named with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.api import diagnose
from sprung.model.diagnosis.component.diagnose import pieces_of
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.laws import CATALOGUE, ElementLaw, ParameterSpec, grid
from sprung.model.system import parse_system
from tests.diagnosis.component.test_component import TEXT, C, K, RigRecording, report, sweep

WAVES = ElementLaw(
    name="cogging",
    title="cogging",
    parameters=(
        ParameterSpec("size", "N", 0.0, 1e6, "amplitude", lambda seen: 50.0),
        ParameterSpec("pitch", "m", 1e-4, 1.0, "of the teeth", lambda seen: seen.deflection_rms, log=True),
    ),
    force=lambda motion, p, element: p[0] * np.sin(2 * np.pi * motion.deflection / p[1]),
    shapes=lambda seen: grid([50.0], seen.deflection_rms * np.geomspace(0.1, 2.0, 16)),
    absent=(0.0, 1e-2),
    looks_like="waves over the deflection",
    confused_with=(),
    sentence="cogging of {size} every {pitch}",
)
LOST = ElementLaw(  # a share of the spring that is gone beyond a deflection: linear in nothing, and follows the spring
    name="lost_spring",
    title="a spring that leaves its seat",
    parameters=(ParameterSpec("reach", "m", 1e-4, 1.0, "deflection", lambda seen: seen.deflection_rms, log=True),),
    force=lambda motion, p, element: -element.stiffness * np.maximum(np.asarray(motion.deflection) - p[0], 0.0),
    shapes=lambda seen: grid(seen.deflection_rms * np.array([0.3, 0.6, 1.0, 1.5])),
    absent=(1.0,),
    looks_like="no force beyond a deflection",
    confused_with=(),
    sentence="no force beyond {reach}",
    strength=None,
)
TORN = replace(  # depends on spring and damper together
    LOST, name="torn", force=lambda motion, p, element: -element.stiffness * element.damping * motion.rate * p[0]
)
_, D, V = sweep(6.0)
MIDDLE = 0.5 * (D.max() + D.min())


def test_a_law_of_a_user_is_found_with_its_values() -> None:
    force = K * D + C * V + 40 * np.sin(2 * np.pi * (D - MIDDLE) / 3.1e-3)
    found = report(force, D, own=(WAVES, TORN))
    first = found.findings[0]
    assert (first.effect, first.family, found.verdict) == ("cogging", None, "missing_physics")
    values = {p.name: p for p in first.parameters}
    for name, truth in (("size", 40.0), ("pitch", 3.1e-3)):
        assert values[name].value == pytest.approx(truth, abs=5 * values[name].std + 0.01 * truth)
    assert any("not searched here: torn:" in line for line in found.advice)
    law = found.laws[0]
    assert (law.effect, [p.name for p in law.parameters]) == ("cogging", ["size", "pitch"])


def test_a_law_that_follows_the_spring_and_is_linear_in_nothing_is_found() -> None:
    force = K * D + C * V - K * np.maximum(D - MIDDLE - 6e-3, 0.0)
    found = report(force, D, own=(LOST,))
    first = found.findings[0]
    assert first.effect == "lost_spring"
    assert first.parameters[0].value == pytest.approx(6e-3, rel=0.02)


def test_a_law_of_a_user_in_the_system_file_is_fitted_and_nothing_is_missing() -> None:
    text = TEXT.replace("damping: 1.5e3", "damping: 1.5e3, laws: [{cogging: {size: 30, pitch: 3.3e-3}}]")
    random = np.random.default_rng(2)
    force = K * D + C * V + 40 * np.sin(2 * np.pi * (D - MIDDLE) / 3.1e-3)
    columns = [D + 1e-6 * random.standard_normal(len(D)), force + random.standard_normal(len(D))]
    catalogue = (*CATALOGUE, WAVES)
    system = parse_system(text, catalogue=catalogue)
    found = diagnose(system, RigRecording(np.column_stack(columns)))
    assert found.verdict == "consistent"
    values = {p.name: p.value for p in found.laws[0].parameters}
    assert values == pytest.approx({"size": 40.0, "pitch": 3.1e-3}, rel=0.02)


def test_what_is_searched_follows_the_catalogue() -> None:
    assert pieces_of(CATALOGUE) == (PIECES, ())
    assert pieces_of((*CATALOGUE, WAVES)) == (PIECES, (WAVES,))
    friction = [law for law in CATALOGUE if law.name == "coulomb_friction"]
    pieces, own = pieces_of(friction)
    assert {piece.law.name for piece in pieces} == {"coulomb_friction"} and own == ()
