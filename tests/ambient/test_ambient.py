"""Identification without any measured input, against truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

import sprung
from sprung.benchmarks.generator import track
from sprung.benchmarks.generator.ride import DrawnRide, draw_ride, record
from sprung.model.ambient.forces import ForceExcitation
from sprung.model.ambient.identify import AmbientIdentifier
from sprung.model.ambient.periodogram import Spectra, spectra
from sprung.model.ambient.response import Responses
from sprung.model.ambient.sensing import sensing
from sprung.model.ambient.track import Running, TrackExcitation
from sprung.model.ambient.whittle import Whittle
from sprung.model.identification.identify import identifiability, load_identifier
from sprung.model.identifier import UnusableWindow
from sprung.model.schema import SystemFileError, TrackInput
from sprung.model.signals import FloatArray
from sprung.model.system import BUNDLED, System, load_system, parse_system

ACCELEROMETERS = BUNDLED / "accelerometers.yaml"
TOWER = """
name: tower
sample_rate: 50
window: 6000
bodies: {one: {mass: 1000}, two: {mass: 800}}
elements:
  lower: {upper: one, lower: ground, stiffness: 4.0e+5, damping: 400}
  upper: {upper: two, lower: one, stiffness: 3.0e+5, damping: 300}
sensors:
  a1: {kind: acceleration, body: one, noise: 0.001}
  a2: {kind: acceleration, body: two, noise: 0.001}
