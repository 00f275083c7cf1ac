"""The newest samples of every vehicle, kept for a diagnosis."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sqlalchemy.exc import OperationalError

from sprung.model.system import System
from sprung.service.diagnosis.excerpts import kept_excerpt
from sprung.service.diagnosis.worker import load_excerpt, save_excerpt
from sprung.service.monitoring.ring import Excerpt, Ring, Rings
from tests.service_fakes import HOP, START, make_window


def test_a_ring_holds_the_last_samples_in_order(system: System) -> None:
    ring = Ring(300, len(system.channels), 100.0)
    assert ring.excerpt() is None
    for number in range(20):
        ring.add(make_window(system, number, level=float(number)))
    excerpt = ring.excerpt()
    assert excerpt is not None
    assert excerpt.values.shape == (300, len(system.channels))
    assert excerpt.start == START + 19 * HOP + 10**9 - 3 * 10**9
    np.testing.assert_array_equal(np.unique(excerpt.values), [15, 16, 17, 18, 19])
    assert (np.diff(excerpt.values[:, 0]) >= 0).all()


def test_a_ring_does_not_pass_off_old_samples_as_new(system: System) -> None:
    ring = Ring(400, len(system.channels), 100.0)
    ring.add(make_window(system, 0, level=1.0))
    ring.add(make_window(system, 5, level=2.0))  # 1.5 s are missing between them
    excerpt = ring.excerpt()
    assert excerpt is not None
    assert len(excerpt.values) == 350
    assert np.isnan(excerpt.values[100:250]).all()
    ring.add(make_window(system, 500, level=3.0))
    after = ring.excerpt()
    assert after is not None and len(after.values) == 100 and (after.values == 3.0).all()


def test_vehicles_that_report_in_turns_keep_their_rings(system: System) -> None:
    rings = Rings(2, 60.0, len(system.channels), 100.0)
    for number in range(3):
        for vehicle in ("a", "b", "c"):
            rings.add(vehicle, [make_window(system, number)])
    assert rings.excerpt("c") is None
    for vehicle in ("a", "b"):
        held = rings.excerpt(vehicle)
        assert held is not None and len(held.values) == 200  # all three windows, which overlap
    rings.add("c", [make_window(system, 3)], urgent=True)  # it has an alarm
    assert rings.excerpt("c") is not None and rings.excerpt("a") is None


def test_an_excerpt_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    values = np.random.default_rng(1).normal(size=(50, 3))
    values[10:12, 1] = np.nan
    save_excerpt(tmp_path / "new" / "x.npz", Excerpt(START, 100.0, values))
    record = load_excerpt(tmp_path / "new" / "x.npz")
    np.testing.assert_array_equal(record.values, values)
    assert (record.start, record.sample_rate, record.lost) == (START, 100.0, 2)


def test_samples_that_the_store_does_not_take_are_not_left_behind(tmp_path: Path) -> None:
    excerpt = Excerpt(START, 100.0, np.zeros((5, 2)))
    with pytest.raises(OperationalError), kept_excerpt(tmp_path, excerpt):
        raise OperationalError("INSERT", {}, Exception("database is locked"))
    assert list(tmp_path.iterdir()) == []
    with kept_excerpt(tmp_path, excerpt) as path:
        pass
    assert list(tmp_path.iterdir()) == [path]
