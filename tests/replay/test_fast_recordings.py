"""The bundled vehicle, recorded by the generator at 2000 Hz and at rates of each node's own, from file to alarms."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

import sprung
from sprung.benchmarks.generator import track
from sprung.benchmarks.generator.exact import VehicleTransfer
from sprung.benchmarks.generator.vehicle import Vehicle, read_vehicle
from sprung.model.identification.identify import Identifier
from sprung.model.signals import FloatArray
from sprung.model.system import MANCHESTER, load_system, parse_system

FINE, START = 2000, 1_790_000_000_000_000_000


def ride(vehicle: Vehicle, seconds: float, seed: int) -> tuple[FloatArray, FloatArray]:
    """True signals (T, C) of `vehicle.channels` at 2000 Hz on a track with nothing above 42 Hz; log-ratios (P,)."""
    rng = np.random.default_rng(seed)
    ratio = rng.uniform(0.85, 1.15, 2 * len(vehicle.elements))
    wheels, omega, samples = track.wheel_spectra(
        rng, seconds, 44.0, track.LOW_TRACK, vehicle.input_position, vehicle.input_side, own_share=0.05
    )
    live = omega < 2 * np.pi * 50.0
    k, c = np.split(ratio, 2)
    transfer = VehicleTransfer(vehicle, vehicle.stiffness * k, vehicle.damping * c, omega[live])
    moved = wheels[live]
    felt = np.einsum("fsw,fw->fs", transfer.to_sensors, moved)
    every = np.concatenate([moved, 1j * omega[live, None] * moved, felt], axis=1)
    finer = round(FINE / track.RATE)
    padded = np.zeros((finer * samples // 2 + 1, every.shape[1]), complex)
    padded[: len(every)] = finer * every
    return np.fft.irfft(padded, finer * samples, axis=0)[: round(seconds * FINE)], np.log(ratio)


def write(path: Path, vehicle: Vehicle, values: FloatArray, rates: dict[str, int]) -> None:
    """One JSON channel per topic, at its rate in Hz, with noise that is as stated once reduced to 100 Hz."""
    rng = np.random.default_rng(1)
    noise = np.concatenate([vehicle.input_noise.ravel(), vehicle.sensor_noise])
    topics: dict[str, list[tuple[str, int]]] = {}
    for column, place in enumerate(vehicle.places):
        topic, _, field = place["mcap"].rpartition(".")
        topics.setdefault(topic, []).append((field, column))
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, fields in topics.items():
            rate = rates.get(topic.split("/")[1], FINE)
            columns = [column for _, column in fields]
            right = values[:: FINE // rate, columns]
            measured = right + np.sqrt(rate / 100) * noise[columns] * rng.standard_normal(right.shape)
            schema = {"type": "object", "properties": {field: {"type": "number"} for field, _ in fields}}
            number = writer.register_schema(topic, "jsonschema", json.dumps(schema).encode())
            channel = writer.register_channel(topic, "json", number)
            for k, row in enumerate(measured.tolist()):
                time = START + k * (1_000_000_000 // rate)
                data = json.dumps(dict(zip((field for field, _ in fields), row, strict=True))).encode()
                writer.add_message(channel, time, data, time)
        writer.finish()


@pytest.mark.parametrize("rates", [pytest.param({}, marks=pytest.mark.slow), {"car": 200, "bogie2": 500}])
def test_a_recording_of_200_to_2000_hz_is_tracked_like_any_other(tmp_path: Path, rates: dict[str, int]) -> None:
    vehicle, system = read_vehicle(MANCHESTER), load_system()
    values, truth = ride(vehicle, 14.0, 3)
    write(tmp_path / "ride.mcap", vehicle, values, rates)
    tracked = sprung.track(system, sprung.open_recording(tmp_path / "ride.mcap", system))
    assert tracked.alarms == ()
    assert tracked.windows > 20
    scores = [(r.log_ratio - t) / r.log_std for r, t in zip(tracked.parameters, truth, strict=True)]
    assert all(r.identifiable for r in tracked.parameters)
    assert np.abs(scores).max() < 3


def test_windows_at_2000_hz_are_identified_as_well_as_at_100_hz() -> None:
    vehicle = read_vehicle(MANCHESTER)
    text = MANCHESTER.read_text(encoding="utf-8")
    fast = parse_system(text.replace("sample_rate: 100", "sample_rate: 2000").replace("window: 100", "window: 2000"))
    values, truth = ride(vehicle, 4.0, 5)
    values = values[:, [vehicle.channels.index(channel.name) for channel in fast.channels]]
    noise = np.array([channel.noise for channel in fast.channels])
    measured = values + noise * np.random.default_rng(2).standard_normal(values.shape)
    found = Identifier(fast).identify(np.stack([measured[k : k + 2000] for k in (0, 2000, 4000)]))
    assert all(estimate.adequate for estimate in found)
    scores = [(estimate.log_ratio - truth) / np.sqrt(np.diag(estimate.covariance)) for estimate in found]
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.3
