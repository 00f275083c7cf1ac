"""Recordings that lack inputs are refused in one line that says which and what to do."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.record.channels import DiagnosisError, prepare
from sprung.model.system import load_system

REST = "nothing can be simulated without"


@pytest.mark.parametrize(
    ("lost", "value", "told"),
    [
        (("wheel_11l",), np.nan, f"input wheel_11l is missing from the recording: {REST} it"),
        (("wheel_11l", "wheel_22r"), np.nan, f"inputs wheel_11l and wheel_22r are missing from the recording: {REST}"),
        (("wheel_",), np.nan, f"inputs wheel_11l and 7 more are missing from the recording: {REST} them"),
        (("wheel_1",), 0.3, f"inputs wheel_11l and 3 more are stuck: {REST} them"),
    ],
)
def test_missing_inputs_are_named_together_with_what_to_do(lost: tuple[str, ...], value: float, told: str) -> None:
    system = load_system()
    values = np.random.default_rng(1).normal(size=(3000, len(system.channels)))
    values[:, [c.name.startswith(lost) for c in system.channels]] = value
    with pytest.raises(DiagnosisError) as refused:
        prepare(system, values, system.sample_rate)
    line = str(refused.value)
    assert line.startswith(told)
    assert "\n" not in line
    assert "record it again" in line or "record them again" in line
    assert line.endswith("a vehicle below which nothing is measured needs inputs of kind track") == np.isnan(value)
