"""The vehicle as SVG, made from its system file: every spring, damper and sensor coloured by state and named in text.

Schematic: elements stand in columns of equal width in the order of their places, so that names can be read however
far the bogies are apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise

import numpy as np

from sprung.model.schema import ForceInput, MotionSensor
from sprung.model.system import System
from sprung.service.monitoring.views import LETTERS
from sprung.service.report.layout import Layout, lay_out

COLUMN, GAP, MARGIN = 70.0, 46.0, 64.0  # px
LONGEST = 5  # letters of a name at the usual size
STOREY, THICKNESS, WHEEL = 112.0, 34.0, 20.0
LETTER = 8.0  # px, of a name
SCALED = 700.0  # px: wider drawings are cut into pieces, which stand below each other on phones
PIECE = 520.0  # px, about: of these labels are read on a phone
ROW = 62.0  # of the plan
WORDS = {  # state -> what it says in words
    "ok": "good",
    "warning": "warning",
    "alarm": "alarm",
    "learning": "learning its baseline",
    "not_identifiable": "not identifiable",
    "suspect": "suspect",
    "absent": "no signal",
    "fixed": "not estimated",
}


@dataclass(frozen=True, slots=True)
class Mark:
    """How one spring, damper or sensor is shown."""

    state: str  # a key of WORDS
    text: str = ""  # a few characters beside it, such as a drift

    def words(self, name: str) -> str:
        """For people who do not see colours, and for the tool tip."""
        return f"{name}: {WORDS[self.state]}{f', {self.text}' if self.text else ''}"


@dataclass(frozen=True, slots=True)
class DrawingColumns:
    """Where places stand across the drawing."""

    layout: Layout
    at: Mapping[tuple[float, float], float]  # px by (x, y)
    width: float
    column: float = COLUMN  # px

    def across(self, x: float, y: float) -> float:
        """px of any place; between columns where none is just there."""
        if (x, y) in self.at:
            return self.at[x, y]
        places = sorted((px, column) for (px, _), column in self.at.items())
        return float(np.interp(x, [p[0] for p in places], [p[1] for p in places]))


def columns(system: System) -> DrawingColumns:
    """Columns of a system's elements, rearmost first; the right side before the left at the same place."""
    layout = lay_out(system)
    short = short_names(system.elements)
    above = dict[tuple[float, float], float]()  # px that the names of a place take beside each other, as in the plan
    for name in system.elements:
        place = layout.element_position(name)
        above[place] = above.get(place, 0.0) + LETTER * (len(short[name]) + 1)
    places, column = sorted(above), max(COLUMN, *above.values(), 0.0)
    xs = sorted({x for x, _ in places})
    steps = np.diff(xs)
    far = 3.0 * float(np.median(steps)) if len(steps) else np.inf
    at, across = dict[tuple[float, float], float](), MARGIN + column / 2
    before = xs[0] if xs else 0.0
    for x, y in places:
        across += GAP if x - before > far else 0.0
        at[x, y] = across
        across += column
        before = x
    return DrawingColumns(layout, at, across - column / 2 + MARGIN, column)


@dataclass(frozen=True, slots=True)
class _Drawn:
    """Something drawn: at one place, then it belongs to one piece; or along the drawing, then each piece shows its own
    of it."""

    left: float  # px
    right: float
    drawn: str


def _at(across: float, drawn: str) -> _Drawn:
    return _Drawn(across, across, drawn)


def _cuts(found: DrawingColumns) -> list[float]:
    """px of the ends of the pieces: cut between columns, near equal parts, where the gap is widest of those as near."""
    ends = [0.0, found.width]
    if found.width <= SCALED:
        return ends
    middles = sorted(found.at.values())
    between = [((a + b) / 2, b - a) for a, b in pairwise(middles)]
    count = round(found.width / PIECE)
    for part in range(1, count):
        aim = part * found.width / count
        ends.append(min(between, key=lambda cut: abs(cut[0] - aim) - cut[1])[0])
    return sorted(set(ends))


def _assembled(found: DrawingColumns, height: float, label: str, parts: Sequence[_Drawn]) -> str:
    """The drawing in one piece, or in several that are seen as one where there is room beside each other."""
    cuts = _cuts(found)
    drawn = []
    for number, (left, right) in enumerate(pairwise(cuts), start=1):
        named = label if len(cuts) == 2 else f"{label}, part {number} of {len(cuts) - 1}"
        inside = [part.drawn for part in parts if part.left < right and (part.right > left or part.left >= left)]
        kind = "vehicle" if len(cuts) == 2 else "vehicle wide"
        drawn.append(
            f'<svg class="{kind}" viewBox="{left:.0f} 0 {right - left:.0f} {height:.0f}" width="{right - left:.0f}" '
            f'height="{height:.0f}" role="group" aria-label="{escape(named)}">{"".join(inside)}</svg>'
        )
    return drawn[0] if len(drawn) == 1 else f'<div class="pieces">{"".join(drawn)}</div>'


