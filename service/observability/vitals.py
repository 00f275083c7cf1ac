"""Prometheus metrics of the service itself: feeds, queues, disk, build."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator, Mapping

import torch
from prometheus_client import CollectorRegistry, Histogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector

from sprung.service.processes.forked import ProcessStatus
from sprung.service.sources.live import FeedStatus

STATES = ("receiving", "silent", "behind", "down", "failing", "hung", "ended")
UNCONNECTED = ("down", "hung", "ended")  # whether windows can be stored at the moment is another matter


def request_histogram(registry: CollectorRegistry) -> Histogram:
    """Durations of requests, from the first byte of the answered request to its whole answer."""
    return Histogram(
        "sprung_http_request_duration_seconds",
        "Time to answer a request",
        ["method", "path", "status"],
        registry=registry,
        buckets=(0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0),
    )


class Vitals(Collector):
    """Reads what it is given at every scrape."""

    def __init__(
        self,
        version: str,
        model: str,
        feeds: Callable[[], list[FeedStatus]],
        gauges: Mapping[str, Callable[[], float]],
        processes: Callable[[], list[ProcessStatus]] = list,
    ) -> None:
        """gauges: by what waits, as in `windows`, `jobs`."""
        self._build = {
            "version": version,
            "model": model,
            "python": platform.python_version(),
            "torch": torch.__version__,
        }
        self._feeds = feeds
        self._waiting = gauges
        self._processes = processes

    def describe(self) -> Iterator[Metric]:
        """Nothing is collected at registration."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """Families of the service."""
        yield InfoMetricFamily("sprung_build", "What runs", value=self._build)
        waiting = GaugeMetricFamily("sprung_queue_length", "Work that waits", labels=["queue"])
        for name, count in self._waiting.items():
            waiting.add_metric([name], count())
        yield waiting
        yield from _feed_families(self._feeds())
        yield from _process_families(self._processes())


def _feed_families(feeds: list[FeedStatus]) -> Iterator[Metric]:
    state = GaugeMetricFamily("sprung_feed_state", "1 for the state that a live feed is in", labels=["source", "state"])
    connected = GaugeMetricFamily("sprung_bus_connected", "Whether the bus of a live feed is open", labels=["source"])
    lag = GaugeMetricFamily("sprung_feed_lag_seconds", "Time that the last frame had waited", labels=["source"])
    lost = CounterMetricFamily("sprung_feed_lost", "What a live feed has lost, by cause", labels=["source", "cause"])
    restarts = CounterMetricFamily("sprung_feed_restarts", "Begun again: bus, reader or writer", labels=["source"])
    for feed in feeds:
        for known in STATES:
            state.add_metric([feed.name, known], float(feed.state == known))
        connected.add_metric([feed.name], float(feed.state not in UNCONNECTED))
        lag.add_metric([feed.name], feed.lag_seconds)
        lost.add_metric([feed.name, "windows given up"], feed.dropped_windows)
        lost.add_metric([feed.name, "windows not identified"], feed.failed_windows)
        lost.add_metric([feed.name, "frames dropped by the kernel"], feed.lost_frames)
        restarts.add_metric([feed.name], feed.restarts)
    yield from (state, connected, lag, lost, restarts)


def _process_families(processes: list[ProcessStatus]) -> Iterator[Metric]:
    up = GaugeMetricFamily("sprung_process_up", "Whether a process of the numerics runs", labels=["process"])
    restarts = CounterMetricFamily(
        "sprung_process_restarts", "Processes that took another one's place", labels=["process"]
    )
    for process in processes:
        up.add_metric([process.name], float(process.works))
        restarts.add_metric([process.name], process.restarts)
    yield from (up, restarts)
