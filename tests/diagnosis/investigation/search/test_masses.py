"""Two masses that are off at once are told as masses, not as what imitates them."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.benchmarks.cars import EFFECTS, recorded
from sprung.benchmarks.setup_rigs import RigRecord
from sprung.model.diagnosis.api import diagnose


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 9])
def test_two_masses_beside_exact_instruments_are_no_springs_and_no_gains(number: int) -> None:
    """Sprung +3.3 % and unsprung -5.8 %, or +1.9 % and -6.5 %: an air spring of the tyre fits better than either."""
    system, values = recorded(EFFECTS[0], np.random.default_rng([61109, number]))
    report = diagnose(system, RigRecord(values, system.sample_rate))
    told = {one.location: one for one in report.findings}
    assert {one.effect for one in told.values()} == {"mass_change"}
    (ratio,) = told["unsprung"].parameters
    truth = {0: 0.9422, 9: 0.9353}[number]
    assert abs(ratio.value - truth) < 3 * ratio.std < 0.05
