"""Events as CloudEvents 1.0, with the words of ISO 13374 (MIMOSA OSA-CBM) for what they tell."""

from __future__ import annotations

import uuid
from typing import Any
from urllib.parse import quote

from sprung.service.monitoring.views import finite, unclear
from sprung.service.monitoring.words import size_in_words, spoken
from sprung.service.store.fleet import AlarmChange
from sprung.service.times import optional_iso, to_iso

ALARM_TYPES = {"opened": "sprung.alarm.opened", "changed": "sprung.alarm.changed", "closed": "sprung.alarm.closed"}
REPORT_READY = "sprung.report.ready"
FEED_LOST, FEED_FOUND = "sprung.feed.lost", "sprung.feed.found"
BLOCKS = {"SD": "state detection", "HA": "health assessment", "DA": "data acquisition"}  # of ISO 13374-1
ADVICE = {
    "change": "Inspect {element}; when it is repaired, mark the maintenance so that its baseline is learned anew.",
    "common": "All of them at once: weather, load, speed or a scale more often than wear. Compare with other vehicles.",
    "misfit": "A sensor, or physics that the model lacks: read the mismatch report that follows.",
    "sensor": "Check mounting, cable and scale of the sensor.",
    "load": "Check the load and its sensor.",
}


def alarm_event(base: str, vehicle: str, change: AlarmChange, now: int) -> dict[str, Any]:
    """An alarm was opened, has another severity, or is closed."""
    alarm = change.alarm
    element, _, quantity = (alarm.parameter or "").rpartition(".")
    advice = ADVICE["common" if alarm.kind == "change" and "*" in element else alarm.kind]
    advice = unclear(alarm.alternatives) + advice
    data = {
        "vehicle": vehicle,
        "alarm": {
            "kind": alarm.kind,
            "parameter": alarm.parameter,
            "element": element or None,
            "quantity": quantity or None,
            "severity": alarm.severity,
            "previous_severity": change.before,
            "change": finite(alarm.change),
            "std": finite(alarm.std),
            "onset": to_iso(alarm.onset),
            "raised": to_iso(alarm.opened),
            "recovered": optional_iso(alarm.closed),
            "alternatives": list(alarm.alternatives),
        },
        "iso13374": {"block": "SD", "function": BLOCKS["SD"]},
        "advisory": advice.format(element=element or vehicle) if change.what != "closed" else None,
        "page": vehicle_page(base, vehicle),
    }
    return _event(ALARM_TYPES[change.what], vehicle, data, now)


def report_event(base: str, vehicle: str | None, report: str, verdict: str, findings: list[str], now: int) -> Any:
    """A mismatch report is there."""
    data = {
        "vehicle": vehicle,
        "report": report,
        "verdict": verdict,
        "findings": findings,
        "iso13374": {"block": "HA", "function": BLOCKS["HA"]},
        "page": f"{base}/reports/{report}/page",
    }
    return _event(REPORT_READY, vehicle or report, data, now)


def feed_event(base: str, source: str, vehicle: str, works: bool, detail: str, now: int) -> dict[str, Any]:
    """A live bus does not deliver any more, or again."""
    data = {
        "source": source,
        "vehicle": vehicle,
        "detail": detail,
        "iso13374": {"block": "DA", "function": BLOCKS["DA"]},
        "page": vehicle_page(base, vehicle),
    }
    return _event(FEED_FOUND if works else FEED_LOST, vehicle, data, now)


def vehicle_page(base: str, vehicle: str) -> str:
    """Where a person looks at it."""
    return f"{base}/pages/vehicles/{quote(vehicle, safe='')}"


def sentence(event: dict[str, Any]) -> str:
    """One line for people, as the subject of a mail."""
    data = event["data"]
    if event["type"].startswith("sprung.alarm."):
        alarm = data["alarm"]
        kind = {"misfit": "windows do not fit the model"}.get(alarm["kind"], alarm["kind"])
        what = " or ".join([*alarm.get("alternatives", ()), spoken(alarm["parameter"] or "") or kind])
        change = f" {size_in_words(alarm['parameter'], alarm['change'], alarm['std'])}".rstrip()
        return f"{data['vehicle']}: {alarm['severity']} {event['type'].rsplit('.', 1)[1]}: {what}{change}"
    if event["type"] == REPORT_READY:
        return f"{data['vehicle'] or 'recording'}: mismatch report: {data['verdict'].replace('_', ' ')}"
    return f"{data['vehicle']}: bus {data['source']} {'delivers again' if event['type'] == FEED_FOUND else 'is lost'}"


def _event(kind: str, subject: str, data: dict[str, Any], now: int) -> dict[str, Any]:
    return {
        "specversion": "1.0",
        "id": str(uuid.uuid4()),
        "source": "/sprung",
        "type": kind,
        "subject": subject,
        "time": to_iso(now),
        "datacontenttype": "application/json",
        "data": data,
    }
