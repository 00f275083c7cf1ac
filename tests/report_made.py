"""A mismatch report as a diagnosis makes it, without one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.report.report import (
    CandidateRow,
    Finding,
    FitFigures,
    LawParameter,
    RecordingFacts,
    Report,
    ReportedParameter,
)
from sprung.model.system import System, load_system

SYSTEM = load_system()


def fit(system: System, value: float) -> FitFigures:
    return FitFigures(value, dict.fromkeys(system.sensors, value))


def friction_report(system: System = SYSTEM) -> Report:
    """Friction of 395 N that had raised one damping by 148 %, with arrays that show it."""
    rng = np.random.default_rng(1)
    sensors = len(system.sensors)
    measured = rng.normal(size=(600, sensors))
    d, v = 2e-3 * rng.normal(size=400), 0.02 * rng.normal(size=400)
    x = np.linspace(-0.06, 0.06, 41)
    law = 395 * np.tanh(x / 2e-3)
    place = system.elements[-3] if len(system.elements) > 3 else system.elements[0]
    augmented = tuple(
        ReportedParameter(p.name, p.nominal, 0.01 * p.nominal, p.nominal, p.unit) for p in system.parameters
    )
    baseline = tuple(replace(p, value=2.48 * p.value) if p.name == f"{place}.damping" else p for p in augmented)
    friction = LawParameter("force", 395.2, 6.1, "N"), LawParameter("smoothing", 2.1e-3, 3e-4, "m/s")
    found = Finding(place, "coulomb_friction", EffectKind.LISTED, friction, 0.0, -5100.0, ("damper_blowoff", -4300.0))
    return Report(
        system=system.name,
        recording=RecordingFacts("run.mcap", 60.0, 6000, 3),
        verdict="missing_physics",
        baseline=baseline,
        baseline_validation=fit(system, 0.145),
        findings=(found,),
        augmented=augmented,
        augmented_validation=fit(system, 0.031),
        noise_floor=fit(system, 0.030),
        localization={place: 5100.0, "car": 30.0},
        explained=0.993,
        candidates=(CandidateRow(place, "coulomb_friction", 5100.0, 0.0, -5100.0),),
        plot_data={
            "validation.time": np.arange(600) / system.sample_rate,
            "validation.measured": measured,
            "validation.baseline": measured + 0.2 * rng.normal(size=measured.shape),
            "validation.augmented": measured + 0.03,
            "validation.noise": np.full(sensors, 0.03),
            "finding.0.deflection": d,
            "finding.0.rate": v,
            "finding.0.force_before": 395 * np.tanh(v / 2e-3),
            "finding.0.force_after": rng.normal(size=400),
            "finding.0.curve_axis": np.array("rate"),
            "finding.0.curve_x": x,
            "finding.0.curve_mean": law,
            "finding.0.curve_std": np.full(41, 9.0),
            "finding.0.curve_law": law,
        },
    )
