"""When a law is named alone, and when with its look-alikes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from sprung.model.diagnosis.investigation.state import AcceptedFinding
from sprung.model.diagnosis.report.findings import _elsewhere, _look_alikes
from sprung.model.diagnosis.rules import RULES
from sprung.model.laws.damping import COULOMB_FRICTION, DAMPER_BLOWOFF


def trial(law: Any, evidence: float, location: str = "strut") -> Any:
    return SimpleNamespace(
        evidence=evidence, named=True, finished=True, term=SimpleNamespace(law=law, location=location)
    )


def test_a_name_of_less_evidence_than_an_implausible_one_is_not_reported_alone() -> None:
    chosen = trial(COULOMB_FRICTION, 100.0)
    better, elsewhere = trial(DAMPER_BLOWOFF, 103.0), trial(DAMPER_BLOWOFF, 120.0, "tyre")
    for other, family in ((better, "coulomb_friction or damper_blowoff"), (elsewhere, None)):
        assert _look_alikes(AcceptedFinding(chosen, (), None, 1e-9, (other,)), RULES.report)[0] == family
    near = AcceptedFinding(chosen, (trial(DAMPER_BLOWOFF, 97.0),), None, 1e-9)
    assert _look_alikes(near, RULES.report)[0] == "coulomb_friction or damper_blowoff"


def test_other_places_at_which_the_same_law_does_as_well_are_reported() -> None:
    chosen = trial(COULOMB_FRICTION, 100.0)
    rivals = (trial(COULOMB_FRICTION, 99.0, "tyre"), trial(COULOMB_FRICTION, 60.0, "bush"))
    assert _elsewhere(AcceptedFinding(chosen, (chosen, *rivals), None, 1e-9), RULES.report) == ("tyre",)
