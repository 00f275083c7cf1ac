"""Parameters and their changes as sentences have them."""

from __future__ import annotations


def spoken(parameter: str) -> str:
    """A parameter as a sentence has it: of `*.damping` and `primary_*.damping` what they mean."""
    element, _, quantity = parameter.rpartition(".")
    if "*" not in element:
        return parameter
    group = element.replace("*", "").strip("_").replace("_", " ")
    return f"{quantity} of all {f'{group} ' if group else ''}elements"


def size_in_words(parameter: str | None, change: float | None, std: float | None = None) -> str:
    """How large an alarm's change is, with its deviation where that is given; empty where it is not known.

    Changes are relative, `-29.6 ± 1.5 %`; those of a delay are in s, `+4.0 ± 0.1 ms`.
    """
    if change is None:
        return ""
    factor, unit = (1e3, "ms") if (parameter or "").endswith(".delay") else (100.0, "%")
    deviation = "" if std is None else f" ± {factor * std:.1f}"
    return f"{factor * change:+.1f}{deviation} {unit}"
