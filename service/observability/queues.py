"""Prometheus metrics of what waits, and of jobs."""

from __future__ import annotations

from collections.abc import Callable

from prometheus_client import CollectorRegistry, Histogram

BUCKETS = (0.001, 0.005, 0.025, 0.1, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0, 1800.0)


class WaitMetrics:
    """How long work waits before it is begun, and how long jobs take."""

    def __init__(self, registry: CollectorRegistry) -> None:
        what = "Time that work waited before it was begun"
        self._waits = Histogram("sprung_wait_seconds", what, ["queue"], registry=registry, buckets=BUCKETS)
        what = "Time that a job took, by what became of it"
        self._jobs = Histogram(
            "sprung_job_duration_seconds", what, ["kind", "state"], registry=registry, buckets=BUCKETS
        )

    def of(self, queue: str) -> Callable[[float], None]:
        """Takes the seconds that something waited in a queue."""
        taken: Callable[[float], None] = self._waits.labels(queue).observe
        return taken

    def job(self, kind: str, state: str, seconds: float) -> None:
        """A job has ended, or went back to its queue."""
        self._jobs.labels(kind, state).observe(seconds)
