"""Formulas that a diagnosis found, as a Python file of laws of one's own (`sprung diagnose --laws`)."""

from __future__ import annotations

import re
from pathlib import Path

from sprung.model.diagnosis.report.report import Finding, Report

_HEAD = '''"""Laws found by a diagnosis; names and titles are yours to choose."""

from sprung.model.laws.saved import saved_law
'''


def write_laws(path: Path, report: Report) -> int:
    """Write a Python file with every formula of a report, where there is one; how many laws it has."""
    formulas = [finding for finding in report.findings if finding.formula]
    if formulas:
        laws = (_law(number, one) for number, one in enumerate(formulas, 1))
        path.write_text("\n".join([_HEAD, *laws]), encoding="utf-8")
    return len(formulas)


def _law(number: int, finding: Finding) -> str:
    name = re.sub(r"\W+", "_", finding.location).strip("_").lower()
    values = ", ".join(f'"{p.name}": ({p.value!r}, "{p.unit}")' for p in finding.parameters)
    memory = f"    memory={finding.memory!r},\n" if finding.memory else ""
    return (
        f'LAW_{number} = saved_law(\n    "{name}_law_{number}",\n    {finding.formula!r},\n    {{{values}}},\n'
        f'{memory}    title="force found at {finding.location}",\n)\n'
    )
