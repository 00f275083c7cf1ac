"""What the service may call: only receivers of the settings, at addresses that are public or allowed by name."""

from __future__ import annotations

import http.client
import ipaddress
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

from sprung.service.access import outbound
from sprung.service.errors import UserError
from sprung.service.notify.notices import Notices
from sprung.service.settings import Settings
from sprung.service.store import Store

LOCAL = outbound.networks(("127.0.0.0/8", "::1"))


@pytest.mark.parametrize(
    "address",
    [
        "127.0.0.1", "127.9.9.9", "0.0.0.0", "10.1.2.3", "172.16.0.1", "192.168.1.1", "169.254.169.254", "100.64.0.1",
        "224.0.0.1", "255.255.255.255", "::1", "::", "fe80::1", "fd00:ec2::254", "::ffff:127.0.0.1", "64:ff9b::7f00:1",
        "2002:7f00:1::", "ff02::1", "192.0.0.192", "168.63.129.16", "100.100.100.200", "fec0::1", "::7f00:1",
        "64:ff9b:1::7f00:1", "::ffff:0:7f00:1", "2001:0:7f00:1::", "5f00::1", "::ffff:168.63.129.16",
        "64:ff9b::c000:c0",
    ],
)  # fmt: skip
def test_addresses_behind_the_wall_are_refused(address: str) -> None:
    assert outbound.judged(ipaddress.ip_address(address), ()) is not None


@pytest.mark.parametrize("address", ["93.184.216.34", "2606:2800:220:1:248:1893:25c8:1946"])
def test_public_addresses_are_called(address: str) -> None:
    assert outbound.judged(ipaddress.ip_address(address), ()) is None


def test_a_network_of_the_settings_opens_only_itself() -> None:
    allowed = outbound.networks(("10.1.0.0/16", "fd00::/8"))
    assert outbound.judged(ipaddress.ip_address("10.1.2.3"), allowed) is None
    assert outbound.judged(ipaddress.ip_address("fd12::1"), allowed) is None
    assert outbound.judged(ipaddress.ip_address("10.2.2.3"), allowed) is not None
    assert outbound.judged(ipaddress.ip_address("169.254.169.254"), allowed) is not None


@pytest.mark.parametrize(
    "url",
    [
        "ftp://example.org/", "file:///etc/passwd", "gopher://x/", "//example.org", "http://", "http://u:p@example.org/",
        "http://example.org:99999/", "http://example.org/ x", "http://example.org/\r\nX: y", "http://exämple.org/",
        "http://[::1", "http://example.org/" + "a" * 400,
    ],
)  # fmt: skip
def test_what_is_no_plain_url_is_refused(url: str) -> None:
    with pytest.raises(UserError):
        outbound.safe_url(url)


@pytest.mark.parametrize(
    "host", ["localhost", "127.1", "2130706433", "0x7f000001", "017700000001", "[::1]", "[::ffff:127.0.0.1]"]
)
def test_other_ways_to_write_this_host_come_to_the_same(host: str) -> None:
    with pytest.raises((outbound.ForbiddenAddress, OSError)):
        outbound.post(f"http://{host}:9/x", b"", {}, (), 1.0)


def test_every_address_of_a_name_is_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    def both(_host: str, port: int, **_: Any) -> list[Any]:
        return [(socket.AF_INET, 1, 6, "", (address, port)) for address in ("93.184.216.34", "169.254.169.254")]

    monkeypatch.setattr(socket, "getaddrinfo", both)
    with pytest.raises(outbound.ForbiddenAddress, match=r"169\.254\.169\.254 .*SPRUNG_WEBHOOK_NETWORKS"):
        outbound.resolved(outbound.safe_url("https://both.example.org/"), ())


def test_a_name_that_changes_after_it_was_judged_is_not_asked_again(
    monkeypatch: pytest.MonkeyPatch, asked: tuple[int, list[str]]
) -> None:
    port, hosts = asked
    calls = []

    def once(_host: str, number: int, **_: Any) -> list[Any]:
        calls.append(1)
        assert len(calls) == 1, "resolved twice"
        return [(socket.AF_INET, 1, 6, "", ("127.0.0.1", number))]

    receiver = outbound.safe_url(f"http://hook.example.org:{port}/in?x=1")
    monkeypatch.setattr(outbound, "resolved", lambda *_: [entry[4][0] for entry in once(receiver.host, port)])
    assert outbound.post(f"http://hook.example.org:{port}/in?x=1", b"{}", {}, LOCAL, 5.0) == 302
    assert hosts == [f"/in?x=1 hook.example.org:{port}"]  # and the redirection was not followed


@pytest.fixture
def asked() -> Iterator[tuple[int, list[str]]]:
    hosts: list[str] = []

    class Elsewhere(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            hosts.append(f"{self.path} {self.headers['host']}")
            self.send_response(302)
            self.send_header("Location", "http://127.0.0.1:1/")
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            """Quiet."""

    server = HTTPServer(("127.0.0.1", 0), Elsewhere)
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    yield server.server_port, hosts
    server.shutdown()
    server.server_close()


def test_receivers_on_this_host_need_a_word_in_the_settings(tmp_path: Path, store: Store) -> None:
    settings: dict[str, Any] = {"data_dir": tmp_path, "webhooks": "http://127.0.0.1:8080/hook"}
    with pytest.raises(UserError, match="SPRUNG_WEBHOOK_NETWORKS"):
        Notices(Settings(**settings), store)
    Notices(Settings(**settings, webhook_networks=("127.0.0.0/8",)), store)
    with pytest.raises(UserError, match=r"^setting webhook_networks \(SPRUNG_WEBHOOK_NETWORKS\): "):
        Notices(Settings(**settings, webhook_networks=("127.0.0.1/8",)), store)


def test_a_receiver_that_drips_is_hung_up_on() -> None:
    """Each byte comes in time; all of them together do not."""
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def drip() -> None:
            line, _ = listening.accept()
            with line, suppress(OSError):
                line.recv(65536)
                for _ in range(100):
                    line.sendall(b"H")
                    time.sleep(0.1)

        dripping = threading.Thread(target=drip)
        dripping.start()
        begun = time.monotonic()
        with pytest.raises((OSError, http.client.HTTPException)):
            outbound.post(f"http://127.0.0.1:{listening.getsockname()[1]}/", b"{}", {}, LOCAL, 0.5)
        assert time.monotonic() - begun < 5.0
        dripping.join()