def short_names(names: Iterable[str]) -> dict[str, str]:
    """`primary_11l` -> `11l` where several names share what comes before."""
    every = list(names)
    heads = [name.split("_", 1)[0] for name in every]
    return {
        name: name.split("_", 1)[1] if "_" in name and heads.count(head) > 1 else name
        for name, head in zip(every, heads, strict=True)
    }


def _named(short: str) -> str:
    """The class of a name's text: one that is wider than its column at the usual size is written smaller."""
    return "name long" if len(short) > LONGEST else "name"


def side_view(system: System, parameters: Mapping[str, Mark], sensors: Mapping[str, Mark]) -> str:
    """Seen from the right; elements are links to their history."""
    found = columns(system)
    layout, file = found.layout, system.file
    storeys = max(layout.level.values(), default=1)
    foot = 46.0 + storeys * (STOREY + THICKNESS)  # px of the ground
    height = foot + 2 * WHEEL + 26
    short = short_names(system.elements)
    label = f"{system.name} from the side: springs, dampers and sensors with their states"
    tops = {name: foot - level * STOREY - (level - 1) * THICKNESS - THICKNESS for name, level in layout.level.items()}
    parts = _ground(found, foot, sensors)
    for name in sorted(file.bodies, key=lambda body: layout.level[body]):
        parts += _body(found, name, tops[name])
    spans = {name: _span(file.elements[name].upper, file.elements[name].lower, tops, foot) for name in system.elements}
    for name, (head, base) in spans.items():
        across = found.across(*layout.element_position(name))
        parts.append(_at(across, _element(name, short[name], across, head, base, parameters)))
    parts += _captions(system, foot, tops)
    names = short_names(system.sensors)
    for name, sensor in file.sensors.items():
        if isinstance(sensor, MotionSensor):
            body = sensor.body
            x, y = sensor.position or file.bodies[body].position
            across = found.across(float(x), float(y))
            stands = any(
                base == tops[body] and found.across(*layout.element_position(element)) == across
                for element, (_, base) in spans.items()
            )
            across += found.column / 2 if stands else 0.0  # beside the element that stands there
            parts.append(_at(across, _sensor(name, names[name], across, tops[body], sensors)))
        else:
            across = found.across(*layout.element_position(sensor.element)) + found.column / 2
            parts.append(_at(across, _sensor(name, names[name], across, sum(spans[sensor.element]) / 2, sensors)))
    return _assembled(found, height, label, parts)


def _span(upper: str, lower: str, tops: Mapping[str, float], foot: float) -> tuple[float, float]:
    """px of an element's upper and lower end."""
    ends = [tops.get(end) for end in (upper, lower)]
    head = min((top + THICKNESS for top in ends if top is not None), default=foot - STOREY)
    base = max((top for top in ends if top is not None), default=foot) if None not in ends else foot
    return head, base


def plan_view(system: System, parameters: Mapping[str, Mark]) -> str:
    """Seen from above: the worst state of each element where it stands, left side on top."""
    found = columns(system)
    places: dict[tuple[float, float], list[str]] = {}
    for name in system.elements:
        places.setdefault(found.layout.element_position(name), []).append(name)
    sides = sorted({y for _, y in places}, reverse=True)
    rows = {y: 30.0 + ROW * i for i, y in enumerate(sides)}
    short = short_names(system.elements)
    parts = list[_Drawn]()
    for y, row in rows.items():
        side = "left" if y > 0 else "right" if y < 0 else ""
        ends = MARGIN / 2, found.width - 8
        parts.append(_Drawn(*ends, f'<line class="rail" x1="{ends[0]}" x2="{ends[1]}" y1="{row}" y2="{row}"/>'))
        parts.append(_at(4, f'<text class="caption" x="4" y="{row - 8}">{side}</text>'))
        parts += [
            _at(cut, f'<text class="caption again" x="{cut + 2:.1f}" y="{row - 8}">{side}</text>')
            for cut in _cuts(found)[1:-1]
        ]
    for (x, y), names in places.items():
        sizes = [LETTER * (len(short[name]) + 1) for name in names]
        starts = found.across(x, y) - sum(sizes) / 2 + np.cumsum([0.0, *sizes[:-1]])
        for name, start, size in zip(names, starts, sizes, strict=True):
            mark = worst(parameters.get(f"{name}.{q}") for q in ("stiffness", "damping"))
            across = start + size / 2
            drawn = (
                f'<a href="#{escape(name)}" data-element="{escape(name)}"><title>{escape(mark.words(name))}</title>'
                f'<circle class="dot {mark.state}" cx="{across:.1f}" cy="{rows[y]:.1f}" r="11"/>'
                f'<text class="name" x="{across:.1f}" y="{rows[y] + 26:.1f}">{escape(short[name])}</text></a>'
            )
            parts.append(_at(across, drawn))
    label = f"{system.name} from above: the worst state of each element"
    return _assembled(found, 30.0 + ROW * len(sides), label, parts)


