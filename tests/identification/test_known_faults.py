"""Faults that earlier windows of a vehicle had: found again without a search, and given up once they are gone."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.identify import Identifier
from sprung.model.identification.refine import Refiner
from sprung.model.signals import FloatArray, MeasurementFault
from sprung.model.system import BUNDLED, System, load_system
from tests.identification.test_measurements import record, windows

Faults = tuple[MeasurementFault, ...]


@pytest.fixture(scope="module")
def system() -> System:
    return load_system()


@pytest.fixture(scope="module")
def samples() -> FloatArray:
    """Clean samples of a loaded car with springs and dampers off by up to 15 %."""
    return record(6, 12, 0.2, np.random.default_rng(12).uniform(-0.15, 0.15, 24))


@contextmanager
def counted() -> Iterator[list[int]]:
    """Windows of every refinement."""
    sizes: list[int] = []
    plain = Refiner.refine

    def refine(self: Refiner, values: FloatArray, *args: Any, **settings: Any) -> Any:
        sizes.append(len(values))
        return plain(self, values, *args, **settings)

    with patch.object(Refiner, "refine", refine):
        yield sizes


def made(samples: FloatArray, kind: str) -> FloatArray:
    wrong = samples.copy()
    if kind == "exchanged":
        wrong[:, [20, 22]] = samples[:, [22, 20]]
    elif kind == "reversed":
        wrong[:, 9] *= -1
    else:
        wrong[:, 21] = samples[0, 21]
    return wrong


@pytest.mark.parametrize("kind", ["exchanged", "reversed", "frozen"])
def test_a_lasting_fault_is_found_again_by_one_refinement_with_the_same_values(
    system: System, samples: FloatArray, kind: str
) -> None:
    values, nothing = windows(system, made(samples, kind), hop=100)[1:4], np.zeros(3, dtype=bool)
    if kind == "frozen":
        values[:, :, 21] = values[0, 0, 21]
    identifier = Identifier(system)
    searched = identifier.examine(values, nothing)
    known = [e.faults for e in searched]
    assert all(known)
    with counted() as sizes:
        again = identifier.examine(values, nothing, known)
    assert sizes == [3]
    assert [e.faults for e in again] == known
    for a, b in zip(again, searched, strict=True):
        assert a.adequate and b.adequate
        np.testing.assert_allclose(a.log_ratio, b.log_ratio, rtol=0, atol=1e-9)
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6, atol=1e-12)


def test_a_frozen_input_is_found_again_by_one_refinement(system: System, samples: FloatArray) -> None:
    values = windows(system, samples, hop=100)[1:3]
    values[:, :, 3] = 0.1
    known: list[Faults] = [(MeasurementFault("wheel_11r.velocity", "frozen", 0.2),)] * 2
    with counted() as sizes:
        found = Identifier(system).examine(values, np.zeros(2, dtype=bool), known)
    assert sizes == [2]
    assert [e.faults for e in found] == [(MeasurementFault("wheel_11r.velocity", "frozen", 0.1),)] * 2
    assert not any(e.adequate for e in found)


@pytest.mark.parametrize(
    ("channel", "kind"),
    [("bogie1_1l|bogie1_2l", "swapped"), ("wheel_21l.velocity", "inverted"), ("bogie1_1r", "frozen")],
)
def test_a_repaired_channel_is_not_accepted_to_be_wrong_any_more(
    system: System, samples: FloatArray, channel: str, kind: Any
) -> None:
    values = windows(system, samples, hop=100)[1:3]
    known = [(MeasurementFault(channel, kind, 0.0),)] * 2
    for estimate in Identifier(system).examine(values, np.zeros(2, dtype=bool), known):
        assert estimate.adequate and not estimate.faults


def test_another_exchange_than_the_known_one_is_looked_for(system: System, samples: FloatArray) -> None:
    values = windows(system, made(samples, "exchanged"), hop=100)[1:3]
    known: list[Faults] = [(MeasurementFault("bogie1_1r|bogie1_2r", "swapped", 0.0),)] * 2
    for estimate in Identifier(system).examine(values, np.zeros(2, dtype=bool), known):
        assert [f.channel for f in estimate.faults] == ["bogie1_1l|bogie1_2l"]


def test_a_known_exchange_that_contradicts_nothing_is_undone_while_it_lasts() -> None:
    """Accelerometers on axle boxes measure every wheel once."""
    system, rng = load_system(BUNDLED / "axleboxes.yaml"), np.random.default_rng(13)
    right = simulate_runs(system, np.zeros((2, 24)), system.window, rng).values
    known: list[Faults] = [(MeasurementFault("wheel_22l.acceleration|wheel_22r.acceleration", "swapped", 0.0),)] * 2
    wrong, identifier = right.copy(), Identifier(system)
    wrong[:, :, [6, 7]] = right[:, :, [7, 6]]
    with counted() as sizes:
        found = identifier.examine(wrong, np.zeros(2, dtype=bool), known)
    assert sizes == [2] and [e.faults for e in found] == known
    assert not any(e.faults for e in identifier.examine(right, np.zeros(2, dtype=bool), known))
