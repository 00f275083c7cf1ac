"""Parts that a structure has and its file does not state: a connection, a mass that hangs on a body, another place.

All are linear.  A point (x, y) of a body moves by z + (y - y0) roll + (x - x0) pitch, as everywhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sprung.model.laws.base import RARE, ParameterSpec, Values
from sprung.model.laws.bodies import columns_of, with_element
from sprung.model.laws.kinds import Foothold, StructureLaw
from sprung.model.laws.motion import Observed
from sprung.model.mechanics import Mechanics
from sprung.model.schema import GROUND, SystemFile
from sprung.model.signals import FloatArray

AXES = {"x": "pitch", "y": "roll"}  # a place along an axis: the rotation that it is a lever of
_ANYWHERE = 1e4  # m


def point_rows(mechanics: Mechanics, body: int) -> FloatArray:
    """Vertical motion of a body's points, row(x, y) = rows[0] + x rows[1] + y rows[2] over the degrees of freedom.

    Shape (3, n).
    """
    columns = columns_of(mechanics, body)
    rows = np.zeros((3, mechanics.n))
    rows[0, columns["z"]] = 1.0
    for number, (axis, centre) in enumerate(zip(AXES, mechanics.centre[body], strict=True), 1):
        if AXES[axis] in columns:
            rows[number, columns[AXES[axis]]] = 1.0
            rows[0, columns[AXES[axis]]] = -centre
    return rows


def point(mechanics: Mechanics, body: int, x: float, y: float) -> FloatArray:
    """Vertical motion of one point, (n,)."""
    return np.array([1.0, x, y]) @ point_rows(mechanics, body)


def _any(seen: Observed) -> float:
    return 1.0


def _place(axis: str) -> ParameterSpec:
    return ParameterSpec(axis, "m", -_ANYWHERE, _ANYWHERE, f"place along {axis}", _any)


def _connected(mechanics: Mechanics, sites: tuple[Foothold, ...], p: Values, variant: str) -> Mechanics:
    """One more spring-damper from the first site to the second."""
    stiffness, damping, x, y = (float(value) for value in p)
    row, ground = np.zeros(mechanics.n), np.zeros(mechanics.G.shape[1])
    for sign, site in zip((1.0, -1.0), sites, strict=True):
        if site.kind == "body":
            row += sign * point(mechanics, site.number, x, y)
        elif site.kind == "support":
            ground[site.number] += sign
    return with_element(mechanics, row, stiffness, damping, ground)


MISSING_CONNECTION = StructureLaw(
    name="missing_connection",
    title="a connection that the system file does not have",
    parameters=(
        ParameterSpec("stiffness", "N/m", 0.0, 1e15, "of the spring", _any),
        ParameterSpec("damping", "N s/m", 0.0, 1e12, "of the damper", _any),
        _place("x"),
        _place("y"),
    ),
    where="bodies",
    modify=_connected,
    absent=(0.0, 0.0, 0.0, 0.0),
    looks_like="two bodies pull each other; springs between them or to others seem off together",
    confused_with=("anti_roll_bar", "wrong_position", "suspended_mass", "mass_change"),
    sentence="the system file lacks a connection between them: stiffness {stiffness}, damping {damping}",
    axes={2: "x", 3: "y"},
    powers={0: (1.0, 0.0), 1: (0.0, 1.0)},
    strengths=(0, 1),
    prior_cost=RARE,
)


def _suspended(mechanics: Mechanics, sites: tuple[Foothold, ...], p: Values, variant: str) -> Mechanics:
    """One more degree of freedom: a mass that hangs on a spring and a damper at a point of a body."""
    mass, frequency, ratio, x, y = (float(value) for value in p)
    ((_, body),) = sites
    omega = 2 * np.pi * frequency
    row = np.append(point(mechanics, body, x, y), -1.0)
    extended = replace(
        mechanics,
        dofs=(*mechanics.dofs, f"{mechanics.dofs[columns_of(mechanics, body)['z']].rsplit('.', 1)[0]}.suspended"),
        body_of_dof=np.append(mechanics.body_of_dof, -1),
        mass=np.append(mechanics.mass, mass),
        H=np.pad(mechanics.H, ((0, 0), (0, 1))),
        F=np.pad(mechanics.F, ((0, 1), (0, 0))),
        S=np.pad(mechanics.S, ((0, 0), (0, 1))),
    )
    return with_element(extended, row, mass * omega**2, 2 * ratio * omega * mass)


SUSPENDED_MASS = StructureLaw(
    name="suspended_mass",
    title="a mass that hangs on the body on a spring",
    parameters=(
        ParameterSpec("mass", "kg", 1e-9, 1e9, "beside the body's own", _any, log=True),
        ParameterSpec("frequency", "Hz", 0.05, 500.0, "of the mass on its spring, the body held", _any, log=True),
        ParameterSpec("damping_ratio", "1", 1e-4, 2.0, "share of critical damping", _any, log=True),
        _place("x"),
        _place("y"),
    ),
    where="body",
    modify=_suspended,
    absent=(0.0, 1.0, 0.02, 0.0, 0.0),
    looks_like="the body is heavier below a frequency, and its motion has a notch there; it moves as a rigid one",
    confused_with=("flexible_mode", "mass_change", "external_force"),
    sentence="a mass of {mass} hangs on it that swings at {frequency} with {damping_ratio} of critical damping",
    axes={3: "x", 4: "y"},
    powers={1: (2.0, 1.0), 2: (0.0, 1.0)},
    adds_motion=True,
    prior_cost=RARE,
)


def _moved(mechanics: Mechanics, sites: tuple[Foothold, ...], p: Values, variant: str) -> Mechanics:
    """An element at another place along an axis: another lever at every body that it holds on to."""
    (offset,) = (float(value) for value in p)
    ((_, element),) = sites
    H = mechanics.H.copy()
    H[element] += offset * moved_row(mechanics, element, variant)
    return replace(mechanics, H=H)


def moved_row(mechanics: Mechanics, element: int, axis: str) -> FloatArray:
    """Change of an element's deflection over the degrees of freedom per metre that it is moved along an axis, (n,)."""
    row = np.zeros(mechanics.n)
    for body in range(len(mechanics.centre)):
        columns = columns_of(mechanics, body)
        if AXES[axis] in columns:
            row[columns[AXES[axis]]] = mechanics.H[element, columns["z"]]
    return row


