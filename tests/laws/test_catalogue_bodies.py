"""Laws of bodies and of sensors against what they say they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sprung.model.laws import CATALOGUE, SensorLaw
from sprung.model.mechanics import Mechanics
from sprung.model.signals import FloatArray
from sprung.model.simulate.nonlinear import NonlinearSimulator
from sprung.model.system import load_system
from tests.named_laws import body_law, sensor_law

SYSTEM = load_system()
MECHANICS = SYSTEM.mechanics
CAR = SYSTEM.bodies.index("car")


def frequencies(mechanics: Mechanics) -> FloatArray:
    return np.array([mode.frequency for mode in mechanics.modes(SYSTEM.bodies)])


def test_a_mode_of_a_body_that_hangs_on_nothing_has_its_frequency_and_damping() -> None:
    free = replace(MECHANICS, stiffness=np.zeros(12), damping=np.zeros(12))
    law = body_law("flexible_mode")
    bent = law.modify(free, CAR, (11.9, 0.02, 0.5), "bending")
    (mode,) = [mode for mode in bent.modes(SYSTEM.bodies) if mode.frequency > 1e-3]
    assert mode.frequency == pytest.approx(11.9, rel=1e-9)
    assert mode.damping_ratio == pytest.approx(0.02, rel=1e-9)


def test_a_mode_without_participation_changes_no_sensor() -> None:
    law = body_law("flexible_mode")
    bent = law.modify(MECHANICS, CAR, (11.9, 0.02, 0.0), "bending")
    knots = _road(200)
    plain = NonlinearSimulator(MECHANICS, 100.0).run(knots, [])
    same = NonlinearSimulator(bent, 100.0).run(knots, [])
    np.testing.assert_allclose(same.outputs, plain.outputs, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize(
    "variant, pattern",
    [("bending", [1, 1, 1, 1]), ("second_bending", [1, 1, -1, -1]), ("torsion", [1, -1, -1, 1])],
)
def test_mode_shapes_have_their_pattern_at_the_secondary_springs_and_the_sensors_there(
    variant: str, pattern: list[int]
) -> None:
    bent = body_law("flexible_mode").modify(MECHANICS, CAR, (11.9, 0.02, 0.25), variant)
    np.testing.assert_allclose(bent.H[8:12, -1], 0.5 * np.array(pattern), rtol=1e-12)
    np.testing.assert_allclose(bent.S[:4, -1], 0.5 * np.array(pattern), rtol=1e-12)
    assert not bent.H[:8, -1].any() and not bent.S[4:, -1].any()


def test_the_first_bending_moves_the_middle_against_the_ends() -> None:
    with_middle = replace(MECHANICS, S=MECHANICS.S.copy())
    with_middle.S[0] = np.eye(9)[0]  # a sensor in the middle of the car
    bent = body_law("flexible_mode").modify(with_middle, CAR, (11.9, 0.02, 1.0), "bending")
    assert bent.S[0, -1] < 0 < bent.S[1, -1]


def test_a_heavier_body_lowers_its_modes_by_the_root_of_the_ratio() -> None:
    stiff_bogies = replace(MECHANICS, stiffness=np.where(np.arange(12) < 8, 1e12, MECHANICS.stiffness))
    heavy = body_law("mass_change").modify(stiff_bogies, CAR, (1.21,), "")
    ratio = frequencies(heavy)[:3] / frequencies(stiff_bogies)[:3]
    np.testing.assert_allclose(ratio, 1 / 1.1, rtol=1e-4)


def test_an_unmeasured_force_enters_like_a_measured_one() -> None:
    law = body_law("external_force")
    assert law.load is not None and law.variants(MECHANICS, CAR) == ("z", "roll", "pitch")
    driven = law.modify(MECHANICS, CAR, (150.0, 3.0, 0.0), "z")
    t = np.arange(4000) / 100.0
    load = law.load(t, (150.0, 3.0, 0.3))
    slope = 150.0 * 2 * np.pi * 3 * np.cos(2 * np.pi * 3 * t + 0.3)
    knots = np.concatenate([np.zeros((4000, 16)), load[:, None], slope[:, None]], axis=1)
    run = NonlinearSimulator(driven, 100.0).run(knots, [])
    settled = slice(3000, 4000)
    A, B, C, D = driven.matrices()
    s = 2j * np.pi * 3
    answer = C[0] @ np.linalg.solve(s * np.eye(18) - A, B[:, -1]) + D[0, -1]
    expected = np.imag(150.0 * answer * np.exp(1j * (2 * np.pi * 3 * t + 0.3)))
    np.testing.assert_allclose(run.outputs[settled, 0], expected[settled], atol=1e-4 * np.abs(expected).max())


def _road(samples: int) -> FloatArray:
    rng = np.random.default_rng(2)
    t = np.arange(samples) / 100.0
    columns = []
    for _ in range(8):
        f, phase = rng.uniform(0.5, 15, 10), rng.uniform(0, 2 * np.pi, 10)
        angle = 2 * np.pi * f * t[:, None] + phase
        columns += [(1e-3 / f * np.sin(angle)).sum(1), (1e-3 * 2 * np.pi * np.cos(angle)).sum(1)]
    return np.stack(columns, axis=1)


def signal(samples: int = 600, rate: float = 100.0) -> tuple[FloatArray, Callable[[FloatArray], FloatArray]]:
    t = np.arange(samples) / rate
    return t, lambda t: np.sin(2 * np.pi * 3.3 * t) + 0.4 * np.cos(2 * np.pi * 11 * t + 1) + 0.2 * t


@pytest.mark.parametrize("late", [0.0075, -0.0031, 0.02])
def test_a_late_sensor_shows_the_past(late: float) -> None:
    t, truth = signal()
    shown = sensor_law("sensor_lag").distort(truth(t), (late,), 100.0)
    inner = slice(40, -40)
    np.testing.assert_allclose(shown[inner], truth(t - late)[inner], atol=2e-3)


@pytest.mark.parametrize(
    "law",
    [law for law in CATALOGUE if isinstance(law, SensorLaw) and law.parameters and not law.filters],
    ids=lambda law: law.name,
)
def test_every_fault_that_can_be_undone_is_undone(law: SensorLaw) -> None:
    t, truth = signal()
    p = {"gain": (0.87,), "time": (0.0075,), "offset": (0.4,), "ratio": (3.0,)}[law.parameters[0].name]
    shown = law.distort(np.stack([truth(t), truth(t + 1)]), p, 100.0)
    restored = law.restore(shown, p, 100.0)
    inner = (slice(None), slice(40, -40))
    np.testing.assert_allclose(restored[inner], np.stack([truth(t), truth(t + 1)])[inner], atol=2e-3)
    np.testing.assert_allclose(law.distort(truth(t), law.absent, 100.0), truth(t), atol=1e-9)


def test_a_stuck_sensor_repeats_its_first_value() -> None:
    t, truth = signal()
    shown = sensor_law("sensor_stuck").distort(truth(t), (), 100.0)
    assert np.ptp(shown) == 0 and shown[0] == truth(t)[0]
