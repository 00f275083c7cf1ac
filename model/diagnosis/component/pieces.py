"""What a component's force may be made of: pieces that are linear in their strengths once a few shapes are fixed.

    F(t) = preload + k d + c v + sum over pieces of  strengths @ columns(motion; shapes)

The strengths and k, c, preload follow by linear least squares for any shapes (variable projection, Golub and Pereyra
1973), so that only one to three shapes per law are searched, on a grid first: no start can be far away.  A piece also
says which values of the catalogue's law its strengths and shapes are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sprung.model.diagnosis.component.motion import ElementMotion
from sprung.model.diagnosis.component.paths import bouc_wen_path, maxwell_path, presliding_path, stop_path
from sprung.model.laws import SpringDamper, grid, reversal_step
from sprung.model.signals import FloatArray

Values = dict[str, tuple[float, str]]  # value and unit by name
_LOWEST_KNEE = 0.3  # of the median rate: a valve that opens far below usual rates acts as friction, and is called so


@dataclass(frozen=True)
class Seen:
    """Sizes of a motion: where knees, gaps and yield displacements can be sought."""

    travel: float  # m, half of the range
    rate: FloatArray  # m/s, quantiles 0 .. 100 % of the magnitude, (101,)
    seconds: float
    step: float  # s

    @classmethod
    def of(cls, motion: ElementMotion) -> Seen:
        quantiles = np.quantile(np.abs(motion.rate), np.linspace(0, 1, 101))
        travel = 0.5 * float(np.ptp(motion.deflection))
        return cls(max(travel, 1e-12), np.maximum(quantiles, 1e-12), len(motion.time) * motion.step, motion.step)

    @property
    def rate_rms(self) -> float:
        return float(np.sqrt(np.mean(self.rate**2)))

    def slowest_corner(self, motion: ElementMotion) -> float:
        """The rate that one sample passes at a reversal, m/s: a knee below it is not resolved."""
        return reversal_step(motion.rate)


@dataclass(frozen=True)
class Piece:
    """One law as a part of a component's force."""

    effect: str  # the catalogue's or contract's word
    title: str  # for sentences
    shapes: tuple[str, ...]  # names of what the columns depend on
    grid: Callable[[Seen], FloatArray]  # trial shapes, (trials, shapes)
    limits: Callable[[Seen], list[tuple[float, float]]]  # of every shape
    columns: Callable[[ElementMotion, Sequence[float]], FloatArray]  # (T, m)
    signs: tuple[int, ...]  # of the m strengths: 1, -1, 0 for either
    values: Callable[[FloatArray, Sequence[float], SpringDamper], Values]  # the law's own parameters
    quoted: Callable[[FloatArray, Sequence[float], SpringDamper], Values] = lambda a, s, e: {}
    kind: str = "static"  # "static", "hysteresis" or "linear": look-alikes within a kind are told apart last
    plain: int = 0  # prior cost: how many commoner laws it contains


def _rates(seen: Seen, shares: Sequence[float]) -> FloatArray:
    return np.interp(shares, np.linspace(0, 1, 101), seen.rate)


def _yields(seen: Seen) -> FloatArray:
    return seen.travel * np.geomspace(0.004, 0.8, 9)


def _yield_limits(seen: Seen) -> tuple[float, float]:
    return (2e-4 * seen.travel, 0.8 * seen.travel)  # beyond it nothing yields: a spring that softens


# --- friction and hysteresis ------------------------------------------------------------------------------------


