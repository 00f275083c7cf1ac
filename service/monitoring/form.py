"""What windows look like that a model identifies, for those who check them and have no model."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class WindowForm:
    """A window is a number of samples of every channel, in the order of `channels`."""

    digest: str  # of the model that identifies
    system: str  # its name
    sample_rate: float  # Hz
    length: int  # samples
    channels: tuple[str, ...]
    inputs: tuple[str, ...]
    sensors: tuple[str, ...]
    needed: tuple[frozenset[str], ...]  # of each, one channel at least
