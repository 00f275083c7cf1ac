"""Laws that leave more than a verdict lets pass are not named in its report either."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.component.diagnose import _doubtful
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.diagnosis.investigation.verdict import HeldOutErrors
from sprung.model.diagnosis.rules import RULES

DAHL = next(piece for piece in PIECES if piece.effect == "dahl")


def judged(before: float, after: float) -> Any:
    """One law on a record of one loop, with errors over the deviation of the force; a floor of 0.001."""
    step, motion = SimpleNamespace(piece=DAHL), SimpleNamespace(repeats=lambda rules: True)
    return SimpleNamespace(
        errors=HeldOutErrors(np.array([before]), np.array([after]), np.array([1e-3])),
        found=SimpleNamespace(steps=(step,)),
        final=SimpleNamespace(
            task=SimpleNamespace(rules=RULES.component, motion=motion),
            model=SimpleNamespace(pieces=(DAHL,)),
            leaves_more=True,
        ),
        base=None,
        alike=(),
        record=SimpleNamespace(given=SimpleNamespace(pieces=())),
    )


@pytest.mark.parametrize(
    ("before", "after", "doubtful"),
    [
        (0.7, 0.25, False),  # 87 % of the excess, 6 % of the force's power left
        (0.9, 0.36, True),  # 84 % of the excess, but 13 % of the force's power left
        (0.7, 0.4, True),  # 67 % of the excess
    ],
)
def test_a_law_is_doubtful_where_the_verdict_would_not_take_its_name(
    before: float, after: float, doubtful: bool
) -> None:
    assert _doubtful(judged(before, after), RULES.verdict) is doubtful