"""


@pytest.fixture(scope="module")
def vehicle() -> System:
    return load_system(ACCELEROMETERS)


def wheels(system: System) -> tuple[FloatArray, np.ndarray]:
    sources = list(system.file.inputs.values())
    tracks = [s for s in sources if isinstance(s, TrackInput) and s.position]
    assert len(tracks) == len(sources)
    return np.array([s.position[0] for s in tracks if s.position]), np.array([s.rail == "left" for s in tracks])


def responses(system: System, loads: tuple[str, ...] | list[str] = ()) -> Responses:
    every = np.arange(len(system.sensors))
    return Responses(system, sensing(system.mechanics, every, system.sensor_noise), loads)


def random_spectra(rng: np.random.Generator, sensors: int, rate: float = 100.0) -> Spectra:
    return spectra(rng.normal(size=(1500, sensors)) * 0.3, rate, (0.65, 0.3 * rate), 0.03)


def differences(likelihood: Whittle, x: FloatArray, step: float) -> FloatArray:
    moves = np.eye(len(x)) * step * np.maximum(np.abs(x), 0.1)
    return np.array([(likelihood.cost(x + m) - likelihood.cost(x - m)) / (2 * m.sum()) for m in moves])


def test_gradient_under_a_track_is_that_of_finite_differences(vehicle: System) -> None:
    rng = np.random.default_rng(1)
    found = random_spectra(rng, 12)
    excitation = TrackExcitation(*wheels(vehicle), found, Running(42.0, 0.4))
    likelihood = Whittle(responses(vehicle, ["car"]), excitation, found)
    z = excitation.start(1e-7 / found.frequency**2)
    z[:-1] += 0.2 * rng.normal(size=len(z) - 1)
    x = np.concatenate([0.2 * rng.normal(size=25), z])
    at = likelihood.evaluate(x)
    expected = differences(likelihood, x, 1e-5)
    assert np.abs(at.gradient - expected).max() < 1e-4 * np.abs(expected[:-1]).max() or np.allclose(
        at.gradient, expected, rtol=2e-4, atol=1e-4 * np.abs(expected[:-1]).max()
    )
    assert at.cost == pytest.approx(likelihood.cost(x))


@pytest.mark.parametrize("kind", ["acceleration", "velocity", "displacement"])
def test_gradient_under_ambient_forces_is_that_of_finite_differences(kind: str) -> None:
    text = TOWER.replace("kind: acceleration", f"kind: {kind}")
    text += "  d: {kind: deflection, element: upper, noise: 0.001}\n  f: {kind: force, element: lower, noise: 10}\n"
    system = parse_system(text + "estimate: [stiffness, damping, mass]\n")
    rng = np.random.default_rng(2)
    found = random_spectra(rng, 4, 50.0)
    excitation = ForceExcitation(system.mechanics.mass, found)
    likelihood = Whittle(responses(system), excitation, found)
    x = np.concatenate(
        [
            0.3 * rng.normal(size=6),
            excitation.start(np.full(len(found.frequency), 0.1)),
        ]
    )
    x[-1] = 0.4
    at = likelihood.evaluate(x)
    assert np.allclose(at.gradient, differences(likelihood, x, 1e-5), rtol=1e-5, atol=1e-5 * np.abs(at.gradient).max())


def test_fisher_information_is_the_covariance_of_the_gradient() -> None:
    system = parse_system(TOWER)
    rng = np.random.default_rng(3)
    found = random_spectra(rng, 2, 50.0)
    excitation = ForceExcitation(system.mechanics.mass, found)
    x = np.concatenate([np.zeros(4), excitation.start(np.full(len(found.frequency), 0.1))])
    whole = replace(found, weight=np.ones(len(found.weight)))
    S = Whittle(responses(system), excitation, whole).evaluate(x).covariance
    factor = np.linalg.cholesky(S)
    basis = sensing(system.mechanics, np.arange(2), np.ones(2)).rows.T
    gradients = []
    for _ in range(600):
        noise = rng.normal(size=(2, len(S), 2, 1)) / np.sqrt(2)
        drawn = system.sensor_noise[:, None] * basis @ (factor @ (noise[0] + 1j * noise[1]))
        seen = replace(whole, matrix=drawn @ drawn.conj().swapaxes(1, 2))
        likelihood = Whittle(responses(system), excitation, seen)
        at = likelihood.evaluate(x)
        gradients.append(at.gradient)
    scale = np.sqrt(np.diag(at.information))
    assert np.abs(np.mean(gradients, axis=0) / scale).max() < 0.2
    observed = np.cov(np.array(gradients).T) / np.outer(scale, scale)
    assert np.abs(observed - at.information / np.outer(scale, scale)).max() < 0.25


def test_periodograms_of_a_long_record_have_the_modelled_spectrum(vehicle: System) -> None:
    rng = np.random.default_rng(4)
    ride = replace(draw_ride(rng, speed=(42.0, 42.0)), own_share=0.1)
    values = record(rng, ride, 960.0)
    parts = [spectra(part, 100.0, (0.7, 20.0), 0.03) for part in np.split(values[: 16 * 6000], 16)]
    found = replace(parts[0], matrix=np.mean([part.matrix for part in parts], axis=0))
    excitation = TrackExcitation(*wheels(vehicle), found, Running(42.0, 0.4))
    z = excitation.start(ride.level_at(2 * np.pi * found.frequency) * 100.0 / 2)
    z[excitation.at[3]] = np.log(0.1 / 0.9)
    x = np.concatenate([ride.log_ratio, [ride.load], z])
    whitened = Whittle(responses(vehicle, ["car"]), excitation, found).evaluate(x).whitened
    weight = 16 * found.weight
    scatter = (np.abs(whitened - np.eye(9)) ** 2).sum(axis=(1, 2)) * weight / 81
    assert scatter.mean() == pytest.approx(1.0, abs=0.12)
    assert np.einsum("fii->i", whitened).real / len(whitened) == pytest.approx(np.ones(9), abs=0.08)


def test_a_minute_of_accelerometers_identifies_every_parameter_speed_and_load(vehicle: System) -> None:
    rng = np.random.default_rng(5)
    ride = draw_ride(rng)
    fit = AmbientIdentifier(vehicle).fit(record(rng, ride, 60.0))
    assert fit is not None
    error = fit.log_ratio - np.append(ride.log_ratio, ride.load)
    std = np.sqrt(np.diag(fit.covariance))
    assert np.abs(error / std).max() < 4.0
    assert np.sqrt(np.mean(error[:8] ** 2)) < 0.04
    speed, speed_std = fit.speed
    assert abs(speed - ride.speed) < 4 * speed_std < 0.1
    assert fit.chi_square == pytest.approx(1.0, abs=6 * fit.chi_std)


def test_a_vehicle_that_runs_backwards_is_recognised(vehicle: System) -> None:
    rng = np.random.default_rng(6)
    ride = draw_ride(rng)
    values = record(rng, ride, 60.0)
    turned = parse_system(_turned(ACCELEROMETERS.read_text()) + f"\nspeed: {ride.speed:.4f}\n")
    fit = AmbientIdentifier(turned).fit(values)
    assert fit is not None
    assert fit.speed[0] == pytest.approx(-ride.speed, rel=1e-3)
    assert np.abs(fit.log_ratio[:8] - ride.log_ratio[:8]).max() < 0.1


def _turned(text: str) -> str:
    """The same vehicle with x pointing to its rear, left and right swapped."""
    import yaml

    data = yaml.safe_load(text)
    for group in ("bodies", "inputs", "elements", "sensors"):
        for part in data[group].values():
            x, y = part["position"]
            part["position"] = [-x, -y]
            if "rail" in part:
                part["rail"] = "right" if part["rail"] == "left" else "left"
    return yaml.safe_dump(data, sort_keys=False)


def test_estimates_say_what_they_do_not_know(vehicle: System) -> None:
    rng = np.random.default_rng(7)
    values = record(rng, draw_ride(rng), 60.0)
    values[:, 4:8] = np.nan  # nothing on the first bogie
    (seen,) = AmbientIdentifier(vehicle).identify(values[None])
    assert seen.adequate and seen.informative
    assert np.isnan(seen.per_sensor[4:8]).all()
    assert (seen.log_ratio[~seen.identifiable] == 0).all()
    assert np.allclose(np.diag(seen.covariance)[~seen.identifiable], 1.0)


@pytest.mark.parametrize("speed", [26.0, 29.3, 34.1, 41.7])
def test_the_band_ends_where_the_track_does(vehicle: System, speed: float) -> None:
    """A group beyond the shortest wavelength would pull levels, and with them springs and load, the same way always."""
    rng = np.random.default_rng(3)
    ride = replace(draw_ride(rng), speed=speed)
    identifier = AmbientIdentifier(vehicle)
    found = identifier.window.spectra(record(rng, ride, 60.0), vehicle.sensor_noise)
    assert found is not None
    end = track.SHORTEST * speed / (2 * np.pi)
    top = found.frequency[-1] + found.reach[-1]
    assert end - 1.0 < top < end


def test_standstill_is_uninformative_and_raises_nothing(vehicle: System) -> None:
    rng = np.random.default_rng(8)
    still = rng.normal(size=(1, 6000, 12)) * vehicle.sensor_noise
    (seen,) = AmbientIdentifier(vehicle).identify(still)
    assert not seen.informative
    assert not seen.identifiable.any()


@pytest.mark.slow
def test_a_changed_structure_does_not_fit(vehicle: System) -> None:
    rng = np.random.default_rng(9)
    values = record(rng, draw_ride(rng), 60.0)
    values[:, 1] = -values[:, 1]  # an accelerometer upside down
    (seen,) = AmbientIdentifier(vehicle).identify(values[None])
    assert not seen.adequate


@pytest.mark.slow
def test_a_measured_speed_is_used_and_a_missing_one_estimated() -> None:
    rng = np.random.default_rng(14)
    ride = draw_ride(rng)
    values = record(rng, ride, 30.0)
    system = parse_system(ACCELEROMETERS.read_text() + "\nspeed: {csv: v, unit: km/h, noise: 0.2}\n")
    assert system.channels[0].name == "speed" and system.needed == ()
    identifier = AmbientIdentifier(system)
    stds = []
    for speed in (ride.speed, np.nan):
        fit = identifier.fit(np.column_stack([np.full(3000, speed), values]))
        assert fit is not None
        assert fit.speed[0] == pytest.approx(ride.speed, rel=3e-3)
        stds.append(fit.speed[1])
    assert stds[0] <= stds[1]
    crawling = np.column_stack([np.full(3000, 3.0), values])
    assert identifier.fit(crawling) is None


def test_windows_of_another_shape_and_values_that_are_no_numbers_are_refused(vehicle: System) -> None:
    with pytest.raises(UnusableWindow, match=r"shape \(B, T, 12\)"):
        AmbientIdentifier(vehicle).identify(np.zeros((1, 6000, 3)))
    values = np.zeros((1, 6000, 12))
    values[0, 5, 2] = np.inf
    with pytest.raises(UnusableWindow, match="car_2l"):
        AmbientIdentifier(vehicle).identify(values)


def test_measured_inputs_beside_a_track_are_refused() -> None:
    text = ACCELEROMETERS.read_text().replace("\nelements:", "\n  push: {kind: force, body: car}\n\nelements:", 1)
    with pytest.raises(SystemFileError, match=r"inputs\.push: measured inputs beside a track"):
        parse_system(text)


@pytest.mark.slow
def test_intervals_hold_what_they_promise(vehicle: System) -> None:
    """Ninety-five per cent, over 24 rides with everything unknown."""
    inside = []
    for seed in range(24):
        rng = np.random.default_rng([10, seed])
        ride: DrawnRide = draw_ride(rng)
        fit = AmbientIdentifier(vehicle).fit(record(rng, ride, 60.0))
        assert fit is not None
        error = fit.log_ratio - np.append(ride.log_ratio, ride.load)
        inside.append(np.abs(error) < 1.96 * np.sqrt(np.diag(fit.covariance)))
    assert 0.91 < np.mean(inside) < 0.985


def shaken_tower(rng: np.random.Generator, seconds: float, force: float, start: FloatArray | None = None) -> FloatArray:
    """Accelerations of the tower with other values than nominal, from an integrator of this test's own."""
    k, c, m = np.array([4.6e5, 2.7e5]), np.array([500.0, 260.0]), np.array([1000.0, 800.0])
    H = np.array([[1.0, 0.0], [-1.0, 1.0]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-(H.T * k) @ H / m[:, None], -(H.T * c) @ H / m[:, None]]])
    fine = 16
    step, steps = 1 / (50 * fine), round(seconds * 50) * fine
    advance = scipy.linalg.expm(A * step)
    push = np.linalg.solve(A, (advance - np.eye(4)) @ np.vstack([np.zeros((2, 2)), np.diag(1 / m)]))
    p = rng.normal(size=(steps, 2)) * force * np.sqrt(fine)
    states = np.empty((steps, 4))
    x = np.zeros(4) if start is None else start
    for i in range(steps):
        states[i] = x
        x = advance @ x + push @ p[i]
    # A sensor feels the mean over a sample: what it has of the force is not that of an instant.
    acceleration = states @ A[2:].T + p / m
    filtered = scipy.signal.decimate(acceleration, fine, ftype="fir", axis=0, n=20 * fine)
    clean = filtered if force else acceleration[::fine]  # the filter starts from nothing, a decay does not
    return np.asarray(clean + 0.001 * rng.normal(size=clean.shape))


