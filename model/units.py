"""Units of measurement of system files, and their conversion to SI.

The table is explicit rather than computed: every name that is accepted can be read here, and `g` means the
acceleration for an accelerometer and the gram for a mass, as people write it.
Exact values: BIPM, The International System of Units, 9th edition; NIST Special Publication 811, appendix B.
"""

from __future__ import annotations

import difflib
from itertools import chain

G = 9.80665  # m/s^2, standard gravity
INCH, FOOT, MILE = 0.0254, 0.3048, 1609.344  # m
POUND = 0.45359237  # kg
POUND_FORCE = POUND * G  # N

_LENGTH = {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": INCH, "ft": FOOT, "mil": INCH / 1e3}
_PER_SECOND = {f"{name}/s": factor for name, factor in _LENGTH.items()}
_PER_SECOND2 = {f"{name}/s^2": factor for name, factor in _LENGTH.items()}

FACTORS: dict[str, dict[str, float]] = {  # SI unit -> other names of it -> how many SI units one is
    "m": _LENGTH,
    "m/s": {**_PER_SECOND, "km/h": 1 / 3.6, "mph": MILE / 3600, "kn": 1852 / 3600},
    "m/s^2": {**_PER_SECOND2, "g": G, "mg": G / 1e3, "Gal": 1e-2},
    "rad/s": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": 0.017453292519943295, "rpm": 0.10471975511965977},
    "N": {
        **{"N": 1.0, "mN": 1e-3, "daN": 10.0, "kN": 1e3, "MN": 1e6, "dyn": 1e-5},
        **{"lbf": POUND_FORCE, "kip": 1e3 * POUND_FORCE, "gf": G / 1e3, "kgf": G, "tf": 1e3 * G},
    },
    "Pa": {
        **{"Pa": 1.0, "hPa": 1e2, "kPa": 1e3, "MPa": 1e6, "mbar": 1e2, "bar": 1e5},
        **{"psi": POUND_FORCE / INCH**2, "atm": 101325.0},
    },
    "degC": {"degC": 1.0, "K": 1.0, "degF": 5 / 9},
    "kg": {"kg": 1.0, "g": 1e-3, "t": 1e3, "lb": POUND},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0},
}
ZEROS = {"K": -273.15, "degF": -32.0}  # offsets of scales with another zero
RAW: dict[str, float] = {  # outputs of transducers, which need a scale
    **{"V": 1.0, "mV": 1e-3, "uV": 1e-6, "A": 1.0, "mA": 1e-3, "Ohm": 1.0, "mV/V": 1e-3},
    **{"count": 1.0, "digit": 1.0, "LSB": 1.0, "%": 1e-2, "1": 1.0},
}
_SAME = {
    **{"lb": "lbf", "lbs": "lbf", "kips": "kip", "klbf": "kip", "kp": "kgf", "gal": "Gal", "degree/s": "deg/s"},
    **{"inch": "in", "inches": "in", '"': "in", "feet": "ft", "micron": "um", "km/hr": "km/h", "kmh": "km/h"},
    **{"kph": "km/h", "kt": "kn", "knot": "kn", "1/min": "rpm", "gn": "g", "g_n": "g", "g0": "g", "gee": "g"},
    **{"sec": "s", "seconds": "s", "second": "s", "msec": "ms", "milliseconds": "ms", "usec": "us", "nsec": "ns"},
    **{"microseconds": "us", "nanoseconds": "ns", "minutes": "min", "hours": "h", "hr": "h", "days": "d", "day": "d"},
    **{"counts": "count", "digits": "digit", "raw": "count", "volt": "V", "volts": "V", "ohm": "Ohm", "Ω": "Ohm"},
    **{"metre": "m", "meter": "m", "newton": "N", "to": "t", "tonne": "t"},
}


class UnitError(ValueError):
    """The unit is unknown or does not fit the quantity; the message lists valid ones."""


def spelt(unit: str) -> str:
    """A unit's name as the tables have it: `m/s2`, `m/s²` and `m/s/s` are `m/s^2`, `µm` is `um`."""
    name = unit.strip().strip("[]()").strip()
    for odd, plain in (("²", "^2"), ("**", "^"), ("µ", "u"), ("μ", "u"), ("°", "deg"), ("·", ""), ("in.", "in")):
        name = name.replace(odd, plain)
    for ending in ("/s/s", "/sec^2", "/s2", "*s^-2", " s^-2"):
        name = name.removesuffix(ending) + "/s^2" if name.endswith(ending) else name
    for ending in ("/sec", "*s^-1", " s^-1", "ps") if not name.endswith("/s^2") else ():
        name = name.removesuffix(ending) + "/s" if name.endswith(ending) else name
    return name


def units_of(si: str) -> dict[str, float]:
    """Names of the units of the quantity that is measured in `si`; of one that no table has only that."""
    return FACTORS.get(si, {si: 1.0})


def known(unit: str, si: str) -> str | None:
    """The table's name of a unit of the quantity that is measured in `si`; None when it is none."""
    for name in (spelt(unit), _SAME.get(spelt(unit), ""), _SAME.get(spelt(unit).lower(), "")):
        if name in units_of(si) or name in RAW:
            return name
    if si == "kg" and spelt(unit).lower() in ("lb", "lbs"):
        return "lb"
    return None


def confusion(ratio: float, si: str, tolerance: float = 0.005) -> str | None:
    """Which units were taken for each other where values in `si` are wrong by a factor; None where no two explain it.

    >>> confusion(0.10197, "m/s^2"), confusion(1000.2, "m"), confusion(0.5, "N")
    ('g taken for m/s^2', 'mm taken for m', None)
    """
    others = [(name, factor) for name, factor in units_of(si).items() if factor != 1.0]
    # a unit that the system file passes over is likelier than one that it states wrongly
    passed = (f"{name} taken for {si}" for name, factor in others if abs(ratio * factor - 1.0) < tolerance)
    stated = (f"{si} taken for {name}" for name, factor in others if abs(ratio / factor - 1.0) < tolerance)
    return next(chain(passed, stated), None)


def to_si(unit: str | None, si: str, scale: float | None, offset: float, sign: int) -> tuple[float, float]:
    """Gain and offset that make the SI value of a recorded one.

    With a unit of the quantity, value = sign (scale recorded + offset) unit.  With a transducer's unit (V, mA,
    counts) the scale and the offset are in SI: value = sign (scale (recorded unit) + offset).
    Errors: `UnitError`.
    """
    gain = 1.0 if scale is None else scale
    if unit is None:
        return sign * gain, sign * offset
    name, units = known(unit, si), units_of(si)
    if name is None:
        near = difflib.get_close_matches(spelt(unit).lower(), [n.lower() for n in units], n=1, cutoff=0.6)
        meant = [n for n in units if n.lower() in near]
        hint = f"did you mean {meant[0]!r}? known are" if meant else "known are"
        raise UnitError(f"{unit!r} is no unit of {si}; {hint} {', '.join(units)}; or V, mA, count with a scale")
    if name in units:
        factor = units[name]
        offset += ZEROS.get(name, 0.0)
        return sign * gain * factor, sign * offset * factor
    if scale is None:
        raise UnitError(f"{unit} alone does not determine {si}; give `scale:` in {si} per {_per(name)}")
    return sign * gain * RAW[name], sign * offset


def _per(raw: str) -> str:
    """The base unit of a transducer's."""
    return {"mV": "V", "uV": "V", "mA": "A", "%": "1 (100 %)"}.get(raw, raw)
