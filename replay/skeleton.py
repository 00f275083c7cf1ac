"""Skeleton of a system file from a recording: known entries are filled in, the others marked."""

from __future__ import annotations

import json
import re
import unicodedata
import zlib

from sprung.model.units import FACTORS, known
from sprung.replay.inspection import Inspection, Signal

KINDS = {  # by the unit a signal has: kind of sensor, SI unit
    "m/s^2": "acceleration",
    "m/s": "velocity",
    "m": "displacement",
    "N": "force",
}
WORDS = {  # in names of signals without a unit
    "acceleration": ("acc", "beschl", "ax", "ay", "az"),
    "displacement": ("disp", "dist", "weg", "stroke", "lvdt", "pos", "travel", "hub", "d", "x"),
    "velocity": ("vel", "speed", "geschw"),
    "force": ("force", "forc", "kraft", "load", "cell", "f"),
}
PLAIN = re.compile(r"^[A-Za-z/][\w/.-]*$")
LETTERS = str.maketrans(
    {"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss", "µ": "u", "μ": "u"}
)
YAML_WORDS = ("y", "n", "yes", "no", "on", "off", "true", "false", "null")
OVERSAMPLED = 10.0  # times the highest frequency that matters, beyond which a lower rate is proposed
FINE = 100.0  # the same of a component test: friction and stops are identified within a cycle
FEWEST = 4000  # samples that a lower rate must leave
LEAST_WINDOW = 64  # samples


def kind_of_signal(signal: Signal) -> tuple[str | None, str | None]:
    """Kind of sensor and the unit to write (None: SI), if unit or name show it."""
    for si, kind in KINDS.items():
        if signal.unit and known(signal.unit, si) in FACTORS[si]:
            return kind, None if known(signal.unit, si) == si else known(signal.unit, si)
    words = re.findall(r"[a-z]+", signal.name.lower())
    for kind, stems in WORDS.items():
        if any(word.startswith(stem) if len(stem) > 2 else word == stem for word in words for stem in stems):
            return kind, None
    return None, None


def sample_rate(inspection: Inspection, oversampled: float = OVERSAMPLED) -> float:
    """A rate for the system file: that of the slowest signal, reduced when nothing needs as much."""
    rates = [signal.rate for signal in inspection.signals if signal.rate and not signal.constant]
    if not rates:
        return 100.0
    rate = min(rates)
    tops = [signal.band[1] for signal in inspection.signals if signal.band is not None]
    if not tops or rate <= oversampled * max(tops):
        return float(f"{rate:.6g}")
    divisor = min(rate / (oversampled * max(*tops, 1.0)), inspection.seconds * rate / FEWEST)
    divisor = max(int(divisor), 1)
    return float(f"{rate / divisor:.6g}")


def skeleton(inspection: Inspection, name: str, time: dict[str, object]) -> str:
    """The text; it is a valid system file, with values to be replaced marked by TODO."""
    usable = [signal for signal in inspection.signals if _is_usable(signal)]
    kinds = {signal.name: kind_of_signal(signal) for signal in usable}
    motions = [s for s in usable if kinds[s.name][0] in ("displacement", "velocity")]
    forces = [s for s in usable if kinds[s.name][0] == "force"]
    test = bool(motions and forces) and not any(kind == "acceleration" for kind, _ in kinds.values())
    rate = sample_rate(inspection, FINE if test else OVERSAMPLED)
    lines = [
        f"# System file for {inspection.file}, begun by sprung inspect.",
        "# Everything marked TODO is a guess: replace it.",
        "# Format: docs/system-file.md; check with: sprung system FILE",
        f"name: {_identifier(name).replace('_', '-')}",
        f"sample_rate: {rate:g}  # Hz; the recording has {_rates(inspection)}",
        f"window: {max(round(rate), LEAST_WINDOW)}  # samples of one identification, a second or some periods",
    ]
    if time:
        lines.append(f"time: {{{', '.join(f'{key}: {_text(value)}' for key, value in time.items())}}}")
    lines += _test(motions, forces, kinds) if test else _vehicle(usable, kinds)
    lines += _unknown([signal for signal in usable if kinds[signal.name][0] is None], test=test)
    return "\n".join(lines) + "\n"


def _is_usable(signal: Signal) -> bool:
    """Whether a signal has values of its own that vary."""
    return signal.samples > signal.missing and not (signal.constant or signal.rising or signal.same_as)


def _unknown(signals: list[Signal], *, test: bool) -> list[str]:
    """Comments on signals of unknown kind."""
    if not signals:
        return []
    lines = ["# Not used yet, since neither unit nor name shows what they measure:"]
    lines += [f"#   {_identifier(s.name)}: {{{_address(s, None)}}}" for s in signals]
    if test:
        lines += [
            "# A valve's current or a temperature on which parameters may depend: list it under `signals:`, with its",
            "# unit, and in the element's `depends_on: [NAME]`",
        ]
    return lines


