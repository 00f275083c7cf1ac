"""The trained estimator: accuracy, files that are refused, reproducible and resumable training."""

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sprung.model.identification.amortised import training
from sprung.model.identification.amortised.estimator import WEIGHTS, ModelError, bundled_estimator, load_estimator
from sprung.model.identification.amortised.training import TrainingSettings, train
from sprung.model.identification.excitation import draw_log_ratios, simulate_runs
from sprung.model.identification.identify import Identifier, load_identifier
from sprung.model.identification.refinement.refine import Refiner
from sprung.model.signals import FloatArray
from sprung.model.simulate.linear import LinearSimulator
from sprung.model.system import System, load_system, parse_system
from tests.test_system import QUARTER_CAR

TINY = TrainingSettings(records=100, windows_per_record=2, steps=30, batch=64, checkpoint_every=10, recording_steps=6)
SMALL_CAR = QUARTER_CAR.replace("window: 200", "window: 100")


@pytest.fixture(scope="module")
def vehicle() -> tuple[System, FloatArray, FloatArray]:
    system = load_system()
    rng = np.random.default_rng(77)
    truth = draw_log_ratios(system, 200, 0.5, rng)
    return system, truth, simulate_runs(system, truth, system.window, rng).values


def test_the_shipped_estimator_is_near_the_bound_and_says_how_near(
    vehicle: tuple[System, FloatArray, FloatArray],
) -> None:
    system, truth, windows = vehicle
    estimator = bundled_estimator(system)
    assert estimator is not None
    output = estimator.estimate(windows)
    error = output.log_ratio - truth
    std = np.sqrt(np.diagonal(output.covariance, axis1=1, axis2=2))
    assert np.abs(error).mean() < 0.016
    assert 0.9 < (np.abs(error) < 1.96 * std).mean() < 0.98


def test_its_start_needs_fewer_iterations_than_nominal_values(vehicle: tuple[System, FloatArray, FloatArray]) -> None:
    system, _, windows = vehicle
    identifier = load_identifier(system)
    trained = np.mean([e.iterations for e in identifier.identify(windows[:64])])
    nominal = np.mean([e.iterations for e in identifier.identify(windows[:64], np.zeros((64, 24)))])
    assert trained <= 0.5 * nominal


def test_the_manifest_records_how_the_weights_were_trained() -> None:
    manifest = json.loads((WEIGHTS / "manchester" / "manifest.json").read_text())
    assert manifest["system_digest"] == load_system().digest
    assert manifest["measured"]["coverage_95"] > 0.9
    assert manifest["seed"] == manifest["training"]["seed"]


def test_a_model_of_another_system_is_refused() -> None:
    with pytest.raises(ModelError, match=r"trained for 'manchester-passenger'.*quarter-car.*sprung train"):
        load_estimator(WEIGHTS / "manchester", parse_system(QUARTER_CAR))


def test_damaged_weights_and_pickles_are_refused(tmp_path: Path) -> None:
    system = load_system()
    for name in ("manifest.json", "weights.safetensors"):
        (tmp_path / name).write_bytes((WEIGHTS / "manchester" / name).read_bytes())
    weights = tmp_path / "weights.safetensors"
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1
    weights.write_bytes(data)
    with pytest.raises(ModelError, match="damaged"):
        load_estimator(tmp_path, system)
    weights.write_bytes(pickle.dumps({"log_weight": 1}))
    with pytest.raises(ModelError, match="damaged"):
        load_estimator(tmp_path, system)
    with pytest.raises(ModelError, match="not a model directory"):
        load_estimator(tmp_path / "nothing", system)
    (tmp_path / "manifest.json").write_text("[]")
    with pytest.raises(ModelError, match="not a model manifest"):
        load_estimator(tmp_path, system)


@pytest.fixture(scope="module")
def small_car() -> System:
    """The quarter car: two accelerometers give the motion of both bodies."""
    return parse_system(SMALL_CAR)


def test_training_twice_from_one_seed_gives_the_same_weights(small_car: System, tmp_path: Path) -> None:
    digests = {train(small_car, tmp_path / str(i), settings=TINY).net.log_weight.sum().item() for i in range(2)}
    other = train(small_car, tmp_path / "other", settings=replace(TINY, seed=1)).net.log_weight.sum().item()
    assert len(digests) == 1
    assert other not in digests


def test_training_that_was_interrupted_resumes_to_the_same_weights(small_car: System, tmp_path: Path) -> None:
    whole = train(small_car, tmp_path / "whole", settings=TINY)

    class Stop(Exception):
        pass

    def interrupt(stage: str, done: int, total: int, loss: float) -> None:
        if stage == "train" and done >= 20:
            raise Stop

    with pytest.raises(Stop):
        train(small_car, tmp_path / "parts", settings=TINY, progress=interrupt)
    assert not (tmp_path / "parts" / "manifest.json").exists()
    stages = []
    resumed = train(small_car, tmp_path / "parts", settings=TINY, progress=lambda s, d, t, x: stages.append((s, d)))
    assert ("train", 30) in stages
    assert ("train", 10) not in stages
    for name, tensor in whole.net.state_dict().items():
        assert np.allclose(tensor.numpy(), resumed.net.state_dict()[name].numpy(), atol=1e-12), name
    assert load_estimator(tmp_path / "parts", small_car).samples == 100


