"""Refinement: recovery, honest uncertainty, missing sensors, quiet windows, misfits."""

import numpy as np
import pytest
import torch

from sprung.model.identification import excitation
from sprung.model.identification.amortised.features import ForceBalance, magnitudes
from sprung.model.identification.excitation import Runs, draw_log_ratios, simulate_runs
from sprung.model.identification.identify import Identifier, identifiability
from sprung.model.identification.likelihood.linearise import WindowModel
from sprung.model.identification.refinement.refine import Refined, Refiner
from sprung.model.identifier import UnusableWindow
from sprung.model.signals import FloatArray
from sprung.model.system import MANCHESTER, System, load_system, parse_system
from tests.test_system import OSCILLATOR, QUARTER_CAR


@pytest.fixture(scope="module")
def vehicle() -> tuple[System, FloatArray, Runs]:
    system = load_system()
    rng = np.random.default_rng(11)
    truth = draw_log_ratios(system, 96, 0.5, rng)
    return system, truth, simulate_runs(system, truth, system.window, rng)


def scores(refined: Refined, truth: FloatArray) -> FloatArray:
    return (refined.log_ratio - truth) / np.sqrt(np.diagonal(refined.covariance, axis1=1, axis2=2))


def test_without_noise_the_truth_comes_back(vehicle: tuple[System, FloatArray, Runs]) -> None:
    system, truth, runs = vehicle
    refined = Refiner(system).refine(runs.clean[:16])
    assert refined.converged.all()
    assert np.abs(refined.log_ratio - truth[:16]).max() < 0.01
    assert np.abs(refined.log_ratio - truth[:16]).mean() < 5e-4


def test_errors_are_what_the_intervals_say_from_nominal_and_from_a_near_start(
    vehicle: tuple[System, FloatArray, Runs],
) -> None:
    system, truth, runs = vehicle
    refiner = Refiner(system)
    from_nominal = refiner.refine(runs.values)
    near = refiner.refine(runs.values, truth + 0.03 * np.random.default_rng(0).standard_normal(truth.shape))
    for refined in (from_nominal, near):
        z = scores(refined, truth)
        assert refined.converged.all()
        assert 0.93 < (np.abs(z) < 1.96).mean() < 0.97
        assert abs(z.mean()) < 0.07
        assert 0.97 < np.median(refined.chi_square) < 1.03
    assert np.abs(scores(near, from_nominal.log_ratio)).max() < 0.5
    assert near.iterations.mean() < 0.6 * from_nominal.iterations.mean()


def test_refinement_of_hardly_informative_windows_converges() -> None:
    system = load_system()
    slow = simulate_runs(system, np.zeros((24, 24)), system.window, np.random.default_rng(3), speed=(2.0, 3.0))
    refined = Refiner(system).refine(slow.values, loads=True, built=True)
    assert refined.converged.all()
    assert refined.iterations.mean() < 3


def test_weak_windows_are_hardly_biased_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(excitation, "_BAND", (0.5, 5.0))  # of a track without short waves, at the pace of a tram
    system, rng = load_system(), np.random.default_rng(1)
    truth = draw_log_ratios(system, 96, 0.1, rng)
    slow = simulate_runs(system, truth, system.window, rng, speed=(9.0, 10.0))
    refined = Refiner(system).refine(slow.values, loads=True)
    load = np.pad(truth, ((0, 0), (0, refined.log_ratio.shape[1] - 24)))
    z = np.where(refined.identifiable, scores(refined, load), np.nan)
    assert 0.03 < np.median(np.sqrt(refined.covariance[:, 24, 24])) < 0.1
    assert abs(np.nanmean(z[:, 24])) < 0.35  # linearised at the windows' own maxima: 0.6
    assert np.nanmean(z[:, 24] ** 2) < 1.1  # 1.6
    secondary = [i for i, p in enumerate(system.parameters) if p.name.startswith("secondary") and i < 12]
    assert abs(np.nanmean(z[:, secondary])) < 0.25  # 0.4


def test_windows_state_the_share_of_input_noise_in_their_information() -> None:
    system = load_system()
    noise = []
    for speed in (6.0, 40.0):
        runs = simulate_runs(system, np.zeros((4, 24)), system.window, np.random.default_rng(4), speed=(speed, speed))
        noise.append(Refiner(system).refine(runs.values, loads=True).noise)
    assert noise[0].min() > 0.05
    assert noise[1].max() == 0.0  # every parameter is told to a tenth: nothing to be held against noise


