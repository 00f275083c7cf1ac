"""What a vehicle's states mean, and what to do about them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sprung.model.identification.estimates import WITHOUT_VALUES
from sprung.model.text import some
from sprung.service.monitoring.views import VehicleView, changed_part, suspected, unclear
from sprung.service.monitoring.words import size_in_words
from sprung.service.rendering.drawing import Mark
from sprung.service.store.fleet import AlarmRow
from sprung.service.store.status import FleetRow, Reason
from sprung.service.times import to_iso

MOSTLY = 0.5  # share of the windows from which something is worth a hint


@dataclass(frozen=True, slots=True)
class Hint:
    """One state in a sentence, and what to do."""

    level: str  # alarm, warning, info
    title: str
    text: str


def hints(
    row: FleetRow,
    view: VehicleView,
    active: Sequence[AlarmRow],
    reasons: Sequence[Reason],
    silent: bool,
    sensors: Mapping[str, Mark],
) -> list[Hint]:
    """The most urgent first; empty for a vehicle that is well."""
    found = [*_alarms(row, active), *_sensors(sensors, active)]
    whole = row.windows["used"] + row.windows["repaired"]
    every = whole + row.windows["dropped"] + row.windows["uninformative"]
    if silent:
        text = "No window has come for a while. Check power, bus and network of the vehicle; what is shown is the past."
        found.append(Hint("warning", "Stale", text))
    if every and row.windows["dropped"] > MOSTLY * every:
        why = next((r.reason for r in reasons if r.outcome == "dropped"), "see below")
        advice = "Check the sensors and the bus that are named under Windows"
        if why.startswith(WITHOUT_VALUES):
            advice = "Go back to another model under Model, or leave laws out of this one"
        text = f"Most often: {why}. {advice}."
        found.append(Hint("warning", "Most windows are dropped", text))
    if every and row.windows["uninformative"] > MOSTLY * every and not _all_lost(view):
        text = (
            "The track or the speed excites the suspension too little: standstill, or very smooth track. Nothing to do."
        )
        found.append(Hint("info", "Uninformative", text))
    if whole and row.windows["unfitting"] > MOSTLY * whole:
        text = (
            "Most windows do not fit the model, so nothing is learned from them. Check masses and positions in the "
            "system file and the sensors; a diagnosis below names the likely cause."
        )
        found.append(Hint("warning", "Windows do not fit", text))
    return found + _parameters(row, view, whole) + _built(view)


def _built(view: VehicleView) -> list[Hint]:
    if not view.built:
        return []
    listed = "; ".join(
        f"{one.body} {100 * one.change:+.1f} % ± {100 * one.std:.1f} % in {one.what}" for one in view.built
    )
    text = f"As the windows tell it: {listed}. It is allowed for; correct the file when the vehicle has been weighed."
    return [Hint("info", "Not quite as the system file says", text)]


def _alarms(row: FleetRow, active: Sequence[AlarmRow]) -> list[Hint]:
    found = []
    changed = [a for a in active if a.kind == "change" and a.parameter]
    if changed:
        worst = max(changed, key=lambda a: abs(a.change or 0.0))
        many = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
        level = "alarm" if any(a.severity == "alarm" for a in changed) else "warning"
        change = size_in_words(worst.parameter, worst.change, worst.std)
        by = f" by {change}" if change else ""
        together = "*" in (worst.parameter or "")
        waiting = [a for a in changed if a.acknowledged is None]
        seen = f"Acknowledged by {worst.acknowledged_by or 'somebody'}."
        ask = seen if not waiting else "Acknowledge the alarm so that others see that somebody looks into it."
        what = (
            "All of them together: weather, load, speed or a scale more often than wear. Compare with other vehicles."
            if together
            else "Inspect the element; once it is repaired, mark the maintenance so that its baseline is learned anew."
        )
        unsure = unclear(worst.alternatives)
        found.append(
            Hint(level, f"{changed_part(worst)} has changed{by}{many}", f"{_since(worst)}. {unsure}{what} {ask}")
        )
    misfit = next((a for a in active if a.kind == "misfit"), None)
    if misfit is not None:
        cause = "A sensor, or physics that the model lacks. A diagnosis follows by itself; its report is listed below."
        text = f"{_since(misfit)}. {cause}"
        found.append(Hint("warning", "Windows do not fit the model", text))
    if any(a.kind == "load" for a in active):
        found.append(Hint("warning", "Load out of range", "Check the load sensor, or the loading of the vehicle."))
    if row.earlier:
        text = "An earlier model raised alarms that nothing has closed. Check them, then mark the maintenance."
        found.append(Hint("warning", "Alarms of an earlier model", text))
    return found


def _since(alarm: AlarmRow) -> str:
    return f"Since {to_iso(alarm.onset)[:19].replace('T', ' ')} UTC"


def _fault(alarm: AlarmRow) -> str:
    """What is wrong with the channels of an alarm of kind sensor, and since when."""
    channels, fault = suspected(alarm)
    change = size_in_words(alarm.parameter, alarm.change, alarm.std) if fault in ("gain", "delay") else ""
    return f"{_since(alarm)}: {', '.join(channels)}, {fault} {change}".rstrip()


def _sensors(sensors: Mapping[str, Mark], active: Sequence[AlarmRow]) -> list[Hint]:
    suspect = [name for name, mark in sensors.items() if mark.state == "suspect"]
    absent = [name for name, mark in sensors.items() if mark.state == "absent"]
    found = []
    if suspect:
        faults = "".join(f"{_fault(a)}. " for a in active if a.kind == "sensor" and suspected(a)[1] != "silent")
        text = "Check mounting, cable and scale; springs and dampers are judged without it where the others suffice."
        text = f"{faults}{text}"
        found.append(Hint("warning", f"Sensor suspect: {', '.join(suspect)}", text))
    if absent:
        since = "".join(f"{_fault(a)}. " for a in active if a.kind == "sensor" and suspected(a)[1] == "silent")
        text = "Its channel delivers nothing, or its address in the system file is wrong: `sprung inspect` lists it."
        text = f"{since}{text}"
        found.append(Hint("warning", f"No signal: {', '.join(absent[:4])}{' …' if len(absent) > 4 else ''}", text))
    return found


def _all_lost(view: VehicleView) -> bool:
    """Whether not one parameter is identifiable while channels are lost."""
    return bool(view.parameters) and all(p.lost_with is not None for p in view.parameters)


def _parameters(row: FleetRow, view: VehicleView, whole: int) -> list[Hint]:
    if _all_lost(view):
        missing = list(dict.fromkeys(c for p in view.parameters for c in str(p.lost_with).split("|")))
        are = "is" if len(missing) == 1 else "are"
        text = (
            "What is left of the measurements tells no spring or damper; values are those of before. Repair the node "
            "that sends these channels; no alarm of a spring or damper can come until then."
        )
        return [Hint("alarm", f"Not monitored while {some(missing, 1)} {are} lost", text)]
    found = []
    lost = [p for p in view.parameters if p.lost_with is not None]
    for channels in dict.fromkeys(p.lost_with for p in lost):
        names = ", ".join(p.name for p in lost if p.lost_with == channels)
        are = "are" if "|" in str(channels) else "is"
        text = "Everything else is tracked, with the uncertainty that this leaves. Repair the sensor."
        found.append(
            Hint("warning", f"Not identifiable while {str(channels).replace('|', ' and ')} {are} lost: {names}", text)
        )
    unknown = [p.name for p in view.parameters if p.state == "not_identifiable" and p.lost_with is None]
    if unknown and whole:
        if row.windows["unfitting"] >= whole:
            text = "No window has fitted yet: this says nothing about the sensors. See why windows do not fit."
        else:
            text = "The sensors or the excitation do not tell it. `sprung system` shows what the sensors can identify."
        names = ", ".join(unknown[:3]) + (" …" if len(unknown) > 3 else "")
        found.append(Hint("info", f"Not identifiable: {names}", text))
    learning = sum(p.state == "learning" for p in view.parameters)
    if learning:
        text = (
            f"{learning} of {len(view.parameters)} parameters have no baseline yet; alarms come only after it is "
            "learned. Keep the vehicle running; nothing to do."
        )
        found.append(Hint("info", "Learning", text))
    return found
