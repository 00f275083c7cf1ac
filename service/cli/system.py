"""`sprung system`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from sprung.model.exchange.matrices import read_matrices
from sprung.model.identification.identify import identifiability
from sprung.model.identification.likelihood.linearise import PRIOR_STD
from sprung.model.schema import ForceInput
from sprung.model.system import MANCHESTER, System, load_system, parse_system
from sprung.model.systemfile import json_schema
from sprung.model.text import counted
from sprung.replay.whole_file import written_whole
from sprung.service.cli.export import export, left_out
from sprung.service.cli.targets import check_file
from sprung.service.rendering.render import quantity

KNOWN_SHARE = 0.5  # of the prior's standard deviation, above which one window is hardly informative


def import_matrices(file: Path, out: Path, rate: float | None, name: str | None) -> int:
    """Write the system file of a model that comes as matrices, and say what became of it."""
    check_file(out)
    text = read_matrices(file, name, rate)
    system = parse_system(text, str(out))
    with written_whole(out) as part:
        part.write_text(text, encoding="utf-8")
    print(
        f"{out}: {counted(len(system.bodies), 'body', 'bodies')}, {counted(len(system.elements), 'element')}, "
        f"{counted(len(system.sensors), 'sensor')}; "
        "set noises and columns to those of your recordings",
        file=sys.stderr,
    )
    return 0


def run(file: Path | None, json_lines: bool, schema: bool, out: Path | None = None) -> int:
    """Check the file and print its contents, or print the JSON Schema of the format.

    Errors: `SystemFileError` with all problems of a file.
    """
    if schema:
        print(json.dumps(json_schema(), indent=2))
        return 0
    system = load_system(file or MANCHESTER)
    if out is not None:
        for path in export(system, out):
            print(path)
        left = left_out(system, out)
        if left:
            print(f"sprung: {out}: it does not hold {', '.join(left)}", file=sys.stderr)
        return 0
    deviations = identifiability(system) if system.bodies else np.full(len(system.parameters), np.nan)
    if json_lines:
        print(json.dumps(_as_dict(system, deviations), indent=None))
        return 0
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console = Console(highlight=False, markup=False, width=110, no_color=True)
    console.print(
        Text(system.name, style="bold"),
        f": {counted(len(system.bodies), 'body', 'bodies')}, "
        f"{counted(len(system.mechanics.dofs), 'degree of freedom', 'degrees of freedom')}, "
        f"{counted(len(system.inputs), 'input signal')}, {counted(len(system.elements), 'element')}, "
        f"{counted(len(system.sensors), 'sensor')}; "
        f"{system.window} samples at {system.sample_rate:g} Hz; digest {system.digest}",
        sep="",
    )
    if not system.bodies:
        console.print(_elements(system))
        console.print("A component test: no mass moves; sprung diagnose fits the element along its measured motion.")
        return 0
    console.print(_bodies(system))
    console.print(_elements(system))
    console.print(_modes(system))
    if system.parameters:
        console.print(_parameters(system, deviations))
    return 0


def _bodies(system: System) -> Table:
    table = Table("body", "mass", "roll inertia", "pitch inertia", title="Bodies", title_justify="left")
    for name, body in system.file.bodies.items():
        table.add_row(name, f"{body.mass.value:g} kg", *(_inertia(i) for i in (body.roll_inertia, body.pitch_inertia)))
    return table


def _inertia(value: float | None) -> str:
    return "–" if value is None else f"{value:g} kg m²"


def _elements(system: System) -> Table:
    columns = ("element", "upper", "lower", "stiffness", "damping")
    table = Table(*columns, title="Elements (nominal)", title_justify="left")
    for name, element in system.file.elements.items():
        values = [
            quantity(v.value, unit) + (" fixed" if v.fixed else "")
            for v, unit in ((element.stiffness, "N/m"), (element.damping, "N s/m"))
        ]
        table.add_row(name, element.upper, element.lower, *values)
    return table


def _modes(system: System) -> Table:
    title = "Modes (nominal, without the laws)" if system.laws else "Modes (nominal)"
    table = Table("frequency", "damping ratio", "moves most", title=title, title_justify="left")
    for mode in system.mechanics.modes(system.bodies):
        table.add_row(f"{mode.frequency:.3g} Hz", f"{round(100 * mode.damping_ratio, 1) + 0.0:.1f} %", mode.body)
    return table


def _parameters(system: System, deviations: Any) -> Table:
    under = "on an average track"
    if not system.file.inputs:
        under = "without any measured input, of vibration well above the noise,"
    elif system.on_track:
        under = "on an average unmeasured track"
    elif all(isinstance(source, ForceInput) for source in system.file.inputs.values()):
        under = "under white forces, well above the sensors' noise,"
    title = f"What one window of {system.window / system.sample_rate:g} s {under} determines"
    table = Table("parameter", "nominal", "standard deviation", "", title=title, title_justify="left")
    for parameter, std in zip(system.parameters, np.asarray(deviations), strict=True):
        known = std < KNOWN_SHARE * PRIOR_STD
        table.add_row(
            parameter.name,
            quantity(parameter.nominal, parameter.unit),
            f"{100 * std:.2g} %" if known else "–",
            "identifiable" if known else "not identifiable by these sensors",
        )
    return table


def _as_dict(system: System, deviations: Any) -> dict[str, Any]:
    return {
        "name": system.name,
        "digest": system.digest,
        "sample_rate": system.sample_rate,
        "window": system.window,
        "bodies": list(system.bodies),
        "elements": list(system.elements),
        "sensors": list(system.sensors),
        "inputs": [channel.name for channel in system.inputs],
        "modes": [
            {"frequency": m.frequency, "damping_ratio": m.damping_ratio, "body": m.body}
            for m in (system.mechanics.modes(system.bodies) if system.bodies else ())
        ],
        "parameters": [
            {
                "name": p.name,
                "unit": p.unit,
                "nominal": p.nominal,
                "window_std": float(std) if system.bodies else None,
                "identifiable": bool(std < KNOWN_SHARE * PRIOR_STD) if system.bodies else None,
            }
            for p, std in zip(system.parameters, np.asarray(deviations), strict=True)
        ],
    }
