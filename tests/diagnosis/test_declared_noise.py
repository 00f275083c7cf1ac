"""The verdict on a vehicle does not hang on the noise that its file declares, within a factor of ten either way."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from sprung.benchmarks.generator import draw_cases, make_recordings, read_vehicle
from sprung.benchmarks.setups import in_order
from sprung.model.diagnosis.api import diagnose
from sprung.model.signals import FloatArray
from sprung.model.system import MANCHESTER, System, load_system


@dataclass
class NoisyRide:
    values: FloatArray
    sample_rate: float = 100.0
    lost: int = 0


def declared(system: System, factor: float) -> System:
    """The system with all declared noise times a factor."""
    sensors = {name: s.model_copy(update={"noise": s.noise * factor}) for name, s in system.file.sensors.items()}
    inputs = {}
    for name, source in system.file.inputs.items():
        quantities = ("displacement", "velocity")
        louder = {q: a.model_copy(update={"noise": a.noise * factor}) for q in quantities if (a := getattr(source, q))}
        inputs[name] = source.model_copy(update=louder)
    return System(system.file.model_copy(update={"sensors": sensors, "inputs": inputs}))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["clean", "coulomb_friction"])
@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_the_verdict_on_a_vehicle_does_not_hang_on_the_declared_noise(kind: str, factor: float) -> None:
    drawn = read_vehicle(MANCHESTER)
    cases = draw_cases(drawn, 1, 31, [kind])
    (made,) = make_recordings(drawn, cases, 30.0)
    system = declared(load_system(), factor)
    report = diagnose(system, NoisyRide(in_order(system, made.values)))
    assert report.verdict == ("consistent" if kind == "clean" else "missing_physics")
    assert [(f.location, f.effect) for f in report.findings] == [
        (f["location"], f["effect"]) for f in cases[0].findings()
    ]
    assert report.unexplained.share == 0
