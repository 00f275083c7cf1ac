"""A Ray of this process on this machine whose head may die: it is started anew and goes on with what is on disk.

The head (`gcs_server`) knows which actors there are and where; Ray keeps that in memory and ends, 60 s after its head,
with everything that it runs.  Kept on disk (RocksDB, Ray's "GCS fault tolerance"), it is read by the next head: actors
that live answer all the while, and what died meanwhile is started anew.
"""

from __future__ import annotations

import logging
import socket
import tempfile
import time

from sprung.service.fleet.tasks import start_ray

log = logging.getLogger("sprung.ray")
PROBE_TIMEOUT = 2.0  # s: the head is on this machine
START_SECONDS, POLL_SECONDS = 30.0, 0.05
# what every replica imports; a process that is started ahead of need imports it while it waits
PRELOADED = ["ray.serve._private.replica", "sprung.service.fleet.ray_replicas"]


class RayHead:
    """Starts Ray; who ends it calls `close` then."""

    def __init__(self, cores: int | None) -> None:
        """cores: of this machine; None: all."""
        import ray

        self._kept = tempfile.TemporaryDirectory(prefix="sprung-ray-", ignore_cleanup_errors=True)
        kept = {"gcs_storage": "rocksdb", "gcs_storage_path": self._kept.name}
        start_ray(cores, kept | {"preload_python_modules": PRELOADED})
        host, _, port = ray.get_runtime_context().gcs_address.rpartition(":")
        self._address = host, int(port)

    def lives(self) -> bool:
        """Whether it takes connections."""
        try:
            socket.create_connection(self._address, PROBE_TIMEOUT).close()
        except OSError:
            return False
        return True

    def start_anew(self) -> bool:
        """Start the head that died again, at its address; whether it takes connections then."""
        from ray._private import worker  # Ray has no other way to start the head alone

        node = worker._global_node
        if node is None:
            return False
        try:
            node.kill_gcs_server(check_alive=False)
            node.start_gcs_server()
        except Exception:  # whatever is wrong, there is no head
            log.exception("Ray's head could not be started anew")
            return False
        deadline = time.monotonic() + START_SECONDS
        while not self.lives():
            if time.monotonic() > deadline:
                return False
            time.sleep(POLL_SECONDS)
        return True

    def close(self) -> None:
        """Ray has ended: delete what its head knew."""
        self._kept.cleanup()
