"""A tiny strict identifier and the windows that it reads."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sprung.model.identifier import StageTimes
from sprung.model.signals import BoolArray, Estimate, FloatArray, MeasurementFault, Window
from sprung.model.system import System
from sprung.service.diagnosis.task import DiagnosisRequest, DiagnosisResult, Stage
from sprung.service.processes.worker import Emit

START = 1_790_000_000_000_000_000  # ns
HOP = 500_000_000  # ns
STANDING = 9.0  # the level of windows that tell nothing


@dataclass
class FakeIdentifier:
    """Reads log-ratios off the window: parameter i is the mean of channel i.  Refuses what the real one refuses."""

    system: System
    digest: str = "fake-1"
    times: StageTimes = field(default_factory=lambda: StageTimes(0.001, 0.002))
    identified: int = 0
    std: float = 0.01
    chi_square: float = 1.0

    def identify(
        self, windows: FloatArray, start: FloatArray | None = None, *, states: bool = False, loads: bool = False
    ) -> list[Estimate]:
        assert windows.ndim == 3 and windows.shape[2] == len(self.system.channels), windows.shape
        inputs = len(self.system.inputs)
        assert all(np.isfinite(window[:, :inputs]).any() for window in windows), "every input is missing"
        self.identified += len(windows)
        return [self._one(window, states) for window in windows]

    def examine(
        self, windows: FloatArray, weigh: BoolArray, known: Sequence[tuple[MeasurementFault, ...]] = ()
    ) -> list[Estimate]:
        return self.identify(windows)

    def _one(self, window: FloatArray, states: bool) -> Estimate:
        count, sensors = len(self.system.parameters), len(self.system.sensors)
        mean = np.nan_to_num(window.mean(axis=0))
        log_ratio = np.array([mean[i % len(mean)] for i in range(count)])
        standing = bool((mean == STANDING).all())
        absent = np.isnan(window[:, -sensors:]).any(axis=0)
        return Estimate(
            log_ratio=log_ratio,
            covariance=self.std**2 * np.eye(count),
            identifiable=np.ones(count, dtype=bool),
            nrmse=0.49 if standing else 0.03,
            per_sensor=np.where(absent, np.nan, 0.03),
            chi_square=self.chi_square,
            adequate=self.chi_square < 2,
            informative=not standing,
            converged=True,
            iterations=2,
            states=np.zeros((len(window), 2 * len(self.system.mechanics.dofs))) if states else None,
            outputs=np.zeros((len(window), sensors)) if states else None,
        )


@dataclass
class FakeExaminer(FakeIdentifier):
    """Finds two exchanged channels in every window that is to be tracked, and notes what it was told of before."""

    faults: tuple[MeasurementFault, ...] = (MeasurementFault("car_1l|car_1r", "swapped", 0.0),)
    told: list[tuple[MeasurementFault, ...]] = field(default_factory=list)

    def examine(
        self, windows: FloatArray, weigh: BoolArray, known: Sequence[tuple[MeasurementFault, ...]] = ()
    ) -> list[Estimate]:
        assert len(windows) == len(weigh) == len(known)
        self.told += known
        return [replace(estimate, faults=self.faults) for estimate in self.identify(windows)]


@dataclass
class BelievingExaminer(FakeExaminer):
    """As that; faults that are known change what it finds beside."""

    def examine(
        self, windows: FloatArray, weigh: BoolArray, known: Sequence[tuple[MeasurementFault, ...]] = ()
    ) -> list[Estimate]:
        found = super().examine(windows, weigh, known)
        return [replace(one, log_ratio=one.log_ratio + 0.01 * len(k)) for one, k in zip(found, known, strict=True)]


def make_window(system: System, number: int, level: float = 0.0, outcome: str = "used") -> Window:
    """Window `number` of a vehicle whose parameters are all exp(level) times nominal, as the fake reads it."""
    values = np.full((system.window, len(system.channels)), level)
    reason = "gap" if outcome == "dropped" else None
    return Window(START + number * HOP, system.sample_rate, values, outcome, reason)  # type: ignore[arg-type]


REPORT: dict[str, Any] = {
    "system": "x",
    "recording": {"file": "x", "seconds": 5.0, "samples": 500, "lost": 0},
    "verdict": "missing_physics",
    "findings": [{"location": "secondary_1r", "effect": "coulomb_friction", "sentence": "secondary_1r: dry friction"}],
}


def diagnose(request: DiagnosisRequest, emit: Emit[Stage]) -> DiagnosisResult:
    """A diagnosis that takes no time: does what the recording's name asks for, else answers REPORT."""
    emit(Stage(0.5, "half way"))
    if "short" in request.name:
        raise ValueError(f"{request.name}: too short to tell")
    if "wrong" in request.name:
        raise KeyError("a mistake of ours")
    if "deadly" in request.name:
        os.kill(os.getpid(), signal.SIGKILL)
    if "endless" in request.name:
        time.sleep(600)
    request.out.mkdir(parents=True)
    (request.out / "report.html").write_text("<p>the page</p>")
    return DiagnosisResult("missing_physics", REPORT)


def eventually(check: Callable[[], Any], seconds: float = 30.0) -> Any:
    """The first true value of `check`; fails after a while."""
    deadline, wait = time.monotonic() + seconds, 0.01
    while not (found := check()):
        assert time.monotonic() < deadline, "nothing happened"
        time.sleep(wait)
        wait = min(1.5 * wait, 0.2)  # asking takes the time of what is waited for
    return found


def hold(started: threading.Event, release: threading.Event) -> None:
    """Keep the thread that runs it busy until `release`."""
    started.set()
    release.wait()
