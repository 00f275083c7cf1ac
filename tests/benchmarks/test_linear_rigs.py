"""Linear rigs of the benchmark: what they are made of, and what is found on two of them."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.benchmarks import linear_rigs
from sprung.model.diagnosis.api import diagnose

RATE = int(linear_rigs.RATE)


def test_springs_carry_a_force_that_stays() -> None:
    rig, true = linear_rigs.made("steps", "displacement", np.random.default_rng([1, 5]))
    count = len(true) // 2
    k = linear_rigs._chain(np.array([true[f"k{i}.stiffness"] for i in range(count)]))
    force, moved = np.split(rig.values[3 * RATE : 9 * RATE].mean(axis=0), [1])  # of the step to 80 N, ringing averaged
    carried = k @ moved
    assert carried.sum() == pytest.approx(force[0], rel=0.05)
    assert np.max(np.abs(carried)) == pytest.approx(force[0], rel=0.05)  # by the body that is pushed alone


def test_accelerations_are_those_of_the_displacements() -> None:
    rigs = [linear_rigs.made("noise", quantity, np.random.default_rng([1, 5]))[0] for quantity in linear_rigs.NOISE]
    accelerated, moved = (np.fft.rfft(rig.values[:, 1] * np.hanning(len(rig.values))) for rig in rigs)
    f = np.fft.rfftfreq(len(rigs[0].values), 1 / RATE)
    band = (f > 2) & (f < 20)
    shown = -((2 * np.pi * f[band]) ** 2) * moved[band]
    assert np.linalg.norm(shown - accelerated[band]) < 0.05 * np.linalg.norm(shown)


def test_a_linear_rig_is_consistent_and_its_values_are_right() -> None:
    (line,) = [one for one in linear_rigs.run(2, 5, "noise") if one["measured"] == "acceleration"]
    assert line["verdicts"] == {"consistent": 2} and line["named"] == [] and line["values_beyond"] == 0


@pytest.mark.parametrize(
    ("excitation", "rig"),
    [
        ("noise", 3),  # on which nothing leads, but instruments explain everything
        pytest.param("sweep", 10, marks=pytest.mark.slow),  # on which an inerter explains a little more than a mass
    ],
)
def test_errors_of_instruments_and_masses_are_calibrated_and_no_law(excitation: str, rig: int) -> None:
    made, true = linear_rigs.made(excitation, "acceleration", np.random.default_rng([700123, rig]))
    report = diagnose(made.system, made)
    assert report.verdict == "consistent", report.summary
    assert all(abs(one.value - true[one.name]) < 3 * one.std for one in report.augmented)
