"""Live windows on Ray Serve: a door, identification batched over vehicles, folding in one transaction a batch.

Three deployments, each with as many replicas as its queue asks for.  None holds anything that the store does not: a
replica that dies loses only unacknowledged requests, which their senders repeat.
"""

from __future__ import annotations

import asyncio
import http.client
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from sprung.model.signals import Estimate, FloatArray
from sprung.service.api.live_ingest import ingest_app
from sprung.service.errors import Busy, UserError
from sprung.service.fleet.ingest import Ingest, Taken, read_messages
from sprung.service.fleet.message import Message, SentWindows, WindowEstimate
from sprung.service.fleet.tasks import start_ray
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import load_engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.processes.threads import one_thread_each
from sprung.service.settings import Settings, settings_with
from sprung.service.store import open_store

APPLICATION = "sprung"
BUSY_BATCHES = 1.5  # of one replica, at work and waiting, beyond which another one is started
PROBE_SECONDS = 2.0
PROBE_TIMEOUT = 10.0  # s: a machine that is busy answers late
SILENT_PROBES = 5
ABANDON_SECONDS = 10.0


@dataclass(frozen=True, slots=True)
class ServingSizes:
    """How much, at most."""

    replicas: int = 8  # of each of the two that compute
    cores: float = 1.0  # of a replica that identifies
    batch_windows: int = 32
    batch_messages: int = 64
    batch_wait_seconds: float = 0.02
    queued: int = 256  # requests for each replica that wait; more are 429


class IdentifyReplica:
    """Windows of any vehicles -> estimates."""

    def __init__(self, settings: Settings) -> None:
        one_thread_each()
        self._engine = load_engine(settings)

    async def identify(self, starts: list[int], values: FloatArray) -> list[Estimate]:
        """The estimates of windows, values (B, T, C)."""
        return (await asyncio.to_thread(self._engine.identify, values, starts=starts))[0]


class FoldReplica:
    """Messages of any vehicles -> trackers and store."""

    def __init__(self, settings: Settings) -> None:
        one_thread_each()
        store = open_store(settings.store_url)
        pipeline = Pipeline(load_engine(settings), store, Compute(1), vehicles_in_memory=settings.vehicles_in_memory)
        self._ingest = Ingest(pipeline, settings.late_seconds)
        self._ingest.start()

    async def fold(self, messages: Sequence[Message]) -> list[Taken | UserError]:
        """What became of each message; they are stored, but for those with an error."""
        return await asyncio.to_thread(self._fold, messages)

    def _fold(self, messages: Sequence[Message]) -> list[Taken | UserError]:
        try:
            return list(self._ingest.take(messages))
        except UserError as error:  # one of them spoils it for the others
            return [error] if len(messages) == 1 else [self._fold([one])[0] for one in messages]


class RayBehind:
    """What the door sees of the two.  Requests are put together here: a call costs more than a window's identification,
    so that one carries the windows, or the messages, of all that ask at a time."""

    def __init__(self, identify: Any, fold: Any, digest: str, sizes: ServingSizes, batch: Callable[..., Any]) -> None:
        """identify, fold: handles of the deployments; batch: `serve.batch`, which runs in a replica only."""
        self._identify = identify
        self._fold = fold
        self._digest = digest
        self._waiting, self._most = 0, sizes.queued * sizes.replicas
        # one more than there are replicas, so that none waits for the next; more, and batches stay small
        wait = {"batch_wait_timeout_s": sizes.batch_wait_seconds, "max_concurrent_batches": sizes.replicas + 1}
        self._identified = batch(max_batch_size=sizes.batch_windows, **wait)(self._identify_together)
        self._folded = batch(max_batch_size=sizes.batch_messages, **wait)(self._fold_together)

    async def fold(self, body: bytes) -> Taken:
        """Fold a message."""
        with self._place():
            return await self._fold_one((await asyncio.to_thread(read_messages, [body]))[0])

    async def identify_and_fold(self, sent: SentWindows) -> Taken:
        """Identify windows, together with those of others, and fold them together."""
        with self._place():
            ways = [self._identified(one) for one in zip(sent.starts, sent.values, strict=True)]
            estimates: list[Estimate] = await asyncio.gather(*ways)
            found = zip(sent.starts, estimates, strict=True)
            windows = tuple(WindowEstimate(start, "used", None, 0, False, estimate) for start, estimate in found)
            return await self._fold_one(Message(sent.vehicle, self._digest, windows))

    @contextmanager
    def _place(self) -> Iterator[None]:
        """One of those who wait.  Raises Busy when there are too many."""
        if self._waiting >= self._most:
            raise Busy("too many requests wait; try again in a second")
        self._waiting += 1
        try:
            yield
        finally:
            self._waiting -= 1

    async def _fold_one(self, message: Message) -> Taken:
        taken: Taken | UserError = await self._folded(message)
        if isinstance(taken, UserError):
            raise taken
        return taken

    async def _identify_together(self, asked: list[tuple[int, FloatArray]]) -> list[Estimate]:
        starts, values = [start for start, _ in asked], np.stack([values for _, values in asked])
        found: list[Estimate] = await _asked(self._identify.identify.remote(starts, values))
        return found

    async def _fold_together(self, messages: list[Message]) -> list[Taken | UserError]:
        found: list[Taken | UserError] = await _asked(self._fold.fold.remote(messages))
        return found


