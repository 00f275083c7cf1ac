"""The catalogue of laws: possible behaviour beyond the nominal structure.  One table; docs/catalogue.md."""

from __future__ import annotations

from sprung.model.laws.base import COMPRESSION, EXTENSION, ElementLaw, ParameterSpec, grid
from sprung.model.laws.bodies import EXTERNAL_FORCE, FLEXIBLE_MODE, MASS_CHANGE
from sprung.model.laws.channel import SensorResponse
from sprung.model.laws.damping import (
    COULOMB_FRICTION,
    DAMPER_ASYMMETRY,
    DAMPER_BLOWOFF,
    POWER_LAW_DAMPING,
    QUADRATIC_DAMPING,
)
from sprung.model.laws.drift import TIME_VARYING_DAMPING, TIME_VARYING_STIFFNESS
from sprung.model.laws.friction import DAHL, LUGRE, STRIBECK
from sprung.model.laws.gas import GAS_SPRING, PRELOAD
from sprung.model.laws.hysteresis import AIR_SPRING, BOUC_WEN, SERIES_STIFFNESS
from sprung.model.laws.kinds import BodyLaw, Law, SensorLaw, StructureLaw, SupportLaw
from sprung.model.laws.lost_motion import FRICTION_BACKLASH, PINCHED_HYSTERESIS
from sprung.model.laws.motion import CLOCK_LEAD, UNIT_ELEMENT, Motion, Observed, SpringDamper, observe, reversal_step
from sprung.model.laws.own import LawFileError, load_laws
from sprung.model.laws.running_gear import ANTI_ROLL_BAR, RAIL_JOINTS, WHEEL_FLAT
from sprung.model.laws.sensor_faults import (
    AXLE_DELAY,
    HIGH_PASS,
    MOUNTING_RESONANCE,
    SENSOR_BIAS,
    SENSOR_ERROR,
    SENSOR_GAIN,
    SENSOR_LAG,
    SENSOR_NOISE,
    SENSOR_STUCK,
)
from sprung.model.laws.stiffness import BUMP_STOP, CLEARANCE, CUBIC_STIFFNESS, PROGRESSIVE_STOP
from sprung.model.laws.structure import (
    DAMPING_CHANGE,
    INERTER,
    MISSING_CONNECTION,
    MODAL_DAMPING,
    STIFFNESS_CHANGE,
    SUSPENDED_MASS,
    WRONG_POSITION,
)
from sprung.model.laws.viscoelastic import FRACTIONAL_STIFFNESS, STRUCTURAL_DAMPING

CATALOGUE: tuple[Law, ...] = (
    CUBIC_STIFFNESS,
    BUMP_STOP,
    PROGRESSIVE_STOP,
    CLEARANCE,
    COULOMB_FRICTION,
    DAMPER_BLOWOFF,
    DAMPER_ASYMMETRY,
    QUADRATIC_DAMPING,
    SERIES_STIFFNESS,
    BOUC_WEN,
    TIME_VARYING_STIFFNESS,
    TIME_VARYING_DAMPING,
    STRIBECK,
    DAHL,
    LUGRE,
    PINCHED_HYSTERESIS,
    FRICTION_BACKLASH,
    GAS_SPRING,
    POWER_LAW_DAMPING,
    PRELOAD,
    AIR_SPRING,
    FRACTIONAL_STIFFNESS,
    STRUCTURAL_DAMPING,
    MODAL_DAMPING,
    ANTI_ROLL_BAR,
    WHEEL_FLAT,
    RAIL_JOINTS,
    FLEXIBLE_MODE,
    EXTERNAL_FORCE,
    MASS_CHANGE,
    MISSING_CONNECTION,
    SUSPENDED_MASS,
    WRONG_POSITION,
    INERTER,
    STIFFNESS_CHANGE,
    DAMPING_CHANGE,
    SENSOR_GAIN,
    SENSOR_LAG,
    HIGH_PASS,
    MOUNTING_RESONANCE,
    SENSOR_BIAS,
    SENSOR_NOISE,
    SENSOR_STUCK,
    SENSOR_ERROR,
    AXLE_DELAY,
)


def find_law(name: str) -> Law:
    """The law of that name; a ValueError that lists the names otherwise."""
    for law in CATALOGUE:
        if law.name == name:
            return law
    known = ", ".join(law.name for law in CATALOGUE)
    raise ValueError(f"no law is called {name!r}; the catalogue has {known}")


__all__ = [
    "CATALOGUE",
    "CLOCK_LEAD",
    "COMPRESSION",
    "EXTENSION",
    "UNIT_ELEMENT",
    "BodyLaw",
    "ElementLaw",
    "Law",
    "LawFileError",
    "Motion",
    "Observed",
    "ParameterSpec",
    "SensorLaw",
    "SensorResponse",
    "SpringDamper",
    "StructureLaw",
    "SupportLaw",
    "find_law",
    "grid",
    "load_laws",
    "observe",
    "reversal_step",
]
