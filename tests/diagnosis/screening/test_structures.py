"""Parts that a structure has and its file does not state: screened, fitted, named; truth by the generator's code."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import yaml

from sprung.benchmarks.structure import HALF_CAR, ConcealedPart, MadeSamples, drawn, made
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise
from sprung.model.diagnosis.screening.score import Projector
from sprung.model.diagnosis.screening.structures import structure_candidates, unconnected
from sprung.model.diagnosis.selection.starts import start_of
from sprung.model.laws import StructureLaw, find_law
from sprung.model.system import load_system

FILE = yaml.safe_load(HALF_CAR.read_text(encoding="utf-8"))
SYSTEM = load_system(HALF_CAR)


def _recording(kind: str, seed: int, seconds: float = 25.0) -> tuple[ConcealedPart, MadeSamples]:
    random = np.random.default_rng(seed)
    part = drawn(FILE, kind, random)
    return part, made(part, FILE, SYSTEM, random, seconds)[0]


@pytest.mark.parametrize(("kind", "seed"), [("missing_connection", 3), ("suspended_mass", 4), ("wrong_position", 5)])
def test_a_part_that_the_file_lacks_is_named_with_its_values(kind: str, seed: int) -> None:
    part, record = _recording(kind, seed)
    report = diagnose(SYSTEM, record, Options())
    assert [(f.location, f.effect) for f in report.findings] == [(part.location, kind)]
    for parameter in report.findings[0].parameters:
        assert parameter.value == pytest.approx(part.parameters[parameter.name], abs=5 * parameter.std)


def test_a_damper_to_the_ground_is_a_connection() -> None:
    """A skyhook: nothing between the axles and the body imitates it."""
    data = copy.deepcopy(FILE)
    size = 0.8 * data["elements"]["spring_front"]["damping"]
    place = {"x": 0.0, "y": 0.0}
    hidden = {"upper": "frame", "lower": "ground", "position": [0, 0], "stiffness": 0.0, "damping": size}
    data["elements"]["hidden"] = hidden
    part = ConcealedPart("missing_connection", "frame|ground", {"stiffness": 0.0, "damping": size, **place}, data)
    record, _ = made(part, FILE, SYSTEM, np.random.default_rng(8), 25.0)
    report = diagnose(SYSTEM, record, Options())
    assert [(f.location, f.effect) for f in report.findings] == [(part.location, part.effect)]
    damping = next(p for p in report.findings[0].parameters if p.name == "damping")
    assert damping.value == pytest.approx(size, rel=0.02)


def test_a_clean_recording_lacks_nothing() -> None:
    _, record = _recording("clean", 6)
    report = diagnose(SYSTEM, record, Options())
    assert report.verdict == "consistent" and not report.findings


@pytest.mark.parametrize(("kind", "share"), [("missing_connection", 0.02), ("suspended_mass", 0.15)])
def test_scores_in_closed_form_promise_what_a_fit_gains(kind: str, share: float) -> None:
    """Of a faint part, where the first order is all there is."""
    random = np.random.default_rng(3)
    part = drawn(FILE, kind, random)
    for group, quantities in (("elements", ("stiffness", "damping")), ("bodies", ("mass",))):
        for quantity in quantities if "hidden" in part.data[group] else ():
            part.data[group]["hidden"][quantity] *= share
    record, _ = made(part, FILE, SYSTEM, random, 20.0)
    signals = prepare(SYSTEM, record.values, record.sample_rate).signals
    problem, fit = baseline(SYSTEM, signals, declared_noise(SYSTEM, signals), signals.samples)
    law = find_law(kind)
    assert isinstance(law, StructureLaw)
    best = max(
        (candidate for candidate, _ in structure_candidates(Projector(problem, fit), (law,))),
        key=lambda candidate: candidate.score,
    )
    assert best.location == part.location and best.score > 30
    again = optimise(problem, start_of(fit, best), whitener=fit.whitener)
    assert fit.chi_square - again.chi_square == pytest.approx(best.score, rel=0.2)


def test_connections_are_sought_where_no_element_is() -> None:
    pairs = set(unconnected(SYSTEM))
    assert ("front", "rear") in pairs and ("frame", "road_front") in pairs
    assert ("front", "road_front") not in pairs
    assert ("frame", "ground") in pairs and ("road_front", "ground") not in pairs
