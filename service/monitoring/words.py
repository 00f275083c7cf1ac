"""Parameters and their changes as sentences have them."""

from __future__ import annotations

from sprung.model.signals import HARD_FAULTS


def spoken(parameter: str) -> str:
    """A parameter as a sentence has it: of `*.damping` and `primary_*.damping` what they mean."""
    element, _, quantity = parameter.rpartition(".")
    if "*" not in element:
        return parameter
    group = element.replace("*", "").strip("_").replace("_", " ")
    return f"{quantity} of all {f'{group} ' if group else ''}elements"


def size_in_words(parameter: str | None, change: float | None, std: float | None = None) -> str:
    """How large an alarm's change is, with its deviation where that is given; empty where it is not known.

    Changes are relative, `-29.6 ± 1.5 %`; those of a delay are in s, `+4.0 ± 0.1 ms`.  A channel that is frozen,
    saturated, noisy, inverted, swapped or silent is so altogether: what is known of it is a level, not a change.
    """
    kind = (parameter or "").rpartition(".")[2]
    if change is None or kind in HARD_FAULTS:
        return ""
    factor, unit = (1e3, "ms") if kind == "delay" else (100.0, "%")
    deviation = "" if std is None else f" ± {factor * std:.1f}"
    return f"{factor * change:+.1f}{deviation} {unit}"


def fault_in_words(kind: str, value: float | None, std: float | None, unit: str) -> str:
    """What is wrong with a channel of an SI unit: `gain 1.051 ± 0.0034`, `delay 3.9 ± 0.09 ms`, `frozen at 0.02 m`."""
    if value is None or kind in ("inverted", "swapped", "silent"):
        return kind
    if kind in ("frozen", "saturated"):
        return f"{kind} at {value:.4g} {unit}".rstrip()
    if kind == "noisy":
        return f"noisy, {value:.2g} {unit}".rstrip()
    factor, unit = (1e3, " ms") if kind == "delay" else (1.0, "")
    return f"{kind} {factor * value:.4g}{'' if std is None else f' ± {factor * std:.2g}'}{unit}"