def _tanh(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    return np.tanh(motion.rate / shape[0])[:, None]


COULOMB = Piece(
    "coulomb_friction",
    "dry friction",
    ("smoothing",),
    lambda seen: grid(seen.rate_rms * np.geomspace(0.005, 0.5, 7)),
    lambda seen: [(1e-3 * seen.rate_rms, 0.8 * seen.rate_rms)],
    _tanh,
    (1,),
    lambda a, s, e: {"force": (a[0], "N"), "smoothing": (s[0], "m/s")},
    lambda a, s, e: {"breakaway_force": (a[0], "N")},
    kind="friction",
)


def _stribeck(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    slide = np.tanh(motion.rate / shape[0])
    return np.column_stack([slide, slide * np.exp(-((motion.rate / shape[1]) ** 2))])


STRIBECK = Piece(
    "stribeck",
    "friction that falls with the rate (Stribeck)",
    ("smoothing", "stribeck_rate"),
    lambda seen: grid(seen.rate_rms * np.geomspace(0.005, 0.2, 4), seen.rate_rms * np.geomspace(0.05, 0.8, 4)),
    lambda seen: [(1e-3 * seen.rate_rms, 0.5 * seen.rate_rms), (0.01 * seen.rate_rms, 1.5 * seen.rate_rms)],
    _stribeck,
    (1, 1),
    lambda a, s, e: {
        "force": (a[0], "N"),
        "static_force": (a[0] + a[1], "N"),
        "stribeck_rate": (s[1], "m/s"),
        "smoothing": (s[0], "m/s"),
    },
    kind="friction",
    plain=1,
)


def _dahl(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    return presliding_path(motion.deflection, shape[0])[:, None]


DAHL = Piece(
    "dahl",
    "friction with presliding (Dahl)",
    ("yield_displacement",),
    lambda seen: grid(_yields(seen)),
    lambda seen: [_yield_limits(seen)],
    _dahl,
    (1,),
    lambda a, s, e: {"force": (a[0], "N"), "stiffness": (a[0] / s[0], "N/m")},
    lambda a, s, e: {"yield_force": (a[0], "N"), "yield_displacement": (s[0], "m")},
    kind="hysteresis",
    plain=1,
)


def _lugre(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    falling = np.exp(-((motion.rate / shape[1]) ** 2))
    paths = [presliding_path(motion.deflection, shape[0], level) for level in (np.ones_like(falling), falling)]
    return np.column_stack(paths)


LUGRE = Piece(
    "lugre",
    "friction with presliding that falls with the rate (LuGre)",
    ("yield_displacement", "stribeck_rate"),
    lambda seen: grid(seen.travel * np.geomspace(0.004, 0.3, 5), seen.rate_rms * np.geomspace(0.05, 0.8, 4)),
    lambda seen: [_yield_limits(seen), (0.01 * seen.rate_rms, 1.5 * seen.rate_rms)],
    _lugre,
    (1, 1),
    lambda a, s, e: {
        "force": (a[0], "N"),
        "static_force": (a[0] + a[1], "N"),
        "stribeck_rate": (s[1], "m/s"),
        "stiffness": (a[0] / s[0], "N/m"),
    },
    lambda a, s, e: {"yield_force": (a[0], "N"), "yield_displacement": (s[0], "m")},
    kind="hysteresis",
    plain=1,
)


def _bouc_wen(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    return bouc_wen_path(motion.deflection, shape[0], shape[1])[:, None]


def _bouc_wen_values(a: FloatArray, s: Sequence[float], element: SpringDamper) -> Values:
    yields, n = s[0], s[1]
    return {"alpha": (a[0] / yields, "N/m"), "beta": (1 / (1.5 * yields**n), "m^-n"), "n": (n, "1")}


BOUC_WEN = Piece(
    "bouc_wen",
    "hysteresis (Bouc-Wen)",
    ("yield_displacement", "n"),
    lambda seen: grid(_yields(seen), [1.0, 2.0]),
    lambda seen: [_yield_limits(seen), (1.0, 8.0)],
    _bouc_wen,
    (1,),
    _bouc_wen_values,
    lambda a, s, e: {"yield_force": (a[0], "N"), "yield_displacement": (s[0], "m")},
    kind="hysteresis",
)


def _free_bouc_wen(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    return bouc_wen_path(motion.deflection, shape[0], shape[1], shape[2])[:, None]


FREE_BOUC_WEN = Piece(
    "bouc_wen",
    "hysteresis (Bouc-Wen, loop of free shape)",
    ("yield_displacement", "n", "gamma"),
    lambda seen: grid(_yields(seen)[::2], [1.0], [-0.6, 0.0, 1.5]),
    lambda seen: [_yield_limits(seen), (1.0, 8.0), (-0.95, 4.0)],
    _free_bouc_wen,
    (1,),
    lambda a, s, e: {
        "alpha": (a[0] / s[0], "N/m"),
        "beta": (1 / ((1 + s[2]) * s[0] ** s[1]), "m^-n"),
        "n": (s[1], "1"),
        "gamma": (s[2], "1"),
    },
    lambda a, s, e: {"yield_force": (a[0], "N"), "yield_displacement": (s[0], "m")},
    kind="hysteresis",
)


def _pinched(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    z = bouc_wen_path(motion.deflection, shape[0], 1.0)
    near = np.exp(-(((motion.deflection - motion.middle) / shape[1]) ** 2))
    return np.column_stack([z, -z * near])


PINCHED = Piece(
    "pinched_hysteresis",
    "hysteresis pinched in the middle of the travel",
    ("yield_displacement", "pinching_width"),
    lambda seen: grid(seen.travel * np.geomspace(0.01, 0.4, 5), seen.travel * np.array([0.1, 0.25, 0.5])),
    lambda seen: [_yield_limits(seen), (0.03 * seen.travel, 1.0 * seen.travel)],
    _pinched,
    (1, 1),
    lambda a, s, e: {
        "force": (a[0], "N"),
        "yield_displacement": (s[0], "m"),
        "pinching": (a[1] / max(a[0], 1e-300), "1"),
        "pinching_width": (s[1], "m"),
    },
    lambda a, s, e: {"yield_force": (a[0], "N")},
    kind="hysteresis",
    plain=2,
)


def _backlash(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    gap, reach = shape
    u = stop_path(motion.deflection, 0.5 * gap + reach)
    beyond = np.sign(u) * np.maximum(np.abs(u) - 0.5 * gap, 0.0) / reach
    return np.column_stack([beyond, u / (0.5 * gap + reach)])


def _backlash_values(a: FloatArray, s: Sequence[float], element: SpringDamper) -> Values:
    gap, reach = s
    inside = a[1] / (0.5 * gap + reach)  # N/m, of what still holds within the gap
    return {"force": (a[0] + a[1], "N"), "gap": (gap, "m"), "stiffness": (a[0] / reach + inside, "N/m")}


FRICTION_BACKLASH = Piece(
    "friction_backlash",
    "friction with backlash (slip, gap and stick in series)",
    ("gap", "reach"),
    lambda seen: grid(seen.travel * np.geomspace(0.02, 0.9, 7), seen.travel * np.geomspace(0.01, 0.5, 6)),
    lambda seen: [(2e-3 * seen.travel, 1.8 * seen.travel), (1e-3 * seen.travel, 1.5 * seen.travel)],
    _backlash,
    (1, 1),
    _backlash_values,
    lambda a, s, e: {
        "slip_force": (a[0] + a[1], "N"),
        "lost_motion": (s[0], "m"),
        "stiffness_within_gap": (a[1] / (0.5 * s[0] + s[1]), "N/m"),
    },
    kind="hysteresis",
)

# --- dampers ----------------------------------------------------------------------------------------------------


def _quadratic(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    return (motion.rate * np.abs(motion.rate))[:, None]


QUADRATIC = Piece(
    "quadratic_damping",
    "quadratic damping",
    (),
    lambda seen: np.zeros((1, 0)),
    lambda seen: [],
    _quadratic,
    (1,),
    lambda a, s, e: {"c2": (a[0], "N s^2/m^2")},
)


def _beyond(x: FloatArray, knee: float) -> FloatArray:
    return x - np.clip(x, -knee, knee)


def _blowoff(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    return _beyond(motion.rate, shape[0])[:, None]


BLOWOFF = Piece(
    "damper_blowoff",
    "damper blow-off",
    ("knee",),
    lambda seen: grid(_rates(seen, [0.2, 0.35, 0.5, 0.65, 0.8, 0.9])),
    lambda seen: [(_LOWEST_KNEE * float(seen.rate[50]), float(seen.rate[97]))],
    _blowoff,
    (-1,),
    lambda a, s, e: {"knee": (s[0], "m/s"), "ratio": (1 + a[0] / max(float(e.damping), 1e-300), "1")},
    lambda a, s, e: {"force_at_knee": (float(e.damping) * s[0], "N")},
)


def _two_knees(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    v = motion.rate
    return np.column_stack([np.maximum(v - shape[0], 0.0), np.minimum(v + shape[1], 0.0)])


TWO_KNEES = Piece(
    "damper_blowoff",
    "damper blow-off, different in extension and compression",
    ("knee", "knee_compression"),
    lambda seen: grid(_rates(seen, [0.2, 0.4, 0.7]), _rates(seen, [0.2, 0.4, 0.7])),
    lambda seen: [(_LOWEST_KNEE * float(seen.rate[50]), float(seen.rate[97]))] * 2,
    _two_knees,
    (-1, -1),
    lambda a, s, e: {
        "knee": (s[0], "m/s"),
        "ratio": (1 + a[0] / max(float(e.damping), 1e-300), "1"),
        "knee_compression": (s[1], "m/s"),
        "ratio_compression": (1 + a[1] / max(float(e.damping), 1e-300), "1"),
    },
    plain=1,
)


def _asymmetry(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    return np.abs(motion.rate)[:, None]


ASYMMETRY = Piece(
    "damper_asymmetry",
    "damper asymmetry",
    (),
    lambda seen: np.zeros((1, 0)),
    lambda seen: [],
    _asymmetry,
    (0,),
    lambda a, s, e: {"a": (a[0] / max(float(e.damping), 1e-300), "1")},
)


def _maxwell(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    return maxwell_path(motion.deflection, shape[0], motion.step)[:, None]


SERIES = Piece(
    "series_stiffness",
    "series stiffness of the damper",
    ("tau",),
    lambda seen: grid(np.geomspace(2 * seen.step, 0.1 * seen.seconds, 9)),
    lambda seen: [(0.5 * seen.step, seen.seconds)],
    _maxwell,
    (1,),
    lambda a, s, e: {"ks": (a[0], "N/m")},
    lambda a, s, e: {"relaxation_time": (s[0], "s")},
    kind="linear",
)

# --- springs ----------------------------------------------------------------------------------------------------


def _cubic(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    return ((motion.deflection - motion.middle) ** 3)[:, None]


CUBIC = Piece(
    "cubic_stiffness",
    "progressive (cubic) spring",
    (),
    lambda seen: np.zeros((1, 0)),
    lambda seen: [],
    _cubic,
    (0,),
    lambda a, s, e: {"k3": (a[0], "N/m^3")},
)


def _stop(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    return _beyond(motion.deflection - motion.middle, shape[0])[:, None]


BUMP_STOP = Piece(
    "bump_stop",
    "bump stop",
    ("gap",),
    lambda seen: grid(seen.travel * np.array([0.3, 0.5, 0.65, 0.8, 0.9])),
    lambda seen: [(0.1 * seen.travel, 0.97 * seen.travel)],
    _stop,
    (1,),
    lambda a, s, e: {"gap": (s[0], "m"), "stiffness": (a[0], "N/m")},
)


def _clearance(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    return -np.clip(motion.deflection - motion.middle, -shape[0], shape[0])[:, None]


CLEARANCE = Piece(
    "clearance",
    "clearance of the spring",
    ("gap",),
    lambda seen: grid(seen.travel * np.array([0.05, 0.1, 0.2, 0.35, 0.55, 0.75])),
    lambda seen: [(0.01 * seen.travel, 0.9 * seen.travel)],
    _clearance,
    (1,),
    lambda a, s, e: {"gap": (s[0], "m")},
)

# --- drift ------------------------------------------------------------------------------------------------------


def _warming(of: str) -> Callable[[ElementMotion, Sequence[float]], FloatArray]:
    def columns(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
        return (getattr(motion, of) * -np.expm1(-motion.time / shape[0]))[:, None]

    return columns


def _drift(effect: str, of: str, quantity: str) -> Piece:
    return Piece(
        effect,
        f"{quantity} that changes with time",
        ("tau",),
        lambda seen: grid(seen.seconds * np.array([0.1, 0.3, 1.0])),
        lambda seen: [(0.03 * seen.seconds, 3.0 * seen.seconds)],
        _warming(of),
        (0,),
        lambda a, s, e: {"p": (a[0] / max(float(getattr(e, quantity)), 1e-300), "1"), "tau": (s[0], "s")},
        plain=1,
    )


# --- no name ----------------------------------------------------------------------------------------------------

_REACHES = np.array([0.01, 0.03, 0.1, 0.25, 0.5, 0.9])  # of the travel, of a family of sliders
_RATES = np.array([0.1, 0.3, 0.6, 0.85])  # quantiles of the rate at which a force over it may bend


def _surface(motion: ElementMotion, shape: Sequence[float]) -> FloatArray:
    """A smooth force over deflection and rate, and a family of sliders (Prandtl and Ishlinskii) for its memory."""
    seen = Seen.of(motion)
    x, v = (motion.deflection - motion.middle) / seen.travel, motion.rate / max(seen.rate_rms, 1e-12)
    columns = [stop_path(motion.deflection, reach * seen.travel) / (reach * seen.travel) for reach in _REACHES]
    columns += [np.clip(motion.rate, -knee, knee) / knee for knee in _rates(seen, _RATES.tolist())]
    columns += [np.maximum(v, 0.0), x**2, x**3, x * v, x**2 * v, v * np.abs(v)]
    return np.column_stack(columns)


SURFACE = Piece(
    "unknown",
    "a force that no law explains",
    (),
    lambda seen: np.zeros((1, 0)),
    lambda seen: [],
    _surface,
    (0,) * (len(_REACHES) + len(_RATES) + 6),
    lambda a, s, e: {},
)

PIECES: tuple[Piece, ...] = (
    COULOMB,
    STRIBECK,
    DAHL,
    LUGRE,
    BOUC_WEN,
    FREE_BOUC_WEN,
    PINCHED,
    FRICTION_BACKLASH,
    QUADRATIC,
    BLOWOFF,
    TWO_KNEES,
    ASYMMETRY,
    SERIES,
    CUBIC,
    BUMP_STOP,
    CLEARANCE,
    _drift("time_varying_stiffness", "deflection", "stiffness"),
    _drift("time_varying_damping", "rate", "damping"),
)
