"""The vehicle, drawn from its system file in oblique projection, with what was located in colour."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from sprung.model.schema import ElementSensor, ForceInput
from sprung.model.system import System
from sprung.service.report import ink
from sprung.service.report.layout import Layout, Point, lay_out
from sprung.service.report.words import place_words

WIDTH, NARROWEST, TALLEST = 10.5, 3.2, 5.6  # in
WORDS_BESIDE = 3.6  # in, of what was found
BODY = "#dfe6ec"
LINE = "#52606d"


def _body(axes: Axes, layout: Layout, name: str, colour: str, edge: str) -> None:
    body = layout.system.file.bodies[name]
    x, y = body.position
    half, side = layout.half_length[name], 1.0 if layout.slant else 0.0
    low, high = layout.bottom(name), layout.top(name)
    corners = [(x - half, -side), (x + half, -side), (x + half, side), (x - half, side)]
    lower = [layout.at(px, py + y, low) for px, py in corners]
    upper = [layout.at(px, py + y, high) for px, py in corners]
    order = 10 * layout.level[name]
    front = [lower[0], lower[1], upper[1], upper[0]]
    right = [lower[1], lower[2], upper[2], upper[1]]
    for face, shade in ((right, 0.80), (upper, 1.0), (front, 0.9)):
        axes.add_patch(
            Polygon(face, closed=True, facecolor=colour, edgecolor=edge, lw=1.1, alpha=shade, zorder=order + 5)
        )
    middle = layout.at(x - half + 0.25, -side + y, (low + high) / 2)
    axes.text(*middle, name, va="center", ha="left", fontsize=8.5, color="#243b53", zorder=order + 6)


def _spring(axes: Axes, foot: Point, head: Point, colour: str, width: float, order: float) -> None:
    """A zigzag to the left of the element's place."""
    (x, low), (_, high) = foot, head
    swing = np.r_[0.0, 0.0, np.tile([0.13, -0.13], 5)[:9], 0.0, 0.0]
    turns = np.linspace(low, high, swing.size)
    axes.plot(x - 0.16 + swing, turns, color=colour, lw=width, zorder=order, solid_joinstyle="round")


def _damper(axes: Axes, foot: Point, head: Point, colour: str, width: float, order: float) -> None:
    """A cup and a piston to the right of the element's place."""
    x, low, high = foot[0] + 0.2, foot[1], head[1]
    cup, rod, wide = low + 0.35 * (high - low), low + 0.55 * (high - low), 0.11
    line: dict[str, Any] = {"color": colour, "lw": width, "zorder": order}
    axes.plot([x, x], [low, cup], **line)
    axes.plot([x - wide, x - wide, x + wide, x + wide], [rod + 0.25, cup, cup, rod + 0.25], **line)
    axes.plot([x - wide * 0.7, x + wide * 0.7], [rod, rod], **line)
    axes.plot([x, x], [rod, high], **line)


def _element(axes: Axes, layout: Layout, name: str, colour: str, width: float) -> Point:
    item = layout.system.file.elements[name]
    x, y = layout.element_position(name)
    upper, lower = item.upper, item.lower
    if layout.bottom(lower) > layout.bottom(upper):
        upper, lower = lower, upper
    foot, head = layout.at(x, y, layout.top(lower)), layout.at(x, y, layout.bottom(upper))
    order = 10 * max(layout.level.get(upper, 0), layout.level.get(lower, 0)) + (-3 if y > 0 else 8)
    for value, draw in ((item.stiffness, _spring), (item.damping, _damper)):
        if value.value or not value.fixed:
            draw(axes, foot, head, colour, width, order)
    return foot[0], (foot[1] + head[1]) / 2