TRUTH = np.log([4.6e5 / 4e5, 2.7e5 / 3e5, 500 / 400, 260 / 300])


def test_springs_and_dampers_of_a_structure_are_identified_under_unmeasured_forces() -> None:
    system = parse_system(TOWER)
    values = shaken_tower(np.random.default_rng(11), 120.0, 50.0)
    (seen,) = load_identifier(system).identify(values[None, :6000])
    assert seen.adequate and seen.identifiable[:2].all()
    std = np.sqrt(np.diag(seen.covariance))
    assert (np.abs(seen.log_ratio - TRUTH)[seen.identifiable] < 4 * std[seen.identifiable]).all()
    assert std[:2].max() < 0.03


def test_a_free_decay_is_identified_as_one() -> None:
    system = parse_system(TOWER)
    values = shaken_tower(np.random.default_rng(12), 120.0, 0.0, np.array([0.01, 0.02, 0.0, 0.0]))
    (seen,) = load_identifier(system).identify(values[None, :6000])
    assert seen.adequate and seen.identifiable.all()
    assert np.abs(seen.log_ratio - TRUTH).max() < 0.01


def test_identifiability_without_inputs_is_the_accuracy_of_a_window() -> None:
    system = parse_system(TOWER)
    fit = identifiability(system)
    (seen,) = load_identifier(system).identify(shaken_tower(np.random.default_rng(13), 120.0, 50.0)[None, :6000])
    assert np.sqrt(np.diag(seen.covariance))[:2] == pytest.approx(fit[:2], rel=0.6)
    assert (fit[:2] < 0.03).all()


