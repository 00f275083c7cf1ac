"""A fluid damper in a building that an earthquake shakes is named, not a valve beside friction."""

import pytest

from sprung.benchmarks.shaken import building
from sprung.model.diagnosis.api import Options, diagnose


@pytest.mark.slow
def test_a_fluid_damper_is_named_with_its_exponent() -> None:
    rig = building(4, "fluid", seed=5)
    report = diagnose(rig.system, rig, Options())
    (found,) = report.findings
    assert (found.location, found.effect) == ("s1", "power_law_damping")
    exponent = {p.name: p for p in found.parameters}["exponent"]
    assert abs(exponent.value - 0.35) < 3 * exponent.std < 0.03
