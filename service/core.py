"""The application without its interfaces: everything wired once, at start, from the settings."""

from __future__ import annotations

import asyncio
import gc
import logging
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial

from prometheus_client import Histogram

from sprung import __version__
from sprung.model.signal_filters import preload
from sprung.model.signals import Tally
from sprung.service.access.oidc import Provider, provider_of
from sprung.service.access.tokens import Tokens
from sprung.service.condition import Condition
from sprung.service.diagnosis.alarm_signals import AlarmSignals
from sprung.service.diagnosis.reports import Diagnoses, DiagnosisJobs
from sprung.service.fleet.ingest import Ingest
from sprung.service.fleet.statistics import FleetStatistics
from sprung.service.housekeeping import Housekeeping
from sprung.service.jobs.queue import Jobs, Kind
from sprung.service.jobs.recordings import RecordingJobs
from sprung.service.monitoring.batching import Batcher
from sprung.service.monitoring.board import Board
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.following import Following, follow
from sprung.service.monitoring.hub import Hub
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.monitoring.processed import Batch
from sprung.service.monitoring.rides import RideCollector, Rides
from sprung.service.monitoring.ring import Rings
from sprung.service.monitoring.views import VehicleView, vehicle_view
from sprung.service.notify.notices import Notices
from sprung.service.observability.metrics import Metrics
from sprung.service.observability.queues import WaitMetrics
from sprung.service.observability.vitals import Vitals, request_histogram
from sprung.service.operations import Operations
from sprung.service.processes.forked import ForkedFunctions
from sprung.service.settings import Settings
from sprung.service.sources.feed import OnTally
from sprung.service.sources.live import LiveFeed
from sprung.service.store import Store, fleet, open_store, status
from sprung.service.store.archive import Archive, open_archive
from sprung.service.store.windows import latest_window
from sprung.service.upload_room import UploadRoom

log = logging.getLogger("sprung")


@dataclass(slots=True)
class Core:
    """What the API, the pages and the feeds share."""

    settings: Settings
    engine: Engine
    store: Store
    compute: Compute
    beside: Compute  # of vehicles with a model of their own
    pipeline: Pipeline
    board: Board
    rides: Rides
    metrics: Metrics
    jobs: Jobs
    diagnoses: Diagnoses
    diagnosis_jobs: DiagnosisJobs
    alarm_signals: AlarmSignals
    housekeeping: Housekeeping
    hub: Hub
    condition: Condition
    operations: Operations
    batcher: Batcher
    notices: Notices
    tokens: Tokens
    stopping: threading.Event
    ingest: Ingest
    statistics: FleetStatistics
    upload_room: UploadRoom
    waits: WaitMetrics
    # vehicles' models are tried one after the other: each takes seconds of the interpreter that answers requests
    trying: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(1))
    archive: Archive | None = None
    oidc: Provider | None = None  # where people sign in beside their tokens
    feeds: list[LiveFeed] = field(default_factory=list)  # of live buses
    processes: Sequence[ForkedFunctions] = ()  # that identify and track
    requests: Histogram | None = None  # durations of requests

    def tally_counter(self, source: str) -> OnTally:
        """A callback that adds to `sprung_frames_total` what a source has read since the last call."""
        return tally_counter(self.metrics, source)

    def start(self) -> None:
        """Take up what was left, begin housekeeping."""
        self.housekeeping.clear_leftovers()
        self.pipeline.refresh_statuses()
        self.board.restore(stored_views(self))
        self.jobs.start()
        self.housekeeping.start()
        self.notices.start()
        self.ingest.start()
        preload()  # the first minute that ends would wait for it, and all windows behind it
        # what lives as long as the service is not looked through again: 320 000 objects, a pause for every client
        gc.collect()
        gc.freeze()

    def stop(self) -> None:
        """Begin to: nothing new is accepted; requests that wait for the store are answered before they are cut off."""
        self.store.leave_within(0.75 * self.settings.shutdown_seconds)
        self.stopping.set()

    def close(self) -> None:
        """Finish what was accepted, then let go of the store."""
        self.stopping.set()
        with ExitStack() as stack:  # in reverse order, each even when another fails
            stack.callback(self.store.close)
            stack.callback(self.batcher.close)
            stack.callback(self.compute.close)
            stack.callback(self.beside.close)
            stack.callback(self.jobs.close)
            stack.callback(self.housekeeping.close)
            stack.callback(self.notices.close)
            stack.callback(self.ingest.close)