def test_one_window_alone_is_the_window_in_a_batch(vehicle: tuple[System, FloatArray, Runs]) -> None:
    system, _, runs = vehicle
    refiner = Refiner(system)
    batch, alone = refiner.refine(runs.values[:5]), refiner.refine(runs.values[3:4])
    assert np.allclose(batch.log_ratio[3], alone.log_ratio[0], atol=1e-9)
    assert np.allclose(batch.covariance[3], alone.covariance[0], rtol=1e-6, atol=1e-12)


def test_linearised_columns_are_the_derivatives_of_the_simulation(vehicle: tuple[System, FloatArray, Runs]) -> None:
    system, truth, runs = vehicle
    model = WindowModel(system, system.window)
    data = model.batch(model.knots(runs.clean[:2]), runs.clean[:2], np.ones(12, dtype=bool))
    x = torch.as_tensor(truth[:2])
    with torch.no_grad():
        at = model.linearise(x, data)
        for p in (0, 9, 12, 23):
            direction = torch.zeros(2, 24, dtype=torch.float64)
            direction[:, p] = 1e-3
            # Moving away from the truth by a known step, the chord must lead back.
            here = model.chord(at, x, at.x0, data).step
            back = model.chord(at, x + direction, at.state_after(direction), data).step - here
            assert torch.allclose(back, -direction, atol=3e-5)


def test_a_missing_sensor_widens_the_uncertainty_and_nothing_breaks(vehicle: tuple[System, FloatArray, Runs]) -> None:
    system, truth, runs = vehicle
    refiner = Refiner(system)
    windows = runs.values[:48].copy()
    windows[:24, :, 16 + 4 : 16 + 6] = np.nan
    refined, whole = refiner.refine(windows), refiner.refine(runs.values[:48])
    assert np.abs(scores(refined, truth[:48])).mean() < 1.0
    ratio = np.diagonal(refined.covariance[:24], axis1=1, axis2=2) / np.diagonal(
        whole.covariance[:24], axis1=1, axis2=2
    )
    assert np.median(ratio[:, 0]) > 1.1
    assert np.isnan(refined.error[0, 4])
    assert np.allclose(refined.log_ratio[24:], whole.log_ratio[24:], atol=1e-6)


@pytest.mark.parametrize("count", [3, 4, 8])  # sums are in another order from batch to batch
def test_a_body_without_any_sensor_leaves_the_windows_of_the_others(
    vehicle: tuple[System, FloatArray, Runs], count: int
) -> None:
    system, truth, runs = vehicle
    windows = runs.values[:count].copy()
    windows[:, :, [c.name.startswith("bogie2") for c in system.channels]] = np.nan
    refined = Refiner(system).refine(windows)
    assert refined.converged.all()
    assert refined.chi_square.max() < 1.5
    assert np.abs(scores(refined, truth[:count])).max() < 5


def test_a_standing_vehicle_is_uninformative_and_says_so() -> None:
    system = load_system()
    noise = np.array([c.noise for c in system.channels])
    windows = noise * np.random.default_rng(0).standard_normal((2, 100, 28))
    for estimate in Identifier(system).identify(windows):
        assert not estimate.identifiable.any()
        assert np.allclose(estimate.covariance, np.eye(24))
        assert np.all(estimate.log_ratio == 0)


def test_a_window_that_does_not_fit_says_so(vehicle: tuple[System, FloatArray, Runs]) -> None:
    system, _, runs = vehicle
    windows = runs.values[:4].copy()
    windows[:2, :, 20] *= 0.7  # one bogie sensor reads too little
    fits = [estimate.adequate for estimate in Identifier(system).identify(windows)]
    assert fits == [False, False, True, True]


@pytest.mark.parametrize("inputs", [0, 4], ids=["all inputs", "some inputs"])
def test_a_window_without_any_sensor_has_no_values_and_says_why(
    vehicle: tuple[System, FloatArray, Runs], inputs: int
) -> None:
    system, _, runs = vehicle
    identifier = Identifier(system)
    windows = runs.values[:2].copy()
    windows[1, :, :inputs] = np.nan
    windows[1, :, len(system.inputs) :] = np.nan
    for ask in (identifier.identify, lambda w: identifier.examine(w, np.ones(len(w), dtype=bool))):
        found = ask(windows)
        assert [e.identified for e in found] == [True, False]
        assert found[1].reason == "missing sensor bogie1_1l and 11 more"


