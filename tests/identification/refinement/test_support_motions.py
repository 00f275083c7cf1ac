"""Supports that are measured by any of their displacement, velocity and acceleration."""

import numpy as np
import pytest
import torch

from sprung.benchmarks.bounds import time_domain_bound
from sprung.benchmarks.generator.ride import SYSTEM
from sprung.benchmarks.sensing import BELOW, draw_windows
from sprung.model.identification.excitation import draw_log_ratios, simulate_runs
from sprung.model.identification.identify import Identifier
from sprung.model.identification.likelihood.linearise import WindowModel
from sprung.model.identification.refinement.refine import Refiner
from sprung.model.signals import FloatArray
from sprung.model.simulate.drives import drives_of
from sprung.model.simulate.fusion import motion, motion_noise, motion_shares
from sprung.model.system import BUNDLED, System, load_system, parse_system
from tests.test_system import QUARTER_CAR

D, V, A = (
    "displacement: {csv: z, noise: 1e-5}",
    "velocity: {csv: vz, noise: 1e-3}",
    "acceleration: {csv: az, noise: 0.1}",
)
MIXES = {"d": [D], "v": [V], "a": [A], "da": [D, A], "va": [V, A], "dva": [D, V, A]}


def car(mix: str) -> System:
    return parse_system(QUARTER_CAR.replace(f"{D}, {V}", ", ".join(MIXES[mix])))


def axleboxes() -> System:
    return load_system(BUNDLED / "axleboxes.yaml")


@pytest.mark.parametrize("mix", MIXES)
def test_errors_are_what_the_intervals_say_and_offsets_do_not_matter(mix: str) -> None:
    system = car(mix)
    rng = np.random.default_rng(4)
    truth = draw_log_ratios(system, 160, 0.4, rng)
    values = simulate_runs(system, truth, system.window, rng).values
    units = [channel.unit for channel in system.channels]
    lowest = min(drive.integrated for drive in drives_of(system))
    for column, unit in enumerate(units):  # every channel that is integrated, and every sensor, has an offset
        order = {"m": 0, "m/s": 1, "m/s^2": 2}.get(unit, 0)
        if column >= len(system.inputs) or 0 < order == lowest:
            values[:, :, column] += values[:, :, column].std() * rng.standard_normal((len(values), 1))
    refined = Refiner(system).refine(values)
    assert refined.converged.mean() > 0.98
    known = refined.identifiable & refined.converged[:, None]
    z = ((refined.log_ratio - truth) / np.sqrt(np.diagonal(refined.covariance, axis1=1, axis2=2)))[known]
    assert known.mean() > 0.7
    assert 0.92 < (np.abs(z) < 1.96).mean() < 0.975
    assert abs(z.mean()) < 0.12
    assert 0.95 < np.median(refined.chi_square) < 1.05


@pytest.mark.parametrize("mix", MIXES)
def test_more_signals_of_one_motion_are_more_informative_never_less(mix: str) -> None:
    system, truth = car(mix), np.zeros((8, 4))
    std = {}
    for less in [mix, *(one for one in "dva" if one in mix)]:
        runs = simulate_runs(car(less), truth, system.window, np.random.default_rng(0))
        covariance = Refiner(car(less)).refine(runs.clean, truth, iterations=1).covariance
        std[less] = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).mean(axis=0)
    for of_less in std.values():
        assert (std[mix] < 1.02 * of_less).all()


def test_the_stated_deviation_is_the_bound_of_the_time_domain() -> None:
    system = axleboxes()
    rng = np.random.default_rng(3)
    _, clean, truth = draw_windows(system, (2,), 2, rng, per_ride=2)
    stated = Refiner(system).refine(clean, truth, iterations=1)
    for b in range(2):
        bound = time_domain_bound(system, clean[b], truth[b], fused=True, offsets=True)
        ratio = np.sqrt(np.diag(stated.covariance[b])) / bound
        assert 0.97 < np.median(ratio) < 1.06
        assert ((ratio > 0.9) & (ratio < 1.2)).all()


