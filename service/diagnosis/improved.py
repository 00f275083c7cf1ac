"""The system file with the findings of a diagnosis: nominal values, laws and noise; comments and order are kept."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, MutableMapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from sprung.model.diagnosis.report.report import IdentifiedLaw, Report, ReportedParameter
from sprung.model.diagnosis.response.terms import WIDER
from sprung.model.laws import CATALOGUE, Law, SensorLaw
from sprung.model.system import System, parse_system

_DIGITS = 6
_GROUPS = ("elements", "bodies", "inputs", "sensors")  # of a system file, whose entries have laws
_NOISE_LAWS = {law.name for law in CATALOGUE if isinstance(law, SensorLaw) and law.scales_noise}
QUANTITIES = ("stiffness", "damping", "mass")


def improved_text(text: str, system: System, report: Report) -> str:
    """The text of a system file (the one that `system` was read from) with the findings of a report.

    Parameters get the values that were identified with the findings in place; laws stand with values and deviations;
    the noise of every channel is the one found.  Unnamed forces have no values to write and are left out, and so is a
    law of all springs: these then have the values with which the structure without it comes closest.
    """
    yaml = YAML()
    yaml.width = 4096
    file = yaml.load(text)
    _write_parameters(file, _parameters(system, report))
    _write_laws(file, system, report)
    _write_noise(file, report)
    out = io.StringIO()
    yaml.dump(file, out)
    return out.getvalue()


def _write_parameters(file: Any, parameters: Iterable[ReportedParameter]) -> None:
    for parameter in parameters:
        part, _, quantity = parameter.name.rpartition(".")
        if quantity in QUANTITIES:  # the preload of a component test is written as a law
            _set_value(file["bodies" if quantity == "mass" else "elements"][part], quantity, parameter.value)


def _write_laws(file: Any, system: System, report: Report) -> None:
    """The laws of a report in place of those that the file has; which values it holds fixed stay so."""
    faults = {law.name: law for law in system.catalogue if isinstance(law, SensorLaw)}
    undone = {name for name, law in faults.items() if not law.filters}
    for group in _GROUPS:
        for entry in (file.get(group) or {}).values():
            _drop_laws(entry, undone if group == "sensors" else set(faults))
    held = {name for law in system.laws for name, fixed in zip(law.names, law.fixed, strict=True) if fixed}
    for law in report.laws:
        _place(file, system, law, held)


def _write_noise(file: Any, report: Report) -> None:
    """Noise of channels that are noisier than their peers, and of all whose level was estimated."""
    for finding in report.findings:
        if finding.effect in _NOISE_LAWS and finding.parameters:
            for name in finding.location.split("|"):
                channel = _channel(file, name)
                if channel is not None and channel.get("noise"):
                    channel["noise"] = _rounded(channel["noise"] * finding.parameters[0].value)
    for name, level in report.noise.items():
        channel = _channel(file, name)
        if channel is not None and level > 0:
            channel["noise"] = _rounded(level)


def _parameters(system: System, report: Report) -> tuple[ReportedParameter, ...]:
    """Values with the findings in place; without them where a law took over springs and no file has a place for it."""
    names = {law.name for law in system.catalogue if law.branches is not None}
    return report.baseline if any(one.effect in names for one in report.findings) else report.augmented


def left_out(report: Report) -> list[str]:
    """Findings that the improved file cannot hold, `unknown at secondary_2r`: nothing may go in silence.

    Unnamed forces, and faults of the measurement set-up.
    """
    held = {(law.location, law.effect) for law in report.laws} | {
        (finding.location, finding.effect) for finding in report.findings if finding.effect in _NOISE_LAWS
    }
    missing = [finding for finding in report.findings if (finding.location, finding.effect) not in held]
    return [f"{one.effect.replace('_', ' ')} at {one.location.replace('|', ' and ')}" for one in missing]


def write_improved(path: Path, text: str, system: System, report: Report) -> None:
    """Write the improved file of a text (that `system` was read from), once it has been read back without an error."""
    text = improved_text(text, system, report)
    parse_system(text, str(path), system.catalogue)
    path.write_text(text, encoding="utf-8")


def _set_value(entry: Any, quantity: str, value: float) -> None:
    if isinstance(entry.get(quantity), Mapping):
        entry[quantity]["value"] = _rounded(value)
    else:
        entry[quantity] = _rounded(value)


def _drop_laws(entry: Any, undone: set[str]) -> None:
    """Take out laws, whose values come anew; those that were undone before stay."""
    if not isinstance(entry, MutableMapping):
        return
    if "laws" in entry:
        kept = [law for law in entry["laws"] if undone.issuperset(law)]
        del entry["laws"]
        if kept:
            entry["laws"] = kept


def _place(file: Any, system: System, law: IdentifiedLaw, held: set[str]) -> None:
    """Add a law; held: full names of values that the file holds fixed."""
    known = next((one for one in system.catalogue if one.name == law.effect), None)
    if known is not None and known.where == "sensor" and "|" in law.location:  # one filter of several sensors
        for place in law.location.split("|"):
            _place(file, system, replace(law, location=place), held)
        return
    first, *others = law.location.split("|")
    entry = _holder(file, first)
    if entry is None:
        return
    setting = CommentedMap({name: text for name in ("formula", "memory") if (text := getattr(law, name))})
    setting.update(_law_values(known, law, held))
    if law.variant and law.variant != WIDER:
        setting["variant"] = law.variant
    if others and not (known is not None and known.everywhere):
        setting["with"] = others[0]
    setting.fa.set_flow_style()
    placed = CommentedMap({law.effect: setting})
    placed.fa.set_flow_style()
    entry.setdefault("laws", CommentedSeq()).append(placed)


def _law_values(known: Law | None, law: IdentifiedLaw, held: set[str]) -> dict[str, CommentedMap]:
    """The values of a law's parameters as the file has them: with deviation, and whether they are fixed."""
    corner = None if known is None else known.corner
    values = {}
    for index, parameter in enumerate(law.parameters):
        if known is not None and known.everywhere and parameter.value == parameter.std == 0:
            continue  # a mode that the system does not have
        value = CommentedMap(value=_rounded(parameter.value))
        if parameter.std > 0:
            value["std"] = float(f"{parameter.std:.3g}")
        # identifiable from a minute of running, but not from a window
        if index == corner or f"{law.location}.{law.effect}.{parameter.name}" in held:
            value["fixed"] = True
        value.fa.set_flow_style()
        values[parameter.name] = value
    return values


def _holder(file: Any, name: str) -> Any:
    """The entry of the file that a law belongs to."""
    for group in _GROUPS:
        if name in (file.get(group) or {}):
            return file[group][name]
    return _channel(file, name)


def _channel(file: Any, name: str) -> Any:
    """The address of a channel: `car_1l`, `wheel_11l.velocity`."""
    part, _, quantity = name.rpartition(".")
    sensors, inputs = file.get("sensors") or {}, file.get("inputs") or {}
    if name in sensors:
        return sensors[name]
    if name in inputs:
        return inputs[name]
    return inputs.get(part, {}).get(quantity)


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
