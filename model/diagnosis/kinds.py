"""What a law is to a report: physics with a name, physics without one, a fault of the measurement, or a nuisance."""

from __future__ import annotations

from enum import Enum

from sprung.model.laws import Law


class EffectKind(Enum):
    """The kind of a finding, as reports name it."""

    LISTED = "law"  # physics of a listed law
    UNLISTED = "unlisted"  # physics that no law explains: a surface, a formula
    FAULT = "measurement"  # a fault of a sensor, an input or the set-up
    NUISANCE = "nuisance"  # reported, and no reason for any verdict


def kind_of_law(law: Law) -> EffectKind:
    """The kind of a law."""
    if law.fault:
        return EffectKind.FAULT
    if law.nuisance:
        return EffectKind.NUISANCE
    return EffectKind.LISTED if law.listed else EffectKind.UNLISTED
