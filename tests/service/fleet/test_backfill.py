"""Back-fill: the same as replaying in order, whatever fails on the way, and swapped in one step."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import func, select

from sprung.model.system import System
from sprung.replay.writing import write_recording
from sprung.service.errors import UserError
from sprung.service.fleet import backfill as module
from sprung.service.fleet.backfill import BackfillPlan, FoldedFile, backfill
from sprung.service.fleet.recordings import FoundFile
from sprung.service.fleet.tasks import HereTasks, WorkLost
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.processes.worker import ProcessLimits
from sprung.service.settings import Settings
from sprung.service.sources.feed import feed_file
from sprung.service.sources.reading import ReadRequest, reading_of
from sprung.service.store import Store, fleet, history, open_store, status
from sprung.service.store.fleet import WantedAlarms
from sprung.service.store.schema import alarms, models, windows
from tests.service_fakes import BelievingExaminer

START = 1_790_000_000_000_000_000
SECONDS = 12


@pytest.fixture(scope="module")
def written(system: System, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two vehicles, three recordings each, listed in no order of time; a file that is none, and one that is cut."""
    folder = tmp_path_factory.mktemp("written")
    (folder / "north").mkdir(parents=True)
    rng = np.random.default_rng(3)
    for vehicle in ("north-1", "north-2"):
        for part, name in enumerate("cab"):
            values = 0.01 * rng.normal(size=(100 * SECONDS, len(system.channels)))
            start = START + part * SECONDS * 1_000_000_000
            path = folder / "north" / f"{name}-{vehicle}.mcap"
            write_recording(path, system.channels, values, system.sample_rate, start, vehicle=vehicle)
    (folder / "broken.mcap").write_bytes(b"no recording")
    return folder


@pytest.fixture
def place(written: Path, tmp_path: Path) -> Path:
    """A copy of the recordings: some tests remove or change files."""
    return Path(shutil.copytree(written, tmp_path / "recordings"))


