"""The store: migrations, windows once, history and roll-ups against brute force, forgetting."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from sqlalchemy import func, select, text

from sprung.model.tracking.state import Alarm
from sprung.service.errors import UserError
from sprung.service.fleet.local_postgres import PostgresServer
from sprung.service.store import Store, fleet, history, open_store, partitions, retention, status, work
from sprung.service.store.schema import metadata, windows
from sprung.service.store.windows import (
    Posterior,
    StoredEstimate,
    VehicleWindows,
    WindowLoads,
    WindowRecord,
    add_windows,
    known_windows,
)
from sprung.service.times import NANOSECONDS, from_iso, to_iso

P, S = 3, 2
START = 1_790_000_000 * NANOSECONDS
HOP = NANOSECONDS // 2
DAY = 86_400 * NANOSECONDS


def record(number: int, level: float | None = None) -> WindowRecord:
    mean = np.full(P, 0.001 * number if level is None else level)
    solved = StoredEstimate(
        mean, np.full(P, 0.1), np.array([True, False, True]), 0.03, np.array([0.02, np.nan]), 1.1, True, True, 2
    )
    return WindowRecord(START + number * HOP, "used", None, 0, True, solved, Posterior(mean, np.full(P, 0.01)))


def fill(store: Store, records: list[WindowRecord], stored_ns: int = START) -> int:
    with store.write() as connection:
        fleet.ensure_vehicle(connection, "a", stored_ns)
        model = fleet.ensure_model(connection, "digest", "toy", {}, stored_ns)
        stored = [VehicleWindows("a", model, records)]
        add_windows(connection, stored, stored_ns, None)
        history.add_to_rollups(connection, stored, stored_ns)
    return model


def test_migrations_make_the_tables_that_the_code_uses(any_store: Store) -> None:
    with any_store.read() as connection:
        context = MigrationContext.configure(
            connection, opts={"compare_type": True, "include_name": lambda name, *_: "windows_2" not in (name or "")}
        )
        assert compare_metadata(context, metadata) == []


def test_the_load_of_a_window_is_read_back_as_it_was(any_store: Store) -> None:
    whole = WindowLoads({"car": (3100.1, 400.3)}, {"car": (2950.7, 1 / 3)})
    believed = WindowLoads({}, {"car": (2951.0, 60.0), "van": (-3.0, 1.0)})
    loads = [whole, believed, WindowLoads()]
    model = fill(any_store, [replace(record(i, 0.1), loads=of) for i, of in enumerate(loads)])
    with any_store.read() as connection:
        known = known_windows(connection, "a", model, [record(i).start for i in range(3)])
    assert [known[record(i).start].loads for i in range(3)] == loads


def test_sqlite_runs_in_wal_mode_with_foreign_keys(store: Store) -> None:
    with store.read() as connection:
        assert connection.execute(text("PRAGMA journal_mode")).scalar_one() == "wal"
        assert connection.execute(text("PRAGMA foreign_keys")).scalar_one() == 1
        assert connection.execute(text("PRAGMA synchronous")).scalar_one() == 2  # FULL


def test_vehicles_that_an_earlier_version_called_well_unheard_are_not_called_so_any_more(tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    store = open_store(str(path))
    fill(store, [])
    with store.write() as connection:
        for vehicle in ("unheard", "heard"):
            fleet.ensure_vehicle(connection, vehicle, START)
    _migrate(store, "downgrade", "0009")
    with store.write() as connection:
        connection.execute(text("update fleet_status set health = 'ok'"))
        connection.execute(text("update fleet_status set revision = 1, last_window_ns = 1 where vehicle_id = 'heard'"))
    store.close()
    store = open_store(str(path))
    with store.read() as connection:
        health = {row.id: row.health for row in status.fleet_page(connection, status.StatusFilter(), "id", 9)}
    store.close()
    assert (health["unheard"], health["heard"]) == ("check_function", "ok")


def test_a_store_of_a_newer_version_is_refused_in_words_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    open_store(str(path)).close()
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("update alembic_version set version_num = '9999'")
        connection.commit()
        before = list(connection.iterdump())
        with pytest.raises(UserError, match="newer version of Sprung"):
            open_store(str(path))
        assert list(connection.iterdump()) == before


def test_opening_again_changes_nothing(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/again.db"
    first = open_store(url)
    model = fill(first, [record(0)])
    first.close()
    second = open_store(url)
    with second.read() as connection:
        assert list(known_windows(connection, "a", model, [START])) == [START]
    second.close()


@pytest.mark.parametrize(
    "url",
    ["mysql://somewhere/db", "nonsense://", "sqlite://", "sqlite:////proc/nowhere/x.db"],
)
def test_a_url_that_cannot_be_used_is_one_clear_line(url: str) -> None:
    with pytest.raises(UserError) as caught:
        open_store(url)
    assert url in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_database_is_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "notes.db"
    path.write_text("not a database, but longer than a header of one would be " * 40)
    with pytest.raises(UserError, match="not a database"):
        open_store(str(path))


def test_a_window_comes_back_as_it_was_stored(any_store: Store) -> None:
    model = fill(any_store, [record(7)])
    with any_store.read() as connection:
        found = known_windows(connection, "a", model, [START + 7 * HOP])[START + 7 * HOP]
    expected = record(7)
    assert found.solved is not None and expected.solved is not None
    assert found.posterior is not None and expected.posterior is not None
    np.testing.assert_array_equal(found.solved.log_ratio, expected.solved.log_ratio)
    np.testing.assert_array_equal(found.solved.identifiable, expected.solved.identifiable)
    np.testing.assert_array_equal(found.solved.per_sensor, expected.solved.per_sensor)
    np.testing.assert_array_equal(found.posterior.std, expected.posterior.std)
    assert (found.outcome, found.tracked, found.solved.iterations) == ("used", True, 2)


def test_a_window_is_stored_once_and_the_first_stays(any_store: Store) -> None:
    fill(any_store, [record(0, level=0.1)])
    model = fill(any_store, [record(0, level=0.9), record(1)])
    with any_store.read() as connection:
        assert connection.execute(select(func.count()).select_from(windows)).scalar_one() == 2
        first = known_windows(connection, "a", model, [START])[START]
    assert first.solved is not None
    assert first.solved.log_ratio[0] == 0.1


def test_a_transaction_that_fails_leaves_nothing(any_store: Store) -> None:
    with pytest.raises(RuntimeError), any_store.write() as connection:
        fleet.ensure_vehicle(connection, "ghost", START)
        raise RuntimeError
    with any_store.read() as connection:
        assert not fleet.vehicle_exists(connection, "ghost")


def test_rollups_equal_the_statistics_of_their_windows_however_they_were_cut(any_store: Store) -> None:
    rng = np.random.default_rng(3)
    records = [record(i, level=float(rng.normal())) for i in range(1000)]  # 500 s: nine minutes are touched
    for first in range(0, 1000, 37):
        model = fill(any_store, records[first : first + 37])
    with any_store.read() as connection:
        points = history.series(connection, "a", model, 0, 2**62, 60, 100)
    assert points.windows.sum() == 1000
    for i, time in enumerate(points.time):
        inside = [
            r.posterior.log_ratio[0]
            for r in records
            if r.posterior is not None and time <= r.start < time + 60 * NANOSECONDS
        ]
        assert points.windows[i] == len(inside)
        assert points.mean[i, 0] == pytest.approx(np.mean(inside))
        assert (points.low[i, 0], points.high[i, 0]) == (min(inside), max(inside))


def test_history_bounds_range_and_number_and_keeps_the_newest(any_store: Store) -> None:
    model = fill(any_store, [record(i) for i in range(100)])
    with any_store.read() as connection:
        raw = history.series(connection, "a", model, START + 10 * HOP, START + 20 * HOP, 0, 1000)
        newest = history.series(connection, "a", model, 0, 2**62, 0, 5)
        coarse = history.series(connection, "a", model, 0, 2**62, 5, 1000)
    assert raw.time.tolist() == [START + i * HOP for i in range(10, 20)]
    assert newest.time.tolist() == [START + i * HOP for i in range(95, 100)]
    assert coarse.windows.sum() == 100
    assert (np.diff(coarse.time) == 5 * NANOSECONDS).all()


def test_hours_are_distinguished_from_hourly_rollups(any_store: Store) -> None:
    hours = [record(i * 7200) for i in range(48)]  # one window an hour, for two days
    model = fill(any_store, hours)
    with any_store.read() as connection:
        points = history.series(connection, "a", model, 0, 2**62, 6 * 3600, 1000)
        chosen = history.fitting_resolution(connection, "a", model, 0, 2**62, 10)
    assert points.windows.sum() == 48
    assert chosen >= 47 * 3600 / 10


def test_forgetting_counts_from_when_a_window_was_stored(any_store: Store) -> None:
    """Windows of one month, one stored at once and one long after, and of two months later."""
    later, day = START + 200 * DAY, DAY // HOP
    fill(any_store, [record(0)], stored_ns=START)
    fill(any_store, [record(61 * day)], stored_ns=START)
    fill(any_store, [record(122 * day)], stored_ns=later)
    with any_store.write() as connection:
        forgotten = retention.forget(connection, retention.RetentionLimits(later, 0, 0))
    assert forgotten.windows == 2
    with any_store.read() as connection:
        assert connection.execute(select(windows.c.start_ns)).scalars().all() == [START + 122 * DAY]


def test_a_month_of_which_one_window_is_young_is_kept_whole_on_postgresql(any_store: Store) -> None:
    fill(any_store, [record(0)], stored_ns=START)
    fill(any_store, [record(1)], stored_ns=START + 100 * DAY)
    with any_store.write() as connection:
        forgotten = retention.forget(connection, retention.RetentionLimits(START + 100 * DAY, 0, 0))
    assert forgotten.windows == (0 if any_store.many_writers else 1)


def test_the_oldest_windows_make_room(any_store: Store) -> None:
    fill(any_store, [record(i) for i in range(300)] + [record(61 * DAY // HOP)])
    with any_store.write() as connection:
        used = retention.used_bytes(connection)
        assert used is not None
        forgotten = retention.forget(connection, retention.RetentionLimits(0, 0, 0, store_bytes=used - 1))
        left = connection.execute(select(func.count()).select_from(windows)).scalar_one()
    assert forgotten.windows_for_room >= (300 if any_store.many_writers else 1)
    assert left == 301 - forgotten.windows_for_room


def test_of_months_that_make_room_no_more_go_than_are_needed(postgres: PostgresServer) -> None:
    store = open_store(postgres.database())
    fill(store, [record(month * 61 * DAY // HOP + i) for month in range(3) for i in range(100)])
    with store.write() as connection:
        used = retention.used_bytes(connection)
        assert used is not None
        forgotten = retention.forget(connection, retention.RetentionLimits(0, 0, 0, store_bytes=used - 1))
        left = [month.name for month in partitions.months(connection)]
    store.close()
    assert forgotten.windows_for_room == 100
    assert left == ["windows_2026_11", "windows_2027_01"]


def test_months_that_are_old_have_made_room_already(postgres: PostgresServer) -> None:
    """PostgreSQL shows the room of a dropped table only after the commit."""
    store = open_store(postgres.database())
    fill(store, [record(month * 61 * DAY // HOP + i) for month in range(3) for i in range(100)], stored_ns=START)
    with store.write() as connection:
        used = retention.used_bytes(connection)
        assert used is not None
        limits = retention.RetentionLimits(START + 40 * DAY, 0, 0, store_bytes=used - 1)
        forgotten = retention.forget(connection, limits)
    store.close()
    assert (forgotten.windows, forgotten.windows_for_room) == (100, 0)


def test_months_are_partitions_made_when_they_are_needed(postgres: PostgresServer) -> None:
    store = open_store(postgres.database())
    fill(store, [record(0), record(61 * DAY // HOP)])
    with store.read() as connection:
        found = partitions.months(connection)
    assert [month.name for month in found] == ["windows_2026_09", "windows_2026_11"]
    assert found[0].begin <= START < found[0].end
    store.close()


def test_many_windows_are_copied_and_those_that_are_there_stay(any_store: Store) -> None:
    fill(any_store, [record(5, level=0.9)])
    model = fill(any_store, [record(i) for i in range(3 * partitions.COPY_FROM)])
    with any_store.read() as connection:
        found = known_windows(connection, "a", model, [START + i * HOP for i in range(200)])
    assert len(found) == 3 * partitions.COPY_FROM
    fifth, sixth = found[START + 5 * HOP].solved, found[START + 6 * HOP]
    assert fifth is not None and fifth.log_ratio[0] == 0.9
    assert sixth.solved is not None and sixth.posterior is not None
    assert (sixth.solved.log_ratio[0], sixth.posterior.std[0], sixth.reason) == (0.006, 0.01, None)


def test_a_store_of_the_version_before_keeps_its_windows(any_store: Store) -> None:
    model = fill(any_store, [record(0), record(70 * DAY // HOP)])
    _migrate(any_store, "downgrade", "0003")
    with any_store.read() as connection:
        assert connection.execute(text("SELECT count(*) FROM posteriors")).scalar_one() == 2
    _migrate(any_store, "upgrade", "head")
    with any_store.read() as connection:
        found = known_windows(connection, "a", model, [START, START + 70 * DAY])
    assert len(found) == 2
    seen = found[START].posterior
    assert seen is not None and seen.std[0] == 0.01


def test_what_an_alarm_is_not_distinguished_from_is_kept_with_it(any_store: Store) -> None:
    """Also while it is closed, and in a list after the tracker has forgotten it; alarms of an older store have none."""
    alarm = Alarm("change", "primary_11l.damping", 0, 1, "warning", -0.1, 0.02, alternatives=("bogie1_1l.gain",))
    model = fill(any_store, [])
    _save(any_store, model, [alarm, replace(alarm, opened=2, alternatives=())])
    assert _alternatives(any_store) == [(), ("bogie1_1l.gain",)]
    _save(any_store, model, [replace(alarm, closed=3)])
    assert _alternatives(any_store) == [(), ("bogie1_1l.gain",)]
    _migrate(any_store, "downgrade", "0006")
    _migrate(any_store, "upgrade", "head")
    assert _alternatives(any_store) == [(), ()]
    _save(any_store, model, [alarm])  # which the tracker still knows
    assert _alternatives(any_store) == [(), ("bogie1_1l.gain",)]


def _save(store: Store, model: int, found: list[Alarm]) -> None:
    with store.write() as connection:
        fleet.save_alarms(connection, "a", model, found)


def _alternatives(store: Store) -> list[tuple[str, ...]]:
    with store.read() as connection:
        return [row.alternatives for row in fleet.list_alarms(connection, fleet.WantedAlarms("a"), 10)]


def _migrate(store: Store, direction: str, revision: str) -> None:
    config = Config()
    config.set_main_option("script_location", "sprung.service:migrations")
    config.set_main_option("path_separator", "os")
    with store.write() as connection:
        config.attributes["connection"] = connection
        getattr(command, direction)(config, revision)


def test_forgetting_names_old_uploads_but_not_those_a_job_needs(any_store: Store) -> None:
    with any_store.write() as connection:
        for name in ("old", "needed", "new"):
            created = START + (100 if name != "new" else 200)
            row = work.RecordingRow(name, None, f"{name}.blf", "upload", f"{name}.blf", 1, None, created, None)
            work.add_recording(connection, row)
        work.add_job(connection, work.JobRow("j", "recording", "queued", "needed", None, 0.0, None, None, 100, 100))
        assert retention.forget(connection, retention.RetentionLimits(0, 0, START + 150)).upload_files == ("old.blf",)


def test_two_processes_can_share_a_file(store: Store, tmp_path: Path) -> None:
    fill(store, [record(0)])
    with sqlite3.connect(tmp_path / "test.db") as other:
        assert other.execute("SELECT count(*) FROM windows").fetchone() == (1,)
    other.close()


@pytest.mark.parametrize(
    ("text_", "nanoseconds"),
    [
        ("2026-09-21T14:13:20Z", 1_790_000_000 * NANOSECONDS),
        ("2026-09-21T14:13:20.500Z", 1_790_000_000 * NANOSECONDS + 500_000_000),
        ("2026-09-21T16:13:20+02:00", 1_790_000_000 * NANOSECONDS),
        ("1790000000", 1_790_000_000 * NANOSECONDS),
    ],
)
def test_times_are_read_in_the_ways_people_write_them(text_: str, nanoseconds: int) -> None:
    assert from_iso(text_) == nanoseconds


@pytest.mark.parametrize("text_", ["2026-09-21T14:13:20", "2026-09-21", "yesterday", ""])
def test_a_time_without_zone_is_not_guessed(text_: str) -> None:
    with pytest.raises(ValueError):
        from_iso(text_)


def test_times_are_written_to_the_millisecond() -> None:
    assert to_iso(1_790_000_000_499_600_000) == "2026-09-21T14:13:20.500Z"
    assert from_iso(to_iso(START)) == START
