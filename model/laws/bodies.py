"""Physics of a body: an elastic mode, an unmeasured force, another mass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sprung.model.laws.base import ParameterSpec, Values, grid
from sprung.model.laws.kinds import BodyLaw
from sprung.model.mechanics import Mechanics
from sprung.model.signals import FloatArray

# A free-free beam's first bending, normalised to 1 at the ends: roots of cosh(b) cos(b) = 1
_BETA = 4.730040744862704
# Bodies overhang their outermost attachment: half length over the attachments' largest distance from the centre
_OVERHANG = 1.3


def _beam(x: FloatArray, half_length: float) -> FloatArray:
    """First free bending mode of a uniform beam at x from its middle, 1 at the ends."""
    s = _BETA / 2 * np.asarray(x) / half_length
    b = _BETA / 2
    found: FloatArray = 0.5 * (np.cosh(s) / np.cosh(b) + np.cos(s) / np.cos(b))
    return found


def columns_of(mechanics: Mechanics, body: int) -> dict[str, int]:
    """Degrees of freedom of a body: {"z": 0, "roll": 1, "pitch": 2}, those it has."""
    return {mechanics.dofs[i].rsplit(".", 1)[1]: int(i) for i in np.flatnonzero(mechanics.body_of_dof == body)}


def _arms(rows: FloatArray, columns: dict[str, int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sign, x and y from the body's centre of the points that rows (.., n) of H, S or F.T touch; sign 0: not at all."""
    sign = rows[:, columns["z"]]
    safe = np.where(sign == 0, 1.0, sign)
    x = rows[:, columns["pitch"]] / safe if "pitch" in columns else np.zeros(len(rows))
    y = rows[:, columns["roll"]] / safe if "roll" in columns else np.zeros(len(rows))
    return sign, x, y


def _mode_shape(mechanics: Mechanics, rows: FloatArray, body: int, variant: str) -> FloatArray:
    """The mode's motion at every row's point, sign included; 1 at the body's outermost attachments."""
    columns = columns_of(mechanics, body)
    sign, x, y = _arms(rows, columns)
    at, reach_x, reach_y = _arms(mechanics.H, columns)
    span_x = max(np.abs(reach_x[at != 0]).max(initial=0.0), 1e-9)
    span_y = max(np.abs(reach_y[at != 0]).max(initial=0.0), 1e-9)
    if variant == "bending":
        half = _OVERHANG * span_x
        return sign * _beam(x, half) / _beam(np.array(span_x), half)
    if variant == "second_bending":
        found: FloatArray = sign * x / span_x
        return found
    if variant == "torsion":
        twisted: FloatArray = sign * x * y / (span_x * span_y)
        return twisted
    return sign  # "local": all attachments of the body move together against it


def _mode_variants(mechanics: Mechanics, body: int) -> tuple[str, ...]:
    columns = columns_of(mechanics, body)
    if "pitch" not in columns:
        return ("local",)
    return ("bending", "second_bending", "torsion") if "roll" in columns else ("bending", "second_bending")


def with_element(
    mechanics: Mechanics, row: FloatArray, stiffness: float, damping: float, of_supports: FloatArray | None = None
) -> Mechanics:
    """The mechanics with one more spring-damper, after the others, of deflection row @ q + of_supports @ s.

    row (n,), of_supports (supports,); zero if left out.
    """
    ground = np.zeros(mechanics.G.shape[1]) if of_supports is None else of_supports
    return replace(
        mechanics,
        stiffness=np.append(mechanics.stiffness, stiffness),
        damping=np.append(mechanics.damping, damping),
        H=np.vstack([mechanics.H, row]),
        G=np.vstack([mechanics.G, ground]),
        L=np.hstack([mechanics.L, np.zeros((len(mechanics.L), 1))]),
    )


def _flexible(mechanics: Mechanics, body: int, p: Values, variant: str) -> Mechanics:
    """One more degree of freedom eta: m eta'' + 2 zeta omega m eta' + m omega^2 eta = phi . forces.

    Its modal mass m is set to the body's mass and phi^2 = participation, which fixes the arbitrary scale of eta.
    """
    frequency, ratio, participation = (float(value) for value in p)
    columns = columns_of(mechanics, body)
    m = mechanics.mass[columns["z"]]
    omega = 2 * np.pi * frequency
    scale = np.sqrt(participation)
    extended = replace(
        mechanics,
        dofs=(*mechanics.dofs, f"{mechanics.dofs[columns['z']].rsplit('.', 1)[0]}.{variant}"),
        body_of_dof=np.append(mechanics.body_of_dof, body),
        mass=np.append(mechanics.mass, m),
        H=np.column_stack([mechanics.H, scale * _mode_shape(mechanics, mechanics.H, body, variant)]),
        F=np.vstack([mechanics.F, scale * _mode_shape(mechanics, mechanics.F.T, body, variant)[None]]),
        S=np.column_stack([mechanics.S, scale * _mode_shape(mechanics, mechanics.S, body, variant)]),
    )
    row = np.zeros(extended.n)
    row[-1] = 1.0
    return with_element(extended, row, m * omega**2, 2 * ratio * omega * m)


