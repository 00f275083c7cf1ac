"""Redundant channels that contradict each other: what is exchanged or reversed, whatever the springs are."""

import numpy as np
import pytest

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.fault_isolation.contradictions import Contradictions
from sprung.model.identification.identify import Identifier
from sprung.model.identification.refinement.refine import Refiner
from sprung.model.signals import FloatArray
from sprung.model.system import BUNDLED, System, load_system, parse_system
from tests.identification.measurements.test_measurements import record, windows

TWO_SUPPORTS = """
name: two alike
sample_rate: 100
window: 100
bodies: {mass: {mass: 1000}}
inputs:
  a: {kind: support, displacement: {csv: a, noise: 1.0e-5}, velocity: {csv: va, noise: 5.0e-4}}
  b: {kind: support, displacement: {csv: b, noise: 1.0e-5}, velocity: {csv: vb, noise: 5.0e-4}}
elements:
  at_a: {upper: mass, lower: a, position: [1.0, 1.0], stiffness: 1.0e+6, damping: 8.0e+3}
  at_b: {upper: mass, lower: b, position: [-1.0, -1.0], stiffness: 1.0e+6, damping: 8.0e+3}
sensors:
  top: {kind: acceleration, body: mass, csv: top, noise: 0.01}
"""


@pytest.fixture(scope="module")
def system() -> System:
    return load_system()


@pytest.fixture(scope="module")
def loaded() -> tuple[FloatArray, FloatArray]:
    """Clean samples of a loaded car with springs and dampers off by up to 15 %, and log-ratios."""
    truth = np.random.default_rng(11).uniform(-0.15, 0.15, 24)
    return record(8, 11, 0.2, truth), truth


@pytest.mark.parametrize("pair", [(16, 17), (18, 19), (20, 22), (0, 2), (20, 24), (16, 20), (1, 11), (4, 5)], ids=str)
def test_exchanged_ends_of_a_loaded_vehicle_are_named_and_no_spring_is_wrong(
    system: System, loaded: tuple[FloatArray, FloatArray], pair: tuple[int, int]
) -> None:
    samples, truth = loaded
    values = windows(system, samples, hop=100)[1:7]
    values[:, :, pair] = values[:, :, pair[::-1]]  # with its noise
    names = "|".join(system.channels[c].name for c in pair)
    for estimate in Identifier(system).examine(values, np.zeros(6, dtype=bool)):
        assert [(f.channel, f.kind) for f in estimate.faults] == [(names, "swapped")]
        assert estimate.adequate
        wrong = (estimate.log_ratio - truth) / np.sqrt(np.diag(estimate.covariance))
        assert np.sqrt(np.mean(wrong**2)) < 1.6


def test_exchanged_inputs_that_contradict_nothing_are_named_by_the_response_of_the_vehicle() -> None:
    """Accelerometers on axle boxes measure every wheel once; springs and dampers are off by up to 15 %."""
    system, rng = load_system(BUNDLED / "axleboxes.yaml"), np.random.default_rng(13)
    truth = np.tile(rng.uniform(-0.15, 0.15, 24), (3, 1))
    values = simulate_runs(system, truth, system.window, rng).values
    values[:, :, [6, 7]] = values[:, :, [7, 6]]
    for estimate in Identifier(system).examine(values, np.zeros(3, dtype=bool)):
        (fault,) = estimate.faults
        assert (fault.channel, fault.kind) == ("wheel_22l.acceleration|wheel_22r.acceleration", "swapped")
        assert estimate.adequate


def test_neither_springs_nor_loads_nor_gains_make_a_contradiction(
    system: System, loaded: tuple[FloatArray, FloatArray]
) -> None:
    contradictions = Contradictions(Refiner(system).calibration, np.zeros(28, dtype=np.int64))
    rng = np.random.default_rng(1)
    values = windows(system, loaded[0] * (1 + 0.03 * rng.uniform(-1, 1, 28)), hop=100)
    assert not contradictions.contradicted(values).any()
    assert all(contradictions.ended_by(window) == () for window in values)
    values[:, :, 16] = np.nan  # three accelerometers of a rigid body say nothing of each other
    values[:, :, 17] *= -1
    assert not contradictions.contradicted(values).any()


def test_an_exchange_that_cannot_be_distinguished_from_another_is_said_to_be_one_of_both() -> None:
    """Springs at two supports of one mass: exchanged displacements are exchanged velocities and exchanged springs."""
    system = parse_system(TWO_SUPPORTS)
    runs = simulate_runs(system, np.zeros((4, 4)), system.window, np.random.default_rng(2)).values
    runs[:, :, [0, 2]] = runs[:, :, [2, 0]]
    for estimate in Identifier(system).examine(runs, np.zeros(4, dtype=bool)):
        ((channels, kind),) = [(f.channel, f.kind) for f in estimate.faults]
        assert (set(channels.split("|")), kind) == (
            {"a.displacement", "b.displacement", "a.velocity", "b.velocity"},
            "swapped",
        )
        assert not estimate.adequate
