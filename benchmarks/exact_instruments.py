"""A system whose instruments are exact, as the generator's are: whatever gain or zero is off there is a fault."""

from __future__ import annotations

from typing import Any

from sprung.model.address import Address
from sprung.model.schema import SupportInput
from sprung.model.system import System

_EXACT = {"gain_std": 0.0, "offset_std": 0.0}


def exact_instruments(system: System) -> System:
    """The system with data sheets that leave nothing to gains and zeros of its channels."""
    file = system.file
    inputs = {name: _exact(source) for name, source in file.inputs.items()}
    sensors = {name: _exact(sensor) for name, sensor in file.sensors.items()}
    return System(file.model_copy(update={"inputs": inputs, "sensors": sensors}), system.catalogue)


def _exact(channel: Any) -> Any:
    if isinstance(channel, Address):
        return channel.model_copy(update=_EXACT)
    if isinstance(channel, SupportInput):
        parts = {quantity: address.model_copy(update=_EXACT) for quantity, address in channel.measured.items()}
        return channel.model_copy(update=parts)
    return channel