def _frequencies(lines: Sequence[float]) -> FloatArray:
    return np.asarray(sorted(set(lines)), dtype=float)


FLEXIBLE_MODE = BodyLaw(
    name="flexible_mode",
    title="elastic mode of the body",
    parameters=(
        ParameterSpec("frequency", "Hz", 0.2, 500.0, "natural frequency of the free body", lambda s: 10.0, log=True),
        ParameterSpec(  # car bodies, fitted out, have 0.01 to 0.05
            "damping_ratio", "1", 1e-4, 0.5, "share of critical damping", lambda s: 0.02, log=True, plausible=(0.0, 0.2)
        ),
        ParameterSpec(
            "participation", "1", 0.0, 10.0, "mass of the body over modal mass, times shape^2 there", lambda s: 0.3
        ),
    ),
    variants=_mode_variants,
    modify=_flexible,
    shapes=lambda lines: grid(_frequencies(lines), [0.02], [0.3]),
    absent=(1.0, 0.02, 0.0),
    looks_like="a narrow resonance in all sensors of one body, in one pattern; follows the excitation's level",
    powers={0: (2.0, 1.0), 1: (0.0, 1.0)},
    confused_with=("external_force", "series_stiffness"),
    sentence="the body has an elastic mode at {frequency} with {damping_ratio} of critical damping",
    adds_motion=True,
)


def _directions(mechanics: Mechanics, body: int) -> tuple[str, ...]:
    return tuple(columns_of(mechanics, body))


def _driven(mechanics: Mechanics, body: int, p: Values, variant: str) -> Mechanics:
    """One more measured force, last in u, on one degree of freedom."""
    column = np.zeros((mechanics.n, 1))
    column[columns_of(mechanics, body)[variant]] = 1.0
    return replace(
        mechanics,
        F=np.hstack([mechanics.F, column]),
        force_drive=np.append(mechanics.force_drive, mechanics.drives),
    )


def _sine(time: FloatArray, p: Values) -> FloatArray:
    amplitude, frequency, phase = p
    found: FloatArray = amplitude * np.sin(2 * np.pi * frequency * np.asarray(time) + phase)
    return found


EXTERNAL_FORCE = BodyLaw(
    name="external_force",
    title="unmeasured periodic force",
    parameters=(
        ParameterSpec("amplitude", "N", 0.0, 1e9, "of the sine; N m on roll and pitch", lambda s: 100.0),
        ParameterSpec("frequency", "Hz", 0.05, 500.0, "of the sine", lambda s: 3.0, log=True),
        ParameterSpec("phase", "rad", -10.0, 10.0, "at the start of the laws' clock", lambda s: 0.3),
    ),
    variants=_directions,
    modify=_driven,
    load=_sine,
    shapes=lambda lines: grid([100.0], _frequencies(lines), [0.0, np.pi / 2]),
    absent=(0.0, 1.0, 0.0),
    looks_like="a line as narrow as the recording is long, without relation to the inputs",
    confused_with=("flexible_mode", "wheel_flat", "rail_joints"),
    sentence="an unmeasured force of {amplitude} at {frequency} acts on the body",
)


def _heavier(mechanics: Mechanics, body: int, p: Values, variant: str) -> Mechanics:
    (ratio,) = p
    return replace(mechanics, mass=np.where(mechanics.body_of_dof == body, ratio * mechanics.mass, mechanics.mass))


MASS_CHANGE = BodyLaw(
    name="mass_change",
    title="another mass",
    parameters=(
        ParameterSpec(
            "ratio", "1", 0.05, 20.0, "mass and inertias over nominal", lambda s: 1.1, log=True, plausible=(0.4, 2.5)
        ),
    ),
    variants=lambda mechanics, body: ("",),
    modify=_heavier,
    shapes=lambda lines: grid([1.1]),
    absent=(1.0,),
    looks_like="all accelerations of the body scale against the forces; stiffnesses and dampings seem off together",
    confused_with=("sensor_gain", "anti_roll_bar"),
    sentence="the body has {ratio} times its nominal mass",
    scales="mass",
)
