"""Writes the dashboards: `python deploy/grafana/make.py`.  A test compares what is committed with what this makes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "dashboards"
SOURCE = {"type": "prometheus", "uid": "prometheus"}
BAND = 1.96  # standard deviations
HEALTH = {  # value of sprung_vehicle_health -> words, colour
    0: ("good", "green"),
    1: ("maintenance required", "yellow"),
    2: ("out of specification", "orange"),
    3: ("check function", "purple"),
    4: ("failure", "red"),
}
FLEET, VEHICLE, SERVICE = "sprung-fleet", "sprung-vehicle", "sprung-service"

Query = tuple[str, str]  # expression, legend


def panel(
    kind: str, title: str, queries: Sequence[Query], at: tuple[int, int, int, int], unit: str = "none", **more: Any
) -> dict[str, Any]:
    """A panel at (x, y, width, height); `instant` queries give one value."""
    instant = more.pop("instant", kind in ("table", "stat"))
    overrides = more.pop("overrides", [])
    defaults = {"unit": unit} | more.pop("defaults", {})
    targets = [
        {"refId": chr(65 + i), "expr": expr, "legendFormat": legend, "datasource": SOURCE}
        | ({"instant": True} if instant else {})
        | ({"format": "table"} if kind == "table" else {})
        for i, (expr, legend) in enumerate(queries)
    ]
    x, y, width, height = at
    return {
        "title": title,
        "type": kind,
        "gridPos": {"x": x, "y": y, "w": width, "h": height},
        "datasource": SOURCE,
        "fieldConfig": {"defaults": defaults, "overrides": overrides},
        "options": more.pop("options", {}),
        "targets": targets,
    } | more


def bands(at: tuple[int, int, int, int]) -> dict[str, Any]:
    """Ratios of one element to the vehicle's own baseline with their 95 % bands; repeated for every element."""
    queries, overrides = [], []
    hidden = [{"id": "custom.lineWidth", "value": 0}, {"id": "custom.hideFrom", "value": {"legend": True}}]
    for quantity in ("stiffness", "damping"):
        where = f'vehicle="$vehicle", element="$element", quantity="{quantity}"'
        mean, spread = f"sprung_parameter_ratio{{{where}}}", f"sprung_parameter_ratio_stddev{{{where}}}"
        lower, upper = f"{quantity} lower", f"{quantity} upper"
        queries += [(mean, quantity), (f"{mean} + {BAND} * {spread}", upper), (f"{mean} - {BAND} * {spread}", lower)]
        fill = [{"id": "custom.fillBelowTo", "value": lower}, {"id": "custom.fillOpacity", "value": 15}]
        overrides += [
            {"matcher": {"id": "byName", "options": upper}, "properties": [*hidden, *fill]},
            {"matcher": {"id": "byName", "options": lower}, "properties": hidden},
        ]
    return panel(
        "timeseries",
        "$element over its baseline, with 95 % bands",
        queries,
        at,
        "percentunit",
        overrides=overrides,
        repeat="element",
        repeatDirection="h",
        maxPerRow=3,
    )


def ratios(title: str, quantity: str, at: tuple[int, int, int, int]) -> dict[str, Any]:
    """Every element's ratio to the vehicle's own baseline."""
    where = f'vehicle="$vehicle", quantity="{quantity}", element=~"$element"'
    return panel("timeseries", title, [(f"sprung_parameter_ratio{{{where}}}", "{{element}}")], at, "percentunit")


def link_to_vehicle() -> dict[str, Any]:
    """From a row of the fleet to the vehicle's dashboard and to its page."""
    links = [
        {"title": "Dashboard", "url": f"/d/{VEHICLE}?var-vehicle=${{__value.text}}"},
        {"title": "Page", "url": "${sprung}/pages/vehicles/${__value.text}", "targetBlank": True},
    ]
    return {"matcher": {"id": "byName", "options": "vehicle"}, "properties": [{"id": "links", "value": links}]}


def health_mapping() -> list[dict[str, Any]]:
    """Numbers of health as words in colours."""
    options = {str(n): {"text": text, "color": colour, "index": n} for n, (text, colour) in HEALTH.items()}
    return [{"type": "value", "options": options}]


def alarm_marks(where: str) -> dict[str, Any]:
    """Alarms as they open."""
    opened = {
        "name": "Alarms",
        "enable": True,
        "datasource": SOURCE,
        "expr": f"sum by (vehicle, severity) (increase(sprung_alarms_active{where}[1m])) > 0",
        "titleFormat": "{{vehicle}}: {{severity}}",
        "iconColor": "red",
        "step": "30s",
    }
    return {"list": [opened]}