def build_core(
    settings: Settings, engine: Engine, following: Following = follow, processes: Sequence[ForkedFunctions] = ()
) -> Core:
    """Wire the application; `following` feeds windows to trackers, `processes` are those in which numerics work.

    Raises UserError when the store cannot be opened.
    """
    store, archive = open_store(settings.store_url), open_archive(settings.archive)
    board = Board(engine, settings.vehicles_in_memory)
    metrics = Metrics(board, settings.parameter_series_vehicles, partial(fleet_counts, store))
    waits = WaitMetrics(metrics.registry)
    store.on_wait = waits.of("store")
    feeds: list[LiveFeed] = []
    notices = Notices(settings, store, lambda: [feed.status() for feed in feeds])
    compute, beside = (Compute(settings.compute_queue, waits.of(queue)) for queue in ("numerics", "own models"))
    listeners: list[Callable[[Batch], None]] = []
    housekeeping = Housekeeping(settings, store)
    pipeline = Pipeline(
        engine,
        store,
        compute,
        listeners,
        settings.vehicles_in_memory,
        on_alarms=notices.alarms,
        follow=following,
        beside=beside,
    )
    pipeline.aging = housekeeping.clock.read
    rings = Rings(settings.ring_vehicles, settings.ring_seconds, len(engine.system.channels), engine.system.sample_rate)
    alarm_signals = AlarmSignals(settings, store, rings, housekeeping.clock.read)
    rides, hub = Rides(settings.parameter_series_vehicles), Hub()
    metrics.registry.register(RideCollector(rides))
    diagnosis_jobs = DiagnosisJobs(settings, pipeline, on_report=notices.report)
    jobs = _jobs(settings, pipeline, metrics, diagnosis_jobs, waits)
    diagnoses = Diagnoses(settings, store, rings, jobs)
    listeners += [board.on_batch, lambda batch: metrics.observe(batch.seconds)]
    listeners += [rides.on_batch, diagnoses.on_batch, alarm_signals.on_batch, hub.on_batch]
    core = Core(
        settings=settings,
        engine=engine,
        store=store,
        compute=compute,
        beside=beside,
        pipeline=pipeline,
        board=board,
        rides=rides,
        metrics=metrics,
        jobs=jobs,
        diagnoses=diagnoses,
        diagnosis_jobs=diagnosis_jobs,
        alarm_signals=alarm_signals,
        housekeeping=housekeeping,
        hub=hub,
        condition=Condition(settings, store),
        operations=Operations(settings, pipeline, partial(_forget, (board, rides)), archive),
        batcher=_batcher(settings, pipeline, compute, beside, metrics),
        notices=notices,
        tokens=Tokens(store, None if settings.admin_token is None else settings.admin_token.get_secret_value()),
        stopping=threading.Event(),
        ingest=Ingest(pipeline, settings.late_seconds),
        statistics=FleetStatistics(engine, store, pipeline.model_id),
        upload_room=UploadRoom(settings, store),
        waits=waits,
        archive=archive,
        oidc=provider_of(settings),
        feeds=feeds,
        processes=processes,
    )
    return _observed(core)


def _forget(kept: Sequence[Board | Rides], vehicle: str) -> None:
    """Drop what is kept in memory of a vehicle."""
    for one in kept:
        one.forget(vehicle)


def _batcher(settings: Settings, pipeline: Pipeline, compute: Compute, beside: Compute, metrics: Metrics) -> Batcher:
    """Windows of many vehicles that arrive together; those of vehicles with a model of their own wait apart."""
    of_own_models = Batcher(pipeline, beside, settings.compute_queue, metrics.observe)
    return Batcher(pipeline, compute, settings.compute_queue, metrics.observe, of_own_models)


def _observed(core: Core) -> Core:
    """With metrics of the whole."""
    queues = {"batches": core.compute, "windows": core.batcher, "jobs": core.jobs}
    waiting = {name: partial(getattr, queue, "waiting") for name, queue in queues.items()}
    vitals = Vitals(
        __version__,
        core.engine.digest,
        lambda: [feed.status() for feed in core.feeds],
        waiting,
        lambda: [process.status for process in core.processes],
    )
    core.metrics.registry.register(vitals)
    core.requests = request_histogram(core.metrics.registry)
    return core


def _jobs(
    settings: Settings, pipeline: Pipeline, metrics: Metrics, diagnosis: DiagnosisJobs, waits: WaitMetrics
) -> Jobs:
    """The queue of jobs, with what runs each kind and how long it may take."""
    recordings = RecordingJobs(settings, pipeline, lambda: tally_counter(metrics, "upload"))
    kinds = {
        "recording": Kind(recordings.run, settings.recording_seconds),
        "diagnosis": Kind(diagnosis.run, settings.diagnosis_seconds),
    }
    return Jobs(pipeline.store, kinds, settings.job_queue, waits, pipeline.aging)


def tally_counter(metrics: Metrics, source: str) -> OnTally:
    """A callback that adds to `sprung_frames_total` what a source has read since the last call."""
    before = Tally()

    def count(now: Tally) -> None:
        nonlocal before
        metrics.count_frames(source, before, now)
        before = replace(now, reasons=now.reasons.copy())

    return count


def stored_views(core: Core) -> list[tuple[VehicleView, int]]:
    """Views of the vehicles heard from last and of all that are not well, and when they were heard from, oldest first.

    From the store.
    """
    views = []
    engines = core.pipeline.engines
    with core.store.read() as connection:
        models = engines.models_in_use(connection)
        recent = fleet.recent_vehicles(connection, models, core.settings.vehicles_in_memory)
        wanted = dict.fromkeys([*status.alarmed_vehicles(connection), *recent[::-1]])
        for vehicle in wanted:
            served = engines.of(connection, vehicle)
            row = fleet.load_tracker(connection, vehicle, served.model_id)
            listed = status.fleet_row(connection, vehicle)
            if row is not None and listed is not None and listed.retired_ns is None:
                last = latest_window(connection, vehicle, served.model_id)
                view = vehicle_view(served.engine, vehicle, served.engine.load_state(row.state), last)
                views.append((view, listed.received_ns))
    return sorted(views, key=lambda pair: pair[1])


def fleet_counts(store: Store) -> dict[str, int]:
    """Vehicles in service by health."""
    with store.read() as connection:
        return status.health_counts(connection, status.StatusFilter())