def _support(axes: Axes, layout: Layout, name: str, colour: str) -> Point:
    """A wheel under the element that stands on the support."""
    x, y = next(
        layout.element_position(e) for e, i in layout.system.file.elements.items() if name in (i.upper, i.lower)
    )
    centre = layout.at(x, y, -0.42)
    order = -2 if y > 0 else 9
    if not layout.railway or name in layout.raised:  # the moved table or crosshead of a test rig
        face = layout.bottom(name)
        away = 1.0 if name in layout.raised else -1.0  # from the element
        across, back = centre[0], face + 0.22 * away
        table = [(across - 0.6, face), (across + 0.6, face), (across + 0.6, back), (across - 0.6, back)]
        axes.add_patch(Polygon(table, closed=True, facecolor="#f4f6f8", edgecolor=colour, lw=1.5, zorder=order))
        arrow = {"arrowstyle": "<|-|>", "color": colour, "lw": 1.3}
        axes.annotate("", xy=(across, face + 0.24 * away), xytext=(across, face + 0.84 * away), arrowprops=arrow)
        return across, back
    axes.add_patch(Circle(centre, 0.42, facecolor="#f4f6f8", edgecolor=colour, lw=1.5, zorder=order))
    axes.add_patch(Circle(centre, 0.08, facecolor=colour, edgecolor="none", zorder=order))
    return centre


def _sensor(axes: Axes, layout: Layout, name: str, colour: str, size: float) -> Point:
    sensor = layout.system.file.sensors[name]
    if isinstance(sensor, ElementSensor):
        x, y = layout.element_position(sensor.element)
        place = layout.at(x + 0.4, y, layout.bottom(layout.system.file.elements[sensor.element].upper) - 0.4)
    else:
        body = layout.system.file.bodies[sensor.body]
        x, y = sensor.position if sensor.position is not None else body.position
        place = layout.at(x, y, layout.top(sensor.body) + 0.06)
    order = 10 * 9 if colour == ink.HIGHLIGHT else 10 * 8
    axes.plot(*place, marker="v", ms=size, color=colour, mec="white", mew=0.6, zorder=order)
    return place


def _force(axes: Axes, layout: Layout, name: str, colour: str) -> Point:
    source = layout.system.file.inputs[name]
    assert isinstance(source, ForceInput)
    body = layout.system.file.bodies[source.body]
    x, y = source.position if source.position is not None else body.position
    across, height = layout.at(x, y, layout.top(source.body))
    tip = (across - 0.18, height)
    tail = (tip[0], tip[1] + 0.9)
    axes.annotate("", xy=tip, xytext=tail, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.8})
    axes.text(tail[0] - 0.1, tail[1] - 0.1, name, fontsize=8.5, color=colour, ha="right")
    return tail


def _shade(score: float, best: float) -> tuple[str, float]:
    """Grey to red by how much of the best score a place reaches (square root, so that weak ones show)."""
    part = float(np.sqrt(max(score, 0.0) / best)) if best > 0 else 0.0
    grey, red = np.array([0x52, 0x60, 0x6D]), np.array([0xC1, 0x12, 0x1F])
    mixed = np.round(grey + (red - grey) * min(part, 1.0) * 0.6).astype(int)
    return "#{:02x}{:02x}{:02x}".format(*mixed), 1.3


def draw_system(system: System, findings: Mapping[str, str], scores: Mapping[str, float]) -> Figure:
    """The drawing; `findings` maps a located element, body, sensor or input to the words beside it."""
    layout = lay_out(system)
    with rc_context(ink.RC):
        figure = ink.new_figure(WIDTH, 4.4)
        axes = figure.add_subplot()
        ink.bare(axes)
        places = _draw_parts(axes, layout, findings, scores)
        axes.autoscale_view()
        axes.set_aspect("equal")
        low, high = axes.get_ylim()
        axes.set_ylim(low - 0.3, high + 0.5 + (1.5 if findings and layout.slant else 0.0))
        _call_out(axes, layout, places, findings)
        left, right = axes.get_xlim()
        low, high = axes.get_ylim()
        height = min(max(WIDTH * (high - low) / (right - left), 2.6), TALLEST)
        # what is taller than wide fills its picture, with room for words at its right: half of it is seen on a phone
        needed = height * (right - left) / (high - low) + (WORDS_BESIDE if findings else 0.3)
        figure.set_size_inches(min(max(needed, NARROWEST), WIDTH), height)
        axes.set_anchor("W" if findings and layout.slant == 0 else "C")
    return figure


