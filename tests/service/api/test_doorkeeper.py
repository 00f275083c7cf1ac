"""Who is given up for whom when there are too many connections, and who counts as one client."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
from prometheus_client import CollectorRegistry

from sprung.service.api import doorkeeper as module
from sprung.service.api.clients import client_of
from sprung.service.api.doorkeeper import Doorkeeper
from sprung.service.observability.connections import ConnectionCollector
from sprung.service.settings import Settings


@dataclass(eq=False)
class Held:
    """A connection as the doorkeeper sees it."""

    host: str
    active: float = 0.0
    waiting: bool = False
    unsent: int = 0
    ended: bool = False

    def too_slow(self, now: float) -> bool:
        return False

    def end(self) -> None:
        self.ended = True


def keeper(tmp_path: Path, connections: int = 12, each: int = 8) -> Doorkeeper:
    return Doorkeeper(Settings(data_dir=tmp_path, connections=connections, client_connections=each))


def test_who_holds_most_gives_one_up_also_when_all_are_being_served(tmp_path: Path) -> None:
    door = keeper(tmp_path)
    greedy = [Held("b", active=k) for k in range(8)]
    others = [Held("c", active=0.0, waiting=True) for _ in range(4)]
    assert all(door.admit(one) for one in (*greedy, *others))
    assert door.admit(Held("a"))
    assert [one.ended for one in greedy] == [True] + [False] * 7  # the oldest
    assert not any(one.ended for one in others)  # although they only wait: others hold more


def test_what_only_waits_is_given_up_before_what_is_being_served(tmp_path: Path) -> None:
    door = keeper(tmp_path)
    greedy = [Held("b", active=k, waiting=k in (4, 5)) for k in range(8)]
    for one in (*greedy, *(Held("c") for _ in range(4))):
        door.admit(one)
    assert door.admit(Held("a"))
    assert [k for k, one in enumerate(greedy) if one.ended] == [4]


def test_nobody_takes_places_of_others_that_hold_no_more(tmp_path: Path) -> None:
    door = keeper(tmp_path)
    for k in range(12):
        assert door.admit(Held("ab"[k % 2]))
    assert not door.admit(Held("a")), "six each, and one more of the same"
    assert door.closed[module.NO_ROOM] == 1
    assert door.admit(Held("c"))


def test_a_client_with_all_it_may_have_loses_its_own(tmp_path: Path) -> None:
    door = keeper(tmp_path, connections=100)
    mine = [Held("a", waiting=k == 3) for k in range(8)]
    assert all(door.admit(one) for one in mine)
    assert door.admit(Held("a"))
    assert [k for k, one in enumerate(mine) if one.ended] == [3]
    assert not door.admit(Held("a")), "none of them waits"


def test_answers_that_nobody_takes_are_bounded_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_UNSENT_BYTES", 100)
    door = keeper(tmp_path)
    sizes = (0, 30, 80, 20)
    all_of_them = [Held("a", unsent=size) for size in sizes]
    for one in all_of_them:
        door.admit(one)
    door.lighten()
    assert [one.ended for one in all_of_them] == [False, False, True, False]
    assert len(door) == 3


@pytest.mark.parametrize(
    ("address", "client"),
    [
        ("192.0.2.7", "192.0.2.7"),
        ("::ffff:192.0.2.7", "192.0.2.7"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("2001:db8:1:2::9", "2001:db8:1:2::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("", ""),
        ("testclient", "testclient"),
    ],
)
def test_a_network_of_ipv6_is_one_client(address: str, client: str) -> None:
    assert client_of(address) == client


def test_who_breaks_off_many_requests_is_not_let_in_for_a_while(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr("sprung.service.api.doorkeeper.time.monotonic", lambda: now[0])
    settings = Settings(data_dir=tmp_path, client_broken_per_second=5, trusted_proxies=("10.0.0.0/8",))
    door = Doorkeeper(settings)
    for host in ("1.2.3.4", "10.0.0.7", "fe80::/64"):
        for _ in range(10):
            one = Held(host)
            assert door.admit(one)
            door.broke_off(one)
            door.leave(one)
    assert [door.admit(Held(host)) for host in ("1.2.3.4", "10.0.0.7", "fe80::/64", "5.6.7.8")] == [0, 1, 0, 1]
    now[0] += 0.3
    assert door.admit(Held("1.2.3.4"))


def test_who_was_closed_for_others_has_broken_nothing_off(tmp_path: Path) -> None:
    door = Doorkeeper(Settings(data_dir=tmp_path, client_connections=1, client_broken_per_second=0.5))
    held = [Held("a", waiting=True) for _ in range(5)]
    for one in held:
        assert door.admit(one)  # the one before is given up for it
    for one in held[:-1]:
        door.broke_off(one)
    assert door.admit(Held("a"))


def test_what_is_closed_is_counted_by_cause_and_shown(tmp_path: Path) -> None:
    door = keeper(tmp_path, connections=2, each=2)
    door.admit(Held("b"))
    door.admit(Held("b", waiting=True))
    assert door.admit(Held("a")), "one of two of the same"
    assert not door.admit(Held("c"))
    for _ in range(200):
        door.broke_off(next(iter(door._open)))
    assert not door.admit(Held("b"))
    registry = CollectorRegistry()
    registry.register(ConnectionCollector(lambda: len(door), lambda: door.closed))
    assert registry.get_sample_value("sprung_connections") == 2
    found = {
        cause: registry.get_sample_value("sprung_connections_closed_total", {"cause": cause}) for cause in module.CAUSES
    }
    assert found == {
        module.NO_ROOM: 1,
        module.BROKEN_OFF: 1,
        module.GIVEN_UP: 1,
        module.TOO_SLOW: 0,
        module.UNREAD: 0,
    }
