"""The model side of the service, loaded once: system, identifier and tracker, and what the store keeps of them."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sprung.model.identification.measurements.deviations import deviations
from sprung.model.identifier import Identifies
from sprung.model.signals import Estimate, FloatArray, MeasurementFault
from sprung.model.system import MANCHESTER, System, load_system
from sprung.model.tracking.load_alarms import LoadLimit
from sprung.model.tracking.tracker import Tracker, TrackerSettings, TrackerState, TrackerStateError
from sprung.service.can_database import database_of
from sprung.service.errors import UserError
from sprung.service.monitoring.form import WindowForm
from sprung.service.monitoring.signed import check_signature
from sprung.service.settings import Settings

# one window of so many is weighed for gains and delays, which costs as much as a refinement: enough to tell a gain of
# 2 % in a minute
WEIGHED_OF = 2
OWN_SECONDS = 10.0  # of processor time for a window of a vehicle with a model of its own
_SCATTERED = 2654435761  # 2^32 over the golden ratio (Knuth): neighbours fall far apart

log = logging.getLogger("sprung.engine")


def in_this_process(system: System, identifier: Identifies) -> Identifies:
    """Where the identifier of a vehicle's own model works, if the service has no process for it."""
    return identifier


@dataclass(frozen=True, slots=True)
class Engine:
    """Everything that turns windows into tracked parameters."""

    system: System
    identifier: Identifies
    tracker: Tracker
    dbc: Path | None = None
    weighed_of: int = WEIGHED_OF  # windows, one is weighed for gains, delays and loads
    place: Callable[[System, Identifies], Identifies] = in_this_process  # identifiers of vehicles' own models

    @property
    def digest(self) -> str:
        """The key of the model under which estimates are stored."""
        return self.identifier.digest

    @property
    def form(self) -> WindowForm:
        """What its windows look like."""
        system = self.system
        channels, inputs = (tuple(channel.name for channel in some) for some in (system.channels, system.inputs))
        return WindowForm(
            self.digest,
            system.name,
            system.sample_rate,
            system.window,
            channels,
            inputs,
            tuple(system.sensors),
            system.needed,
        )

    def description(self) -> dict[str, Any]:
        """What the store must know to read its arrays without this code."""
        return {
            "parameters": [{"name": p.name, "unit": p.unit, "nominal": p.nominal} for p in self.system.tracked],
            "sensors": list(self.system.sensors),
            "window": self.system.window,
            "sample_rate": self.system.sample_rate,
            "structure": self.system.structure,
        }

    def identify(
        self,
        values: FloatArray,
        states: bool = False,
        loads: bool = False,
        starts: Sequence[int] | None = None,
        known: Sequence[tuple[MeasurementFault, ...]] = (),
    ) -> tuple[list[Estimate], dict[str, float]]:
        """Estimates of windows, values of shape (B, T, C), and the seconds they took by stage.

        loads: what the vehicle carries is refined along even where its file does not declare it.
        starts: ns, of windows that will be tracked: measurements that are wrong are looked for, too.
        known: of each such window, `Tracker.known_faults` of its vehicle, which spares looking for these anew.
        """
        if starts is None:
            estimates = self.identifier.identify(values, states=states, loads=loads)
        else:
            weigh = np.array([self._weighed(start) for start in starts])
            estimates = self.identifier.examine(values, weigh, known)
        times = self.identifier.times
        return estimates, {"estimate": times.estimate, "refine": times.refine}

    def _weighed(self, start: int) -> bool:
        """Whether a window's evidence on gains and delays is computed: one of `weighed_of`."""
        number = start // round(self.tracker.settings.hop * 1e9)
        return bool(number * _SCATTERED % 2**32 < 2**32 // self.weighed_of)

    def placed(self) -> Engine:
        """The same, of a vehicle's own model, where the service identifies those."""
        return replace(self, identifier=self.place(self.system, self.identifier))

    def load_state(self, data: dict[str, Any]) -> TrackerState:
        """A stored tracker state; one that cannot be read starts anew rather than stopping the service."""
        try:
            return self.tracker.upgraded(TrackerState.from_dict(data))
        except TrackerStateError as error:
            log.warning("a stored tracker state cannot be read (%s); the vehicle's baseline is learned anew", error)
            return self.tracker.initial_state()


def one_thread_an_operation() -> None:
    """Have torch split none: batches are shared among workers instead, and single operations are too small.

    In a process that was forked this comes before its first thread: there torch makes its threads anew when they are
    first needed, and two threads that need them at the same moment fail ("Invalid thread pool", torch 2.13).
    """
    import torch

    torch.set_num_threads(1)


def load_engine(settings: Settings) -> Engine:
    """Load the system file and the trained estimator that belongs to it.

    Raises UserError, or the model's own one-line ValueErrors, when one of them cannot be used.
    """
    # takes a second; a bad system file is reported before
    from sprung.model.identification.identify import load_identifier, without_weights

    one_thread_an_operation()
    path = settings.system or MANCHESTER
    system = load_system(path)
    if not system.bodies:
        raise UserError(
            f"{path}: a component test has no bodies, so nothing to follow from window to window; "
            f"`sprung diagnose FILE --system {path}` identifies it from a whole recording"
        )
    if not system.tracked:
        raise UserError(f"{path}: estimates nothing; name stiffness, damping or mass under `estimate`")
    if settings.weights is not None and (reason := without_weights(system)):
        log.warning("%s: these weights are not used: %s", settings.weights, reason)
    if settings.weights is not None and settings.weights_key is not None:
        check_signature(settings.weights, settings.weights_key)
    return Engine(
        system,
        load_identifier(system, settings.weights, workers=os.cpu_count() or 1),
        make_tracker(system),
        database_of(system, settings.dbc),
    )


def engine_like(engine: Engine, system: System) -> Engine:
    """An engine of another system file with the same measurements, which works in this process.

    Raises the model's one-line ValueErrors for a system whose windows cannot be identified.
    """
    return replace(engine, system=system, identifier=own_identifier(system), tracker=make_tracker(system))


def own_identifier(system: System) -> Identifies:
    """The identifier of a vehicle's own system file.

    Raises the model's one-line ValueErrors for a system whose windows cannot be identified.
    """
    from sprung.model.identification.identify import load_identifier  # brings torch

    # one worker: the other processors are for vehicles without such a file
    return load_identifier(system, seconds=OWN_SECONDS)


def seconds_of_a_window(engine: Engine) -> float:
    """Processor time that one simulated window takes an engine that works in this process; 0 for systems without
    measured inputs."""
    from sprung.model.identification.excitation import simulate_runs  # brings torch

    system = engine.system.whole_system
    if system.on_track or not system.file.inputs:
        return 0.0
    runs = simulate_runs(system, np.zeros((1, len(system.parameters))), system.window, np.random.default_rng(0))
    begin = time.thread_time()
    engine.identify(runs.values, starts=[0])
    return time.thread_time() - begin


def make_tracker(system: System) -> Tracker:
    """The tracker of a system, with its window and hop."""
    rate = system.sample_rate
    settings = TrackerSettings(window=system.window / rate, hop=system.hop / rate)
    limits = {load.body: LoadLimit(load.empty, load.least, load.most) for load in system.loads if load.declared}
    elements = system.file.elements.items()
    masses = {body: tuple(n for n, e in elements if body in (e.upper, e.lower)) for body in system.built}
    return Tracker(
        system.tracked,
        settings,
        deviations(system),
        limits=limits,
        model_uncertainty=_model_uncertainty(system),
        masses=masses,
    )


def _model_uncertainty(system: System) -> tuple[FloatArray, FloatArray] | None:
    """Systematic variances of parameters, and covariance of gains, delays and loads, from masses, positions and laws;
    None: there are none."""
    from sprung.model.identification.model_uncertainty import model_uncertainty  # brings torch

    found = model_uncertainty(system, loads=True, tracked=True)
    return None if found.none else (np.diag(found.parameters), found.deviations)