def test_a_window_without_any_input_has_no_values_and_says_why(vehicle: tuple[System, FloatArray, Runs]) -> None:
    system, _, runs = vehicle
    identifier = Identifier(system)
    for ask in (identifier.identify, lambda w: identifier.examine(w, np.ones(len(w), dtype=bool))):
        windows = runs.values[:3].copy()
        windows[1, :, :16] = np.nan
        found = ask(windows)
        assert [e.identified for e in found] == [True, False, True]
        assert found[1].reason == "missing input wheel_11l.displacement and 15 more"
        assert not found[1].identifiable.any()
        alone = ask(runs.values[:3][[0, 2]])
        np.testing.assert_array_equal([found[0].log_ratio, found[2].log_ratio], [e.log_ratio for e in alone])
    windows[0, 7, 3] = np.inf
    with pytest.raises(UnusableWindow, match=r"wheel_11r\.velocity"):
        identifier.identify(windows)


def test_states_are_the_simulated_ones(vehicle: tuple[System, FloatArray, Runs]) -> None:
    system, truth, runs = vehicle
    (estimate,) = Identifier(system).identify(runs.clean[:1], truth[:1], states=True)
    assert estimate.states is not None and estimate.states.shape == (100, 18)
    rate = np.gradient(estimate.states[:, 0], 0.01)
    assert np.abs(rate - estimate.states[:, 9])[5:-5].max() < 0.02 * np.abs(estimate.states[:, 9]).max()


@pytest.mark.parametrize("text", [OSCILLATOR, QUARTER_CAR])
def test_other_systems_are_identified_with_masses_and_element_sensors(text: str) -> None:
    system = parse_system(text)
    rng = np.random.default_rng(3)
    truth = draw_log_ratios(system, 64, 0.3, rng)
    runs = simulate_runs(system, truth, system.window, rng)
    refined = Refiner(system).refine(runs.values)
    z = scores(refined, truth)[refined.converged]
    assert refined.converged.mean() > 0.95
    assert refined.identifiable.mean() > 0.5
    assert 0.9 < (np.abs(z[refined.identifiable[refined.converged]]) < 1.96).mean() < 0.985


def test_the_force_balance_holds_on_clean_windows(vehicle: tuple[System, FloatArray, Runs]) -> None:
    system, truth, runs = vehicle
    target, regressors = ForceBalance(system, system.window)(runs.clean[:8])
    ratio = torch.as_tensor(np.exp(truth[:8]))
    residual = target - (regressors @ ratio.unsqueeze(2)).squeeze(2)
    assert float(residual.norm() / target.norm()) < 0.01
    wrong = target - regressors.sum(dim=2)
    assert float(wrong.norm() / target.norm()) > 0.1


def test_magnitudes_are_the_absolute_discrete_fourier_transform() -> None:
    signal = torch.randn(2, 32, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    features = magnitudes(signal).reshape(2, 17, 3)
    assert np.allclose(features[1, :, 2], np.abs(np.fft.fft(signal[1, :, 2].numpy()))[:17])


def test_identifiability_under_a_measured_force_covers_all_modes() -> None:
    """A model building whose modes are far above those of a vehicle."""
    system = parse_system("""
name: model building
sample_rate: 320
window: 320
bodies: {base: {mass: 6.9}, first: {mass: 6.5}, second: {mass: 6.5}}
inputs: {shaker: {kind: force, body: base, csv: f, noise: 0.1}}
elements:
  rail: {upper: base, lower: ground, stiffness: 600, damping: 20}
  lower: {upper: first, lower: base, stiffness: 4.2e5, damping: 50}
  upper: {upper: second, lower: first, stiffness: 4.2e5, damping: 50}
sensors:
  a0: {kind: acceleration, body: base, csv: a0, noise: 0.01}
  a1: {kind: acceleration, body: first, csv: a1, noise: 0.01}
  a2: {kind: acceleration, body: second, csv: a2, noise: 0.01}
""")
    assert np.all(identifiability(system) < 0.05)


def test_identifiability_is_that_beside_an_unknown_load_where_the_file_names_one() -> None:
    """A window's own bound: about twice the deviation of the springs at the body, of the others nothing."""
    text = MANCHESTER.read_text()
    place = "position: [0.0, 0.0]}"
    known, loaded = (
        identifiability(parse_system(one)) for one in (text, text.replace(place, f"{place[:-1]}, load: true}}", 1))
    )
    assert np.all(loaded[8:12] > 1.4 * known[8:12])
    assert np.allclose(loaded[:8], known[:8], rtol=0.1)


def test_identifiability_names_what_a_window_does_not_determine() -> None:
    std = identifiability(load_system())
    assert np.all(std < 0.05)
    assert std[12:20].min() > std[:8].max()  # primary dampings are the hardest
