"""What is kept: by both clocks of a window, within bytes, and no clock that leaps forgets anything."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from sqlalchemy import func, select

from sprung.model.system import System
from sprung.service.cli import retention as retention_command
from sprung.service.core import Core
from sprung.service.housekeeping import DAY, Housekeeping
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.settings import Settings
from sprung.service.store import Store, open_store, retention, work
from sprung.service.store.schema import windows
from tests.clocks import Clocks
from tests.service_fakes import START, make_window

HOUR = DAY // 24


def stored(store: Store) -> int:
    with store.read() as connection:
        return int(connection.execute(select(func.count()).select_from(windows)).scalar_one())


def fill(engine: Engine, store: Store, compute: Compute, system: System, at: int, first: int = 0) -> None:
    pipeline = Pipeline(engine, store, compute, clock=lambda: at)
    pipeline.process("a", [make_window(system, first + i) for i in range(20)])


def test_a_clock_that_cannot_be_written_down_goes_on_all_the_same(tmp_path: Path) -> None:
    """On a full disk, what is old must be deleted more than ever."""
    (tmp_path / "full").write_text("no folder")
    clocks = Clocks(START)
    clock = clocks.retention(tmp_path / "full" / "retention.json")
    assert clock.now() == START
    clocks.passed(3600)
    assert clock.now() == START + HOUR


def test_the_clock_goes_on_with_time_but_takes_no_leap(tmp_path: Path) -> None:
    path, clocks = tmp_path / "retention.json", Clocks(START)
    clock = clocks.retention(path)
    assert clock.now() == START
    clocks.passed(3600)
    assert clock.now() == START + HOUR
    clocks.passed(3600, leap=40 * DAY)
    assert clock.now() == START + 2 * HOUR
    clocks.passed(3600, leap=-80 * DAY)
    assert clock.now() == START + 3 * HOUR


def test_what_comes_while_the_clock_is_set_back_is_not_old_when_it_is_right_again(
    engine: Engine, store: Store, compute: Compute, system: System, tmp_path: Path
) -> None:
    """Windows of a live bus are stamped by the host's clock: a wrong one makes them old by both."""
    clocks = Clocks(START + 100 * DAY)
    housekeeping = Housekeeping(Settings(data_dir=tmp_path), store)
    housekeeping.clock = clocks.retention(tmp_path / "retention.json")
    housekeeping.clock.now()
    clocks.passed(60, leap=-100 * DAY)
    pipeline = Pipeline(engine, store, compute, clock=lambda: clocks.wall)
    pipeline.aging = housekeeping.clock.read
    pipeline.process("a", [make_window(system, i) for i in range(20)])
    clocks.passed(60, leap=100 * DAY)
    assert housekeeping.once(housekeeping.clock.now()).windows == 0 and stored(store) == 20
    clocks.passed(31 * 86_400)
    assert housekeeping.once(housekeeping.clock.now()).windows == 20


def test_uploads_that_come_while_the_clock_is_set_back_are_not_old_when_it_is_right_again(core: Core) -> None:
    """Neither do they go first when room is needed."""
    clocks = Clocks(START + 400 * DAY)
    vars(core.housekeeping.clock).update(_wall=lambda: clocks.wall, _monotonic=lambda: clocks.monotonic)
    for name, leap in (("before.csv", -300 * DAY), ("meanwhile.csv", 300 * DAY), ("after.csv", 0)):
        row = work.RecordingRow(name, None, "n", "upload", name, 100, None, clocks.wall, None)
        job = core.jobs.submit("recording", row)
        with core.store.write() as connection:
            work.update_job(connection, job.id, 1, state="done")
        clocks.passed(3600, leap=leap)
    assert core.housekeeping.once(core.housekeeping.clock.now()).upload_files == ()
    with core.store.write() as connection:
        found = retention.forget(connection, retention.RetentionLimits(0, 0, 0, upload_bytes=250))
    assert found.upload_files == ("before.csv",)
    clocks.passed(core.settings.retention_uploads_days * 86_400 - 7200)
    assert core.housekeeping.once(core.housekeeping.clock.now()).upload_files == ()
    clocks.passed(3600)
    assert core.housekeeping.once(core.housekeeping.clock.now()).upload_files == ("meanwhile.csv",)