def test_recordings_without_labels_lower_the_misfit_of_a_badly_trained_model(small_car: System, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    truth = np.repeat(rng.uniform(-0.3, 0.3, (1, 4)), 60, axis=0)
    windows = simulate_runs(small_car, truth, small_car.window, rng).values
    hasty = replace(TINY, steps=3, learning_rate=0.05)
    before = train(small_car, tmp_path / "before", settings=hasty)
    after = train(small_car, tmp_path / "after", recordings=windows, settings=replace(hasty, recording_steps=60))
    misfits = [Refiner(small_car).misfit(windows, e.estimate(windows).log_ratio)[0].mean() for e in (before, after)]
    errors = [np.abs(e.estimate(windows).log_ratio - truth).mean() for e in (before, after)]
    assert misfits[1] < misfits[0]
    assert errors[1] < errors[0]


def test_a_system_whose_sensors_give_no_motion_cannot_be_trained(tmp_path: Path) -> None:
    text = QUARTER_CAR.replace("  wheel: {kind: acceleration, body: unsprung, csv: a2, noise: 0.05}\n", "")
    with pytest.raises(ValueError, match="no force balance"):
        train(parse_system(text), tmp_path, settings=TINY)


def test_progress_goes_from_simulation_through_training(small_car: System, tmp_path: Path) -> None:
    seen = []
    training.train(small_car, tmp_path, settings=TINY, progress=lambda *a: seen.append(a[0]))
    assert seen[0] == "simulate"
    assert seen[-1] == "train"


@pytest.mark.parametrize("terms", [(0.25, -0.05, -0.03, 0.02, 0.03), (-0.25, 0.04, 0.03, -0.01, 0.0)])
def test_its_start_knows_a_load_so_that_one_iteration_is_enough(
    vehicle: tuple[System, FloatArray, FloatArray], terms: tuple[float, ...]
) -> None:
    system = vehicle[0]
    rng = np.random.default_rng(78)
    truth = np.hstack([draw_log_ratios(system, 48, 0.2, rng), np.tile(terms, (48, 1))])
    windows = simulate_runs(system, truth, system.window, rng).values
    identifier = load_identifier(system)
    assert isinstance(identifier, Identifier) and identifier.estimator is not None
    start = identifier.estimator.estimate(windows, loads=True).log_ratio
    assert start.shape == (48, 29)
    error = np.sqrt(np.mean((start - truth) ** 2, axis=0))
    assert error[:24].max() < 0.06
    assert np.all(error[24:] < [0.06, 0.06, 0.06, 0.03, 0.03])
    found = identifier.examine(windows, np.zeros(48, dtype=bool))
    assert np.mean([e.iterations for e in found]) < 1.3
    ignorant = identifier.examine(windows, np.zeros(len(windows), dtype=bool), start=start[:, :24] * 0)
    std = np.sqrt([np.diag(e.covariance) for e in found])
    off = np.array([a.log_ratio - b.log_ratio for a, b in zip(found, ignorant, strict=True)])
    assert np.quantile(np.abs(off) / std, 0.99) < 0.2  # where it starts hardly shows in where it ends


def test_linear_changes_of_masses_become_the_terms_of_a_load() -> None:
    system = load_system()
    loading = LinearSimulator(system).loading
    terms = torch.tensor([[0.25, -0.08, 0.06, 0.02, -0.03]], dtype=torch.float64)
    factors = loading.factors(terms)[0, :3]
    coupling = loading.coupling(terms)
    assert coupling is not None
    along, aside = (coupling[0, 0, at] * (factors[0] * factors[at]).sqrt() for at in (2, 1))
    linear = torch.stack([factors[0] - 1, factors[1] - factors[0], factors[2] - factors[0], along, aside])[None]
    np.testing.assert_allclose(loading.terms_of(linear).numpy(), terms.numpy(), atol=1e-12)


@pytest.mark.parametrize("body", ["bogie2", "car"])
def test_refinement_converges_beside_a_body_without_any_sensor(body: str) -> None:
    system = load_system()
    rng = np.random.default_rng(6)
    truth = np.log(rng.uniform(0.9, 1.1, (4, 24)))
    windows = simulate_runs(system, truth, system.window, rng).values
    windows[:, :, [c.name.startswith(body) for c in system.channels]] = np.nan
    found = Identifier(system, bundled_estimator(system)).examine(windows, np.ones(4, dtype=bool))
    assert all(e.adequate and e.iterations < 5 for e in found)
