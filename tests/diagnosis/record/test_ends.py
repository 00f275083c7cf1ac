"""A recording's ends do not meet: what the motion of a support is continued with."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise, transform
from sprung.model.diagnosis.record.spectra import derivative
from sprung.model.system import parse_system
from tests.test_system import QUARTER_CAR

ROAD = "displacement: {csv: z, noise: 1e-5}, velocity: {csv: vz, noise: 1e-3}"


@pytest.mark.parametrize(("quantity", "order"), [("displacement", 0), ("acceleration", 2)])
def test_the_unmeasured_rate_of_a_support_is_right_up_to_the_ends(quantity: str, order: int) -> None:
    system = parse_system(QUARTER_CAR.replace(ROAD, f"{quantity}: {{csv: z, noise: 1e-5}}"))
    time, omega = np.arange(2000) / system.sample_rate, 2 * np.pi * np.array([1.03, 3.71])
    motion, rate = (((1j * omega) ** k * np.exp(1j * np.outer(time, omega))).imag.sum(axis=1) for k in (order, 1))
    values = np.column_stack([motion, np.tile(rate[:, None], len(system.sensors))])
    signals = prepare(system, values, system.sample_rate).signals
    part = transform(signals, declared_noise(system, signals))
    grid = part.grid
    slope = grid.monomials @ derivative(part.support_polynomial, grid.length)
    found = (grid.inverse(1j * grid.omega[:, None] * part.support) + slope)[:, 0]
    off = (found - rate)[20:-20]
    line = np.polynomial.Polynomial.fit(time[20:-20], off, 1)  # of an acceleration, what the integral leaves open
    assert np.abs(off - line(time[20:-20])).max() < 2e-3 * np.abs(rate).max()