WRONG_POSITION = StructureLaw(
    name="wrong_position",
    title="another lever arm than stated",
    parameters=(ParameterSpec("offset", "m", -_ANYWHERE, _ANYWHERE, "from the stated position", lambda s: 0.1),),
    where="element",
    modify=_moved,
    absent=(0.0,),
    looks_like="rotations of the bodies at its ends are pushed more or less than their heave",
    confused_with=("missing_connection", "anti_roll_bar", "mass_change"),
    sentence="sits {offset} from its position in the system file",
    variants=("x", "y"),
    strengths=(0,),
    fault=True,
)


def _heave(mechanics: Mechanics) -> FloatArray:
    """One at the degrees of freedom that are heave, (n,)."""
    return np.array([dof.endswith(".z") for dof in mechanics.dofs], dtype=float)


def frame_of(mechanics: Mechanics) -> FloatArray:
    """What the bodies move relative to, as displacements of the supports (supports,): the ground, thus zeros; a single
    support where nothing else holds them."""
    supports = mechanics.G.shape[1]
    alone = supports == 1 and np.allclose(mechanics.H @ _heave(mechanics) + mechanics.G[:, 0], 0.0)
    return np.ones(1) if alone else np.zeros(supports)


MOST_MODES = 12  # the slowest, that have a damping ratio of their own
_ELASTIC = 2 * np.pi * 1e-3  # rad/s; what is slower moves as a whole


def elastic_modes(mechanics: Mechanics) -> tuple[FloatArray, FloatArray]:
    """Natural frequencies (rad/s, (m,)) and shapes (n, m), of modal mass 1, of the slowest elastic modes."""
    root = np.sqrt(mechanics.mass)
    squares, vectors = np.linalg.eigh((mechanics.H.T * mechanics.stiffness) @ mechanics.H / np.outer(root, root))
    elastic = np.flatnonzero(squares > _ELASTIC**2)[:MOST_MODES]
    return np.sqrt(squares[elastic]), vectors[:, elastic] / root[:, None]