async def _asked(pending: Any) -> Any:
    from ray.exceptions import RayTaskError

    try:
        return await pending
    except RayTaskError as error:
        raise error.cause from None


def application(settings: Settings, sizes: ServingSizes) -> Any:
    """The Serve application: `serve.run(application(...))`."""
    from ray import serve

    scaling = {"min_replicas": 1, "max_replicas": sizes.replicas, "target_ongoing_requests": BUSY_BATCHES}
    shared: dict[str, Any] = {
        "autoscaling_config": scaling,
        "max_ongoing_requests": 1,  # batches: they compute
        "health_check_period_s": 5,
        "graceful_shutdown_timeout_s": settings.shutdown_seconds,
    }
    cores = {"num_cpus": sizes.cores}
    identify = serve.deployment(IdentifyReplica, name="identify", ray_actor_options=cores, **shared)
    fold = serve.deployment(FoldReplica, name="fold", ray_actor_options={"num_cpus": sizes.cores / 2}, **shared)

    def build() -> Any:
        """The door's ASGI application; runs in its replica."""
        engine = load_engine(settings)
        behind = RayBehind(
            serve.get_deployment_handle("identify", APPLICATION),
            serve.get_deployment_handle("fold", APPLICATION),
            engine.digest,
            sizes,
            serve.batch,
        )
        return ingest_app(settings, engine, open_store(settings.store_url), behind)

    class Door:
        """Authenticates requests, reads their bodies, passes them on."""

        def __init__(self, *after: Any) -> None:
            """after: deployments that are started before it."""

    door = serve.deployment(
        serve.ingress(build)(Door),
        name="door",
        num_replicas=1,
        ray_actor_options={"num_cpus": sizes.cores / 4},
        max_ongoing_requests=8 * sizes.queued,
    )
    return door.bind(identify.bind(settings), fold.bind(settings))


def start(
    settings: Settings, sizes: ServingSizes, host: str, port: int, address: str | None, cores: int | None
) -> None:
    """Serve on the cluster at `address`, or on a Ray that is started here; returns when requests are taken."""
    try:
        import ray
        from ray import serve
    except ModuleNotFoundError as error:
        raise UserError("Ray is not installed: pip install 'sprung[fleet]'") from error
    if address:
        ray.init(address=address)
    else:
        start_ray(cores)
    serve.start(http_options={"host": host, "port": port})
    serve.run(application(settings, sizes), name=APPLICATION, route_prefix="/")


def stop() -> None:
    """Answer pending requests, then leave the cluster, or end the one that was started here.

    Only the application goes: a cluster may serve others, and Serve itself ends with its Ray.
    """
    import ray
    from ray import serve

    serve.delete(APPLICATION)
    ray.shutdown()


def abandon() -> None:
    """End what was started here without answers; waits for Ray only briefly."""
    import ray

    leaving = threading.Thread(target=ray.shutdown, daemon=True)
    leaving.start()
    leaving.join(ABANDON_SECONDS)


def watch(stopping: threading.Event, host: str, port: int, own: bool) -> bool:
    """Wait until `stopping` is set: true; or until nobody takes requests any more, or the head of a Ray that was
    started here is gone: false.  Whoever started the process then starts it anew."""
    import ray

    head_host, _, head_port = ray.get_runtime_context().gcs_address.rpartition(":")
    silent = 0
    while not stopping.wait(PROBE_SECONDS):
        if own and not _listens(head_host, int(head_port)):
            return False
        silent = 0 if _answers(host, port) else silent + 1
        if silent >= SILENT_PROBES:
            return False
    return True


def _answers(host: str, port: int) -> bool:
    connection = http.client.HTTPConnection("127.0.0.1" if host == "0.0.0.0" else host, port, timeout=PROBE_TIMEOUT)
    try:
        connection.request("GET", "/health/live")
        return connection.getresponse().status < 500
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()


def _listens(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), PROBE_TIMEOUT).close()
    except OSError:
        return False
    return True


def from_environment(arguments: dict[str, str]) -> Any:
    """The application as `import_path` of a Serve configuration: settings from SPRUNG_..., sizes from its `args`."""
    sizes = ServingSizes(replicas=int(arguments.get("replicas", 8)), cores=float(arguments.get("cores", 1.0)))
    return application(settings_with({}), sizes)
