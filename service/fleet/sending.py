"""From the spool to the server, over a link that comes and goes: as often as it takes, longer and longer pauses."""

from __future__ import annotations

import http.client
import logging
import random
import ssl
import threading
import uuid
from dataclasses import dataclass
from typing import Protocol
from urllib.parse import urlsplit

from sprung.model.text import first_line
from sprung.service.errors import UserError
from sprung.service.fleet.message import MEDIA_TYPE
from sprung.service.fleet.spool import Spool, SpoolEntry

log = logging.getLogger("sprung.edge")
FIRST_PAUSE, LAST_PAUSE = 1.0, 300.0  # s, doubled from try to try
ANSWER_SECONDS = 30.0


@dataclass(frozen=True, slots=True)
class Answer:
    """What came of one attempt."""

    stored: bool
    refused: str = ""  # why it will never be taken
    trouble: str = ""  # why it was not taken now
    wait: float = 0.0  # s that the server asks for


class Link(Protocol):
    """A way to the server."""

    def send(self, entry: SpoolEntry) -> Answer:
        """One attempt; never raises for network errors."""

    def close(self) -> None:
        """Close connections."""


class HttpLink:
    """`POST /ingest/estimates` and `POST /recordings` with a bearer token, the connection kept open."""

    def __init__(self, url: str, token: str | None, vehicle: str, option: str = "--server") -> None:
        """option: where the address was given.  Raises UserError for an address that is none."""
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise UserError(f"{option} {url}: give an address as in https://sprung.example.org")
        self._parts = parts
        self._vehicle = vehicle
        self._headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self._open: http.client.HTTPConnection | None = None

    def send(self, entry: SpoolEntry) -> Answer:
        """One attempt."""
        try:
            status, wait, text = self._post(entry)
        except (OSError, http.client.HTTPException) as error:
            self.close()
            return Answer(False, trouble=str(error) or type(error).__name__)
        if status < 300:
            return Answer(True)
        said = f"{status} {text}"
        if status == 404 and entry.kind == "recording":
            said += "; raw samples are for the server of the pages: name it with --recordings"
        if status in (401, 403, 408, 425, 429) or status >= 500:  # the token may be renewed, the server started anew
            return Answer(False, trouble=said, wait=wait)
        if status == 404 and entry.kind == "estimates":  # Ray Serve that is starting, or another address
            return Answer(False, trouble=said, wait=wait)
        if status == 409 and entry.kind == "recording":  # an earlier attempt is being worked on; it may fail yet
            return Answer(False, trouble=said, wait=wait)
        return Answer(False, refused=said)

    def _post(self, entry: SpoolEntry) -> tuple[int, float, str]:
        if entry.kind == "estimates":
            path, kind, body = "/ingest/estimates", MEDIA_TYPE, entry.body
        else:
            path, (kind, body) = "/recordings", _form(entry, self._vehicle)
        headers = self._headers | {"Content-Type": kind, "Idempotency-Key": f"{self._vehicle}-{entry.name}"}
        if entry.kind == "estimates":
            del headers["Idempotency-Key"]  # windows are known by themselves
        connection = self._connection()
        connection.request("POST", self._parts.path.rstrip("/") + path, body, headers)
        response = connection.getresponse()
        text = response.read().decode(errors="replace")
        wait = response.headers.get("Retry-After", "0")
        return response.status, float(wait) if wait.isdigit() else 0.0, " ".join(text.split())[:300]

    def _connection(self) -> http.client.HTTPConnection:
        if self._open is None:
            host, port = self._parts.hostname or "", self._parts.port
            if self._parts.scheme == "https":
                context = ssl.create_default_context()
                self._open = http.client.HTTPSConnection(host, port, timeout=ANSWER_SECONDS, context=context)
            else:
                self._open = http.client.HTTPConnection(host, port, timeout=ANSWER_SECONDS)
        return self._open

    def close(self) -> None:
        """Close the connection; the next attempt opens another one."""
        if self._open is not None:
            self._open.close()
            self._open = None


class LinksByKind:
    """Estimates one way, raw recordings another: to the ingest or a broker, and to the server that diagnoses them."""

    def __init__(self, estimates: Link, recordings: Link) -> None:
        self._estimates, self._recordings = estimates, recordings

    def send(self, entry: SpoolEntry) -> Answer:
        """One attempt, by the way of its kind."""
        return (self._estimates if entry.kind == "estimates" else self._recordings).send(entry)

    def close(self) -> None:
        """Close both."""
        self._estimates.close()
        self._recordings.close()


class Sending:
    """A thread that empties a spool.  Pauses double while nothing is taken, with a random part: a fleet that lost its
    server does not come back all at once."""

    def __init__(self, spool: Spool, link: Link, first_pause: float = FIRST_PAUSE) -> None:
        self._spool = spool
        self._link = link
        self._first_pause = first_pause
        self._wake = threading.Event()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sprung-sending", daemon=True)
        self.sent = 0
        self.refused = 0
        self.trouble = ""  # why nothing is taken now

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def wake(self) -> None:
        """Something was added."""
        self._wake.set()

    def close(self, seconds: float) -> bool:
        """Send what can be sent within `seconds`, then stop; whether the spool is empty."""
        deadline = threading.Event()
        timer = threading.Timer(seconds, deadline.set)
        timer.start()
        self.wake()
        while self._spool.waiting[0] and not deadline.is_set():
            deadline.wait(0.05)
        timer.cancel()
        self.stop()
        return self._spool.waiting[0] == 0

    def stop(self) -> None:
        """Send nothing more: before the spool is closed.  Waits for an attempt that is under way."""
        self._stopping.set()
        self.wake()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        pause = self._first_pause
        while not self._stopping.is_set():
            try:
                answer = self._one()
            except Exception as error:  # the thread must outlive a disk that is full, and whatever a link comes to
                answer = Answer(False, trouble=first_line(error) or type(error).__name__)
            if answer is None:
                self._wake.wait(1.0)
                self._wake.clear()
                continue
            if not answer.trouble:
                self.trouble, pause = "", self._first_pause
                continue
            if not self.trouble:
                log.warning("nothing can be sent (%s); messages wait", answer.trouble)
            self.trouble = answer.trouble
            self._stopping.wait(max(answer.wait, pause * random.uniform(0.5, 1.0)))
            pause = min(2.0 * pause, LAST_PAUSE)

    def _one(self) -> Answer | None:
        """One attempt to send what is next; None where nothing waits."""
        entry = self._spool.first()
        if entry is None:
            return None
        answer = self._link.send(entry)
        if answer.stored or answer.refused:
            self._spool.done(entry)
            if answer.refused:
                log.error("the server will not take %s: %s", entry.name or entry.kind, answer.refused)
            self.sent += answer.stored
            self.refused += not answer.stored
        return answer


def _form(entry: SpoolEntry, vehicle: str) -> tuple[str, bytes]:
    """multipart/form-data of a recording."""
    border = uuid.uuid4().hex
    head = (
        f'--{border}\r\nContent-Disposition: form-data; name="vehicle"\r\n\r\n{vehicle}\r\n'
        f'--{border}\r\nContent-Disposition: form-data; name="file"; filename="{entry.name}"\r\n'
        "Content-Type: application/octet-stream\r\n\r\n"
    )
    body = head.encode() + entry.body + f"\r\n--{border}--\r\n".encode()
    return f"multipart/form-data; boundary={border}", body