def small_view(system: System, found: DrawingColumns, letters: str) -> str:
    """The plan for a line of the fleet: a dot an element by the letters of `views.LETTERS`."""
    sides = sorted({y for _, y in found.at}, reverse=True)
    names = {".": "learning", "?": "not_identifiable", "o": "ok", "w": "warning", "a": "alarm"}
    bad = [name for name, letter in zip(system.elements, letters, strict=False) if letter in "wa"]
    caption = f"changed: {', '.join(bad)}" if bad else "no element has changed"
    width, height = 120.0, 8.0 + 12.0 * len(sides)
    parts = [f'<svg class="small" viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(caption)}">']
    lettered = zip(system.elements, letters, strict=False)
    for name, letter in sorted(lettered, key=lambda pair: LETTERS.find(pair[1])):  # the worst of a place is seen
        x, y = found.layout.element_position(name)
        across = 6 + (found.across(x, y) / found.width) * (width - 12)
        row = 8 + 12 * sides.index(y)
        parts.append(f'<circle class="dot {names.get(letter, "learning")}" cx="{across:.1f}" cy="{row:.1f}" r="3.6"/>')
    return "".join([*parts, "</svg>"])


def worst(marks: Iterable[Mark | None]) -> Mark:
    """The one that needs attention most."""
    order = ("fixed", "ok", "not_identifiable", "learning", "warning", "alarm")
    return max((mark for mark in marks if mark is not None), key=lambda m: order.index(m.state), default=Mark("fixed"))


def _body(found: DrawingColumns, name: str, top: float) -> list[_Drawn]:
    layout = found.layout
    own = [
        found.across(*layout.element_position(element))
        for element, item in layout.system.file.elements.items()
        if name in (item.upper, item.lower)
    ]
    left = min(own, default=found.width / 2) - found.column / 2 + 4
    right = max(own, default=found.width / 2) + found.column / 2 - 4
    missing = max(LETTER * (len(name) + 1) + 8 - (right - left), 0.0)  # px for the whole name
    left, right = left - missing / 2, right + missing / 2
    box = f'<rect class="body" x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" height="{THICKNESS}" rx="5"/>'
    text = f'y="{top + 22:.1f}">{escape(name)}</text>'
    again = [cut for cut in _cuts(found)[1:-1] if left < cut < right]  # pieces to which the body goes on
    return [
        _Drawn(left, right, box),
        _at(left, f'<text class="bodyname" x="{left + 8:.1f}" {text}'),
        *(_at(cut, f'<text class="bodyname again" x="{cut + 8:.1f}" {text}') for cut in again),
    ]


def _element(name: str, short: str, across: float, head: float, base: float, parameters: Mapping[str, Mark]) -> str:
    spring = parameters.get(f"{name}.stiffness", Mark("fixed"))
    damper = parameters.get(f"{name}.damping", Mark("fixed"))
    caption = f"{spring.words('spring')}; {damper.words('damper')}"
    top, bottom = head + 18, base - 18
    swing = np.r_[0.0, np.tile([8.0, -8.0], 4), 0.0]
    turns = np.linspace(top, bottom, len(swing))
    zigzag = " ".join(f"{across - 15 + dx:.1f},{y:.1f}" for dx, y in zip(swing, turns, strict=True))
    x, cup = across + 15, bottom - 0.35 * (bottom - top)
    return (
        f'<a href="#{escape(name)}" data-element="{escape(name)}" class="element">'
        f"<title>{escape(f'{name}: {caption}')}</title>"
        f'<rect class="hit" x="{across - 32:.1f}" y="{head:.1f}" width="64" height="{base - head:.1f}"/>'
        f'<g class="spring {spring.state}"><path d="M{across - 15:.1f},{head:.1f}V{top:.1f}M{across - 15:.1f},'
        f'{bottom:.1f}V{base:.1f}"/><polyline points="{zigzag}"/></g>'
        f'<g class="damper {damper.state}"><path d="M{x:.1f},{base:.1f}V{cup:.1f}M{x - 8:.1f},{top + 12:.1f}'
        f"V{cup:.1f}H{x + 8:.1f}V{top + 12:.1f}M{x - 6:.1f},{top + 20:.1f}H{x + 6:.1f}M{x:.1f},{top + 20:.1f}"
        f'V{head:.1f}"/></g>'
        f'<text class="{_named(short)}" x="{across:.1f}" y="{head + 13:.1f}">{escape(short)}</text>'
        + _said(spring, across - 16, base - (17 if damper.text else 5), "upper" if damper.text else "")
        + _said(damper, across + 16, base - 5)
        + "</a>"
    )


