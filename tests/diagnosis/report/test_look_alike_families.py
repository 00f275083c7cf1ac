"""When a law is named alone, and when with its look-alikes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.investigation.state import AcceptedFinding
from sprung.model.diagnosis.report.findings import _elsewhere, _look_alikes
from sprung.model.diagnosis.rules import RULES
from sprung.model.laws import observe
from sprung.model.laws.basis import static_law, trials
from sprung.model.laws.damping import COULOMB_FRICTION, DAMPER_BLOWOFF
from sprung.model.laws.stiffness import BUMP_STOP


def trial(law: Any, evidence: float, location: str = "strut") -> Any:
    return SimpleNamespace(
        evidence=evidence,
        named=law.named,
        finished=True,
        freedom=len(law.parameters),
        term=SimpleNamespace(law=law, location=location),
    )


def test_a_name_of_less_evidence_than_an_implausible_one_is_not_reported_alone() -> None:
    chosen = trial(COULOMB_FRICTION, 100.0)
    better, elsewhere = trial(DAMPER_BLOWOFF, 103.0), trial(DAMPER_BLOWOFF, 120.0, "tyre")
    for other, family in ((better, "coulomb_friction or damper_blowoff"), (elsewhere, None)):
        assert _look_alikes(AcceptedFinding(chosen, (), None, 1e-9, (other,)), RULES)[0] == family
    near = AcceptedFinding(chosen, (trial(DAMPER_BLOWOFF, 97.0),), None, 1e-9)
    assert _look_alikes(near, RULES)[0] == "coulomb_friction or damper_blowoff"


@pytest.mark.parametrize(
    ("shape", "behind", "family"),
    [
        ("d^2", 3.0, "bump_stop or unknown"),  # of the recording's evidence: it says as much for a smooth spring
        ("d^2", 20.0, None),  # it speaks for the stop, by odds of more than 20 to 1
        ("map", 3.0, None),  # so flexible that it imitates any law
    ],
)
def test_a_law_is_not_named_alone_beside_a_force_without_a_name_that_is_as_plain_and_does_as_well(
    shape: str, behind: float, family: str | None
) -> None:
    seen = observe(np.linspace(-4e-3, 4e-3, 100), np.linspace(-0.05, 0.05, 100), 100.0, 4e5, 2e4)
    force = static_law(trials()[shape], seen)
    rarity = RULES.evidence.rarity * force.prior_cost  # before the recording: no evidence of its
    stop, smooth = trial(BUMP_STOP, 100.0), trial(force, 100.0 - rarity - behind)
    assert _look_alikes(AcceptedFinding(stop, (smooth,), None, 1e-9), RULES)[0] == family


def test_other_places_at_which_the_same_law_does_as_well_are_reported() -> None:
    chosen = trial(COULOMB_FRICTION, 100.0)
    rivals = (trial(COULOMB_FRICTION, 99.0, "tyre"), trial(COULOMB_FRICTION, 60.0, "bush"))
    assert _elsewhere(AcceptedFinding(chosen, (chosen, *rivals), None, 1e-9), RULES.report) == ("tyre",)
