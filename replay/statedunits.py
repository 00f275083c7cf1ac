"""Units that a recording states by itself, against those by which the system file reads it."""

from __future__ import annotations

from collections.abc import Iterable

from sprung.model.signals import Channel
from sprung.model.units import FACTORS, RAW, known
from sprung.replay.account import Account

SAME = 0.05  # relative: a calibration factor within it is no other unit
MECHANICAL = ("m", "m/s", "m/s^2", "N", "Pa")  # quantities that a column may be mistaken for


def compare_units(channels: Iterable[tuple[Channel, str, str | None]], account: Account) -> None:
    """One line for every channel whose recording states another unit than the system file reads.

    channels: each with where it is found, and the unit stated there.
    """
    for channel, where, stated in channels:
        contradiction = stated and channel.unit in FACTORS and _contradiction(channel, where, stated)
        if contradiction:
            account.note(f"{channel.name}: {contradiction}")


def _contradiction(channel: Channel, where: str, stated: str) -> str | None:
    """What is wrong, and what to do; None where nothing is, or no table has the stated unit."""
    as_recorded = abs(channel.gain) == 1.0  # neither unit nor scale is given
    unit = known(stated, channel.unit)
    if unit in FACTORS[channel.unit]:
        factor = FACTORS[channel.unit][unit]
        if abs(abs(channel.gain) / factor - 1.0) < SAME:
            return None
        if as_recorded:
            return f"the recording states {where} in {stated}, and it is read as {channel.unit}; give `unit: {unit}`"
        taken = f"one recorded unit as {abs(channel.gain):.4g} {channel.unit}"
        return f"the recording states {where} in {stated}, the system file takes {taken}; one of them is wrong"
    if unit in RAW:  # the scale tells what a volt or a count is
        if not as_recorded or unit == "1":
            return None
        return f"the recording states {where} in {stated}, and it is read as {channel.unit}; give `unit` and `scale`"
    if where.endswith(f"_{stated}"):  # the end of a name may be anything
        return None
    if any(known(stated, other) in FACTORS[other] for other in MECHANICAL if other != channel.unit):
        return f"the recording states {where} in {stated}, which is no unit of {channel.unit}; is it the right signal?"
    return None
