"""Formulas that a force may have which no law of the catalogue explains: a small grammar with units and complexity.

    force = a * shape(d, v, z),     shape = factor in d x factor in v,  or in a hidden state  z' = v - z / tau

A factor is a power, odd or even, or one of a few functions of d / L or v / U with one length or rate of its own.  The
amplitude `a` has the unit that makes the product a force.  Complexity is the number of factors and of inner values; it
is paid for by the number of formulas of as many parts (`formula_cost`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from sprung.model.laws.base import RARE, ElementLaw, ParameterSpec, Values, grid
from sprung.model.laws.formula import formula_law
from sprung.model.laws.motion import Motion, Observed, SpringDamper
from sprung.model.signal_filters import lfilter_from
from sprung.model.signals import FloatArray

DECAYS = "v - z / tau"  # rate of the hidden state
_AMPLITUDE = 1e18  # of any unit
_INNER = {  # name: (unit, least, most, trial values over the rms of its motion, meaning)
    "L": ("m", 1e-9, 1e3, (0.2, 0.35, 0.6, 1.0, 1.5, 2.2), "length"),
    "U": ("m/s", 1e-9, 1e4, (0.1, 0.16, 0.25, 0.4, 0.65, 1.0, 1.6, 2.5), "rate"),
    "tau": ("s", 1e-4, 1e3, (0.01, 0.02, 0.04, 0.08, 0.15, 0.3, 0.6), "time of the hidden state"),
}


@dataclass(frozen=True)
class Factor:
    """One factor of a shape."""

    text: str  # in d, v or z and at most one of L, U; empty: 1
    metres: float = 0.0  # its dimension
    seconds: float = 0.0
    inner: str = ""  # L or U

    @property
    def parts(self) -> int:
        """Complexity."""
        return int(bool(self.text)) + int(bool(self.inner))


NOTHING = Factor("")
OF_DEFLECTION = (
    *(Factor("d", 1), Factor("abs(d)", 1), Factor("d * abs(d)", 2), Factor("d**2", 2), Factor("d**3", 3)),
    *(Factor("abs(d)**3", 3), Factor("sqrt(abs(d))", 0.5), Factor("sign(d) * sqrt(abs(d))", 0.5)),
)
OF_LENGTH = (
    *(Factor("sin(d / L)", inner="L"), Factor("tanh(d / L)", inner="L"), Factor("exp(-(d / L)**2)", inner="L")),
    *(Factor("max(d - L, 0)", 1, inner="L"), Factor("max(-d - L, 0)", 1, inner="L")),
    *(Factor("(exp(d / L) - 1)", inner="L"), Factor("max(abs(d) - L, 0)", 1, inner="L")),
    *(Factor("d / (1 + (d / L)**2)", 1, inner="L"), Factor("cos(d / L)", inner="L")),
    *(Factor("max(d - L, 0)**2", 2, inner="L"), Factor("max(-d - L, 0)**2", 2, inner="L")),
)
OF_RATE = (
    *(Factor("v", 1, -1), Factor("abs(v)", 1, -1), Factor("v * abs(v)", 2, -2), Factor("v**2", 2, -2)),
    *(Factor("v**3", 3, -3), Factor("sqrt(abs(v))", 0.5, -0.5), Factor("sign(v) * sqrt(abs(v))", 0.5, -0.5)),
)
OF_SPEED = (
    *(Factor("tanh(v / U)", inner="U"), Factor("max(v - U, 0)", 1, -1, "U"), Factor("max(-v - U, 0)", 1, -1, "U")),
    *(Factor("v / (1 + (v / U)**2)", 1, -1, "U"), Factor("exp(-(v / U)**2)", inner="U")),
)
OF_MEMORY = (*(Factor("z", 1), Factor("z * abs(z)", 2), Factor("z**2", 2), Factor("z**3", 3), Factor("abs(z)", 1)),)
_SIMPLE = ("", "d", "abs(d)", "d**2", "v", "abs(v)")  # factors that may stand beside one with a value of its own
_ONE_AT_REST = {"cos(d / L)", "exp(-(d / L)**2)", "exp(-(v / U)**2)"}
_LINEAR = {("d", ""), ("", "v")}  # spring and damper


@dataclass(frozen=True)
class Shape:
    """One shape of the grammar."""

    first: Factor
    second: Factor = NOTHING
    memory: bool = False

    @property
    def text(self) -> str:
        """The shape."""
        return " * ".join(factor.text for factor in (self.first, self.second) if factor.text)

    @property
    def parts(self) -> int:
        """Complexity."""
        return self.first.parts + self.second.parts + 2 * int(self.memory)

    @property
    def inner(self) -> tuple[str, ...]:
        """Names of its own values."""
        names = tuple(factor.inner for factor in (self.first, self.second) if factor.inner)
        return (*names, "tau") if self.memory else names

    def size(self, seen: Observed) -> float:
        """Of the shape along a motion, roughly."""
        metres, seconds = (getattr(self.first, n) + getattr(self.second, n) for n in ("metres", "seconds"))
        period = max(seen.deflection_rms, 1e-12) / max(seen.rate_rms, 1e-12)
        return float(max(seen.deflection_rms, 1e-12) ** metres * period**seconds)

    @property
    def unit(self) -> str:
        """Of the amplitude: newtons over the shape's dimension."""
        metres, seconds = (getattr(self.first, n) + getattr(self.second, n) for n in ("metres", "seconds"))
        over = "" if metres == 0 else f"/m^{metres:g}" if metres != 1 else "/m"
        times = "" if seconds == 0 else f" s^{-seconds:g}" if seconds != -1 else " s"
        return f"N{times}{over}"


