"""The outbox: an event is written down in the transaction of what it tells of, and sent by a thread of its own.

An attempt that fails is made again after 5 s, 30 s, 2 min, ... for about two days; what was given up stays to be seen.
"""

from __future__ import annotations

import ipaddress
import logging
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from typing import Any

from sqlalchemy import Connection

from sprung.service.access import outbound
from sprung.service.errors import UserError
from sprung.service.notify import events, senders
from sprung.service.settings import Settings
from sprung.service.sources.live import FeedStatus
from sprung.service.store import Store, outbox
from sprung.service.store.fleet import AlarmChange
from sprung.service.store.outbox import DeliveryRow
from sprung.service.times import NANOSECONDS, now_ns

log = logging.getLogger("sprung.notify")

PAUSES = (5, 30, 120, 600, 1800, 3600, 10_800, 21_600, 43_200, 86_400)  # s before the next attempt
PERIOD_SECONDS = 2.0
AT_ONCE = 50  # deliveries to one receiver before it is the next one's turn
TURN_SECONDS = 2.0  # after which a receiver's turn ends with the attempt that is being made


class Notices:
    """Accepts events and delivers them to every receiver of the settings."""

    def __init__(self, settings: Settings, store: Store, feeds: Callable[[], Sequence[FeedStatus]] = tuple) -> None:
        """Raises UserError for a receiver that is no http(s) URL and no mail address."""
        self._settings = settings
        self._store = store
        self._feeds = feeds
        self._working: dict[str, bool] = {}  # as reported last, by bus
        self._targets = receivers(settings)
        senders.signing_key(settings.webhook_secret)  # wrong ones are reported now
        self._allowed = outbound.networks(settings.webhook_networks)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sprung-notify", daemon=True)

    def start(self) -> None:
        """Begin; without receivers there is nothing to do."""
        if self._targets:
            self._thread.start()

    def close(self) -> None:
        """Stop; what waits is sent after the next start."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()

    def alarms(self, connection: Connection, vehicle: str, changes: Sequence[AlarmChange]) -> None:
        """Alarms of a vehicle were opened, changed or closed."""
        for change in changes:
            self._accept(connection, events.alarm_event(self._settings.public_url, vehicle, change, now_ns()))

    def report(self, connection: Connection, vehicle: str | None, report: str, found: dict[str, Any]) -> None:
        """A mismatch report is there."""
        findings = [str(f.get("sentence") or f"{f['location']}: {f['effect']}") for f in found.get("findings", [])]
        base, verdict = self._settings.public_url, str(found.get("verdict", ""))
        self._accept(connection, events.report_event(base, vehicle, report, verdict, findings, now_ns()))

    def watch_feeds(self) -> None:
        """Tell of live buses that were lost or found since they were told of last, by this process or one before."""
        feeds = self._feeds()
        if any(feed.name not in self._working for feed in feeds):
            with self._store.read() as connection:
                newest = outbox.newest_of_sources(connection)
            self._working = {name: kind == events.FEED_FOUND for name, kind, _ in newest} | self._working
        for feed in feeds:
            if self._working.get(feed.name, True) != feed.works:
                base = self._settings.public_url
                event = events.feed_event(base, feed.name, feed.vehicle, feed.works, feed.detail, now_ns())
                with self._store.write() as connection:
                    self._accept(connection, event)
            self._working[feed.name] = feed.works  # not before it is written down

    def deliver(self, now: int) -> int:
        """Try what is due, as if it were `now`; how many arrived.

        Receivers take turns: one that takes ten seconds to fail holds the others up once, and not with everything that
        waits for it.
        """
        ahead = now + 2 * PAUSES[-1] * NANOSECONDS
        with self._store.read() as connection:
            targets = outbox.targets(connection)
            waiting = {target: outbox.due(connection, now, target, AT_ONCE, ahead) for target in targets}
        arrived = 0
        for rows in waiting.values():
            begun = time.monotonic()
            for row in rows:
                if self._stopping.is_set() or time.monotonic() - begun > TURN_SECONDS:
                    break
                arrived += self._attempt(row, now)
        return arrived

    def _attempt(self, row: DeliveryRow, now: int) -> bool:
        try:
            if row.target.startswith("mailto:"):
                senders.mail(self._settings, row.target.removeprefix("mailto:"), row.event)
            else:
                senders.post(row.target, row.event, self._settings.webhook_secret, self._allowed)
            values: dict[str, Any] = {"state": "delivered", "error": None}
        except Exception as error:  # whatever it is: others wait behind it
            line = " ".join(str(error).split())[:300] or type(error).__name__
            dead = row.attempts >= len(PAUSES)
            pause = PAUSES[min(row.attempts, len(PAUSES) - 1)]
            values = {"state": "dead" if dead else "waiting", "error": line, "next_ns": now + pause * NANOSECONDS}
            log.log(logging.ERROR if dead else logging.INFO, "%s to %s: %s", row.kind, row.target, line)
        with self._store.write() as connection:
            outbox.settle(connection, row.id, now, attempts=row.attempts + 1, **values)
        found: bool = values["state"] == "delivered"
        return found

    def _accept(self, connection: Connection, event: dict[str, Any]) -> None:
        now = now_ns()
        for target in self._targets:
            row = DeliveryRow(str(uuid.uuid4()), event["type"], target, event, "waiting", 0, now, None, now, now)
            outbox.add_delivery(connection, row)

    def _run(self) -> None:
        while not self._stopping.wait(PERIOD_SECONDS):
            try:
                self.watch_feeds()
                self.deliver(now_ns())
            except Exception:  # the store, or no thread for a time-out: nothing else would send what waits
                log.exception("notifications could not be sent; they are tried again")


def receivers(settings: Settings) -> tuple[str, ...]:
    """Webhooks, then mail addresses as mailto:.  Raises UserError for one that cannot be."""
    found = []
    allowed = outbound.networks(settings.webhook_networks)
    for url in settings.webhooks:
        try:
            _plainly_allowed(outbound.safe_url(url).host, allowed)
        except ValueError as error:
            raise UserError(f"setting webhooks (SPRUNG_WEBHOOKS): {error}") from None
        found.append(url)
    for address in settings.mail_to:
        if "@" not in address.strip("@") or len(address) > 250:
            raise UserError(f"setting mail_to (SPRUNG_MAIL_TO): {address[:80]!r} is no mail address")
        found.append(f"mailto:{address}")
    if settings.mail_to and not settings.smtp_host:
        raise UserError("setting smtp_host (SPRUNG_SMTP_HOST) is needed to send mail to SPRUNG_MAIL_TO")
    return tuple(found)


def _plainly_allowed(host: str, allowed: tuple[outbound.Network, ...]) -> None:
    """A host that is written as an address is judged at the start; names when they are called."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return
    wrong = outbound.judged(address, allowed)
    if wrong is not None:
        raise outbound.ForbiddenAddress(wrong)
