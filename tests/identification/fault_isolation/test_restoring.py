"""Windows with a fault put in: taken back step by step, tried at the nominal values, or left out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.fault_isolation.contradictions import Rearrangement
from sprung.model.identification.fault_isolation.explanation import FIT_SIGMAS, fit_limit, unexplained
from sprung.model.identification.fault_isolation.nominal_trials import NominalTrials
from sprung.model.identification.fault_isolation.restoring import Restorer
from sprung.model.identification.refinement.any_inputs import RefinerOfAnyInputs
from sprung.model.identification.refinement.refine import Refiner
from sprung.model.signals import FloatArray, MeasurementFault
from sprung.model.system import System, load_system


@pytest.fixture(scope="module")
def system() -> System:
    return load_system()


@pytest.fixture(scope="module")
def restorer(system: System) -> Restorer:
    made: dict[int, RefinerOfAnyInputs] = {}

    def refiner(samples: int) -> RefinerOfAnyInputs:
        if samples not in made:
            made[samples] = RefinerOfAnyInputs(system, lambda part: Refiner(part, samples))
        return made[samples]

    return Restorer(system, system.window, refiner, lambda windows: None)


@pytest.fixture
def window(system: System) -> FloatArray:
    """A window (T, C) of a running vehicle with springs and dampers up to 10 % off."""
    rng = np.random.default_rng(11)
    return np.array(simulate_runs(system, rng.uniform(-0.1, 0.1, (1, 24)), system.window, rng).values[0])


def column(restorer: Restorer, name: str) -> int:
    return restorer.names.index(name)


def test_a_right_window_fits_with_nothing_taken_back(restorer: Restorer, window: FloatArray) -> None:
    explained = restorer.by_steps(window[None], [()])[0]
    assert explained.faults == () and explained.corrected
    assert not explained.point[restorer.corrections.measured].any()


def test_a_gain_is_taken_back_to_what_the_window_was_before(restorer: Restorer, window: FloatArray) -> None:
    wrong, at = window.copy(), column(restorer, "bogie1_1l")
    wrong[:, at] *= 1.15
    explained = restorer.by_steps(wrong[None], [()])[0]
    ((channel, kind, value),) = [(f.channel, f.kind, f.value) for f in explained.faults]
    assert (channel, kind) == ("bogie1_1l", "gain") and value == pytest.approx(1.15, abs=0.02)
    before = restorer.by_steps(window[None], [()])[0].refined
    std = np.sqrt(np.diagonal(before.covariance[0]))
    assert np.abs(explained.refined.log_ratio[0] - before.log_ratio[0])[:24].max() < 3 * std[:24].max()


def test_faults_that_were_put_right_before_are_named_first(restorer: Restorer, window: FloatArray) -> None:
    wrong, known = window.copy(), MeasurementFault("bogie1_1r", "inverted", -1.0)
    wrong[:, column(restorer, "bogie1_1l")] *= 1.15
    faults = restorer.by_steps(wrong[None], [(known,)])[0].faults
    assert faults[0] == known and faults[1].channel == "bogie1_1l"


def test_a_channel_is_left_out_where_the_others_are_enough(
    restorer: Restorer, system: System, window: FloatArray
) -> None:
    wrong, fault = window.copy(), MeasurementFault("bogie1_1l", "frozen", 0.0)
    wrong[:, column(restorer, "bogie1_1l")] = 0.0
    found = restorer.without(wrong[None], [(fault,)])
    assert found[0].faults == (fault,) and found[0].corrected
    sensors = tuple(MeasurementFault(name, "frozen", 0.0) for name in system.sensors)
    assert restorer.can_lose(np.array([column(restorer, "bogie1_1l")]))
    (uncorrected,) = restorer.or_uncorrected(wrong[None], [sensors], {})
    assert uncorrected.faults == sensors and not uncorrected.corrected


@pytest.mark.parametrize("columns", [(20,), (0, 2)])
def test_a_reversed_sign_and_an_exchange_are_found_among_others_at_nominal_values(
    restorer: Restorer, window: FloatArray, columns: tuple[int, ...]
) -> None:
    candidates = [Rearrangement(one) for one in ((20,), (21,), (22,), (0, 2), (4, 6))]
    trials, wrong = NominalTrials(restorer, candidates), Rearrangement(columns).undone(window)
    found = trials.rearranged(wrong)
    assert found is not None and found.faults == (Rearrangement(columns).fault(restorer.names),)
    assert trials.rearranged(window) is None  # nothing is better than the window as it is


def test_a_channel_too_late_for_a_linear_step_is_found_with_its_delay(restorer: Restorer, window: FloatArray) -> None:
    late, at = window.copy(), column(restorer, "bogie2_1l")
    late[4:, at] = window[:-4, at]
    found = NominalTrials(restorer, ()).late(late, far=False)
    assert found is not None
    ((channel, kind, value),) = [(f.channel, f.kind, f.value) for f in found.faults]
    assert (channel, kind) == ("bogie2_1l", "delay") and value == pytest.approx(0.04, abs=2e-3)


def test_the_limit_of_a_fit_is_one_that_chance_hardly_passes() -> None:
    freedom = np.array([200.0, 2000.0, 0.0])
    limit = fit_limit(freedom)
    assert np.all(stats.chi2.sf((limit * freedom)[:2], freedom[:2]) < 1e-6)
    np.testing.assert_allclose((limit[:2] - 1) / np.sqrt(2 / freedom[:2]), FIT_SIGMAS)  # its standard deviations
    assert np.isfinite(limit[2])


def test_what_is_explained_is_left_out_in_order() -> None:
    assert unexplained(np.array([5, 3, 8, 1]), {3: None, 1: None}).tolist() == [5, 8]
