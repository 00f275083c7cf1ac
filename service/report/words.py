"""The report in an engineer's words."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sprung.model.diagnosis.report.report import Finding, LawParameter, Report
from sprung.model.diagnosis.report.sentences import names_in_words
from sprung.model.laws import CATALOGUE, ElementLaw, Law
from sprung.model.laws.basis import UNKNOWN
from sprung.model.text import some
from sprung.service.report.ink import engineering
from sprung.service.report.values import largest_bias

VERDICTS = {
    "consistent": "Consistent: the nominal structure explains the recording",
    "missing_physics": "Missing physics found",
    "sensor_fault": "A sensor or input signal is at fault, not the vehicle",
    "unknown_physics": "The vehicle does something that no known law explains",
}

Laws = Sequence[Law]  # of which a report may speak


def effect_words(effect: str, laws: Laws = CATALOGUE) -> str:
    """An effect's name as words: a law's title, else `exchanged_sensors` as "exchanged sensors"."""
    if effect == UNKNOWN:
        return "an unknown law"
    law = _called(effect, laws)
    return names_in_words(effect) if law is None else law.title


def _called(effect: str, laws: Laws) -> Law | None:
    return next((law for law in laws if law.name == effect), None)


def _minor(effect: str, laws: Laws) -> set[str]:
    """Parameters of a law, or of its wider form, that say nothing about how strong it is."""
    law = _called(effect, laws)
    forms = [law, law.wider] if isinstance(law, ElementLaw) else [law]
    return {spec.name for form in forms if form is not None for spec in form.parameters if spec.minor}


def quantity(p: LawParameter) -> str:
    """ "395 ± 6 N": rounded to the standard deviation; small lengths and speeds in millimetres."""
    if not p.determined:
        return "not determined"
    value, std, unit = p.value, p.std, "" if p.unit in {"", "-", "1"} else p.unit
    if unit in {"m", "m/s"} and max(abs(value), std) < 0.1:
        value, std, unit = 1e3 * value, 1e3 * std, "m" + unit
    if not math.isfinite(std) or std <= 0:
        return f"{value:.4g} {unit}".rstrip()
    size = max(abs(value), std)
    power = 0 if 0.01 <= size < 1e5 else 3 * math.floor(math.log10(size) / 3)
    value, std = value / 10.0**power, std / 10.0**power
    exponent = math.floor(math.log10(std))
    digits = min(max(0, -exponent + (std / 10.0**exponent < 3)), 6)
    text = f"{value:.{digits}f} ± {std:.{digits}f}"
    return (f"({text})e{power} {unit}" if power else f"{text} {unit}").rstrip()


def finding_words(finding: Finding, laws: Laws = CATALOGUE) -> str:
    """One finding: place, law, numbers."""
    name, minor = effect_words(finding.family or finding.effect, laws), _minor(finding.effect, laws)
    main = [p for p in finding.parameters if p.name not in minor]
    if len(main) == 1 and main[0].determined:
        return f"{name} of {quantity(main[0])}"
    numbers = ", ".join(f"{p.name} {quantity(p)}" for p in main)
    return f"{name}, {numbers}" if numbers else name


def place_words(location: str, most: int = 3) -> str:
    """A place in a picture, which has room for few of the channels that share a fault.

    >>> place_words("car_1l|car_1r"), place_words("car_1l|car_1r|car_2l|car_2r")
    ('car_1l, car_1r', 'car_1l, car_1r, car_2l and 1 more')
    """
    return some(location.split("|"), most)


def headline(report: Report, laws: Laws = CATALOGUE) -> str:
    """One sentence: what is where, how much it explains, and what it had falsified."""
    if report.summary:
        return report.summary.replace("+-", "±")
    if not report.findings:
        fit = report.baseline_validation.nrmse
        return f"Nothing is missing: the re-identified structure simulates the held-out part to {fit:.1%} of its rms."
    parts = ["; ".join(f"{f.location}: {finding_words(f, laws)}" for f in report.findings)]
    if report.explained is not None:
        parts.append(f"explains {100 * report.explained:.0f} % of the excess error")
    bias = largest_bias(report)
    if bias is not None and bias.bias is not None:
        name, _, kind = bias.name.rpartition(".")
        whose = f"the {kind}" if len(report.findings) == 1 and name == report.findings[0].location else bias.name
        direction = "high" if bias.bias > 0 else "low"
        parts.append(f"without it {whose} was read {abs(bias.bias):.0%} too {direction}".replace("%", " %"))
    return "; ".join(parts) + "."


def probability(value: float | None) -> str:
    """A p-value for people."""
    if value is None or not math.isfinite(value):
        return "-"
    return "< 1e-99" if value < 1e-99 else f"{value:.2g}"


def number(value: float | None, digits: int = 4) -> str:
    """A number for a table, a dash for none."""
    return "-" if value is None or not math.isfinite(value) else engineering(value, digits)