@pytest.fixture
def plan(
    engine: Engine, place: Path, any_store: Store, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> BackfillPlan:
    monkeypatch.setattr(module, "engine_of", lambda settings: engine)
    url = any_store.engine.url.render_as_string(hide_password=False)
    return BackfillPlan(Settings(data_dir=tmp_path, store=url), str(place), 0, 2**62)


def test_an_engine_is_loaded_once_whatever_else_is_set(tmp_path: Path) -> None:
    """Settings that say nothing of the model may be anything, a table of groups, too."""
    one = module.engine_of(Settings(data_dir=tmp_path))
    assert module.engine_of(Settings(data_dir=tmp_path / "other", oidc_groups={"works": ["read"]})) is one


def shown(file: FoldedFile, done: int, of: int) -> None:
    """Nothing."""


def replayed(engine: Engine, place: Path, tmp_path: Path) -> Store:
    """What replaying the same files in order of time comes to."""
    store, compute = open_store(str(tmp_path / "replayed.db")), Compute(4)
    pipeline = Pipeline(engine, store, compute)
    for name in "cab":
        for vehicle in ("north-1", "north-2"):
            feed_file(pipeline, place / "north" / f"{name}-{vehicle}.mcap")
    compute.close()
    return store


class _Close:  # noqa: PLW1641 (never a key)
    """Equal to within rounding."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def __eq__(self, other: object) -> bool:
        assert isinstance(other, _Close)
        return self.values.shape == other.values.shape and np.allclose(
            self.values, other.values, rtol=1e-12, atol=1e-14
        )


def everything(store: Store, digest: str) -> dict[str, object]:
    """Tracker states, roll-ups and posteriors of both vehicles, bit by bit."""
    found: dict[str, object] = {}
    with store.read() as connection:
        model = connection.execute(select(models.c.id).where(models.c.digest == digest)).scalar_one()
        for vehicle in ("north-1", "north-2"):
            row = fleet.load_tracker(connection, vehicle, model)
            assert row is not None
            found[vehicle] = row.state
            for resolution in (0, 60, 3600):
                series = history.series(connection, vehicle, model, 0, 2**62, resolution, 10_000)
                for name in ("time", "mean", "std"):
                    values = getattr(series, name)
                    # means of roll-ups depend on the order of their sums
                    found[f"{vehicle} {resolution} {name}"] = values.tobytes() if not resolution else _Close(values)
            line = status.fleet_row(connection, vehicle)
            assert line is not None
            found[f"{vehicle} windows"] = line.windows
    return found


def test_a_backfill_equals_replaying_in_order_of_time(
    plan: BackfillPlan, place: Path, engine: Engine, any_store: Store, tmp_path: Path
) -> None:
    told = backfill(plan, HereTasks(), 2, shown)
    assert (told.files, told.vehicles, told.swapped) == (7, ["north-1", "north-2"], 2)
    assert len(told.problems) == 1 and "broken.mcap" in told.problems[0]
    alone = replayed(engine, place, tmp_path)
    assert everything(any_store, engine.digest) == everything(alone, engine.digest)
    alone.close()


@pytest.fixture
def examiner(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> BelievingExaminer:
    """Finds a fault in every window; faults that are known change what it finds."""
    made = BelievingExaminer(engine.system)
    monkeypatch.setattr(module, "engine_of", lambda settings: replace(engine, identifier=made))
    return made


def test_a_backfill_equals_replaying_where_a_sensor_is_faulty(
    plan: BackfillPlan, place: Path, engine: Engine, any_store: Store, tmp_path: Path, examiner: BelievingExaminer
) -> None:
    backfill(plan, HereTasks(), 2, shown)
    assert examiner.faults in examiner.told and () in examiner.told
    alone = replayed(replace(engine, identifier=examiner), place, tmp_path)
    assert everything(any_store, engine.digest) == everything(alone, engine.digest)
    alone.close()


def test_a_recording_that_goes_away_before_it_is_read_again_is_reported_of(
    plan: BackfillPlan, place: Path, examiner: BelievingExaminer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def identified(asked: BackfillPlan, file: FoundFile) -> module.IdentifiedFile:
        found = identify(asked, file)
        if file.path.endswith("b-north-1.mcap"):  # the last one
            Path(file.path).unlink()
        return found

    identify = module.identify_file
    monkeypatch.setattr(module, "identify_file", identified)
    told = backfill(plan, HereTasks(), 2, shown)
    assert told.swapped == 2
    assert [one for one in told.problems if "b-north-1.mcap: no such file" in one]


def test_a_backfill_that_was_interrupted_goes_on(
    plan: BackfillPlan, place: Path, engine: Engine, any_store: Store, tmp_path: Path
) -> None:
    """Stopped after three files, and in the middle of what was fed to the fourth; until the end nothing is shown."""
    calls = 0

    class StoppedHere(Exception):
        pass

    class Dying(HereTasks):
        def submit(self, work: object, *arguments: object) -> object:
            nonlocal calls
            calls += work is module.fold_file
            if calls > 3:
                raise StoppedHere
            return super().submit(work, *arguments)  # type: ignore[arg-type]

    with pytest.raises(StoppedHere):
        backfill(plan, Dying(), 2, shown)
    with any_store.read() as connection:
        assert status.fleet_page(connection, status.StatusFilter(), "id", 10) == []
    told = backfill(plan, HereTasks(), 2, shown)
    assert told.done_before == 3
    alone = replayed(engine, place, tmp_path)
    assert everything(any_store, engine.digest) == everything(alone, engine.digest)
    alone.close()


def test_a_vehicle_of_which_work_was_lost_stays_as_it_was_until_the_next_time(
    plan: BackfillPlan, place: Path, engine: Engine, any_store: Store, tmp_path: Path
) -> None:
    """As when a worker runs out of memory with one recording, again and again."""

    class Losing(HereTasks):
        def submit(self, work: object, *arguments: object) -> object:
            lost = work is module.fold_file and arguments[1].file.path.endswith("a-north-2.mcap")  # type: ignore[attr-defined]
            return None if lost else super().submit(work, *arguments)  # type: ignore[arg-type]

        def result(self, pending: object) -> object:
            if pending is None:
                raise WorkLost("its process ended")
            return pending

    told = backfill(plan, Losing(), 2, shown)
    assert told.swapped == 1 and any("a-north-2.mcap: its process ended" in one for one in told.problems)
    with any_store.read() as connection:
        assert [row.id for row in status.fleet_page(connection, status.StatusFilter(), "id", 10)] == ["north-1"]


def test_a_copy_of_a_recording_adds_nothing_and_is_reported(plan: BackfillPlan, place: Path, any_store: Store) -> None:
    (place / "copy.mcap").write_bytes((place / "north" / "a-north-1.mcap").read_bytes())
    done: dict[str, FoldedFile] = {}
    backfill(plan, HereTasks(), 2, lambda file, *_: done.update({Path(file.file.path).name: file}))
    copy, original = done["copy.mcap"], done["a-north-1.mcap"]
    assert sorted([copy.windows, original.windows]) == [0, copy.known + original.known]
    with any_store.read() as connection:
        line = status.fleet_row(connection, "north-1")
    assert line is not None
    rows = sum(one.windows for name, one in done.items() if "north-2" not in name)
    assert sum(count for outcome, count in line.windows.items() if outcome != "unfitting") == rows


def test_a_recording_that_breaks_a_reader_is_reported_of_and_the_others_go_on(
    plan: BackfillPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    def breaking(request: ReadRequest, limits: ProcessLimits | None) -> object:
        if request.path.name == "b-north-1.mcap":
            raise KeyError("nobody has thought of it")
        return reading_of(request, limits)

    monkeypatch.setattr(module, "reading_of", breaking)
    told = backfill(plan, HereTasks(), 2, shown)
    assert told.swapped == 2
    assert any("b-north-1.mcap: unexpected KeyError: 'nobody has thought of it'" in one for one in told.problems)


def test_what_was_there_is_replaced_and_other_times_stay(
    plan: BackfillPlan, place: Path, engine: Engine, any_store: Store, tmp_path: Path
) -> None:
    """The second recording was replayed before, alone; so was one of a day later."""
    compute = Compute(4)
    pipeline = Pipeline(engine, any_store, compute)
    feed_file(pipeline, place / "north" / "a-north-1.mcap")
    later = tmp_path / "later-north-1.mcap"
    values = np.full((1000, len(engine.system.channels)), 0.02)
    start = START + 86_400_000_000_000
    write_recording(later, engine.system.channels, values, engine.system.sample_rate, start, vehicle="north-1")
    feed_file(pipeline, later)
    state = pipeline.state("north-1").to_dict()
    compute.close()
    backfill(plan, HereTasks(), 2, shown)
    with any_store.read() as connection:
        model = pipeline.model_id
        inside = history.series(connection, "north-1", model, 0, START + 10**12, 0, 10_000)
        after = history.series(connection, "north-1", model, start, 2**62, 0, 10_000)
        minutes = history.series(connection, "north-1", model, 0, START + 10**12, 60, 10_000)
        assert len(inside.time) > 3 * 2 * (SECONDS - 2)
        assert int(minutes.windows.sum()) == len(inside.time)
        assert len(after.time) >= 17
        row = fleet.load_tracker(connection, "north-1", model)
        assert row is not None and row.state == state  # it had seen later windows
        left = select(func.count()).select_from(windows).where(windows.c.model_id != model)
        assert connection.execute(left).scalar_one() == 0


def test_alarms_of_a_backfill_are_unseen_until_it_is_done(engine: Engine, any_store: Store) -> None:
    with any_store.write() as connection:
        fleet.ensure_vehicle(connection, "north-1", START, listed=False)
        staged = fleet.ensure_model(connection, "staging:x", "toy", {}, START)
        row = {"vehicle_id": "north-1", "model_id": staged, "kind": "change", "parameter": "p", "severity": "alarm"}
        connection.execute(alarms.insert().values(**row, opened_ns=1, onset_ns=1))
        assert fleet.list_alarms(connection, WantedAlarms(), 10) == []
        connection.execute(models.update().values(digest="shown"))
        assert len(fleet.list_alarms(connection, WantedAlarms(), 10)) == 1


def test_windows_outside_the_times_are_left_out(plan: BackfillPlan, any_store: Store, engine: Engine) -> None:
    middle = replace(plan, since=START + 3_000_000_000, until=START + 6_000_000_000)
    backfill(middle, HereTasks(), 2, shown)
    with any_store.read() as connection:
        starts = connection.execute(select(windows.c.start_ns).where(windows.c.vehicle_id == "north-1")).scalars().all()
    assert len(starts) == 6
    assert min(starts) >= middle.since and max(starts) < middle.until


def test_a_place_without_recordings_is_one_clear_line(plan: BackfillPlan, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such folder"):
        backfill(replace(plan, place=str(tmp_path / "nowhere")), HereTasks(), 1, shown)
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no recordings"):
        backfill(replace(plan, place=str(tmp_path / "empty")), HereTasks(), 1, shown)
