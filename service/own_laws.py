"""Formulas that a diagnosis found, as a Python file of laws of one's own (`sprung diagnose --laws`)."""

from __future__ import annotations

import re
from pathlib import Path

from sprung.model.diagnosis.report.report import Finding, Report

_HEAD = '''"""Laws found by a diagnosis; names and titles are yours to choose."""

from sprung.model.laws.saved import saved_law
'''


def own_laws_text(report: Report) -> str:
    """A Python file with every formula of a report; empty where there is none."""
    formulas = [finding for finding in report.findings if finding.formula]
    if not formulas:
        return ""
    return "\n".join([_HEAD, *(_law(number, one) for number, one in enumerate(formulas, 1))])


def write_laws(path: Path, report: Report) -> int:
    """Write the file where there is something to write; how many laws it has."""
    text = own_laws_text(report)
    if text:
        path.write_text(text, encoding="utf-8")
    return text.count("= saved_law(")


def _law(number: int, finding: Finding) -> str:
    name = re.sub(r"\W+", "_", finding.location).strip("_").lower()
    values = ", ".join(f'"{p.name}": ({p.value!r}, "{p.unit}")' for p in finding.parameters)
    memory = f"    memory={finding.memory!r},\n" if finding.memory else ""
    return (
        f'LAW_{number} = saved_law(\n    "{name}_law_{number}",\n    {finding.formula!r},\n    {{{values}}},\n'
        f'{memory}    title="force found at {finding.location}",\n)\n'
    )
