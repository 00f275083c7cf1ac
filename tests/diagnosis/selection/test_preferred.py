"""Whether a law with a name or a force without one leads."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.selection.compete import Trial, preferred
from sprung.model.laws import observe
from sprung.model.laws.basis import SMALL, static_law
from tests.named_laws import element_law

SEEN = observe(np.linspace(-4e-3, 4e-3, 100), np.linspace(-0.05, 0.05, 100), 100.0, 4e5, 2e4)


def _trial(law: Any, gain: float, evidence: float) -> Trial:
    nothing: Any = None
    fit: Any = SimpleNamespace(
        point=SimpleNamespace(terms=(Term(law, "secondary", tuple(1.0 for _ in law.parameters)),)),
        noise=SimpleNamespace(process_noise=False),
    )
    return Trial(nothing, fit, gain, gain, evidence, len(law.parameters))


@pytest.mark.parametrize(
    ("gain", "evidence", "leads"),
    [
        (1000.0, 1050.0, False),  # as much: a law is expected
        (1080.0, 1050.0, False),  # laws are simulated no better
        (1250.0, 1005.0, False),  # more, but it costs nearly as much
        (1250.0, 1020.0, True),  # a stop in place of a spring that is quadratic
        (1400.0, 1001.0, True),  # far more
    ],
)
def test_an_unnamed_force_leads_where_it_says_far_more_or_more_with_certainty(
    gain: float, evidence: float, leads: bool
) -> None:
    stop = _trial(element_law("bump_stop"), 1000.0, 1000.0)
    force = _trial(static_law(SMALL["d^2"], SEEN), gain, evidence)
    assert preferred([force, stop])[0] is (force if leads else stop)
