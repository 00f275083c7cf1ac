"""Forces that no law of the catalogue is, and that one resembles: told as unknown, with what comes closest."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.signals import FloatArray
from tests.diagnosis.component.rigs import TRAVEL, Force, diagnosed, found, leaves, moved, recorded, sliders


def even_sliders() -> Force:
    """Iwan's model of a lap joint: sliders that slip one after the other, evenly up to 12 mm."""
    reach = np.linspace(2e-4, 0.6 * TRAVEL, 60)
    return sliders(np.full(60, 350.0 / float(np.sum(reach))), reach)


def filled_rubber() -> Force:
    """Bonds that break one after the other, so that the stiffness falls with the amplitude as Kraus has it (Payne)."""
    at = 0.04 * TRAVEL
    reach = np.geomspace(at / 30, 1.5 * TRAVEL, 80)
    ends = np.concatenate([[0.0], reach])
    slope = np.diff(1.5e5 * ends / (1 + (ends / at) ** 1.2)) / np.diff(ends)
    return sliders(np.maximum(-np.diff(np.append(slope, slope[-1])), 0.0), reach)


def rubber_spring(d: FloatArray, v: FloatArray) -> FloatArray:
    """Friction of rubber (Berg): hyperbolic branches from every turning point to 300 N either way."""
    most, half = 300.0, 2e-3
    path, begun, since, turned = np.zeros(len(d)), 0.0, float(d[0]), 0.0
    for i, way in enumerate(np.sign(np.diff(d)).tolist(), 1):
        if way not in (0.0, turned):
            begun, since, turned = path[i - 1], d[i - 1], way
        gone = abs(d[i] - since)
        path[i] = begun + turned * gone / (half * (1 - turned * begun / most) + gone) * (most - turned * begun)
    return path


def kwok(d: FloatArray, v: FloatArray) -> FloatArray:
    """A magneto-rheological damper after Kwok et al. (2006)."""
    return np.asarray(250.0 * np.tanh(25.0 * v + 0.6 * np.sign(d)))


@pytest.mark.parametrize(
    ("force", "kind"),
    [
        (even_sliders(), "random"),
        (even_sliders(), "sines"),
        (filled_rubber(), "random"),
        (rubber_spring, "random"),
        pytest.param(leaves(3e4, 160.0, 2e-3, 0.3), "random", marks=pytest.mark.slow),
        pytest.param(kwok, "sines", marks=pytest.mark.slow),
    ],
    ids=["iwan-random", "iwan-sines", "rubber-random", "berg-random", "leaves-random", "kwok-sines"],
)
def test_a_force_that_a_law_resembles_is_unknown_where_the_law_leaves_a_force_of_the_motion(
    force: Force, kind: str
) -> None:
    report = diagnosed(recorded(force, moved(kind, 5)))
    assert report.verdict == "unknown_physics", report.summary
    (unknown,) = [f for f in report.findings if f.effect != "preload"]
    assert unknown.location == "damper" and unknown.effect in ("unknown", "formula")
    if unknown.effect == "unknown":
        assert "would come closest" in unknown.sentence
    assert report.augmented_validation.nrmse < 0.4 * report.baseline_validation.nrmse


@pytest.mark.parametrize("noise", [0.005, 0.03])
@pytest.mark.parametrize("kind", ["random", "sweep"])
def test_a_law_that_is_the_components_keeps_its_name(kind: str, noise: float) -> None:
    for name, force in {
        "damper_blowoff": lambda d, v: 2e3 * np.sign(v) * np.minimum(np.abs(v), 0.05 + 0.2 * np.abs(v)),
        "cubic_stiffness": lambda d, v: 300.0 * (d / TRAVEL) ** 3,
    }.items():
        report = diagnosed(recorded(force, moved(kind, 5), noise), noise)
        assert (report.verdict, found(report)) == ("missing_physics", {name}), report.summary


def test_a_single_loop_tells_nothing_of_what_a_law_leaves() -> None:
    """An unnamed force follows it whatever it is, so that the law of the loop is named as far as it goes."""
    report = diagnosed(recorded(even_sliders(), moved("sine")))
    assert report.verdict == "missing_physics"
    assert report.findings[0].effect in ("bouc_wen", "dahl", "lugre")
