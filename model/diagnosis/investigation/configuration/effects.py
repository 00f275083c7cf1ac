"""Configuration faults of a set-up: name, sentence, correction, and estimate of the remaining fault of each kind.

A new kind is a new value here and an iterator of hypotheses beside the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from sprung.model.diagnosis.investigation.configuration import changes
from sprung.model.diagnosis.investigation.configuration.response import NOTHING, Group, ModelResponse
from sprung.model.diagnosis.investigation.configuration.scores import ChangeEstimate, SetupScores
from sprung.model.laws import StructureLaw
from sprung.model.laws.sensor_faults import SENSOR_GAIN, SENSOR_LAG
from sprung.model.laws.structure import WRONG_POSITION
from sprung.model.system import System

NEAR = 0.02  # m, of differences
_SMALL = 0.05  # of a sample, or of a ratio, of differences


@dataclass(frozen=True)
class SetupPlace:
    """Where a fault of the set-up is."""

    location: str  # channels joined by "|", or an element
    group: Group = NOTHING  # the channels that share it
    axis: int = 0  # of a position: x or y
    detail: str = ""  # in words: where an element belongs
    inverse_at: str = ""  # channels joined by "|", at which the inverse fault gives the same recording


@dataclass(frozen=True)
class CorrectedFit:
    """A fit with a corrected fault, on which the remaining fault is estimated."""

    scores: SetupScores
    response: ModelResponse
    system: System


@dataclass(frozen=True)
class SetupEffect:
    """A kind of fault of a set-up."""

    name: str  # a word of the contract
    sentence: str = ""  # with {place}, {value}, {axis}, {detail}
    inverse: str = ""  # what else gives the same recording, with {channels}; empty: nothing
    parameter: tuple[str, str] | None = None  # name and unit of its value
    relative: bool = False  # the remaining fault is a share of its value
    ordinary: bool = False  # a fault of one sensor that screening tests: here only a rival
    model_free: bool = False  # known whatever the structure: stands even if nothing fits
    undo: Callable[[SetupPlace, float], changes.Undo] | None = None  # of a value
    remaining: Callable[[SetupPlace, CorrectedFit], tuple[ChangeEstimate, float]] | None = (
        None  # in units of the second value
    )
    law: StructureLaw | None = field(default=None, compare=False)  # the same in a system file, its variant the axis

    def undone(self, site: SetupPlace, value: float) -> changes.Undo:
        """The change that undoes a value of it."""
        assert self.undo is not None, f"{self.name} has no value"
        return self.undo(site, value)

    def further(self, value: float, change: float) -> float:
        """A value, corrected by the remaining fault."""
        return value * (1 + change) if self.relative else value + change

    def remainder(self, site: SetupPlace, change: float) -> changes.Undo:
        """The change that undoes the remaining fault, too."""
        return self.undone(site, 1 + change if self.relative else change)

    def describe(self, site: SetupPlace, value: str) -> str:
        """In words."""
        place, channels = (location.replace("|", " and ") for location in (site.location, site.inverse_at))
        sentence = self.sentence.format(place=place, value=value, axis="xy"[site.axis], detail=site.detail)
        return f"{sentence}; {self.inverse.format(channels=channels)}" if self.inverse and channels else sentence


@dataclass(frozen=True)
class Hypothesis:
    """A fault of the set-up and how to undo it."""

    effect: SetupEffect
    site: SetupPlace
    value: float | None  # time s, ratio, offset m
    misfit: float  # by spectra
    undo: changes.Undo
    by_mass: bool = False  # from frequencies above all modes: fitted whatever their rank by spectra
    unranked: bool = False  # the same under a measured force only, after ranked hypotheses

    @classmethod
    def of(
        cls, effect: SetupEffect, site: SetupPlace, value: float, misfit: float, by_mass: bool = False
    ) -> Hypothesis:
        """With a value, which the kind of fault knows how to undo."""
        return cls(effect, site, value, misfit, effect.undone(site, value), by_mass)


def _advanced(site: SetupPlace, late: float) -> changes.Undo:
    return changes.advance(site.group.sensors, site.group.supports, late, site.group.forces)


def _late(site: SetupPlace, fitted: CorrectedFit) -> tuple[ChangeEstimate, float]:
    one = fitted.response
    unit = _SMALL * one.step
    return fitted.scores.of(one.late(site.group, unit) - one.predicted), unit


def _rescaled(site: SetupPlace, ratio: float) -> changes.Undo:
    group = site.group
    return changes.scale(group.sensors, group.supports, ratio, group.forces)


def _scaled(site: SetupPlace, fitted: CorrectedFit) -> tuple[ChangeEstimate, float]:
    one = fitted.response
    return fitted.scores.of(one.scaled(site.group, 1 + _SMALL) - one.predicted), _SMALL


def _moved(
    move: Callable[[System, str, int, float], System], name: str, law: StructureLaw | None = None
) -> SetupEffect:
    """A position: of sensors or elements, each moved in its own way."""

    def undo(site: SetupPlace, offset: float) -> changes.Undo:
        return changes.in_system(lambda system: move(system, site.location, site.axis, offset))

    def remaining(site: SetupPlace, fitted: CorrectedFit) -> tuple[ChangeEstimate, float]:
        return fitted.scores.of_system(move(fitted.system, site.location, site.axis, NEAR)), NEAR

    words = "{place}: sits {value} along {axis} from where the system file says"
    return SetupEffect(name, words, parameter=("offset", "m"), undo=undo, remaining=remaining, law=law)


SIGN_REVERSED = SetupEffect(
    "sign_reversed", "{place}: the sign is reversed", inverse="{channels} reversed instead gives the same recording"
)
SIGN_REVERSED_BY_ONSET = SetupEffect(
    SIGN_REVERSED.name,
    "{place}: the sign is reversed, for as recorded {detail} first moves its own point backwards",
    SIGN_REVERSED.inverse,
    model_free=True,
)
CHANNELS_SWAPPED = SetupEffect("channels_swapped", "{place}: exchanged")
NODE_DELAY = SetupEffect(
    "node_delay",
    "{place}: all of them are late by {value}, as a whole node is",
    parameter=("time", "s"),
    undo=_advanced,
    remaining=_late,
)
WRONG_SCALE = SetupEffect(
    "wrong_scale",
    "{place}: {value} times what it should show, a wrong scale or unit",
    "{channels} off by the inverse instead gives the same recording",
    ("ratio", "1"),
    relative=True,
    undo=_rescaled,
    remaining=_scaled,
)
SENSOR_POSITION = _moved(changes.moved_sensor, "wrong_position")
ELEMENT_POSITION = _moved(changes.moved_element, WRONG_POSITION.name, WRONG_POSITION)
WRONG_BODY = SetupEffect("wrong_body", "{place}: is not fixed to what the system file says; its {detail} fits")
ONE_GAIN = SetupEffect(SENSOR_GAIN.name, relative=True, ordinary=True, undo=_rescaled, remaining=_scaled)
ONE_LAG = SetupEffect(SENSOR_LAG.name, ordinary=True, undo=_advanced, remaining=_late)
SETUP_EFFECTS = (
    SIGN_REVERSED, SIGN_REVERSED_BY_ONSET, CHANNELS_SWAPPED, NODE_DELAY, WRONG_SCALE,
    SENSOR_POSITION, ELEMENT_POSITION, WRONG_BODY,
)  # fmt: skip
