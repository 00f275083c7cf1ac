"""The demo, watched as it would be: the service replays it, Prometheus scrapes and judges, Alertmanager tells."""

from __future__ import annotations

import json
import shutil
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest

from tests.demo import VEHICLE, made_demo, serving
from tests.monitoring import RULES, Query, alertmanager, ask, prometheus, queries

PROGRAMS = ("prometheus", "prometheus-alertmanager")
SCRAPES = 8.0  # s for the last values to be scraped and asked for
FIRING = {("SprungSuspensionChanged", "change"), ("SprungSuspensionOutOfSpecification", "")}  # its damper lost a fifth
DRIFTING = ("SprungDoesNotFit", "sensor")  # its accelerometer, by 6 %: named, and an alarm where it is sure
NOTHING = {"Dropped windows by reason, per second"}  # the demo's recording is whole
BUS = "socketcan:absent0"  # beside the demo, so that the panels of live feeds have one to show
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(any(shutil.which(name) is None for name in PROGRAMS), reason=f"needs {' and '.join(PROGRAMS)}"),
]


@dataclass
class Watched:
    """What was seen from the first scrape to some seconds after the last window."""

    answered: dict[Query, int] = field(default_factory=dict)  # series, at most
    while_replaying: dict[Query, int] = field(default_factory=dict)  # times that it was asked before the end
    rules: dict[str, int] = field(default_factory=dict)  # series of a rule's expression, at most
    firing: set[tuple[str, str]] = field(default_factory=set)  # alert and kind
    told: list[dict[str, Any]] = field(default_factory=list)  # alerts that came to the webhook
    vehicle: dict[str, Any] = field(default_factory=dict)

    def look(self, address: str, replaying: bool) -> None:
        """Ask everything once."""
        for query in queries(VEHICLE):
            self.answered[query] = max(self.answered.get(query, 0), len(ask(address, query.expression)))
            self.while_replaying[query] = self.while_replaying.get(query, 0) + replaying
        for rule in RULES:
            self.rules[rule["alert"]] = max(self.rules.get(rule["alert"], 0), len(ask(address, rule["expr"])))
        firing = [one["metric"] for one in ask(address, 'ALERTS{alertstate="firing"}')]
        self.firing |= {(one["alertname"], one.get("kind", "")) for one in firing}


@contextmanager
def receiving(told: list[dict[str, Any]]) -> Iterator[str]:
    """A webhook that keeps the alerts it is sent."""

    class AlertHook(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            told.extend(json.loads(self.rfile.read(int(self.headers["content-length"])))["alerts"])
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            """Quiet."""

    with HTTPServer(("127.0.0.1", 0), AlertHook) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


def get(url: str) -> Any:
    """A JSON answer."""
    with urllib.request.urlopen(url, timeout=60) as answer:
        return json.load(answer)


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Watched:
    folder = tmp_path_factory.mktemp("demo")
    recording, seen = made_demo(folder), Watched()
    with (
        receiving(seen.told) as hook,
        alertmanager(hook, folder) as telling,
        serving(recording, folder / "data", "--can", BUS) as service,
        prometheus(service.removeprefix("http://"), folder, telling) as judge,
    ):
        deadline, ended = time.monotonic() + 1200, None
        while ended is None or time.monotonic() < ended + SCRAPES:
            assert time.monotonic() < deadline
            time.sleep(1.0)
            try:
                seen.look(judge, replaying=ended is None)
            except OSError:  # it is starting
                continue
            finished = [one["finished"] for one in get(f"{service}/recordings")["recordings"]]
            if ended is None and finished and None not in finished:
                ended = time.monotonic()
        seen.vehicle = get(f"{service}/vehicles/{VEHICLE}")
    return seen


def test_every_panel_shows_the_demo(watched: Watched) -> None:
    empty = {query.title for query, series in watched.answered.items() if not series}
    assert empty == NOTHING and watched.vehicle["windows"]["dropped"] == 0
    assert min(watched.while_replaying.values()) >= 3


def test_the_rules_that_the_demo_must_raise_are_firing_and_no_other(watched: Watched) -> None:
    assert watched.vehicle["health"] == "out_of_specification"
    met = {name for name, series in watched.rules.items() if series}
    apart = {"SprungDown", DRIFTING[0]}  # one scrape may time out where much else runs
    assert met - apart == {name for name, _ in FIRING} | {"SprungBusLost"}
    seen = {one for one in watched.firing if one[0] != "SprungBusLost"}  # after a minute
    assert FIRING <= seen <= FIRING | {DRIFTING}


def test_alertmanager_tells_what_is_out_of_specification(watched: Watched) -> None:
    told = [one for one in watched.told if one["labels"]["alertname"] == "SprungSuspensionOutOfSpecification"]
    assert told and told[0]["status"] == "firing" and told[0]["labels"]["vehicle"] == VEHICLE
    assert told[0]["annotations"]["summary"].startswith(f"{VEHICLE}: suspension parameters have changed by a fifth")
    assert "description" in told[0]["annotations"]
