"""What log-ratios of parameters make of a system: the values that the file would have had."""

from __future__ import annotations

import numpy as np

from sprung.model.ratios import mechanics_at, parameter_powers
from sprung.model.simulate.ride import with_values
from sprung.model.system import MANCHESTER, load_system, parse_system


def test_log_ratios_give_the_mechanics_of_the_values_that_they_stand_for() -> None:
    system = load_system()
    ratio = np.random.default_rng(3).normal(0.0, 0.5, len(system.parameters))
    values = {p.name: p.nominal * np.exp(x) for p, x in zip(system.parameters, ratio, strict=True)}
    found, wanted = mechanics_at(system, ratio), with_values(system, values)
    for name in ("stiffness", "damping", "mass"):
        assert np.allclose(getattr(found, name), getattr(wanted, name), rtol=1e-14)
    powers = parameter_powers(system)
    assert powers.stiffness.sum() + powers.damping.sum() == len(system.parameters) and not powers.mass.any()


def test_a_mass_scales_all_inertias_of_its_body_and_nothing_else() -> None:
    text = MANCHESTER.read_text(encoding="utf-8")
    system = parse_system(text.replace("estimate: [stiffness, damping]", "estimate: [stiffness, damping, mass]"))
    at = [p.name for p in system.parameters].index("car.mass")
    ratio = np.zeros(len(system.parameters))
    ratio[at] = np.log(2.0)
    found, own = mechanics_at(system, ratio), system.mechanics.body_of_dof == system.bodies.index("car")
    assert np.allclose(found.mass, system.mechanics.mass * np.where(own, 2.0, 1.0))
    assert np.array_equal(found.stiffness, system.mechanics.stiffness)
