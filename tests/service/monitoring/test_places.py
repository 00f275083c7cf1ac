"""Who has a place where there are fewer than vehicles."""

from __future__ import annotations

from sprung.service.monitoring.places import Places


def test_places_are_kept_while_their_vehicles_are_heard_from() -> None:
    now = 0.0
    places: Places[list[str]] = Places(2, 10.0, lambda: now)
    kept = {name: places.heard(name, list) for name in ("a", "b")}
    for _ in range(5):
        now += 5.0
        assert places.heard("a", list) is kept["a"]
        assert places.heard("b", list) is kept["b"]
        assert places.heard("c", list) is None
    assert set(places.all()) == {"a", "b"}
    now += 9.0
    places.heard("b", list)
    now += 2.0
    assert places.heard("c", list) == []  # a has been silent for eleven seconds
    assert places.get("a") is None and places.get("b") is kept["b"]
    places.pop("b")
    assert places.get("b") is None


def test_an_urgent_vehicle_has_the_place_of_one_that_is_not() -> None:
    places: Places[list[str]] = Places(2, 10.0, lambda: 0.0)
    places.heard("a", list, urgent=True)
    places.heard("b", list)
    assert places.heard("c", list, urgent=True) == []
    assert set(places.all()) == {"a", "c"}
    assert places.heard("d", list, urgent=True) is None  # all of them are
    assert places.heard("a", list) == []  # well again
    assert places.heard("d", list, urgent=True) == [] and "a" not in places.all()


def test_without_places_nothing_is_held() -> None:
    places: Places[list[str]] = Places(0, 10.0)
    assert places.heard("a", list) is None and places.heard("a", list, urgent=True) is None