def variable(name: str, label: str, query: str, every: bool = False) -> dict[str, Any]:
    """A drop-down of a label's values."""
    found: dict[str, Any] = {"name": name, "label": label, "type": "query", "datasource": SOURCE, "query": query}
    found |= {"refresh": 2, "sort": 1}
    return found | ({"includeAll": True, "multi": True, "current": {"text": "All", "value": "$__all"}} if every else {})


def address() -> dict[str, Any]:
    """Where the pages are reached, for the links."""
    return {"name": "sprung", "label": "Sprung", "type": "textbox", "query": "http://localhost:8000"}


def dashboard(
    uid: str, title: str, panels: list[dict[str, Any]], variables: list[dict[str, Any]], where: str = ""
) -> dict[str, Any]:
    """The whole of one."""
    links = [
        {"title": name, "type": "link", "url": f"/d/{other}", "icon": "dashboard"}
        for other, name in ((FLEET, "Fleet"), (SERVICE, "Service"))
        if other != uid
    ]
    return {
        "title": f"Sprung: {title}",
        "uid": uid,
        "schemaVersion": 39,
        "version": 2,
        "editable": True,
        "refresh": "10s",
        "time": {"from": "now-1h", "to": "now"},
        "tags": ["sprung"],
        "links": links,
        "annotations": alarm_marks(where),
        "templating": {"list": variables},
        "panels": [{"id": i + 1} | each for i, each in enumerate(panels)],
    }


def fleet() -> dict[str, Any]:
    """What needs attention."""
    health = {"mappings": health_mapping(), "custom": {"cellOptions": {"type": "color-text"}}}
    table = panel(
        "table",
        "Vehicles, the most urgent first",
        [
            ("sort_desc(sprung_vehicle_health)", "health"),
            ("sprung_vehicle_largest_drift_ratio", "drift"),
            ("sum by (vehicle) (sprung_alarms_active)", "alarms"),
            ("time() - sprung_last_received_timestamp_seconds", "age"),
        ],
        (0, 4, 24, 9),
        overrides=[
            link_to_vehicle(),
            {
                "matcher": {"id": "byName", "options": "Value #A"},
                "properties": [{"id": "displayName", "value": "health"}]
                + [{"id": key, "value": value} for key, value in health.items()],
            },
            _named("Value #B", "largest drift", "percentunit"),
            _named("Value #C", "alarms", "none"),
            _named("Value #D", "silent for", "s"),
        ],
        transformations=[
            {"id": "joinByField", "options": {"byField": "vehicle", "mode": "outer"}},
            {"id": "sortBy", "options": {"sort": [{"field": "Value #A", "desc": True}]}},
        ],
    )
    panels = [
        panel("stat", "Vehicles by health", [("sprung_fleet_vehicles", "{{health}}")], (0, 0, 12, 4)),
        panel(
            "stat",
            "Vehicles heard from in the last ten minutes",
            [("count(time() - sprung_last_received_timestamp_seconds < 600) or vector(0)", "vehicles")],
            (12, 0, 6, 4),
        ),
        panel("stat", "Service", [('up{job="sprung"}', "{{instance}}")], (18, 0, 6, 4)),
        table,
        panel(
            "timeseries",
            "Active alarms by vehicle",
            [("sum by (vehicle, severity) (sprung_alarms_active) > 0", "{{vehicle}} {{severity}}")],
            (0, 13, 12, 8),
        ),
        panel(
            "timeseries",
            "Largest drift by vehicle",
            [("sprung_vehicle_largest_drift_ratio", "{{vehicle}}")],
            (12, 13, 12, 8),
            "percentunit",
        ),
    ]
    return dashboard(FLEET, "fleet", panels, [address()])