def test_identifiability_of_a_vehicle_on_a_track_is_the_accuracy_of_a_minute(vehicle: System) -> None:
    fit = identifiability(vehicle)
    assert fit[:8].max() < 0.03 and fit[12:20].max() < 0.1
    with pytest.raises(SystemFileError, match=r"window: 1 s is too short .* a minute \(6000\)"):
        parse_system(ACCELEROMETERS.read_text().replace("window: 6000", "window: 100"))


@pytest.mark.slow
def test_a_ride_is_tracked_from_a_table_of_accelerations(vehicle: System, tmp_path: Path) -> None:
    rng = np.random.default_rng(15)
    ride = draw_ride(rng)
    values = record(rng, ride, 150.0)
    names = list(vehicle.sensors)
    text = ACCELEROMETERS.read_text()
    for name in names:
        text = text.replace(f"  {name}: {{kind: acceleration", f"  {name}: {{kind: acceleration, csv: {name}")
    system = parse_system(text)
    table = np.column_stack([1.7e9 + np.arange(len(values)) / 100, values])
    path = tmp_path / "ride.csv"
    np.savetxt(path, table, delimiter=",", header=",".join(["time", *names]), comments="", fmt="%.6f")
    tracked = sprung.track(system, sprung.open_recording(path, system))
    assert tracked.windows >= 3
    for report, truth in zip(tracked.parameters, ride.log_ratio, strict=True):
        assert report.identifiable
        assert abs(report.log_ratio - truth) < 4 * report.log_std
