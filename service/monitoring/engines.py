"""Which model a vehicle's windows are identified with: the service's system file, or one of the vehicle's own."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

from cachetools import LRUCache, TTLCache
from sqlalchemy import Connection

from sprung.model.schema import SystemFile
from sprung.model.system import System, parse_system
from sprung.model.systemfile import parse_system_file
from sprung.service.errors import UserError
from sprung.service.monitoring.engine import OWN_SECONDS, Engine, engine_like, seconds_of_a_window
from sprung.service.store import Store, vehicle_models
from sprung.service.store.vehicle_models import SERVICE_FILE

log = logging.getLogger("sprung.engine")
LATELY_SECONDS = 10.0  # for which it is taken for granted that nobody gave a vehicle another model
MOST_LATELY = 10_000  # vehicles
MOST_LAWS = 12  # in a vehicle's own file: a window with twice as many takes ten seconds
MOST_BODIES = 20  # and four times as many elements, where the service's file has no more itself
KEPT = 16  # engines of single vehicles in memory; one that is asked for again is loaded in a second


@dataclass(frozen=True, slots=True)
class ServedModel:
    """What one vehicle's windows are identified with, and where they are stored."""

    version: int  # 0: the service's own system file
    engine: Engine
    model_id: int  # row of `models`


Make = Callable[[Engine, System], Engine]


class Engines:
    """Engines by vehicle, as many in memory as `kept`.  Safe to share between threads."""

    def __init__(
        self, shared: Engine, model_id: int, own: bool = True, kept: int = KEPT, make: Make = engine_like
    ) -> None:
        """shared: of the service's system file; own: whether vehicles may have another one (a back-fill's may not)."""
        self._make = make
        self.shared = ServedModel(SERVICE_FILE, shared, model_id)
        self._own = own
        self._held: LRUCache[tuple[str, int], ServedModel] = LRUCache(kept)
        self._lately: TTLCache[str, ServedModel] = TTLCache(MOST_LATELY, LATELY_SECONDS)
        self._broken: dict[tuple[str, int], str] = {}
        self._lock = threading.Lock()

    def of(self, connection: Connection, vehicle: str) -> ServedModel:
        """What the vehicle's windows are identified with now.

        A version that cannot be used any more, since the service's system file has become another one, is logged and
        the service's file takes its place.
        """
        served = self._usable(connection, vehicle)
        self._note({vehicle: served})
        return served

    def of_all(self, connection: Connection, vehicles: Collection[str]) -> dict[str, ServedModel]:
        """As `of`, for several: only those that were ever given a model of their own are asked for one by one."""
        own = vehicle_models.with_own_models(connection, vehicles) if self._own else set()
        found = {v: self._usable(connection, v) if v in own else self.shared for v in vehicles}
        self._note(found)
        return found

    def _note(self, found: Mapping[str, ServedModel]) -> None:
        with self._lock:
            self._lately.update(found)

    def lately(self, store: Store, vehicle: str) -> ServedModel:
        """As `of`, out of memory where that was asked a few seconds ago.

        For identifying only: whoever stores looks again in his transaction (`ModelChanged`).
        """
        with self._lock:
            served = self._lately.get(vehicle)
        if served is not None:
            return served
        with store.read() as connection:
            return self.of(connection, vehicle)

    def _usable(self, connection: Connection, vehicle: str) -> ServedModel:
        version = vehicle_models.current_version(connection, vehicle) if self._own else SERVICE_FILE
        try:
            return self.version(connection, vehicle, version)
        except UserError as error:
            with self._lock:
                if self._broken.get((vehicle, version)) != str(error):
                    log.error("%s; the service's system file is used instead", error)
                self._broken[vehicle, version] = str(error)
            return self.shared

    def version(self, connection: Connection, vehicle: str, version: int) -> ServedModel:
        """One version of a vehicle's.  Raises UserError where there is none, or it does not belong to this service."""
        if version == SERVICE_FILE:
            return self.shared
        with self._lock:
            held = self._held.get((vehicle, version))
        if held is not None:
            return held
        row = vehicle_models.get_version(connection, vehicle, version)
        text = vehicle_models.text_of(connection, vehicle, version)
        if row is None or text is None:
            raise UserError(f"vehicle {vehicle} has no model {version}")
        served = ServedModel(version, self.made(text, f"model {version} of vehicle {vehicle}"), row.model_id)
        self.remember(vehicle, served)
        return served

    def remember(self, vehicle: str, served: ServedModel) -> None:
        """Keep an engine for the next time."""
        with self._lock:
            self._held[vehicle, served.version] = served

    def made(self, text: str, what: str) -> Engine:
        """The engine of a system file's text.  Raises UserError where it is not one of the same measurements."""
        return self._made(text, what).placed()

    def _made(self, text: str, what: str) -> Engine:
        """As `made`, in this process."""
        shared = self.shared.engine.system
        try:
            self._not_too_large(parse_system_file(text, what), what)
            system = parse_system(text, what, shared.catalogue)
        except ValueError as error:
            reason = str(error)
            raise UserError(reason if reason.startswith(what) else f"{what}: {reason}") from error
        differing = _differing(shared, system)
        if differing:
            raise UserError(f"{what}: {differing} of the service's system file are other ones")
        if len(system.laws) > MOST_LAWS:
            raise UserError(f"{what}: {len(system.laws)} laws; windows can be identified with {MOST_LAWS} at most")
        try:
            return self._make(self.shared.engine, system)
        except ValueError as error:  # a law that windows cannot hold
            raise UserError(f"{what}: {error}") from error

    def tried(self, text: str, what: str) -> Engine:
        """As `made`, for a file that is new: one simulated window is identified.

        Raises UserError also where that takes too long.
        """
        engine = self._made(text, what)
        seconds = seconds_of_a_window(engine)
        if seconds > OWN_SECONDS:
            raise UserError(
                f"{what}: a window takes longer than {OWN_SECONDS:g} s of processor time; leave laws or bodies out"
            )
        return engine.placed()

    def _not_too_large(self, file: SystemFile, what: str) -> None:
        """Before anything is calculated, which takes the cube of a system's size."""
        shared = self.shared.engine.system.file
        bodies = max(MOST_BODIES, len(shared.bodies))
        if len(file.bodies) > bodies or len(file.elements) > 4 * bodies:
            raise UserError(f"{what}: more than {bodies} bodies, or {4 * bodies} elements")

    def models_in_use(self, connection: Connection) -> Sequence[int]:
        """Rows of `models` under which windows of this service are stored, the shared one first."""
        own = vehicle_models.own_model_ids(connection) if self._own else []
        return list(dict.fromkeys([self.shared.model_id, *own]))


def _differing(one: System, other: System) -> str | None:
    """What is measured in another way; recordings are read, and samples held, by the service's system file."""
    pairs = {
        "channels": ([c.name for c in one.channels], [c.name for c in other.channels]),
        "signals beside": ([c.name for c in one.auxiliary], [c.name for c in other.auxiliary]),
        "sample rate": (one.sample_rate, other.sample_rate),
        "window": (one.window, other.window),
        "hop": (one.hop, other.hop),
    }
    return next((name for name, (a, b) in pairs.items() if a != b), None)
