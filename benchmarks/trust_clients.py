"""Clients of a service that is killed: each notes what was acknowledged and goes on after the next start."""

from __future__ import annotations

import http.client
import json
import threading
import time
from contextlib import closing
from pathlib import Path
from typing import Any

from sprung.benchmarks.trust_ride import RestlessRide

UPLOAD_SECONDS = 20.0  # of a recording
TIMEOUT = 30.0


class Ledger:
    """What was acknowledged, one JSON line each, appended by one client; it goes on where it was left."""

    def __init__(self, path: Path) -> None:
        self._path = path
        lines = path.read_text().splitlines() if path.exists() else []
        self.entries: list[dict[str, Any]] = [json.loads(line) for line in lines]

    def add(self, **entry: Any) -> None:
        """Write down."""
        self.entries.append(entry)
        with open(self._path, "a") as file:
            file.write(json.dumps(entry) + "\n")


class RestlessClient(threading.Thread):
    """Acts again and again against whatever service is at `port`."""

    def __init__(self, ledger: Ledger, ride: RestlessRide) -> None:
        super().__init__(daemon=True)
        self.port: int | None = None
        self.ledger = ledger
        self.ride = ride
        self._stopping = threading.Event()

    def stop(self) -> None:
        """End after what is being sent."""
        self._stopping.set()
        self.join(2 * TIMEOUT)

    def run(self) -> None:
        """Until stopped."""
        while not self._stopping.is_set():
            try:
                acted = self.port is not None and self.act()
            except (OSError, http.client.HTTPException, ValueError):
                acted = False  # the service died under it
            if not acted:
                self._stopping.wait(0.05)

    def act(self) -> bool:
        """One request; whether it was acknowledged."""
        raise NotImplementedError

    def ask(
        self, method: str, path: str, body: bytes = b"", kind: str = "application/json", identity: str = ""
    ) -> tuple[int, Any]:
        """Status and JSON of an answer."""
        if self.port is None:
            raise ConnectionError("the service is gone")
        headers = {"content-type": kind} | ({"x-request-id": identity} if identity else {})
        return ask(self.port, method, path, body, headers, TIMEOUT)


def ask(port: int, method: str, path: str, body: bytes, headers: dict[str, str], seconds: float) -> tuple[int, Any]:
    """Status and JSON of an answer of the service at a port of this machine."""
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=seconds)) as connection:
        connection.request(method, path, body, headers)
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())


class Windows(RestlessClient):
    """One window after the other to POST /identify."""

    def act(self) -> bool:
        """Each window until it is acknowledged."""
        number = len(self.ledger.entries)
        body = self.ride.window(number, "windows")
        status, _ = self.ask("POST", "/identify?track=true", json.dumps(body).encode(), identity=f"window-{number}")
        if status == 200:
            self.ledger.add(start=round(float(body["start"]) * 1e9))
        return status == 200


class Files(RestlessClient):
    """One recording after the other, to be read or to be diagnosed; the next when the last one is done with."""

    def __init__(self, ledger: Ledger, ride: RestlessRide, route: str, vehicle: str) -> None:
        super().__init__(ledger, ride)
        self._route = route
        self._vehicle = vehicle
        self._last: str | None = ledger.entries[-1]["job"] if ledger.entries else None

    def act(self) -> bool:
        """The next file, once the job of the one before has ended."""
        if self._last is not None:
            status, job = self.ask("GET", f"/jobs/{self._last}")
            if status == 200 and job["state"] in ("queued", "running"):
                time.sleep(0.2)
                return True
        number = len(self.ledger.entries)
        vehicle = f"{self._vehicle}-{number}"
        form = multipart(self.ride.csv(number, UPLOAD_SECONDS), f"{vehicle}.csv", vehicle)
        kind = "multipart/form-data; boundary=frontier"
        status, job = self.ask("POST", self._route, form, kind, identity=f"{self._vehicle}-{number}")
        if status == 202:
            self._last = job["id"]
            self.ledger.add(job=job["id"], vehicle=vehicle)
        return status == 202


def multipart(content: bytes, name: str, vehicle: str) -> bytes:
    """The form of an upload."""
    return (
        b'--frontier\r\ncontent-disposition: form-data; name="vehicle"\r\n\r\n' + vehicle.encode() + b"\r\n"
        b'--frontier\r\ncontent-disposition: form-data; name="file"; filename="' + name.encode() + b'"\r\n\r\n'
        + content + b"\r\n--frontier--\r\n"
    )  # fmt: skip
