"""Old windows leave the store for Parquet, and the history still tells them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from sprung.service.errors import UserError
from sprung.service.store import Store, history, retention
from sprung.service.store.archive import Archive, fleet_of, open_archive
from sprung.service.store.history import older_windows
from sprung.service.times import NANOSECONDS
from tests.service.store.test_store import DAY, HOP, START, fill, record

pytest.importorskip("pyarrow")
LONG_AFTER = START + 200 * DAY


def forget(store: Store, archive: Archive, before: int) -> int:
    with store.write() as connection:
        limits = retention.RetentionLimits(before, 0, 0)
        return retention.forget(connection, limits, lambda c, *which: archive.keep(c, LONG_AFTER, *which)).windows


def raw(store: Store, archive: Archive, model: int, since: int = 0, limit: int = 1000) -> list[int]:
    with store.read() as connection:
        older = older_windows(archive, "a", "digest")
        return history.series(connection, "a", model, since, 2**62, 0, limit, older).time.tolist()


def test_the_history_goes_on_into_the_archive(any_store: Store, tmp_path: Path) -> None:
    """Windows of September are archived, those of November are still in the store."""
    archive = Archive(str(tmp_path / "archive"))
    september, november = [record(i) for i in range(100)], [record(61 * DAY // HOP + i) for i in range(50)]
    model = fill(any_store, september + november)
    with any_store.read() as connection:
        before = history.series(connection, "a", model, 0, 2**62, 0, 1000)
        coarse = history.series(connection, "a", model, 0, 2**62, 10, 1000)
    assert forget(any_store, archive, START + 40 * DAY) == 100
    with any_store.read() as connection:
        older = older_windows(archive, "a", "digest")
        after = history.series(connection, "a", model, 0, 2**62, 0, 1000, older)
        bucketed = history.series(connection, "a", model, 0, 2**62, 10, 1000, older)
        without = history.series(connection, "a", model, 0, 2**62, 0, 1000)
    for one, other in ((before, after), (coarse, bucketed)):
        np.testing.assert_array_equal(one.time, other.time)
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.std, other.std)
    assert len(without.time) == 50
    assert raw(any_store, archive, model, limit=55) == before.time.tolist()[-55:]
    assert raw(any_store, archive, model, since=START + 90 * HOP) == before.time.tolist()[90:]


def test_windows_that_are_archived_twice_are_reported_once(store: Store, tmp_path: Path) -> None:
    """The process died after it had written the files and before it had deleted the windows."""
    archive = Archive(str(tmp_path / "archive"))
    model = fill(store, [record(i) for i in range(10)])
    with store.read() as connection:
        assert archive.keep(connection, 1) == 10
    assert raw(store, archive, model) == [START + i * HOP for i in range(10)]
    assert forget(store, archive, START + DAY) == 10
    assert raw(store, archive, model) == [START + i * HOP for i in range(10)]


def test_files_lie_by_fleet_and_date_and_anybody_can_read_them(store: Store, tmp_path: Path) -> None:
    from pyarrow import dataset

    fill(store, [record(0), record(DAY // HOP)])
    with store.read() as connection:
        Archive(str(tmp_path / "archive")).keep(connection, 7)
    found = sorted(path.relative_to(tmp_path / "archive").as_posix() for path in tmp_path.rglob("*.parquet"))
    assert [re.sub("-[0-9a-f]{12}[.]", "-X.", name) for name in found] == [
        f"fleet=none/date=2026-09-{day}/part-7-X.parquet" for day in (21, 22)
    ]
    rows = dataset.dataset(tmp_path / "archive", partitioning="hive").to_table().to_pylist()
    assert [row["posterior"] for row in rows] == [[0.0] * 3, [0.001 * (DAY // HOP)] * 3]
    assert {row["model"] for row in rows} == {"digest"}
    assert rows[0]["identifiable"] == [True, False, True]


def test_what_makes_room_in_many_turns_is_archived_whole(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each turn has windows of the same day; the files of one turn must not take the place of another's."""
    monkeypatch.setattr(retention, "AT_ONCE", 7)
    archive = Archive(str(tmp_path / "archive"))
    model = fill(store, [record(i) for i in range(100)])
    with store.write() as connection:
        limits = retention.RetentionLimits(START + 10 * HOP, 0, 0, store_bytes=1000)
        found = retention.forget(connection, limits, lambda c, *which: archive.keep(c, LONG_AFTER, *which))
    assert found.windows == 100 and found.windows_for_room == 90
    assert raw(store, archive, model) == [START + i * HOP for i in range(100)]


def test_an_archive_is_on_the_disk_before_the_windows_go(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power cut would take both otherwise: the store is synced with its commit."""
    synced: list[str] = []

    def sync(path: Path) -> None:
        assert path.exists()
        synced.append(path.name)

    monkeypatch.setattr("sprung.service.store.archive.sync_file", sync)
    monkeypatch.setattr("sprung.service.store.archive.sync_folder", sync)
    fill(store, [record(0)])
    with store.read() as connection:
        Archive(str(tmp_path / "archive")).keep(connection, 7)
    assert synced[0].startswith("part-7-") and synced[0].endswith(".parquet.part")
    assert synced[1:] == ["date=2026-09-21", "fleet=none", "archive", tmp_path.name]


def test_a_vehicle_that_is_deleted_is_deleted_in_the_archive_too(store: Store, tmp_path: Path) -> None:
    archive = Archive(str(tmp_path / "archive"))
    model = fill(store, [record(i) for i in range(10)])
    with store.write() as connection:
        retention.forget(
            connection,
            retention.RetentionLimits(START + 2 * NANOSECONDS, 0, 0),
            lambda c, *which: archive.keep(c, 1, *which),
        )
    assert archive.remove("b") == 0
    assert archive.remove("a") == 1
    assert raw(store, archive, model) == [START + i * HOP for i in range(4, 10)]


@pytest.mark.parametrize(
    ("vehicle", "fleet"),
    [("north-0017", "north"), ("db.ice.403", "db.ice"), ("demo", "none"), ("a_b-c", "a_b")],
)
def test_a_fleet_is_what_stands_before_the_number(vehicle: str, fleet: str) -> None:
    assert fleet_of(vehicle) == fleet


def test_a_place_that_cannot_be_used_is_one_clear_line() -> None:
    with pytest.raises(UserError, match="/proc/nowhere"):
        Archive("/proc/nowhere/archive")
    assert open_archive(None) is None
