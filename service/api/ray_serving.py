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

from sprung.service.api.listening import listen
from sprung.service.api.ray_door import ListeningDoor, door_app
from sprung.service.errors import UserError
from sprung.service.fleet.ray_head import RayHead
from sprung.service.fleet.ray_replicas import ComputeReplica
from sprung.service.fleet.serving_sizes import ServingSizes
from sprung.service.processes.imports import lasting_imports
from sprung.service.settings import Settings, settings_with

log = logging.getLogger("sprung.ray")
APPLICATION, DOOR, COMPUTE = "sprung", "door", "compute"
AT_ONCE = 2  # batches of one replica: what it identifies, and what it folds while the database keeps it waiting
BUSY_BATCHES = 2.5  # of one replica, at work and waiting, beyond which another one is started
HEALTH_SECONDS = 1.0  # a replica that died is missed after that
PROBE_SECONDS = 0.5
PROBE_TIMEOUT = 10.0  # s: a machine that is busy answers late
SILENT_SECONDS = 30.0  # without an answer: a door that died is back before, on a busy machine, too
ABANDON_SECONDS = 10.0
FINISH_SECONDS = 60.0  # for the requests that have come


def application(settings: Settings, sizes: ServingSizes, migrated: bool = False, listening: bool = False) -> Any:
    """The Serve application: `serve.run(application(...))`; migrated: the store has been.

    listening: the door takes connections at the settings' address itself, instead of Serve's proxies.
    """
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
        "logging_config": {"enable_access_log": False},  # the door has its own
    }
    deployment: Any = serve.deployment
    compute = deployment(
        ComputeReplica,
        name=COMPUTE,
        ray_actor_options={"num_cpus": sizes.cores},
        autoscaling_config=scaling,
        max_ongoing_requests=AT_ONCE,
        **watched,
    ).bind(settings, migrated)
    door = {"name": DOOR, "num_replicas": 1, "ray_actor_options": {"num_cpus": sizes.cores / 4}} | watched
    if listening:
        return deployment(ListeningDoor, **door).bind(settings, sizes, migrated, compute)

    def build() -> Any:
        return door_app(settings, sizes, migrated, serve.get_deployment_handle(COMPUTE, APPLICATION))

    class Door:
        """Requests come from Serve's proxies."""

        def __init__(self, *after: Any) -> None:
            """after: deployments that are started before it."""

    behind_proxies = deployment(serve.ingress(build)(Door), max_ongoing_requests=8 * sizes.queued, **door)
    return behind_proxies.bind(compute)


def start(settings: Settings, sizes: ServingSizes, address: str | None, cores: int | None) -> RayHead | None:
    """Serve on the cluster at `address`, or on a Ray that is started here; returns when requests are taken.

    The store must have been migrated.  The head of a Ray that was started here.
    """
    try:
        with lasting_imports():
            import ray
            from ray import serve
    except ModuleNotFoundError as error:
        raise UserError("Ray is not installed: pip install 'sprung[fleet]'") from error
    if address:
        if settings.tls_certificate is not None:
            raise UserError("on a cluster Ray Serve's proxies take connections, without TLS: leave the certificate out")
        ray.init(address=address)
        serve.start(http_options={"host": settings.host, "port": settings.port})
        serve.run(application(settings, sizes, migrated=True), name=APPLICATION, route_prefix="/")
        return None
    listen(settings).close()  # an address in use is a plain error, before Ray starts
    head = RayHead(cores)
    serve.start(proxy_location="Disabled")
    serve.run(application(settings, sizes, migrated=True, listening=True), name=APPLICATION, route_prefix=None)
    return head


def stop(head: RayHead | None) -> None:
    """Answer pending requests, then leave the cluster, or end the one that was started here: that of `head`.

    Only the application goes: a cluster may serve others, and Serve itself ends with its Ray.
    """
    import ray
    from ray import serve

    if head is not None:
        serve.get_deployment_handle(DOOR, APPLICATION).finish.remote().result(timeout_s=FINISH_SECONDS)
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


def watch(stopping: threading.Event, settings: Settings, head: RayHead | None) -> bool:
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
        if _answers(settings):
            answered = time.monotonic()
        elif time.monotonic() - answered > SILENT_SECONDS:
            return False
    return True


def _answers(settings: Settings) -> bool:
    address = "127.0.0.1" if settings.host == "0.0.0.0" else settings.host, settings.port
    connection = http.client.HTTPConnection(*address, timeout=PROBE_TIMEOUT)
    try:
        connection.connect()
        if settings.tls_certificate is not None:  # which may want a certificate of its clients
            return True
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
