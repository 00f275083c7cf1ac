"""No further law is sought where one leaves most of what was missing and a model that is none of the recording."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.investigation import diagnose
from sprung.model.diagnosis.rules import RULES


@pytest.mark.parametrize(
    ("left", "error", "rejected"),
    [(0.9, 0.8, True), (0.3, 0.8, False), (0.9, 0.3, False)],  # of chi-square; of the sensors
)
def test_a_finding_that_hardly_helps_a_rejected_model_is_the_last(
    left: float, error: float, rejected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diagnose, "misfit", lambda fit: np.full(3, error**2))
    state: Any = SimpleNamespace(
        options=SimpleNamespace(rules=RULES),
        problem=SimpleNamespace(process_noise=False),
        fit=SimpleNamespace(chi_square=left * 1e4),
    )
    before: Any = SimpleNamespace(chi_square=1e4)
    assert diagnose._still_rejected(state, before) is rejected
