"""The table of a vehicle's parameters."""

from __future__ import annotations

import math

from rich.table import Table
from rich.text import Text

from sprung.service.monitoring.views import VehicleView
from sprung.service.rendering.render import percent, quantity

COLUMNS = {  # of the table of parameters, and the width from which they are shown
    "parameter": 0,
    "value": 64,
    "± std": 96,
    "nominal": 84,
    "ratio": 74,
    "drift": 0,
    "state": 0,
}
DRIFT_STD = 104  # characters: the width from which drifts have their deviations
HEALTH_STYLE = {"ok": "green", "maintenance_required": "yellow"}


def parameter_table(view: VehicleView, width: int = 120) -> Table:
    """Every tracked parameter, the ones with alarms marked; on narrow terminals fewer columns, whole names."""
    style = HEALTH_STYLE.get(view.health, "red")
    table = Table(
        title=Text.assemble(f"{view.vehicle}: ", (view.health.replace("_", " "), style)),
        title_justify="left",
        title_style="bold",
    )
    shown = [name for name, least in COLUMNS.items() if width >= least]
    for name in shown:
        table.add_column(name, justify="left" if name in ("parameter", "state") else "right", no_wrap=True)
    for p in view.parameters:
        known = p.identifiable
        cells = {
            "parameter": p.name,
            "value": quantity(p.value, p.unit) if known else "–",
            "± std": quantity(p.std, p.unit) if known else "–",
            "nominal": quantity(p.nominal, p.unit),
            "ratio": f"{p.value / p.nominal:.3f}" if known else "–",
            "drift": _drift(p.drift, p.drift_std if width >= DRIFT_STD else None),
            "state": _state(p.alarm, known, p.drift, p.lost_with),
        }
        colour = {"alarm": "red", "warning": "yellow"}.get(p.alarm or "")
        table.add_row(*(cells[name] for name in shown), style=colour)
    return table


def _drift(drift: float | None, std: float | None) -> str:
    """A change from the vehicle's baseline, `-29.8 ± 0.1 %`."""
    if std is None or not math.isfinite(std):
        return percent(drift)
    return percent(drift).replace(" %", f" ± {100 * std:.1f} %")


def _state(alarm: str | None, identifiable: bool, drift: float | None, lost: str | None) -> str:
    if alarm is not None:
        return alarm
    if lost is not None:
        return f"{lost.replace('|', ' and ')} lost"
    if not identifiable:
        return "not identifiable"
    return "learning" if drift is None else "ok"
