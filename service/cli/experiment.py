"""`sprung experiment`: which run of a menu would distinguish models that one recording could not."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from sprung.model.experiment.choose import RankedRun, rank_runs
from sprung.model.experiment.drives import run_inputs
from sprung.model.experiment.evidence import KNOWN
from sprung.model.experiment.menu import BUNDLED, Menu, check_menu, read_menu
from sprung.model.experiment.rivals import NoRival, rival
from sprung.model.system import System, load_system
from sprung.service.errors import UserError

MOST_RIVALS = 3  # of one finding, the nearest


def run(
    models: list[Path], system_file: Path | None, menu_file: Path | None, known: float | None, json_lines: bool
) -> int:
    """Print the menu's runs, best evidence per cost first."""
    menu = read_menu(menu_file or BUNDLED)
    report = _report_of(models)
    if report is None:
        systems = _from_files(models, menu)
    else:
        systems = _from_report(report, system_file or report.parent / "system.yaml", menu)
    found = rank_runs(
        systems, menu, KNOWN if known is None else known, tell=lambda name: print(f"{name} ...", file=sys.stderr)
    )
    if json_lines:
        print(json.dumps({"models": list(systems), "runs": [_as_dict(one) for one in found]}))
        return 0
    _show(found, list(systems))
    return 0


def _report_of(models: list[Path]) -> Path | None:
    """The report's JSON where one is given: itself or its folder."""
    if len(models) != 1:
        return None
    path = models[0] / "report.json" if models[0].is_dir() else models[0]
    if path.suffix != ".json":
        raise UserError(f"{path}: a single model has no alternative; give two system files or more, or a report")
    return path


def _from_files(paths: list[Path], menu: Menu) -> dict[str, System]:
    systems = {str(path): load_system(path) for path in paths}
    if len(systems) < 2:
        raise UserError("the models are one and the same file; give two or more")
    first = next(iter(systems.values()))
    for name, system in systems.items():
        if [c.name for c in system.channels] != [c.name for c in first.channels] or system.window != first.window:
            raise UserError(f"{name}: its channels or window are not those of {paths[0]}")
        check_menu(menu, system)
    return systems


def _from_report(path: Path, system_file: Path, menu: Menu) -> dict[str, System]:
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
        findings = report["findings"]
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: is no report of `sprung diagnose`") from error
    if not system_file.is_file():
        raise UserError(
            f"{system_file}: name the system file with the findings by --system (diagnose --write-system writes it)"
        )
    system = load_system(system_file)
    check_menu(menu, system)
    inputs = run_inputs(system, next(iter(menu.runs.values())))
    systems = {"as found": system}
    for finding in findings:
        element, effect = finding["location"], finding["effect"]
        if not any(law.location == element and law.law.name == effect for law in system.laws):
            continue
        for name in _nearest(finding):
            try:
                systems[f"{element}: {name}"] = rival(system, element, effect, name, inputs)
            except NoRival as refusal:
                print(refusal, file=sys.stderr)
    if len(systems) < 2:
        raise UserError(
            f"{path}: names no look-alike of a law that {system_file} holds; there is nothing to distinguish"
        )
    return systems


def _nearest(finding: dict[str, Any]) -> list[str]:
    """Laws that fitted almost as well: those of the family, else the nearest that were tried."""
    if finding.get("family"):
        names = [name for name in finding["family"].split(" or ") if name != finding["effect"]]
    else:
        margins = finding.get("look_alikes") or {}
        names = sorted(margins, key=lambda name: float(margins[name]))
    return names[:MOST_RIVALS]


def _as_dict(found: RankedRun) -> dict[str, Any]:
    return {
        "run": found.run,
        "evidence": round(found.evidence, 2),
        "chance": round(found.chance, 4),
        "evidence_per_cost": round(found.per_cost, 2),
        "pairs": [
            {"true": a, "other": b, "evidence": round(p.evidence, 2), "chance": round(p.chance, 4)}
            for (a, b), p in found.promises.items()
        ],
    }


def _show(found: list[RankedRun], names: list[str]) -> None:
    print(f"distinguished: {', '.join(names)}")
    print(f"{'run':<28}{'evidence':>11}{'per cost':>11}  chance that it is strong")
    for one in found:
        print(f"{one.run[:27]:<28}{one.evidence:>11.5g}{one.per_cost:>11.5g}  {100 * one.chance:.0f} %")
    best = found[0]
    if best.chance < 0.5:
        print("no run of the menu is likely to decide: longer or rougher runs would be more informative")
    else:
        print(f"do next: {best.run}")