def vehicle() -> dict[str, Any]:
    """One vehicle."""
    mine = '{vehicle="$vehicle"}'
    received = f"time() - sprung_last_received_timestamp_seconds{mine}"
    dropped = f"sum by (reason) (rate(sprung_windows_dropped_total{mine}[5m]))"
    outcome = f"sum by (outcome) (rate(sprung_windows_total{mine}[1m]))"
    panels = [
        panel(
            "stat",
            "Health",
            [(f"sprung_vehicle_health{mine}", "health")],
            (0, 0, 5, 4),
            defaults={"mappings": health_mapping()},
        ),
        panel("stat", "Active alarms", [(f"sprung_alarms_active{mine}", "{{severity}}")], (5, 0, 5, 4)),
        panel(
            "stat",
            "Largest drift from baseline",
            [(f"sprung_vehicle_largest_drift_ratio{mine}", "drift")],
            (10, 0, 5, 4),
            "percentunit",
        ),
        panel("stat", "Since the last window came", [(received, "age")], (15, 0, 5, 4), "s"),
        panel("stat", "Windows per second", [(outcome, "{{outcome}}")], (20, 0, 4, 4)),
        ratios("Stiffness over baseline", "stiffness", (0, 4, 12, 9)),
        ratios("Damping over baseline", "damping", (12, 4, 12, 9)),
        panel("timeseries", "Fit by sensor (NRMSE)", [(f"sprung_fit_nrmse{mine}", "{{sensor}}")], (0, 13, 12, 8)),
        panel("timeseries", "Dropped windows by reason, per second", [(dropped, "{{reason}}")], (12, 13, 12, 8)),
        panel(
            "timeseries",
            "Stiffness",
            [('sprung_stiffness_newtons_per_meter{vehicle="$vehicle", element=~"$element"}', "{{element}}")],
            (0, 21, 12, 8),
            "si:N/m",
        ),
        panel(
            "timeseries",
            "Damping",
            [('sprung_damping_newton_seconds_per_meter{vehicle="$vehicle", element=~"$element"}', "{{element}}")],
            (12, 21, 12, 8),
            "si:N s/m",
        ),
        bands((0, 29, 8, 8)),
    ]
    variables = [
        variable("vehicle", "Vehicle", "label_values(sprung_vehicle_health, vehicle)"),
        variable("element", "Element", 'label_values(sprung_parameter_ratio{vehicle="$vehicle"}, element)', every=True),
        address(),
    ]
    return dashboard(VEHICLE, "vehicle", panels, variables, mine)


def service() -> dict[str, Any]:
    """The service itself."""
    quantile = "histogram_quantile(0.95, sum by (le, stage) (rate(sprung_identify_duration_seconds_bucket[5m])))"
    panels = [
        panel("stat", "Version", [("sprung_build_info", "{{version}} {{model}}")], (0, 0, 8, 4)),
        panel("stat", "Up", [('up{job="sprung"}', "{{instance}}")], (8, 0, 4, 4)),
        panel("stat", "Waiting", [("sprung_queue_length", "{{queue}}")], (12, 0, 6, 4)),
        panel(
            "stat",
            "Windows per second",
            [("sum by (outcome) (rate(sprung_windows_total[1m]))", "{{outcome}}")],
            (18, 0, 6, 4),
        ),
        panel("timeseries", "Queues", [("sprung_queue_length", "{{queue}}")], (0, 4, 12, 8)),
        panel("timeseries", "Identification, 95th percentile by stage", [(quantile, "{{stage}}")], (12, 4, 12, 8), "s"),
        panel(
            "timeseries",
            "Messages per second",
            [("sum by (source, outcome) (rate(sprung_frames_total[1m]))", "{{source}} {{outcome}}")],
            (0, 12, 12, 8),
        ),
        panel(
            "timeseries",
            "Live feeds: state",
            [("sprung_feed_state == 1", "{{source}} {{state}}")],
            (12, 12, 12, 8),
            description="Empty where no bus is followed.",
        ),
        panel("timeseries", "Live feeds: lag", [("sprung_feed_lag_seconds", "{{source}}")], (0, 20, 12, 8), "s"),
        panel(
            "timeseries",
            "Live feeds: losses per second",
            [("sum by (source, cause) (rate(sprung_feed_lost_total[5m]))", "{{source}} {{cause}}")],
            (12, 20, 12, 8),
        ),
        panel("timeseries", "Buses: connected", [("sprung_bus_connected", "{{source}}")], (0, 28, 12, 8)),
        panel(
            "timeseries",
            "Live feeds: begun again, per hour",
            [("increase(sprung_feed_restarts_total[1h])", "{{source}}")],
            (12, 28, 12, 8),
        ),
    ]
    return dashboard(SERVICE, "service", panels, [])


def _named(field: str, name: str, unit: str) -> dict[str, Any]:
    properties = [{"id": "displayName", "value": name}, {"id": "unit", "value": unit}]
    return {"matcher": {"id": "byName", "options": field}, "properties": properties}


DASHBOARDS = {"fleet.json": fleet, "vehicle.json": vehicle, "service.json": service}


def text(name: str) -> str:
    """A dashboard as its file holds it."""
    return json.dumps(DASHBOARDS[name](), indent=1, sort_keys=True) + "\n"


if __name__ == "__main__":
    for file in DASHBOARDS:
        (FOLDER / file).write_text(text(file), encoding="utf-8")
        print(FOLDER / file)
