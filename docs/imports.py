"""The drawing of imports between folders, docs/img/imports.svg: `make drawing`.

Every folder stands below those that it imports; an arrow that pointed down would be a circle, and is refused.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TOPS = ("model", "replay", "service", "benchmarks")
# folders whose members are drawn one by one
INSIDE = ("model", "model.diagnosis", "model.diagnosis.investigation", "model.identification")
WIDTH, HEIGHT, GAP_X, GAP_Y = 262, 26, 18, 34


def folder_of(module: str) -> str:
    """The box that a module belongs to."""
    parts = module.split(".")
    if parts[:2] == ["service", "cli"]:
        return "service.cli"  # the command line starts benchmarks, which use the service
    depth = 1
    while ".".join(parts[:depth]) in INSIDE and depth < len(parts):
        depth += 1
    return ".".join(parts[:depth])


def imports() -> dict[str, set[str]]:
    """Folder -> folders that it imports."""
    found: dict[str, set[str]] = defaultdict(set)
    for top in TOPS:
        for path in sorted((ROOT / top).rglob("*.py")):
            own = folder_of(".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"))
            found[own] |= set()
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sprung."):
                    other = folder_of((node.module or "").removeprefix("sprung."))
                    if other != own and other not in INSIDE:
                        found[own].add(other)
    for name in INSIDE:  # empty packages
        found.pop(name, None)
    return {name: {other for other in others if other in found} for name, others in found.items()}


def levels(edges: dict[str, set[str]]) -> dict[str, int]:
    """How far each folder stands from the bottom; raises CycleError for a circle."""
    level: dict[str, int] = {}
    for name in TopologicalSorter(edges).static_order():
        level[name] = 1 + max((level[other] for other in edges[name]), default=-1)
    return level


def drawing() -> str:
    """The SVG, nearest imports only: those that follow from others are left out."""
    edges = imports()
    level = levels(edges)
    rows: dict[int, list[str]] = defaultdict(list)
    for name in sorted(level):
        rows[level[name]].append(name)
    most = max(len(row) for row in rows.values())
    wide, high = most * (WIDTH + GAP_X) + GAP_X, len(rows) * (HEIGHT + GAP_Y) + GAP_Y
    at: dict[str, tuple[float, float]] = {}
    for number, row in rows.items():
        left = (wide - len(row) * (WIDTH + GAP_X) + GAP_X) / 2
        for i, name in enumerate(row):
            at[name] = left + i * (WIDTH + GAP_X), high - (number + 1) * (HEIGHT + GAP_Y)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {high}" font-family="sans-serif" font-size="11">',
        '<rect width="100%" height="100%" fill="#ffffff"/>',
    ]
    for name, others in sorted(edges.items()):
        through = {far for near in others for far in reachable(edges, near)}
        for other in sorted(others - through):
            (x1, y1), (x2, y2) = at[name], at[other]
            lines.append(
                f'<line x1="{x1 + WIDTH / 2:.0f}" y1="{y1 + HEIGHT:.0f}" x2="{x2 + WIDTH / 2:.0f}" y2="{y2:.0f}" '
                'stroke="#8d99a6" stroke-width="1"/>'
            )
    for name, (x, y) in sorted(at.items()):
        colour = {"model": "#e3f1ef", "replay": "#fdf0d9", "service": "#e6ebf5", "benchmarks": "#f1f1f1"}[
            name.split(".")[0]
        ]
        lines.append(
            f'<rect x="{x:.0f}" y="{y:.0f}" width="{WIDTH}" height="{HEIGHT}" rx="4" fill="{colour}" stroke="#8d99a6"/>'
        )
        lines.append(f'<text x="{x + WIDTH / 2:.0f}" y="{y + 17:.0f}" text-anchor="middle">{name}</text>')
    return "\n".join([*lines, "</svg>", ""])


def reachable(edges: dict[str, set[str]], start: str) -> set[str]:
    """Everything that a folder imports, directly or not."""
    seen: set[str] = set()
    waiting = [start]
    while waiting:
        for other in edges[waiting.pop()]:
            if other not in seen:
                seen.add(other)
                waiting.append(other)
    return seen


if __name__ == "__main__":
    (ROOT / "docs" / "img" / "imports.svg").write_text(drawing(), encoding="utf-8")