def test_signals_of_an_alarm_that_was_raised_while_the_clock_was_set_back_are_kept(core: Core) -> None:
    clocks = Clocks(START + 400 * DAY)
    vars(core.housekeeping.clock).update(_wall=lambda: clocks.wall, _monotonic=lambda: clocks.monotonic)
    assert core.alarm_signals._aging() == clocks.wall
    clocks.passed(3600, leap=-300 * DAY)
    assert core.alarm_signals._aging() == START + 400 * DAY + HOUR


def test_the_service_stores_windows_by_the_clock_of_retention(core: Core, system: System) -> None:
    clocks = Clocks(START + 5 * DAY)
    vars(core.housekeeping.clock).update(_wall=lambda: clocks.wall, _monotonic=lambda: clocks.monotonic)
    core.pipeline.process("a", [make_window(system, i) for i in range(3)])
    with core.store.read() as connection:
        assert set(connection.execute(select(windows.c.stored_ns)).scalars()) == {START + 5 * DAY}


@pytest.mark.parametrize(("leap", "advance"), [(40 * DAY, DAY), (5500 * DAY, DAY), (-9000 * DAY, 0), (HOUR, HOUR)])
def test_a_restart_advances_it_by_a_day_at_the_most(tmp_path: Path, leap: int, advance: int) -> None:
    path = tmp_path / "retention.json"
    Clocks(START).retention(path).now()
    assert Clocks(START + leap).retention(path).now() == START + advance


@pytest.mark.parametrize("walls", [[5500] * 40, [5500, 0] * 20, [0, -20000] * 20, [0.9, 0] * 20])
def test_many_starts_by_a_wrong_clock_advance_it_by_a_day_at_the_most(tmp_path: Path, walls: list[float]) -> None:
    path = tmp_path / "retention.json"
    Clocks(START).retention(path).now()
    for second, leap in enumerate(walls):
        advanced = Clocks(START + round(leap * DAY) + second * 10**9).retention(path).now() - START
        assert 0 <= advanced <= DAY + 40 * 10**9


@pytest.mark.parametrize("leap", [0, 5500 * DAY, -9000 * DAY])
def test_days_go_on_by_a_wrong_clock_and_after_it_was_set_right(tmp_path: Path, leap: int) -> None:
    path, clocks = tmp_path / "retention.json", Clocks(START)
    clocks.retention(path).now()
    clocks.passed(0, leap)
    before = clocks.retention(path).now()
    for back in (0, -leap):
        clocks.passed(0, back)
        for _ in range(20):  # a day each, half of it a pause
            clock = clocks.retention(path)
            clock.now()
            clocks.passed(43200)
            clock.now()
            clocks.passed(43200)
    assert clocks.retention(path).now() >= before + 37 * DAY


def test_a_clock_written_by_an_earlier_version_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "retention.json"
    path.write_text(f'{{"time_ns": {START}}}')
    assert Clocks(START + HOUR).retention(path).now() == START + HOUR


def test_a_preview_by_the_command_does_not_move_the_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPRUNG_DATA_DIR", str(tmp_path))
    path = tmp_path / "retention.json"
    open_store(f"sqlite:///{tmp_path / 'sprung.db'}").close()
    Clocks(START).retention(path).now()
    before = path.read_bytes()
    assert retention_command.run(dry_run=True, data_dir=None, store=None) == 0
    assert path.read_bytes() == before
    assert retention_command.run(dry_run=False, data_dir=None, store=None) == 0
    assert path.read_bytes() != before


def test_without_its_file_it_begins_at_the_last_window(tmp_path: Path) -> None:
    path = tmp_path / "retention.json"
    assert Clocks(START + 40 * DAY).retention(path, newest=START).now() == START + DAY
    path.write_text("rubbish")
    assert Clocks(START + 40 * DAY).retention(path, newest=START).now() == START + DAY


@pytest.mark.parametrize("leap", [40 * DAY, 5500 * DAY])
def test_a_clock_that_is_ahead_at_the_start_forgets_nothing(
    engine: Engine, store: Store, compute: Compute, system: System, tmp_path: Path, leap: int
) -> None:
    fill(engine, store, compute, system, START)
    housekeeping = Housekeeping(Settings(data_dir=tmp_path), store)
    housekeeping.clock = Clocks(START + leap).retention(tmp_path / "retention.json", newest=START)
    assert housekeeping.once(housekeeping.clock.now()).windows == 0
    assert stored(store) == 20


