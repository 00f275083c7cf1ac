"""What a law carries beside its force: branch, path, other starts, prior cost."""

from math import gamma

import numpy as np
import pytest

from sprung.model.laws import CATALOGUE, ElementLaw, SpringDamper, reversal_step
from sprung.model.laws.along import force_along
from sprung.model.laws.base import RARE, FittedElement
from sprung.model.laws.trajectory import along
from tests.named_laws import element_law, wider_law

TIME = np.arange(4000) / 1000
D = 3e-3 * np.sin(2 * np.pi * 1.3 * TIME) + 1e-3 * np.sin(2 * np.pi * 4.1 * TIME + 1)
V = np.gradient(D, TIME)


@pytest.mark.parametrize(("name", "p"), [("series_stiffness", (1.2e6,)), ("air_spring", (3e5, 0.2))])
def test_a_branch_is_the_law_that_its_memory_integrates(name: str, p: tuple[float, ...]) -> None:
    law, element = element_law(name), SpringDamper(4e5, 2e4)
    assert law.branch is not None
    branch = law.branch(p, element.damping)
    stepped = along(law, p, D, V, sample_rate=1000.0, element=element)
    s = 2j * np.pi * np.fft.rfftfreq(len(D), 1e-3)
    settled = slice(len(D) // 2, None)
    impedance = branch.stiffness * branch.time / (1 + s * branch.time) - branch.replaces  # per rate
    periodic = np.fft.irfft(impedance * np.fft.rfft(V), len(D))
    assert np.corrcoef(stepped[settled], periodic[settled])[0, 1] > 0.995


PATHS = {
    "bouc_wen": (9e4, 300.0, 1.0, -0.5),
    "dahl": (300.0, 6e5),
    "lugre": (300.0, 450.0, 5e-3, 6e5),
    "pinched_hysteresis": (300.0, 5e-4, 0.7, 1e-3),
    "friction_backlash": (300.0, 1.5e-3, 6e5, 2e4),
    "air_spring": (3e5, 0.2),
    "fractional_stiffness": (3e5, 0.3),
}


@pytest.mark.parametrize("law", [law for law in CATALOGUE if isinstance(law, ElementLaw) and law.path])
def test_a_path_is_the_law_that_its_memory_integrates(law: ElementLaw) -> None:
    for one in (law, law.wider) if law.wider is not None else (law,):
        p, element = PATHS[one.name][: len(one.parameters)], SpringDamper(4e5, 2e4)
        slow = along(one, p, D, V, sample_rate=1000.0, element=element)
        np.testing.assert_allclose(force_along(one, p, D, V, TIME, element), slow, atol=0.01 * np.abs(slow).max())


def test_a_damper_behind_a_spring_is_started_from_a_stronger_one_that_reads_alike() -> None:
    read = FittedElement(stiffness=4e5, damping=8e3, nominal_damping=2e4, frequency=12.0, rate=0.05)
    law = element_law("series_stiffness")
    assert law.restarts is not None
    (restart,) = law.restarts(read)
    c, (ks,) = restart.damping * read.damping, restart.parameters
    r = read.frequency * c / ks
    assert c / (1 + r**2) == pytest.approx(read.damping)
    softer = 1 - read.frequency * c * r / (1 + r**2) / read.stiffness
    assert restart.stiffness == pytest.approx(max(softer, 0.5))


def test_a_damper_without_a_spring_beside_it_has_other_starts_too() -> None:
    """A slide on a guide: what is read has no stiffness."""
    law = element_law("series_stiffness")
    assert law.restarts is not None
    (restart,) = law.restarts(FittedElement(0.0, 200.0, 400.0, 12.0, 0.05))
    assert restart.stiffness == 1.0 and np.all(np.isfinite(restart.parameters))


def test_the_step_of_the_rate_at_a_reversal_does_not_count_what_trembles_at_rest() -> None:
    t = np.arange(4000) / 400
    rate = np.where(t < 2, np.cos(2 * np.pi * 20 * t + 0.1), 1e-9 * np.cos(2 * np.pi * 90 * t))
    assert reversal_step(rate) == pytest.approx(2 * np.pi * 20 / 400, rel=0.05)
    assert reversal_step(np.ones(10)) == 0.0


@pytest.mark.parametrize("p", [(9e4, 300.0, 1.0), (9e4, 300.0**2, 2.0, 0.2)])
def test_other_starts_of_a_hysteresis_yield_at_the_same_force(p: tuple[float, ...]) -> None:
    law = element_law("bouc_wen") if len(p) == 3 else wider_law("bouc_wen")
    way = np.linspace(0, 1.0, 200)  # far beyond yielding

    def yields(values: tuple[float, ...]) -> float:
        return force_along(law, values, way, np.ones(200), np.arange(200) / 200, SpringDamper(4e5, 2e4))[-1]

    assert law.alike is not None
    others = law.alike(p)
    assert len(others) == 2
    for other in others:
        assert yields(other) == pytest.approx(yields(p), rel=1e-3)
        assert law.admits(other)


def test_laws_that_contain_commoner_ones_must_beat_them() -> None:
    rare = {law.name for law in CATALOGUE if law.prior_cost >= RARE}
    assert rare == {
        *("air_spring", "fractional_stiffness", "anti_roll_bar", "wheel_flat", "rail_joints"),
        *("stribeck", "dahl", "lugre", "pinched_hysteresis", "friction_backlash", "gas_spring", "progressive_stop"),
        "power_law_damping",
        *("missing_connection", "suspended_mass", "structural_damping", "modal_damping", "inerter"),
    }


def test_laws_of_rigs_are_no_candidates_for_a_vehicle() -> None:
    """What needs the force of the element itself to be told from its look-alikes."""
    kept = {law.name for law in CATALOGUE if isinstance(law, ElementLaw) and not law.screened}
    assert kept == {
        "stribeck",
        "dahl",
        "lugre",
        "pinched_hysteresis",
        "friction_backlash",
        "gas_spring",
        "progressive_stop",
        "preload",
    }
    assert wider_law("bouc_wen").prior_cost == RARE


@pytest.mark.parametrize("exponent", [0.2, 0.5, 0.9])
def test_a_cycle_of_a_fluid_damper_takes_the_energy_of_a_power_of_the_rate(exponent: float) -> None:
    """4 2^a Gamma(1 + a/2)^2 / Gamma(2 + a) times largest force times amplitude (Soong and Constantinou 1994)."""
    phase = np.linspace(0, 2 * np.pi, 40_001)
    amplitude, rate = 0.02, 0.02 * 2 * np.pi
    d, v = amplitude * np.sin(phase), rate * np.cos(phase)
    force = force_along(element_law("power_law_damping"), (3e3, exponent, 1e-6), d, v, phase, SpringDamper(4e5, 2e4))
    energy = float(np.trapezoid(force, d))
    share = 4 * 2**exponent * gamma(1 + exponent / 2) ** 2 / gamma(2 + exponent)
    assert energy == pytest.approx(share * 3e3 * rate**exponent * amplitude, rel=1e-3)


def test_a_fluid_damper_is_started_from_one_whose_mean_slope_is_what_was_read() -> None:
    read = FittedElement(stiffness=4e5, damping=8e3, nominal_damping=2e4, frequency=12.0, rate=0.05)
    law = element_law("power_law_damping")
    assert law.restarts is not None
    v = read.rate * np.random.default_rng(0).standard_normal(400_000)
    for restart in law.restarts(read):
        force = force_along(law, restart.parameters, v, v, v, SpringDamper(0.0, 0.0))
        slope = restart.damping * read.damping + float(np.mean(force * v) / np.mean(v * v))
        assert slope == pytest.approx(read.damping, rel=0.01)
