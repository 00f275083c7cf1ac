"""Forces over bins of the motion, as reports draw them."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.report.plot_data import binned


def test_every_bin_has_the_mean_of_its_samples() -> None:
    x, force = np.array([-9.0, -0.9, 0.1, 0.2, 1.1, 30.0]), np.array([1.0, 3.0, 4.0, 6.0, -2.0, 8.0])
    mean, std, law = binned(x, force, 2 * force, 0.5, np.array([-1.0, 0.0, 1.0]))
    assert mean == pytest.approx([2.0, 5.0, 3.0])  # what lies outside counts for the outermost bins
    assert law == pytest.approx(2 * mean)
    assert std == pytest.approx([std[0]] * 3)  # of two samples each


def test_where_the_motion_never_was_no_force_is_drawn() -> None:
    """A motion that hits its stops: at rest at either end, hardly ever between."""
    x = np.concatenate([np.full(50, -1.0), np.full(50, 1.0)])
    force = 100.0 * x
    mean, std, law = binned(x, force, force, 1.0, np.array([-1.0, 0.0, 1.0]))
    assert mean[[0, 2]] == pytest.approx([-100.0, 100.0])
    assert np.isnan([mean[1], std[1], law[1]]).all()