def forms() -> tuple[Shape, ...]:
    """Every shape of the grammar but spring and damper themselves."""
    return tuple(_forms())


def _forms() -> Iterator[Shape]:
    powers_d, powers_v = (NOTHING, *OF_DEFLECTION), (NOTHING, *OF_RATE)
    for first, second in product(powers_d, powers_v):
        if first.text + second.text and (first.text, second.text) not in _LINEAR:
            yield Shape(first, second) if first.text else Shape(second)
    simple = [factor for factor in (*powers_d, *OF_RATE) if factor.text in _SIMPLE]
    for own, beside in product((*OF_LENGTH, *OF_SPEED), simple):
        yield Shape(own if beside.text else _from_rest(own), beside)
    for own in OF_MEMORY:
        yield from (Shape(own, beside, memory=True) for beside in (NOTHING, *OF_DEFLECTION[:2], OF_RATE[1]))


def _from_rest(factor: Factor) -> Factor:
    """A factor alone as a force that is nothing at rest.

    A constant beside it would be a preload, which no record of the motion shows; it would move the equilibrium instead,
    and the spring with it.
    """
    return replace(factor, text=f"({factor.text} - 1)") if factor.text in _ONE_AT_REST else factor


def formula_cost(parts: int) -> float:
    """Evidence that a formula of so many parts must bring: twice the logarithm of how many there are, and more for
    being none of the catalogue."""
    return RARE + 2.0 * float(np.log(len(OF_DEFLECTION) + len(OF_RATE))) * parts / 2


def law_of(forms: tuple[Shape, ...]) -> ElementLaw:
    """The law of a sum of shapes, each with an amplitude a, b, ...; at most one of them with the hidden state."""
    texts: list[str] = []
    names: list[str] = []
    units: dict[str, str] = {}
    specs: list[ParameterSpec] = []
    for number, form in enumerate(forms):
        amplitude = "abc"[number]
        text = form.text
        renamed = {
            name: name if number == 0 or name == "tau" else f"{name}{number + 1}"
            for name in form.inner
            if name != "tau" or name not in names  # two shapes have one hidden state
        }
        for name, new in renamed.items():
            text = _renamed(text, name, new)
        texts.append(f"{amplitude} * {text}")
        specs.append(_amplitude(amplitude, form))
        specs += [_inner(new, name) for name, new in renamed.items()]
        names += [amplitude, *renamed.values()]
        units |= {amplitude: form.unit, **{new: _INNER[name][0] for name, new in renamed.items()}}
    remembers = any(form.memory for form in forms)
    law = formula_law(" + ".join(texts), DECAYS if remembers else "", tuple(names), units)
    return replace(
        law,
        parameters=tuple(specs),
        absent=tuple(0.0 if spec.name in "abc" else 1.0 for spec in specs),
        strength=0 if len(forms) == 1 else None,
        prior_cost=formula_cost(sum(form.parts for form in forms)),
        shapes=(lambda seen: _trials(forms[0], seen)) if len(forms) == 1 else law.shapes,
        path=filtered(law, names.index("tau")) if remembers else None,
    )


def _renamed(text: str, name: str, new: str) -> str:
    return text.replace(f"/ {name})", f"/ {new})").replace(f"- {name},", f"- {new},")


def _amplitude(name: str, form: Shape) -> ParameterSpec:
    def typical(seen: Observed) -> float:
        return 0.1 * max(seen.stiffness * seen.deflection_rms, seen.damping * seen.rate_rms, 1e-12) / form.size(seen)

    return ParameterSpec(name, form.unit, -_AMPLITUDE, _AMPLITUDE, f"amplitude of {form.text}", typical)


def _inner(name: str, kind: str) -> ParameterSpec:
    unit, low, high, _, meaning = _INNER[kind]
    return ParameterSpec(name, unit, low, high, meaning, lambda seen: _scale(kind, seen), log=True)


def _scale(kind: str, seen: Observed) -> float:
    return {"L": max(seen.deflection_rms, 1e-9), "U": max(seen.rate_rms, 1e-9), "tau": 1.0}[kind]


def _trials(form: Shape, seen: Observed) -> FloatArray:
    """Values of a single shape to be scored: unit amplitude, its own values over a grid."""
    inner = [np.array(_INNER[kind][3]) * _scale(kind, seen) for kind in form.inner]
    size = max(seen.stiffness * seen.deflection_rms, 1e-12) / form.size(seen)
    return grid([0.1 * size], *inner)


def filtered(law: ElementLaw, tau: int) -> Callable[[Motion, Values], FloatArray]:
    """Force (T,) along an evenly sampled motion: z' = v - z / tau is a first-order filter of the deflection."""

    def path(motion: Motion, p: Values) -> FloatArray:
        time, d = np.asarray(motion.time), np.asarray(motion.deflection)
        step = float(time[1] - time[0])
        kept = float(np.exp(-step / p[tau]))
        gain = p[tau] * (1 - kept) / step  # of a straight line between samples
        z = lfilter_from([gain, -gain], [1.0, -kept], d, [-gain * d[0]])
        return np.asarray(law.force(motion._replace(memory=(z,)), p, SpringDamper(0.0, 0.0)))

    return path
