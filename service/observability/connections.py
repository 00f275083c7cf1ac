"""Prometheus metrics of connections, which requests that never come to be do not show."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector


class ConnectionCollector(Collector):
    """Reads what it is given at every scrape."""

    def __init__(self, count: Callable[[], int], closed: Callable[[], Mapping[str, int]]) -> None:
        """count: of those that are open; closed: by the service, by cause."""
        self._count = count
        self._closed = closed

    def describe(self) -> Iterator[Metric]:
        """Nothing is collected at registration."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """Open and closed ones."""
        yield GaugeMetricFamily("sprung_connections", "Connections that are open", value=self._count())
        closed = CounterMetricFamily(
            "sprung_connections_closed", "Refused or closed by the service, by cause", labels=["cause"]
        )
        for cause, number in self._closed().items():
            closed.add_metric([cause], number)
        yield closed
