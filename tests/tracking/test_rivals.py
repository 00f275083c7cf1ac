"""Jumps of gains and delays of different channels that explain windows equally well are named together."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.identification.measurements.deviations import Deviation
from sprung.model.tracking import deviation_record, jumps
from sprung.model.tracking.deviation_model import model_of
from sprung.model.tracking.rules import TRACKING_RULES

# two channels of a bogie's node, two of its wheels' node, one of the car
DELAYS = [Deviation(f"c{i}", "delay", 0.002, group) for i, group in enumerate((0, 0, 1, 1, 2))]


def jump_of(information: np.ndarray, late: np.ndarray) -> tuple[set[str], list[set[str]]]:
    """Channels of the jump that windows with this information (H, H) show, and those of its rivals."""
    model = model_of(DELAYS)
    record = deviation_record.start(3, model)
    slope, curvature = information @ late, np.einsum("vh,hk,vk->v", model.directions, information, model.directions)
    record, jump = jumps.tested_for_jumps(record, model, model.directions @ slope, curvature, 1.0, 0)
    assert jump is not None
    return _names(jump.direction), [_names(rival) for rival in jump.rivals]


def _names(direction: np.ndarray) -> set[str]:
    return {d.name for d, part in zip(DELAYS, direction, strict=True) if part}


def differences(car: float) -> np.ndarray:
    """Information on what bogie and wheels differ by, a millisecond in 20 deviations, and `car` of it on the car."""
    apart, with_car = np.array([1.0, 1, -1, -1, 0]) / 2, np.array([1.0, 1, 0, 0, -2]) / 2
    own = np.diag([1.0, 1, 1, 1, 0.01]) * 1e-3
    return (20 / 1e-3) ** 2 * (np.outer(apart, apart) + car * np.outer(with_car, with_car) + own)


@pytest.mark.parametrize(("car", "rivals"), [(0.0, 1), (0.5, 0)])
def test_wheels_that_are_late_and_a_bogie_that_is_early_are_told_apart_by_the_car_only(car: float, rivals: int) -> None:
    late = np.array([0.0, 0.0, 1e-3, 1e-3, 0.0])
    jump, others = jump_of(differences(car), late)
    both = [{"c2", "c3"}, {"c0", "c1"}]
    if rivals:
        assert jump in both and others == [one for one in both if one != jump]
    else:
        assert jump == {"c2", "c3"} and others == []


def test_a_rival_is_told_up_to_the_stated_ratio_only() -> None:
    model = model_of(DELAYS)
    ratio, size = np.zeros(len(model.directions)), np.full(len(model.directions), 1e-3)
    ratio[:3] = 30.0, 30.0 - 0.9 * TRACKING_RULES.jumps.rival, 30.0 - 1.1 * TRACKING_RULES.jumps.rival
    assert [_names(one) for one in jumps.rivals(model, ratio, size, 0)] == [{"c1"}]
    size[1] = 0.5 * TRACKING_RULES.jumps.delay
    assert jumps.rivals(model, ratio, size, 0) == ()