def modal_dampers(mechanics: Mechanics) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Natural frequencies (rad/s, (m,)) of the elastic modes, and the deflections of dampers along them.

    Over the degrees of freedom (m, n) and over the supports (m, supports).
    """
    omegas, shapes = elastic_modes(mechanics)
    rows = (mechanics.mass[:, None] * shapes).T
    return omegas, rows, -np.outer(rows @ _heave(mechanics), frame_of(mechanics))


def _damped_by_mode(mechanics: Mechanics, sites: tuple[Foothold, ...], p: Values, variant: str) -> Mechanics:
    """One damper per mode, along its modal coordinate: C = M (sum 2 zeta omega phi phi^T) M."""
    found = mechanics
    for ratio, omega, row, below in zip(p, *modal_dampers(mechanics), strict=False):
        if ratio > 0:
            found = with_element(found, row, 0.0, 2 * float(ratio) * float(omega), below)
    return found


def _frequencies_and_ratios(mechanics: Mechanics) -> dict[str, tuple[float, str]]:
    """Of the elastic modes, with all dampers: zeta = phi^T C phi / (2 omega), for light damping."""
    omegas, shapes = elastic_modes(mechanics)
    along = mechanics.H @ shapes
    ratios = mechanics.damping @ along**2 / (2 * omegas)
    found = {}
    for number, (omega, ratio) in enumerate(zip(omegas, ratios, strict=True), 1):
        found[f"frequency_of_mode_{number}"] = (float(omega / (2 * np.pi)), "Hz")
        found[f"damping_ratio_of_mode_{number}"] = (float(ratio), "1")
    return found


MODAL_DAMPING = StructureLaw(
    name="modal_damping",
    title="damping of the modes, not of dampers between the bodies",
    parameters=tuple(
        ParameterSpec(f"mode_{number}", "1", 0.0, 0.5, "damping ratio of an elastic mode, by rising frequency", _any)
        for number in range(1, MOST_MODES + 1)
    ),
    where="every body",
    modify=_damped_by_mode,
    absent=(0.0,) * MOST_MODES,
    looks_like="every resonance is damped on its own, as no set of dampers between the bodies would damp them",
    confused_with=("structural_damping", "missing_connection"),
    sentence="damped mode by mode, by {all} of critical damping beside the dampers between them",
    quoted=_frequencies_and_ratios,
    strengths=tuple(range(MOST_MODES)),
    prior_cost=RARE,
)


_RIGID = 1000.0  # Hz, of an inerter on what holds it, above all that is compared


def _geared(mechanics: Mechanics, sites: tuple[Foothold, ...], p: Values, variant: str) -> Mechanics:
    """One more degree of freedom: a mass that moves as an element's deflection does, and pulls the element."""
    (inertance,) = (float(value) for value in p)
    ((_, element),) = sites
    omega = 2 * np.pi * _RIGID
    extended = replace(
        mechanics,
        dofs=(*mechanics.dofs, f"inerter{element}.deflection"),
        body_of_dof=np.append(mechanics.body_of_dof, -1),
        mass=np.append(mechanics.mass, inertance),
        H=np.pad(mechanics.H, ((0, 0), (0, 1))),
        F=np.pad(mechanics.F, ((0, 1), (0, 0))),
        S=np.pad(mechanics.S, ((0, 0), (0, 1))),
    )
    row = np.append(mechanics.H[element], -1.0)
    held = with_element(extended, row, inertance * omega**2, 0.1 * omega * inertance, mechanics.G[element])
    L = held.L.copy()
    L[:, -1] = L[:, element]  # a force sensor of the element shows it, too
    return replace(held, L=L)


INERTER = StructureLaw(
    name="inerter",
    title="inertia beside spring and damper",
    parameters=(
        ParameterSpec("inertance", "kg", 1e-9, 1e9, "force per acceleration of the deflection", _any, log=True),
    ),
    where="element",
    modify=_geared,
    absent=(0.0,),
    looks_like="the element seems softer the faster it moves; its bodies seem to have other masses",
    confused_with=("mass_change", "sensor_lag", "suspended_mass"),
    sentence="has an inertia of {inertance} beside its spring and damper",
    adds_motion=True,
    along=2,
    prior_cost=RARE,
)


def _stiffer(mechanics: Mechanics, sites: tuple[Foothold, ...], p: Values, variant: str) -> Mechanics:
    stiffness = mechanics.stiffness.copy()
    stiffness[sites[0].number] += float(p[0])
    return replace(mechanics, stiffness=stiffness)


def _more_damped(mechanics: Mechanics, sites: tuple[Foothold, ...], p: Values, variant: str) -> Mechanics:
    damping = mechanics.damping.copy()
    damping[sites[0].number] += float(p[0])
    return replace(mechanics, damping=damping)


def _held(
    quantity: str, unit: str, along: int, modify: Callable[..., Mechanics], alike: tuple[str, ...]
) -> StructureLaw:
    """Another stiffness or damping than the one that the system file holds."""
    return StructureLaw(
        name=f"{quantity}_change",
        title=f"another {quantity} than the file holds",
        parameters=(ParameterSpec("change", unit, -1e15, 1e15, "above the value of the system file", _any),),
        where="element",
        modify=modify,
        absent=(0.0,),
        looks_like="its neighbours' values are off together, and differently at every frequency",
        confused_with=alike,
        sentence=f"its {quantity} is {{change}} above the value of the system file",
        strengths=(0,),
        along=along,
        holds=quantity,
    )


STIFFNESS_CHANGE = _held("stiffness", "N/m", 0, _stiffer, ("mass_change", "time_varying_stiffness"))
DAMPING_CHANGE = _held("damping", "N s/m", 1, _more_damped, ("time_varying_damping", "series_stiffness"))


def sites_of(file: SystemFile, location: str) -> tuple[Foothold, ...]:
    """What a location names: bodies, moving supports, the ground or elements, "|" between two."""
    supports = [name for name, source in file.inputs.items() if source.kind != "force"]
    found = []
    for name in location.split("|"):
        if name in file.bodies:
            found.append(Foothold("body", list(file.bodies).index(name)))
        elif name in supports:
            found.append(Foothold("support", supports.index(name)))
        elif name == GROUND:
            found.append(Foothold("ground", 0))
        else:
            found.append(Foothold("element", list(file.elements).index(name)))
    return tuple(found)