Kinds = dict[str, tuple[str | None, str | None]]


def _test(motions: list[Signal], forces: list[Signal], kinds: Kinds) -> list[str]:
    """A component between a moving support and the ground, its force measured."""
    by_quantity = {str(kinds[s.name][0]): s for s in reversed(motions)}
    order = [quantity for quantity in ("displacement", "velocity") if quantity in by_quantity]
    moved = ", ".join(f"{q}: {{{_address(by_quantity[q], kinds[by_quantity[q].name][1])}}}" for q in order)
    rest = [s for s in (*motions, *forces[1:]) if s not in [by_quantity[q] for q in order]]
    lines = [
        "bodies: {}  # a component test: no mass moves",
        "inputs:",
        f"  rod: {{kind: support, {moved}}}{_si(*(by_quantity[q] for q in order))}",
        "elements:",
        "  component: {upper: rod, lower: ground, stiffness: 1.0e+4, damping: 1.0e+3}  # TODO: N/m, N s/m",
        "sensors:",
        f"  cell: {{kind: force, element: component, {_address(forces[0], kinds[forces[0].name][1])}}}{_si(forces[0])}",
    ]
    return lines + [f"#   {_identifier(s.name)}: {{{_address(s, kinds[s.name][1])}}}  # another one" for s in rest]


def _si(*signals: Signal) -> str:
    """A reminder where no unit was read."""
    return "" if all(signal.unit for signal in signals) else "  # TODO: unit (mm, in, kN ...), where it is not SI"


def _vehicle(usable: list[Signal], kinds: Kinds) -> list[str]:
    """One body on a spring, every motion a sensor of it, every force an input on it."""
    lines = [
        "bodies:",
        "  body: {mass: 1000.0}  # TODO: kg; further bodies, with roll_inertia and pitch_inertia where they turn",
    ]
    forces = [s for s in usable if kinds[s.name][0] == "force"]
    if forces:
        lines += [
            "inputs:",
            "  # TODO: measured forces on bodies; or of an element: a sensor {kind: force, element: ...}",
        ]
        lines += [
            f"  {_identifier(s.name)}: {{kind: force, body: body, {_address(s, kinds[s.name][1])}}}" for s in forces
        ]
    else:
        lines += [
            "# inputs:  # TODO: what drives the bodies from below, where it is measured",
            "#   wheel: {kind: support, displacement: {column: NAME}}",
        ]
    lines += [
        "elements:",
        "  spring: {upper: body, lower: ground, stiffness: 1.0e+5, damping: 1.0e+3}  # TODO: N/m, N s/m",
        "sensors:  # TODO: the body that each is on, and where",
    ]
    sensors = [s for s in usable if kinds[s.name][0] not in (None, "force")]
    for s in sensors or usable[:1]:
        kind, unit = kinds[s.name]
        guess = "" if kind else "  # TODO: what it measures"
        lines.append(
            f"  {_identifier(s.name)}: {{kind: {kind or 'acceleration'}, body: body, {_address(s, unit)}}}{guess}"
        )
    return lines


def _address(signal: Signal, unit: str | None) -> str:
    """Address, unit and noise; the noise in SI."""
    parts = [f"{key}: {_text(value)}" for key, value in signal.address.items()]
    factor = 1.0
    if unit is not None:
        parts.append(f"unit: {unit}")
        factor = next(table[unit] for si, table in FACTORS.items() if si in KINDS and unit in table)
    if signal.noise:
        parts.append(f"noise: {_number(signal.noise * factor)}")
    return ", ".join(parts)


def _number(value: float) -> str:
    text = f"{value:.2g}"
    mantissa, _, exponent = text.partition("e")
    return text if not exponent else f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}"


def _text(value: object) -> str:
    """A YAML scalar."""
    if not isinstance(value, str) or (PLAIN.match(value) and value.lower() not in YAML_WORDS):
        return str(value)
    return json.dumps(value, ensure_ascii=False)


def _identifier(name: str) -> str:
    """A name that a system file takes: Car.AccelerationLeft becomes car_acceleration_left."""
    parts = name.split(".")
    if len(parts) == 2 and parts[1].startswith(parts[0]):  # a CAN signal that repeats its message's name
        parts = parts[1:]
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", "_".join(parts))
    letters = unicodedata.normalize("NFKD", spaced.translate(LETTERS))
    short = re.sub(r"[\W_]+", "_", letters, flags=re.ASCII).strip("_").lower()
    if any(letter.isalpha() and not letter.isascii() for letter in letters):  # another alphabet's: only told apart
        short = f"{short}_{zlib.crc32(name.encode()):08x}".strip("_")
    return short if re.match(r"[a-z_]", short) else f"signal_{short}"


def _rates(inspection: Inspection) -> str:
    rates = sorted({f"{signal.rate:.4g}" for signal in inspection.signals if signal.rate}, key=float)
    return f"{', '.join(rates[:6])} Hz" if rates else "no clear rate"
