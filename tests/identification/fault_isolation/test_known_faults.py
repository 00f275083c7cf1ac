"""Faults that earlier windows of a vehicle had: found again without a search, and given up once they are gone."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.fault_isolation.steps import DeviationSteps
from sprung.model.identification.identify import Identifier
from sprung.model.identification.measurements.deviations import deviations
from sprung.model.identification.refinement.refine import Refiner
from sprung.model.signals import FloatArray, MeasurementFault
from sprung.model.system import BUNDLED, System, load_system
from tests.identification.measurements.test_measurements import record, windows

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
    assert all(e.adequate and e.identifiable.all() for e in found)  # the displacement is enough


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


def wrong(samples: FloatArray) -> tuple[FloatArray, Faults]:
    """A gain of 4 % and all of a clock 2 ms late, and how a tracker knows of them."""
    gained, names = samples.copy(), [channel.name for channel in load_system().channels]
    gained[:, 20] *= 1.04
    time = np.arange(len(samples)) / 100
    late = range(16, 20)
    for c in late:
        gained[:, c] = make_interp_spline(time, samples[:, c], k=7)(np.clip(time - 0.002, 0, None))
    clock = MeasurementFault("|".join(names[c] for c in late), "delay", 0.002)
    return gained, (MeasurementFault("bogie1_1l", "gain", 1.04), clock)


def test_known_gains_and_delays_are_taken_back_without_a_search(system: System, samples: FloatArray) -> None:
    gained, faults = wrong(samples)
    values, right = windows(system, gained, hop=100)[1:4], windows(system, samples, hop=100)[1:4]
    weigh, identifier = np.array([True, False, True]), Identifier(system)
    with counted() as sizes:
        found = identifier.examine(values, weigh, [faults] * 3)
    assert sizes == [3]
    whole = identifier.examine(right, weigh)
    for one, clean in zip(found, whole, strict=True):
        assert one.adequate and not one.faults and one.deviating is not None
        assert one.deviating.point[[20, 28 + 16, 28 + 19, 0]] == pytest.approx([0.04, 0.002, 0.002, 0.0])
        assert one.deviating.whole == (clean.deviating is not None and clean.deviating.whole)
        off = (one.log_ratio - clean.log_ratio) / np.sqrt(clean.covariance.diagonal())
        assert np.abs(off).max() < 1.5  # the ends of the window are missing


def test_what_windows_say_of_a_gain_does_not_depend_on_what_was_taken_back(system: System, samples: FloatArray) -> None:
    gained = samples.copy()
    gained[:, 20] *= 1.02
    values, identifier = windows(system, gained, hop=100)[1:4], Identifier(system)
    told = []
    for known in ((), (MeasurementFault("bogie1_1l", "gain", 1.03),)):
        found = [e.deviating for e in identifier.examine(values, np.ones(3, dtype=bool), [known] * 3)]
        information = np.diag([d.std**-2 for d in deviations(system)])
        pull = np.zeros(len(information))
        for one in found:
            assert one is not None
            information += one.information
            pull += one.score + one.information @ one.point
        told.append((np.linalg.solve(information, pull)[20], np.linalg.inv(information)[20, 20] ** 0.5))
    (plain, std), (near, _) = told
    assert near == pytest.approx(plain, abs=0.3 * std)
    assert plain == pytest.approx(0.02, abs=3 * std)


def test_a_gain_taken_back_before_an_exchange_is_found_is_that_of_the_right_channel(
    system: System, samples: FloatArray
) -> None:
    """Columns 20 and 22 are exchanged; the tracker knew a gain of the first, which is in the second column now."""
    exchanged = samples.copy()
    exchanged[:, 20], exchanged[:, 22] = samples[:, 22], 1.03 * samples[:, 20]
    values = windows(system, exchanged, hop=100)[1:3]
    known: list[Faults] = [(MeasurementFault("bogie1_1l", "gain", 1.03),)] * 2
    for one in Identifier(system).examine(values, np.ones(2, dtype=bool), known):
        assert next(f.kind for f in one.faults) == "swapped"
        assert one.deviating is not None
        seen = one.deviating.point + np.linalg.pinv(one.deviating.information, rcond=1e-6) @ one.deviating.score
        assert one.deviating.point[20] == pytest.approx(0.03, abs=0.02) or abs(seen[20] - 0.03) < 0.02


def test_standing_windows_are_refined_once_and_the_first_of_many_start_the_others(
    system: System, samples: FloatArray
) -> None:
    moving, identifier = windows(system, samples, hop=20)[:25], Identifier(system)
    standing = 1e-5 * np.random.default_rng(3).standard_normal((3, *moving.shape[1:]))
    with counted() as sizes:
        found = identifier.examine(np.concatenate([standing, moving]), np.zeros(28, dtype=bool))
    assert sizes == [3, 6, 19]
    assert [e.informative for e in found] == [False] * 3 + [True] * 25
    alone = identifier.examine(moving[:20], np.zeros(20, dtype=bool))
    for one, other in zip(found[3:], alone, strict=False):
        off = (one.log_ratio - other.log_ratio) / np.sqrt(other.covariance.diagonal())
        assert np.abs(off).max() < 0.2


def test_channels_that_are_all_off_within_their_data_sheets_leave_windows_that_fit(
    system: System, samples: FloatArray
) -> None:
    """3 % each is more than a window bears that fits only with all of them, and no fault of any one."""
    gains = 1 + 0.03 * np.random.default_rng(5).choice([-1.0, 1.0], 28)
    values, identifier = windows(system, samples * gains, hop=100)[:4], Identifier(system)
    with patch.object(DeviationSteps, "of_all", lambda self, score, information: 0 * score):
        before = identifier.examine(values, np.ones(4, dtype=bool))
    after = identifier.examine(values, np.ones(4, dtype=bool))
    assert sum(e.adequate for e in before) < 4
    assert all(e.adequate and not e.faults for e in after)
    truth = np.random.default_rng(12).uniform(-0.15, 0.15, 24)
    for one in after:
        assert np.abs((one.log_ratio - truth) / np.sqrt(one.covariance.diagonal())).max() < 4.0
