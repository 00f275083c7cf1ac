"""Nodes that sample at rates of their own, and a force gauge among them: from the file to the values."""

import json
from pathlib import Path

import numpy as np
from mcap.writer import Writer

import sprung
from sprung.model.identification.excitation import simulate_runs
from sprung.model.signals import FloatArray
from sprung.model.system import parse_system

FINE, SECONDS, START = 2000, 7, 1_790_000_000_000_000_000
TRUTH = np.array([0.1, -0.15, 0.0, 0.2])
SYSTEM = """
name: quarter-car
sample_rate: {rate}
window: {rate}
bodies:
  sprung: {{mass: 300.0}}
  unsprung: {{mass: 40.0}}
inputs:
  road:
    kind: displacement
    displacement: {{mcap: /axlebox.z, noise: 1e-5}}
    velocity: {{mcap: /axlebox.v, noise: 1e-3}}
elements:
  tyre: {{upper: unsprung, lower: road, stiffness: 1.8e5, damping: 800.0}}
  strut: {{upper: sprung, lower: unsprung, stiffness: 2.0e4, damping: 1500.0}}
sensors:
  body: {{kind: acceleration, body: sprung, mcap: /body.a, noise: 0.01}}
  wheel: {{kind: acceleration, body: unsprung, mcap: /wheel.a, noise: 0.05}}
  gauge: {{kind: force, element: strut, mcap: /gauge.volts, scale: 200.0, unit: V, noise: 2.0}}
"""
NODES = {
    "/axlebox": (2000, {"z": 0, "v": 1}),
    "/body": (200, {"a": 2}),
    "/wheel": (1000, {"a": 3}),
    "/gauge": (500, {"volts": 4}),
}


def write(path: Path, values: FloatArray) -> None:
    """One JSON channel per node, each with every so many of the fine samples (T, C)."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, (rate, columns) in NODES.items():
            properties = {name: {"type": "number"} for name in columns}
            schema = writer.register_schema(
                topic, "jsonschema", json.dumps({"type": "object", "properties": properties}).encode()
            )
            channel = writer.register_channel(topic, "json", schema)
            for k in range(0, len(values), FINE // rate):
                time = START + k * (1_000_000_000 // FINE)
                row = json.dumps({name: values[k, c] for name, c in columns.items()}).encode()
                writer.add_message(channel, time, row, time)
        writer.finish()


def test_nodes_of_200_to_2000_hz_and_a_force_gauge_in_volts_give_the_true_values(tmp_path: Path) -> None:
    fine = parse_system(SYSTEM.format(rate=FINE))
    values = simulate_runs(fine, TRUTH[None], FINE * SECONDS, np.random.default_rng(4)).values[0]
    values[:, 4] /= 200.0
    write(tmp_path / "ride.mcap", values)
    system = parse_system(SYSTEM.format(rate=100))
    record = sprung.load_record(tmp_path / "ride.mcap", system)
    scores = []
    for k in range(100, len(record.values) - 200, 50):  # but for the ends, where the filters begin
        estimate = sprung.identify(system, record.values[k : k + 100]).estimate
        assert estimate.adequate
        scores.append((estimate.log_ratio - TRUTH) / np.sqrt(np.diag(estimate.covariance)))
    assert len(scores) > 6
    assert 0.2 < np.sqrt(np.mean(np.square(scores))) < 1.3  # less than one: fast nodes are averaged