@pytest.mark.parametrize(
    ("stored_at", "forgotten"), [(0, 0), (START, 20), (START + 31 * DAY, 0)], ids=["1970", "long ago", "lately"]
)
def test_a_window_is_old_when_its_data_and_its_storing_are(
    engine: Engine, store: Store, compute: Compute, system: System, tmp_path: Path, stored_at: int, forgotten: int
) -> None:
    fill(engine, store, compute, system, stored_at)
    found = Housekeeping(Settings(data_dir=tmp_path), store).once(START + 32 * DAY)
    assert (found.windows, stored(store)) == (forgotten, 20 - forgotten)


def test_a_preview_tells_the_same_and_keeps_everything(
    engine: Engine, store: Store, compute: Compute, system: System, tmp_path: Path
) -> None:
    fill(engine, store, compute, system, START)
    housekeeping = Housekeeping(Settings(data_dir=tmp_path), store)
    preview = housekeeping.once(START + 32 * DAY, keep=False)
    assert (preview.windows, stored(store)) == (20, 20)
    assert housekeeping.once(START + 32 * DAY) == preview
    assert stored(store) == 0


def test_a_store_that_is_too_large_loses_its_oldest_windows(
    engine: Engine, store: Store, compute: Compute, system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sprung.service.store.retention.AT_ONCE", 5)
    for first in range(0, 200, 20):
        fill(engine, store, compute, system, START, first)
    with store.read() as connection:
        used = retention.used_bytes(connection)
    assert used is not None
    with store.write() as connection:
        found = retention.forget(connection, retention.RetentionLimits(0, 0, 0, store_bytes=used - 50_000))
        left = connection.execute(select(func.min(windows.c.start_ns))).scalar_one()
    assert 0 < found.windows == found.windows_for_room < 200
    assert found.too_many_bytes == 0
    assert left == START + found.windows * 500_000_000  # the oldest went


def test_a_store_that_is_too_large_without_any_window_is_told_of(
    engine: Engine,
    store: Store,
    compute: Compute,
    system: System,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    fill(engine, store, compute, system, START)
    housekeeping = Housekeeping(Settings(data_dir=tmp_path, retention_store_bytes=1000), store)
    found = housekeeping.once(START)
    assert stored(store) == 0 and found.too_many_bytes > 0
    assert "beyond SPRUNG_RETENTION_STORE_BYTES: no more windows can go" in caplog.text


def test_a_store_that_is_slightly_too_large_loses_few_windows(
    engine: Engine, store: Store, compute: Compute, system: System
) -> None:
    for first in range(0, 200, 20):
        fill(engine, store, compute, system, START, first)
    with store.write() as connection:
        used = retention.used_bytes(connection)
        assert used is not None
        found = retention.forget(connection, retention.RetentionLimits(0, 0, 0, store_bytes=used - 10_000))
    assert 0 < found.windows <= 2 * retention.FEWEST


def test_uploads_make_room_oldest_first(store: Store) -> None:
    with store.write() as connection:
        for number in range(5):
            row = work.RecordingRow(f"r{number}", None, "n", "upload", f"{number}.csv", 100, None, START + number, None)
            work.add_recording(connection, row)
        found = retention.forget(connection, retention.RetentionLimits(0, 0, 0, upload_bytes=250))
    assert found.upload_files == ("0.csv", "1.csv", "2.csv")


def test_a_round_that_fails_for_whatever_reason_is_not_the_last(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("sprung.service.housekeeping.PERIOD_SECONDS", 0.01)
    housekeeping = Housekeeping(Settings(data_dir=tmp_path), store)
    rounds, twice = [0], threading.Event()

    def once(now: int) -> None:
        rounds[0] += 1
        if rounds[0] > 1:
            twice.set()
        raise RuntimeError("nobody thought of this")

    monkeypatch.setattr(housekeeping, "once", once)
    housekeeping.start()
    assert twice.wait(10)
    housekeeping.close()
    assert "tries again" in caplog.text