def _said(mark: Mark, across: float, at: float, place: str = "") -> str:
    if not mark.text:
        return ""
    text = escape(mark.text).replace("%", '<tspan class="unit">%</tspan>')
    return f'<text class="{f"said {place}".strip()} {mark.state}" x="{across:.1f}" y="{at:.1f}">{text}</text>'


def _sensor(name: str, short: str, across: float, top: float, sensors: Mapping[str, Mark]) -> str:
    mark = sensors.get(name, Mark("absent"))
    return (
        f'<a href="#sensor-{escape(name)}" data-sensor="{escape(name)}"><title>{escape(mark.words(name))}</title>'
        f'<path class="sensor {mark.state}" d="M{across - 6:.1f},{top - 11:.1f}h12l-6,10z"/>'
        f'<text class="sensorname" x="{across:.1f}" y="{top - 15:.1f}">{escape(short)}</text></a>'
    )


def _ground(found: DrawingColumns, foot: float, sensors: Mapping[str, Mark]) -> list[_Drawn]:
    """Wheels, or the tables of a rig, with what is wrong with the channels that measure their motion."""
    layout, parts = found.layout, list[_Drawn]()
    supports = {name for name, source in layout.system.file.inputs.items() if not isinstance(source, ForceInput)}
    for name, item in layout.system.file.elements.items():
        if not {item.upper, item.lower} & supports:
            continue
        across = found.across(*layout.element_position(name))
        wrong = {
            channel: mark
            for channel, mark in sensors.items()
            if channel.split(".")[0] in {item.upper, item.lower} & supports
        }
        state = "".join(f" {mark.state}" for mark in list(wrong.values())[:1])
        title = f"<title>{escape('; '.join(mark.words(channel) for channel, mark in wrong.items()))}</title>"
        inside = title if wrong else ""
        if layout.railway:
            drawn = (
                f'<circle class="wheel{state}" cx="{across:.1f}" cy="{foot + WHEEL:.1f}" r="{WHEEL}">{inside}</circle>'
            )
        else:  # a test rig: a table that is moved up and down
            box = f'x="{across - 30:.1f}" y="{foot:.1f}" width="60" height="12"'
            arrow = f'<path class="arrow" d="M{across:.1f},{foot + 16:.1f}v22m-4,-18l4,-5l4,5m-8,14l4,5l4,-5"/>'
            drawn = f'<rect class="table{state}" {box}>{inside}</rect>{arrow}'
        parts.append(_at(across, drawn))
    floor = foot + 2 * WHEEL if layout.railway else foot + WHEEL * 2 + 4
    if not supports:
        floor = foot
    right = found.width - 8
    rail = f'<line class="rail" x1="8" x2="{right:.1f}" y1="{floor:.1f}" y2="{floor:.1f}"/>'
    return [*parts, _Drawn(8.0, right, rail)]


def _captions(system: System, foot: float, tops: Mapping[str, float]) -> list[_Drawn]:
    """What the names of a storey have in common, at its left edge."""
    heads: dict[str, float] = {}
    for name in system.elements:
        item = system.file.elements[name]
        known = [tops[end] for end in (item.upper, item.lower) if end in tops]
        if "_" in name and sum(other.startswith(name.split("_", 1)[0] + "_") for other in system.elements) > 1:
            heads.setdefault(name.split("_", 1)[0], min(known, default=foot - STOREY) + THICKNESS)
    return [_at(4, f'<text class="caption" x="4" y="{y + 50:.1f}">{escape(head)}</text>') for head, y in heads.items()]
