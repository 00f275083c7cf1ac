"""The menu of runs that users edit: running on track at a speed, or signals of a test bench, with loads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import Field, ValidationError, model_validator

from sprung.model.address import Strict
from sprung.model.schema import SupportInput
from sprung.model.system import System

BUNDLED = Path(__file__).parents[1] / "systems" / "menu.yaml"
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class MenuError(ValueError):
    """A menu that cannot be used; one line."""


class TrackRun(Strict):
    """Running on a track of the ERRI B176 spectrum."""

    speed: Positive  # m/s
    level: Positive = 1.0  # times the power of the low-level track


class BenchSignal(Strict):
    """What a test bench does at the supports, m, or to forces, N."""

    kind: Literal["sine", "sweep", "noise"]
    amplitude: Positive  # of a sine or sweep; rms of noise
    frequency: Positive  # Hz, of a sweep or noise the lowest
    to: Positive | None = None  # Hz, the highest
    inputs: tuple[str, ...] = ()  # that move, all alike; empty: all

    @model_validator(mode="after")
    def _has_a_band(self) -> BenchSignal:
        if self.kind != "sine" and (self.to is None or self.to <= self.frequency):
            raise ValueError(f"a {self.kind} goes from `frequency` up `to` a higher one")
        return self


class MenuRun(Strict):
    """One run of the menu."""

    track: TrackRun | None = None
    signal: BenchSignal | None = None
    seconds: Annotated[float, Field(gt=0, le=600)] = 10.0
    load: dict[str, float] = Field(default_factory=dict)  # kg more in a body, its inertias in proportion
    cost: Positive = 1.0  # in any unit; runs are compared by evidence per cost

    @model_validator(mode="after")
    def _is_one_thing(self) -> MenuRun:
        if (self.track is None) == (self.signal is None):
            raise ValueError("give either `track` or `signal`")
        return self


class Menu(Strict):
    """Runs by name."""

    runs: Annotated[dict[str, MenuRun], Field(min_length=1, max_length=200)]


def read_menu(path: Path) -> Menu:
    """A menu from a YAML file.  Errors: `MenuError`, OSError."""
    try:
        return Menu.model_validate(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise MenuError(f"{path}: not YAML: {' '.join(str(error).split())[:200]}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise MenuError(f"{path}: {where}: {first['msg'].removeprefix('Value error, ')}") from error


def check_menu(menu: Menu, system: System) -> None:
    """Refuse runs that a system cannot have.  Errors: `MenuError`."""
    supports = [name for name, source in system.file.inputs.items() if isinstance(source, SupportInput)]
    for name, run in menu.runs.items():
        _known(f"{name}: load", run.load, list(system.file.bodies))
        if run.signal is not None:
            _known(f"{name}: inputs", run.signal.inputs, list(system.file.inputs))
        elif not supports:
            raise MenuError(f"{name}: {system.name} has no moving support, so it runs on no track; give a signal")
        if run.seconds * system.sample_rate < 2 * system.window:
            raise MenuError(f"{name}: {run.seconds:g} s are less than two windows of {system.name}")
        for body, more in run.load.items():
            if system.file.bodies[body].mass.value + more <= 0:
                raise MenuError(f"{name}: load: {body} would weigh nothing")


def _known(where: str, names: Sequence[str] | dict[str, float], known: list[str]) -> None:
    for name in names:
        if name not in known:
            raise MenuError(f"{where}: {name!r} is none of {', '.join(known)}")
