"""Live windows on Ray Serve: a door, identification batched over vehicles, folding in one transaction a batch.

Two deployments: the door, and replicas that identify and fold, as many as their queue asks for.  None holds anything
that the store does not: a replica that dies loses only unacknowledged requests, which their senders repeat.
"""

from __future__ import annotations

import http.client
import logging
import threading
import time
from typing import Any

from sprung.service.errors import UserError
from sprung.service.fleet.ray_head import RayHead
from sprung.service.fleet.ray_replicas import ComputeReplica
from sprung.service.fleet.serving_sizes import ServingSizes
from sprung.service.processes.imports import lasting_imports
from sprung.service.settings import Settings, settings_with
from sprung.service.store import open_store

log = logging.getLogger("sprung.ray")
APPLICATION, COMPUTE = "sprung", "compute"
AT_ONCE = 2  # batches of one replica: what it identifies, and what it folds while the database keeps it waiting
BUSY_BATCHES = 2.5  # of one replica, at work and waiting, beyond which another one is started
HEALTH_SECONDS = 1.0  # a replica that died is missed after that
PROBE_SECONDS = 0.5
PROBE_TIMEOUT = 10.0  # s: a machine that is busy answers late
SILENT_SECONDS = 10.0  # without an answer
ABANDON_SECONDS = 10.0


def application(settings: Settings, sizes: ServingSizes, migrated: bool = False) -> Any:
    """The Serve application: `serve.run(application(...))`; migrated: the store has been."""
    from ray import serve

    least = min(sizes.least, sizes.replicas)
    scaling = {
        "min_replicas": least,
        "max_replicas": sizes.replicas,
        "target_ongoing_requests": BUSY_BATCHES,
        "upscale_delay_s": sizes.more_after_seconds,
        "downscale_delay_s": sizes.fewer_after_seconds,
    }
    watched: dict[str, Any] = {
        "health_check_period_s": HEALTH_SECONDS,
        "graceful_shutdown_timeout_s": settings.shutdown_seconds,
    }
    deployment: Any = serve.deployment
    compute = deployment(
        ComputeReplica,
        name=COMPUTE,
        ray_actor_options={"num_cpus": sizes.cores},
        autoscaling_config=scaling,
        max_ongoing_requests=AT_ONCE,
        **watched,
    )

    def build() -> Any:
        """The door's ASGI application; runs in its replica, and what it needs is imported there alone."""
        with lasting_imports():
            from sprung.service.api.live_ingest import ingest_app
            from sprung.service.fleet.ray_behind import RayBehind

        behind = RayBehind(serve.get_deployment_handle(COMPUTE, APPLICATION), sizes, serve.batch)
        return ingest_app(settings, open_store(settings.store_url, migrated), behind)

    class Door:
        """Authenticates requests, reads their bodies, passes them on."""

        def __init__(self, *after: Any) -> None:
            """after: deployments that are started before it."""

    door = deployment(
        serve.ingress(build)(Door),
        name="door",
        num_replicas=1,
        ray_actor_options={"num_cpus": sizes.cores / 4},
        max_ongoing_requests=8 * sizes.queued,
        **watched,
    )
    return door.bind(compute.bind(settings, migrated))


def start(
    settings: Settings, sizes: ServingSizes, host: str, port: int, address: str | None, cores: int | None
) -> RayHead | None:
    """Serve on the cluster at `address`, or on a Ray that is started here; returns when requests are taken.

    The store must have been migrated.  The head of a Ray that was started here.
    """
    try:
        with lasting_imports():
            import ray
            from ray import serve
    except ModuleNotFoundError as error:
        raise UserError("Ray is not installed: pip install 'sprung[fleet]'") from error
    head = None
    if address:
        ray.init(address=address)
    else:
        head = RayHead(cores)
    serve.start(http_options={"host": host, "port": port})
    serve.run(application(settings, sizes, migrated=True), name=APPLICATION, route_prefix="/")
    return head


def stop(head: RayHead | None) -> None:
    """Answer pending requests, then leave the cluster, or end the one that was started here: that of `head`.

    Only the application goes: a cluster may serve others, and Serve itself ends with its Ray.
    """
    import ray
    from ray import serve

    serve.delete(APPLICATION)
    ray.shutdown()
    if head is not None:
        head.close()


def abandon(head: RayHead | None) -> None:
    """End what was started here without answers; waits for Ray only briefly."""
    import ray

    leaving = threading.Thread(target=ray.shutdown, daemon=True)
    leaving.start()
    leaving.join(ABANDON_SECONDS)
    if head is not None:
        head.close()


def watch(stopping: threading.Event, host: str, port: int, head: RayHead | None) -> bool:
    """Wait until `stopping` is set: true; or until nobody takes requests any more: false.  Whoever started the process
    then starts it anew.

    head: of a Ray that was started here; one that dies is started anew, and requests are answered meanwhile.
    """
    answered = time.monotonic()
    while not stopping.wait(PROBE_SECONDS):
        if head is not None and not head.lives():
            log.warning("Ray's head has died; starting it anew")
            if not head.start_anew():
                return False
        if _answers(host, port):
            answered = time.monotonic()
        elif time.monotonic() - answered > SILENT_SECONDS:
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


def from_environment(arguments: dict[str, str]) -> Any:
    """The application as `import_path` of a Serve configuration: settings from SPRUNG_..., sizes from its `args`."""
    replicas, least = int(arguments.get("replicas", 8)), int(arguments.get("least", 1))
    sizes = ServingSizes(replicas=replicas, least=least, cores=float(arguments.get("cores", 0.8)))
    return application(settings_with({}), sizes)
