"""The course of the concealed-effects benchmark: made once, diagnosed once, taken up again, judged."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sprung.benchmarks import concealed
from sprung.benchmarks.generator import read_vehicle
from sprung.benchmarks.silverbox import FINER, free_run, oscillator
from sprung.benchmarks.sindy import regression, sparse_fit
from sprung.model.diagnosis.report.report import FitFigures, RecordingFacts, Report
from sprung.model.system import MANCHESTER


def quiet(system: Any, record: Any, options: Any = None, progress: Any = None) -> Report:
    """A diagnosis that finds nothing."""
    fit = FitFigures(0.03, dict.fromkeys(system.sensors, 0.03))
    facts = RecordingFacts(options.file, record.seconds, len(record.values), record.lost)
    return Report(system.name, facts, "consistent", (), fit, (), (), fit, fit, {})


def test_the_benchmark_is_resumed_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def counted(*arguments: Any, **named: Any) -> Report:
        seen.append(named["options"].file)
        return quiet(*arguments, **named)

    monkeypatch.setattr(concealed, "diagnose", counted)
    options: dict[str, Any] = {"count": 0, "clean": 3, "ablate": 1, "pysindy": 0, "seconds": 1.0, "out": tmp_path}
    first = list(concealed.run(**options))
    ablated = len(concealed.ABLATIONS) - 1
    assert len(seen) == 3 + ablated
    assert list(concealed.run(**options)) == first
    assert len(seen) == 3 + ablated
    figures = next(line for line in first if line.get("set") == "all")
    assert figures["false_alarms"] == 0 and figures["clean"] == 3
    assert {line["ablation"] for line in first if "ablation" in line} == set(concealed.ABLATIONS)


def test_pysindy_finds_a_strong_cubic_spring_in_perfect_motions() -> None:
    pytest.importorskip("pysindy")
    vehicle, rng = read_vehicle(MANCHESTER), np.random.default_rng(1)
    names, matrix, _ = regression(vehicle, rng.normal(size=(3000, 28)) * np.r_[np.full(16, 1e-3), np.ones(12)], 100.0)
    value = np.zeros(len(names))
    for i, (element, law) in enumerate(names):
        size = np.sqrt(np.mean(matrix[:, :, i] ** 2))
        if law in ("stiffness", "damping"):
            value[i] = 1 / size
        elif (element, law) == ("secondary_1r", "cubic_stiffness"):
            value[i] = 0.8 / size
    found = sparse_fit(names, matrix, matrix @ value)
    assert (found["location"], found["effect"]) == ("secondary_1r", "cubic_stiffness")
    assert found["gain"] > 0.9


def test_the_free_run_of_an_oscillator_follows_the_closed_form() -> None:
    mass, damping, stiffness, rate = 2.0, 0.8, 50.0, 100.0
    parameters = [
        {"name": "body.mass", "value": mass},
        {"name": "spring.damping", "value": damping},
        {"name": "spring.stiffness", "value": stiffness},
    ]
    model = oscillator(parameters, [])
    x = free_run(model, np.zeros(2 * FINER * 300), rate, np.array([0.01, 0.0]))
    decay = damping / (2 * mass)
    omega = np.sqrt(stiffness / mass - decay**2)
    t = np.arange(300) / rate
    closed = 0.01 * np.exp(-decay * t) * (np.cos(omega * t) + decay / omega * np.sin(omega * t))
    assert x == pytest.approx(closed, abs=1e-9)


def test_a_reported_cubic_spring_enters_the_free_run() -> None:
    parameters = [
        {"name": "b.mass", "value": 1.0},
        {"name": "s.damping", "value": 0.0},
        {"name": "s.stiffness", "value": 4.0},
    ]
    finding = {"location": "s", "effect": "cubic_stiffness", "parameters": [{"name": "k3", "value": 9.0}]}
    assert oscillator(parameters, [finding])[3](2.0, 0.0) == pytest.approx(72.0)
    assert oscillator(parameters, [])[3](2.0, 0.0) == 0.0