def _draw_parts(
    axes: Axes, layout: Layout, findings: Mapping[str, str], scores: Mapping[str, float]
) -> dict[str, Point]:
    file, places = layout.system.file, dict[str, Point]()
    best = max((scores.get(name, 0.0) for name in file.elements), default=0.0)
    owners = {owner for place in findings for owner in _owners(place)}
    for name in sorted(file.bodies, key=lambda n: layout.level[n]):
        found = name in owners
        _body(axes, layout, name, "#f6c9cd" if found else BODY, ink.HIGHLIGHT if found else LINE)
        x, y = file.bodies[name].position
        places[name] = layout.at(x, y, layout.top(name))
    for name in file.elements:
        colour, width = _shade(scores.get(name, 0.0), best) if findings else (LINE, 1.3)
        if name in owners:
            colour, width = ink.HIGHLIGHT, 2.8
        places[name] = _element(axes, layout, name, colour, width)
    for name, source in file.inputs.items():
        colour = ink.HIGHLIGHT if name in owners else LINE
        draw = _force if isinstance(source, ForceInput) else _support
        places[name] = draw(axes, layout, name, colour)
    for name in file.sensors:
        found = name in owners
        places[name] = _sensor(axes, layout, name, ink.HIGHLIGHT if found else "#3a86c8", 11 if found else 6)
    _ground(axes, layout)
    return places


def _owners(place: str) -> list[str]:
    """What is drawn of a located place: an input for one of its channels, both of a pair."""
    return [part.split(".")[0] for part in place.split("|")]


def _ground(axes: Axes, layout: Layout) -> None:
    """Rails under supports, a hatched line under elements that stand on the ground."""
    file = layout.system.file
    rails: dict[float, list[float]] = {}
    for name, item in file.elements.items():
        x, y = layout.element_position(name)
        if item.lower not in file.bodies or item.upper not in file.bodies:
            rails.setdefault(y, []).append(x)
    supports = {name for name, source in file.inputs.items() if not isinstance(source, ForceInput)}
    on_wheels = bool(supports - layout.raised)
    for y, along in rails.items():
        height = -0.84 if on_wheels else 0.0
        start, end = layout.at(min(along) - 1.2, y, height), layout.at(max(along) + 1.2, y, height)
        axes.plot([start[0], end[0]], [start[1], end[1]], color="#7b8794", lw=2.0, zorder=-5)
        if not on_wheels:
            for x in np.linspace(start[0], end[0], 15)[1:]:
                axes.plot([x, x - 0.16], [height, height - 0.16], color="#7b8794", lw=1.0, zorder=-5)


def _call_out(axes: Axes, layout: Layout, places: Mapping[str, Point], findings: Mapping[str, str]) -> None:
    """Words above the vehicle in the order of their places, so that no arrows cross; several in staggered rows."""
    low, high = axes.get_ylim()
    left, right = axes.get_xlim()
    found = {name: places.get(name) or places.get(_owners(name)[0]) for name in findings}
    known = sorted((place, name) for name, place in found.items() if place is not None)
    levels = 1 if len(known) <= 2 else 2 if len(known) <= 4 else 3
    axes.set_ylim(low, high + 1.5 * (levels - 1))
    for number, (place, name) in enumerate(known):
        margin = 0.22 * (right - left)
        x = float(np.clip(place[0], left + margin, right - margin))
        if len(known) > 1:
            x = left + (right - left) * (number + 0.5) / len(known)
        y = high - 0.25 + 1.5 * (levels - 1 - number % levels)
        beside = (place[0] + 1.1, place[1]) if layout.slant == 0 else (x, y)
        words = "\n".join(textwrap.wrap(findings[name], 44 if len(known) <= 2 else 26)[:3])
        axes.annotate(
            f"{place_words(name)}\n{words}",
            xy=place,
            xytext=beside,
            fontsize=10 if len(known) <= 2 else 8.5,
            color=ink.HIGHLIGHT,
            ha="left" if layout.slant == 0 else "center",
            va="center" if layout.slant == 0 else "top",
            fontweight="bold",
            zorder=200,
            annotation_clip=False,
            bbox={"boxstyle": "round,pad=0.35", "fc": "white", "ec": ink.HIGHLIGHT, "lw": 1.2},
            arrowprops={"arrowstyle": "-|>", "color": ink.HIGHLIGHT, "lw": 1.4, "shrinkB": 6},
        )
