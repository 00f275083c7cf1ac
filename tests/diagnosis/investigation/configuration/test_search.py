"""Wrong set-ups of a simulated vehicle are found and undone; a right one is left alone."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.benchmarks.generator import draw_cases, make_recordings, read_vehicle
from sprung.benchmarks.sensitivity_cases import QUARTER_CAR
from sprung.benchmarks.setups import KINDS, falsified, in_order
from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.investigation.configuration.fitted import FittedSetup, SetupFault
from sprung.model.diagnosis.investigation.configuration.search import without_setup_faults
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise
from sprung.model.diagnosis.record.split import cut
from sprung.model.system import MANCHESTER, System, load_system, parse_system
from tests.diagnosis_cases import simulate


@pytest.fixture(scope="module")
def vehicle() -> tuple[System, np.ndarray]:
    system, drawn = load_system(), read_vehicle(MANCHESTER)
    (made,) = make_recordings(drawn, draw_cases(drawn, 1, 77, ["clean"]), 10.0)
    return system, in_order(system, made.values)


def found(system: System, values: np.ndarray) -> tuple[SetupFault, ...]:
    signals, split = cut(prepare(system, values, 100.0).signals)
    declared = declared_noise(system, signals)
    problem, fit = baseline(system, signals, declared, split)
    return without_setup_faults(FittedSetup(system, signals, split, declared, problem, fit))[1]


def test_a_right_set_up_is_left_alone(vehicle: tuple[System, np.ndarray]) -> None:
    assert found(*vehicle) == ()


@pytest.mark.parametrize(
    "kind",
    [
        "left and right",
        "late inputs",
        pytest.param("element at another body", marks=pytest.mark.slow),
        pytest.param("upside down", marks=pytest.mark.slow),
        pytest.param("scale of a node", marks=pytest.mark.slow),
    ],
)
def test_a_wrong_set_up_is_named_at_its_channels(kind: str, vehicle: tuple[System, np.ndarray]) -> None:
    system, values = vehicle
    wrong = falsified(system, values, kind, np.random.default_rng(8))
    fault = found(wrong.file or system, wrong.values)[0]
    assert fault.effect.name == KINDS[kind]
    assert frozenset(fault.site.location.split("|")) == wrong.channels


@pytest.mark.slow
def test_all_sensors_of_two_bodies_exchanged_are_no_other_structure() -> None:
    """Under a road whose displacement alone is measured; each pair by itself would explain too little."""
    once = parse_system(QUARTER_CAR.replace("    velocity: {csv: v, noise: 5.0e-4}\n", ""))
    values = np.delete(simulate(seed=45).values, 1, axis=1)
    (fault,) = found(once, values[:, [0, 3, 4, 1, 2]])
    assert (fault.effect.name, fault.site.location) == ("channels_swapped", "car_a|bogie_a|car_b|bogie_b")


@pytest.mark.slow
def test_a_delay_is_estimated_with_its_deviation(vehicle: tuple[System, np.ndarray]) -> None:
    system, values = vehicle
    names = [channel.name for channel in system.channels]
    at = [names.index(name) for name in system.sensors if name.startswith("bogie2")]
    late = values[7:].copy()
    late[:, at] = values[:-7, at]
    (fault,) = found(system, late)
    assert fault.value == pytest.approx(0.07, abs=1e-3)