def test_axleboxes_alone_are_as_accurate_as_they_say_behind_filters_with_offsets_and_drift() -> None:
    system = axleboxes()
    values, _, truth = draw_windows(system, BELOW[1].orders, 96, np.random.default_rng(21), per_ride=4)
    estimates = Identifier(system).identify(values)
    assert all(e.adequate and e.converged and e.informative for e in estimates)
    z = np.concatenate(
        [
            ((e.log_ratio - x) / np.sqrt(np.diag(e.covariance)))[e.identifiable]
            for e, x in zip(estimates, truth, strict=True)
        ]
    )
    assert 0.93 < (np.abs(z) < 1.96).mean() < 0.97
    assert 0.95 < np.median([e.chi_square for e in estimates]) < 1.06


def test_a_standing_vehicle_with_accelerometers_is_uninformative() -> None:
    system = axleboxes()
    noise = np.array([channel.noise for channel in system.channels])
    values = noise * np.random.default_rng(0).standard_normal((4, system.window, len(noise))) + 0.05
    assert not any(e.informative for e in Identifier(system).identify(values))


def test_motion_comes_back_from_its_derivatives_up_to_what_they_leave_open() -> None:
    t = np.arange(300) / 100
    w = 2 * np.pi * 3.0
    signals = {0: np.sin(w * t), 1: w * np.cos(w * t), 2: -(w**2) * np.sin(w * t)}
    for orders in ((1,), (2,), (0, 2), (1, 2), (0, 1, 2)):
        noise = {order: 1e-3 * w**order for order in orders}
        d, v = motion({order: signals[order] for order in orders}, 0.01, noise)
        for found, truth in ((d, signals[0]), (v, signals[1])):
            line = np.vander(t, 3)
            apart = line @ np.linalg.lstsq(line, found - truth, rcond=None)[0]
            assert np.abs(found - truth - apart).max() < 2e-3 * np.abs(truth).max()
        if orders[0] == 0:
            assert np.abs(d - signals[0]).max() < 5e-3


def test_exact_signals_are_taken_as_they_are() -> None:
    t = np.arange(100) / 100
    d, v = motion({0: np.sin(t), 2: np.full(100, 7.0)}, 0.01, {0: 0.0, 2: 0.1})
    assert np.allclose(d, np.sin(t))
    assert np.allclose(v, np.cos(t), atol=1e-4)


def test_integrated_noise_has_the_stated_spectrum() -> None:
    rng = np.random.default_rng(0)
    noise = {1: 1e-3, 2: 0.1}
    d, _ = motion({order: std * rng.standard_normal((600, 256)) for order, std in noise.items()}, 0.01, noise)
    window = np.hanning(200)
    apart = d[:, 28:-28] - d[:, 28:-28].mean(axis=1, keepdims=True)
    power = (np.abs(np.fft.rfft(apart * window, axis=1)) ** 2).mean(axis=0) / (window**2).sum()
    frequency: FloatArray = np.fft.rfftfreq(200, 0.01).astype(float)
    band = (frequency > 4) & (frequency < 30)
    stated = motion_noise(2 * np.pi * frequency[band], 0.01, noise) ** 2
    assert abs((power[band] / stated).mean() - 1) < 0.05
    shares = motion_shares(2 * np.pi * frequency[band], 0.01, noise)
    assert np.allclose(sum(shares.values()), 1.0)
    assert shares[1][0] > shares[1][-1]


def test_trends_are_added_where_integration_leaves_them_open() -> None:
    system = car("a")
    model = WindowModel(system, system.window)
    present = np.ones(4, dtype=bool)
    assert model.unknowns(present) == 4 + 2 * 2  # two powers of time for the deflection and the force
    assert torch.equal(model.compression.trends(present)[:, :2], torch.zeros(system.window, 2, 4))
    assert WindowModel(axleboxes(), 100).unknowns(np.ones(12, dtype=bool)) == 18
    assert WindowModel(load_system(SYSTEM), 100).unknowns(np.ones(12, dtype=bool)) == 18
