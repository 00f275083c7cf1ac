"""Uploads, live buses, background diagnoses: work that goes on beside the requests."""

from __future__ import annotations

import csv
import math
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import cantools
import pytest
from cantools.database.can import Database
from fastapi.testclient import TestClient
from sqlalchemy.exc import OperationalError

from sprung.model.signals import Tally
from sprung.model.system import MANCHESTER, MANCHESTER_DBC, System, parse_system
from sprung.model.tracking.tracker import Tracker
from sprung.replay.live import LiveBus
from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.errors import UserError
from sprung.service.main import Feeds, _feed_files, _limits, live_feed
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import Engine, make_tracker
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.processes.worker import WorkerKilled
from sprung.service.settings import Settings
from sprung.service.sources.feed import feed_file, vehicle_of
from sprung.service.sources.live import LiveFeed
from sprung.service.sources.reading import ProcessReading, ReadWindows, prefetched
from sprung.service.store import open_store, work
from sprung.service.store.work import JobRow
from tests.service_fakes import START, FakeIdentifier, diagnose, eventually, hold, make_window

SECONDS = 5


@pytest.fixture(scope="module")
def tracked_columns() -> tuple[System, Tracker]:
    """The Manchester system, its signals found in the columns of a CSV file, and its tracker."""
    found = parse_system(MANCHESTER.read_text().replace("can: ", "csv: "))
    return found, make_tracker(found)


@pytest.fixture
def csv_engine(tracked_columns: tuple[System, Tracker]) -> Engine:
    system, tracker = tracked_columns
    return Engine(system, FakeIdentifier(system), tracker)


@pytest.fixture
def recording(tmp_path: Path, csv_engine: Engine) -> Path:
    """A few seconds in which every channel stays at 0.01."""
    path = tmp_path / "car 7.csv"
    with open(path, "w", newline="") as target:
        writer = csv.writer(target)
        writer.writerow(["time", *(channel.csv for channel in csv_engine.system.channels)])
        for row in range(100 * SECONDS):
            writer.writerow([f"{START / 1e9 + row / 100:.3f}", *[0.01] * len(csv_engine.system.channels)])
    return path


@pytest.fixture
def core(csv_engine: Engine, tmp_path: Path, empty_store: Path, reading_here: None) -> Core:
    data = tmp_path / "data"
    data.mkdir()
    shutil.copy(empty_store, data / "sprung.db")
    core = build_core(Settings(data_dir=data, misfit_seconds=5, job_queue=2), csv_engine)
    core.diagnosis_jobs.task = diagnose
    return core


@pytest.fixture
def client(core: Core) -> Iterator[TestClient]:
    with TestClient(create_app(core)) as running:
        yield running


def finished(client: TestClient, job: dict[str, Any]) -> dict[str, Any]:
    """The job when it is done or failed."""

    def ended() -> Any:
        found = client.get(f"/jobs/{job['id']}").json()
        return found if found["state"] in ("done", "failed") else None

    answer: dict[str, Any] = eventually(ended)
    return answer


def upload(client: TestClient, path: Path, name: str | None = None, **form: str) -> Any:
    with open(path, "rb") as stream:
        return client.post("/recordings", files={"file": (name or path.name, stream)}, data=form)


def test_a_file_is_fed_whole_and_counted(csv_engine: Engine, recording: Path, tmp_path: Path) -> None:
    store, compute = open_store(str(tmp_path / "x.db")), Compute(4)
    fed = feed_file(Pipeline(csv_engine, store, compute), recording, batch_windows=4)
    compute.close()
    store.close()
    assert fed.vehicle == "car_7"
    assert fed.windows == {"used": 9, "repaired": 0, "dropped": 0}
    assert fed.tally.used == 100 * SECONDS
    assert fed.recorded_seconds == pytest.approx(SECONDS)
    assert (fed.lost, fed.expected) == (0, 28 * 100 * SECONDS)


def test_an_upload_becomes_a_job_and_its_windows_are_stored(
    client: TestClient, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()  # this one is read as in operation: in a process of its own
    response = upload(client, recording)
    assert response.status_code == 202
    job = response.json()
    assert response.headers["location"] == f"/jobs/{job['id']}"
    done = finished(client, job)
    assert (done["state"], done["progress"]) == ("done", 1.0), done
    assert done["result"]["vehicle"] == "car_7"
    assert done["result"]["windows"]["used"] == 9
    assert client.get("/vehicles/car_7").json()["windows"]["used"] == 9
    assert 'sprung_frames_total{outcome="used",source="upload"} 500.0' in client.get("/metrics").text


def test_the_same_upload_twice_stores_nothing_twice(client: TestClient, recording: Path) -> None:
    for _ in range(2):
        finished(client, upload(client, recording, vehicle="bus-7").json())
    assert client.get("/vehicles/bus-7").json()["windows"]["used"] == 9


@pytest.mark.parametrize("how", ["upload", "replay"])
def test_a_store_that_refuses_for_a_while_costs_no_recording(
    client: TestClient, core: Core, recording: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    monkeypatch.setattr("sprung.service.retrying.FIRST_RETRY", 0.01)
    refusals = {"keep": 3, "identify": 2, "state": 1}

    def refusing(name: str) -> Any:
        real = getattr(core.pipeline, name)

        def asked(*given: Any) -> Any:
            if refusals[name]:
                refusals[name] -= 1
                raise OperationalError("INSERT", {}, Exception("database is locked"))
            return real(*given)

        return asked

    for name in refusals:
        monkeypatch.setattr(core.pipeline, name, refusing(name))
    if how == "upload":
        assert finished(client, upload(client, recording, vehicle="bus-7").json())["result"]["windows"]["used"] == 9
    else:
        monkeypatch.setattr("sprung.service.main._limits", lambda *_: None)
        ended = threading.Event()
        feeds = Feeds((recording,), vehicle="bus-7")
        _feed_files(core, feeds, lambda path, core: (lambda batch: None, lambda fed: ended.set()))
        assert ended.is_set()
    assert refusals["keep"] == refusals["identify"] == 0
    assert client.get("/vehicles/bus-7").json()["windows"]["used"] == 9


def test_a_recording_whose_reading_process_is_killed_is_read_once_more(
    client: TestClient, core: Core, recording: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Killed with its last piece, so that all of it is stored before; the messages are counted from 0 again."""
    began, ended, real = [0], threading.Event(), ProcessReading.pieces

    def killed(self: ProcessReading, check: Callable[[], None]) -> Iterator[ReadWindows]:
        began[0] += 1
        yield ReadWindows([], Tally(), None)
        yield from real(self, check)
        if began[0] == 1:
            raise WorkerKilled("the process of the reading of the recording was ended by SIGKILL")

    monkeypatch.setattr(ProcessReading, "pieces", killed)
    feeds = Feeds((recording,), vehicle="bus-7")
    _feed_files(core, feeds, lambda path, core: (lambda batch: None, lambda fed: ended.set()))
    assert ended.is_set() and began == [2] and "it is tried once more" in caplog.text
    assert client.get("/vehicles/bus-7").json()["windows"]["used"] == 9


@pytest.fixture
def from_zero(recording: Path) -> Path:
    """The same, with times that count from 0."""
    head, *rows = recording.read_text().splitlines()
    path = recording.with_name("from zero.csv")
    path.write_text("\n".join([head, *(f"{i / 100},{row.partition(',')[2]}" for i, row in enumerate(rows))]))
    return path


def test_uploads_whose_times_count_from_0_begin_when_their_sender_says(client: TestClient, from_zero: Path) -> None:
    for number, start in enumerate(("2026-09-21T14:00:00Z", "2026-09-21T16:00:00+02:00", "1790000000")):
        done = finished(client, upload(client, from_zero, vehicle="a", start=start).json())
        assert done["state"] == "done", done
        assert client.get("/vehicles/a").json()["windows"]["used"] == (9, 9, 18)[number]  # the second is the first
        line = client.get("/recordings").json()["recordings"][0]
        assert line["start"] == ("2026-09-21T14:13:20.000Z" if number == 2 else "2026-09-21T14:00:00.000Z")
    at = client.get("/vehicles/a/history", params={"parameter": "primary_11l.stiffness", "resolution": "raw"}).json()
    assert [point["time"][:19] for point in at["points"]][::9] == ["2026-09-21T14:00:00", "2026-09-21T14:13:20"]
    assert len(client.get("/recordings").json()["recordings"]) == 2  # of one start the file is kept once


def test_an_upload_among_windows_of_another_is_taken_with_its_start(client: TestClient, from_zero: Path) -> None:
    assert finished(client, upload(client, from_zero, vehicle="a", start="1790000000").json())["state"] == "done"
    again = upload(client, from_zero, "other.csv", vehicle="a", start="1790000060").json()
    assert finished(client, again)["state"] == "done"
    assert client.get("/vehicles/a").json()["windows"]["used"] == 18


@pytest.mark.parametrize(
    "start", ["noon", "2026-09-21", "2026-09-21T14:13:20", "-5", "1e300", "nan", "2199-01-01T00:00:00Z"]
)
@pytest.mark.parametrize("place", ["/recordings", "/diagnose"])
def test_a_start_that_is_no_time_is_refused_and_nothing_is_kept(
    client: TestClient, core: Core, from_zero: Path, place: str, start: str
) -> None:
    with open(from_zero, "rb") as stream:
        answer = client.post(place, files={"file": (from_zero.name, stream)}, data={"start": start})
    assert answer.status_code == 422 and answer.json()["errors"][0]["field"] == "start"
    assert list(core.settings.uploads.iterdir()) == [] and client.get("/recordings").json()["recordings"] == []


@pytest.mark.parametrize("name", ["../../etc/cron.d/evil.csv", "..\\..\\evil.csv", "/abs/evil.csv", "a\0b.csv"])
def test_no_name_of_a_client_reaches_the_file_system(
    client: TestClient, core: Core, recording: Path, name: str
) -> None:
    response = upload(client, recording, name)
    stored = list(core.settings.data_dir.rglob("*.csv"))
    if response.status_code == 202:
        assert [path.parent for path in stored] == [core.settings.uploads]
        assert "evil" not in stored[0].name
    else:
        assert response.status_code in (400, 422) and stored == []


def test_unknown_kinds_of_files_are_refused(client: TestClient, recording: Path) -> None:
    for name in ("virus.exe", "noextension", ".csv"):
        response = upload(client, recording, name)
        assert response.status_code == 415
        assert response.headers["content-type"] == "application/problem+json"


def test_a_wrong_vehicle_in_the_form_is_refused(client: TestClient, recording: Path) -> None:
    answer = upload(client, recording, vehicle="../x")
    assert answer.status_code == 422 and answer.json()["detail"].startswith("vehicle: letters, digits and . _ : - only")


def test_an_upload_that_cannot_be_read_fails_with_one_line_and_the_users_name_for_it(
    client: TestClient, tmp_path: Path
) -> None:
    path = tmp_path / "other.csv"
    path.write_text("time,speed\n0,1\n1,2\n")
    job = finished(client, upload(client, path).json())
    assert job["state"] == "failed"
    assert "other.csv" in job["error"]
    assert str(tmp_path) not in job["error"]


def test_a_job_that_a_stop_interrupts_goes_on_at_the_next_start(
    csv_engine: Engine, tmp_path: Path, recording: Path, reading_here: None
) -> None:
    settings = Settings(data_dir=tmp_path / "data")
    core = build_core(settings, csv_engine)
    started, release = threading.Event(), threading.Event()
    with TestClient(create_app(core, on_stop=lambda: None)) as client:
        core.compute.submit(lambda: hold(started, release))
        started.wait(5)
        job = upload(client, recording).json()
        eventually(lambda: client.get(f"/jobs/{job['id']}").json()["state"] == "running")
        closing = threading.Thread(target=core.close)
        closing.start()
        eventually(core.stopping.is_set)
        release.set()
        closing.join()
    again = build_core(settings, csv_engine)
    with TestClient(create_app(again)) as client:
        assert finished(client, job)["state"] == "done"
        assert client.get("/vehicles/car_7").json()["windows"]["used"] == 9


def test_more_jobs_than_the_queue_holds_are_refused(client: TestClient, core: Core, recording: Path) -> None:
    started, release = threading.Event(), threading.Event()
    core.compute.submit(lambda: hold(started, release))
    started.wait(5)
    answers = [upload(client, recording, vehicle=f"v{i}").status_code for i in range(3)]
    release.set()
    assert answers == [202, 202, 503]


def test_a_virtual_bus_is_followed_within_two_seconds(engine: Engine, data_dir: Path) -> None:
    core = build_core(Settings(data_dir=data_dir), engine)
    database = cantools.database.load_file(MANCHESTER_DBC)
    assert isinstance(database, Database)
    bus = LiveBus("virtual", "sprung-test", engine.system.channels, MANCHESTER_DBC, stop=core.stopping)
    feed = LiveFeed(core.pipeline, bus, "live", core.stopping, core.tally_counter(bus.name))
    core.feeds.append(feed)
    frames = [
        can.Message(
            arbitration_id=message.frame_id,
            data=message.encode(dict.fromkeys((s.name for s in message.signals), 0.0)),
            is_extended_id=False,
        )
        for message in database.messages
    ]
    app = create_app(core, on_start=feed.start)
    with TestClient(app) as client, can.Bus(interface="virtual", channel="sprung-test") as sender:
        eventually(lambda: bus.connected)
        begun = time.monotonic()
        for row in range(240):
            time.sleep(max(0.0, begun + row / 100 - time.monotonic()))
            for frame in frames:
                sender.send(frame)
        ended = time.monotonic()
        eventually(lambda: client.get("/vehicles").json()["vehicles"], seconds=2.0)
        assert time.monotonic() - ended < 2.0
        assert 'source="virtual:sprung-test"' in client.get("/metrics").text
        assert client.get("/health/ready").json()["feeds"][0]["state"] == "receiving"
    assert feed.join(5)


@pytest.mark.parametrize("name", ["can0", "virtual:", ":0", "carrier-pigeon:0", "virtual:x,fd"])
def test_a_bus_that_cannot_be_is_one_clear_line(engine: Engine, data_dir: Path, name: str) -> None:
    core = build_core(Settings(data_dir=data_dir), engine)
    try:
        with pytest.raises(ValueError, match="can"):
            live_feed(core, name, None)
    finally:
        core.close()
    assert Feeds().buses == ()


def test_reading_ahead_hands_over_everything_and_errors_too() -> None:
    assert list(prefetched(iter(range(100)), 2)) == list(range(100))

    def broken() -> Iterator[int]:
        yield 1
        raise KeyError("late")

    items = prefetched(broken(), 2)
    assert next(items) == 1
    with pytest.raises(KeyError):
        next(items)


def test_reading_ahead_stops_when_nobody_listens() -> None:
    produced = []

    def endless() -> Iterator[int]:
        while True:
            produced.append(1)
            yield 1

    items = prefetched(endless(), 2)
    next(items)
    items.close()
    assert len(produced) < 10


@pytest.mark.parametrize(
    ("named", "recorded", "file", "vehicle"),
    [
        ("a", "b", "c.blf", "a"),
        (None, "b", "c.blf", "b"),
        (None, None, "run 4/c d.blf", "c_d"),
        (None, "Zug Nr. 1/2", "c.blf", "Zug_Nr._1_2"),
        (None, "..", "c.blf", "v.."),
    ],
)
def test_the_vehicle_is_as_the_user_says_else_as_recorded_else_the_file(
    named: str | None, recorded: str | None, file: str, vehicle: str
) -> None:
    assert vehicle_of(named, recorded, file) == vehicle


def test_an_upload_is_diagnosed_and_the_report_kept(client: TestClient, recording: Path) -> None:
    with open(recording, "rb") as stream:
        response = client.post("/diagnose", files={"file": ("ride.csv", stream)})
    assert response.status_code == 202, response.text
    done = finished(client, response.json())
    assert done["result"]["verdict"] == "missing_physics", done
    report = client.get(f"/reports/{done['result']['report']}").json()
    assert report["findings"][0]["effect"] == "coulomb_friction"
    page = client.get(f"/reports/{done['result']['report']}", headers={"accept": "text/html"})
    assert page.text == "<p>the page</p>"


def test_the_system_file_with_what_was_found_is_handed_out(client: TestClient, core: Core, recording: Path) -> None:
    with open(recording, "rb") as stream:
        job = client.post("/diagnose", files={"file": ("ride.csv", stream)}).json()
    report = finished(client, job)["result"]["report"]
    assert client.get(f"/reports/{report}/system").status_code == 404
    (core.settings.reports / report / "system.yaml").write_text("name: found\n")
    answer = client.get(f"/reports/{report}/system")
    assert answer.text == "name: found\n" and answer.headers["content-type"].startswith("application/yaml")
    assert client.get("/reports/none/system").status_code == 404


def test_a_stored_recording_is_diagnosed_by_id(client: TestClient, recording: Path) -> None:
    job = finished(client, upload(client, recording).json())
    response = client.post("/diagnose", json={"recording": job["recording"]})
    assert finished(client, response.json())["state"] == "done"
    assert client.post("/diagnose", json={"recording": "none"}).status_code == 404


def test_a_diagnosis_that_cannot_be_made_fails_with_its_line(client: TestClient, recording: Path) -> None:
    with open(recording, "rb") as stream:
        job = finished(client, client.post("/diagnose", files={"file": ("short.csv", stream)}).json())
    assert (job["state"], job["error"]) == ("failed", "short.csv: too short to tell")


@pytest.mark.parametrize("content", [b"{}", b'{"recording": "a", "vehicle": "b"}', b'{"file": 1}', b"["])
def test_wrong_bodies_of_diagnose_are_refused(client: TestClient, content: bytes) -> None:
    headers = {"content-type": "application/json"}
    assert client.post("/diagnose", content=content, headers=headers).status_code == 422
    assert client.post("/diagnose", content=content, headers={"content-type": "text/csv"}).status_code == 415


def test_windows_that_stop_fitting_start_one_diagnosis_that_joins_the_alarm(
    client: TestClient, core: Core, csv_engine: Engine
) -> None:
    identifier = csv_engine.identifier
    assert isinstance(identifier, FakeIdentifier)
    core.pipeline.process("a", [make_window(csv_engine.system, i) for i in range(80)])
    assert jobs(core) == []
    identifier.chi_square = 9.0
    for first in range(80, 160, 8):
        core.pipeline.process("a", [make_window(csv_engine.system, first + i) for i in range(8)])
    assert len(jobs(core)) == 1
    job = finished(client, {"id": jobs(core)[0].id})
    assert job["state"] == "done", job
    alarm = client.get("/vehicles/a/alarms").json()["alarms"][0]
    assert (alarm["kind"], alarm["report"]) == ("misfit", job["result"]["report"])
    core.pipeline.process("a", [make_window(csv_engine.system, 160 + i) for i in range(8)])
    assert len(jobs(core)) == 1  # the same vehicle is left alone for an hour
    page = client.get("/pages/vehicles/a").text
    assert "dry friction" in page and "mismatch report" in page


def test_a_vehicles_last_minute_is_diagnosed_on_request(client: TestClient, core: Core, csv_engine: Engine) -> None:
    core.pipeline.process("a", [make_window(csv_engine.system, i) for i in range(8)])
    response = client.post("/diagnose", json={"vehicle": "a"})
    assert finished(client, response.json())["state"] == "done"
    assert client.post("/diagnose", json={"vehicle": "nobody"}).status_code == 404


def jobs(core: Core) -> list[JobRow]:
    """Diagnoses, whatever their state."""
    from sqlalchemy import select

    from sprung.service.store.schema import jobs as table

    with core.store.read() as connection:
        rows = connection.execute(select(table).where(table.c.kind == "diagnosis"))
        return [JobRow(*row) for row in rows]


def test_housekeeping_deletes_what_is_old(core: Core, recording: Path) -> None:
    core.settings.uploads.mkdir(parents=True)
    (core.settings.uploads / "old.csv").write_text("x")
    with core.store.write() as connection:
        work.add_recording(connection, work.RecordingRow("r", None, "n", "upload", "old.csv", 1, None, START, None))
    core.housekeeping.once(START + 30 * 86_400 * 10**9)
    assert not (core.settings.uploads / "old.csv").exists()
    core.close()


def test_a_vehicle_that_is_deleted_while_its_recording_is_read_does_not_come_back(
    client: TestClient, core: Core, csv_engine: Engine, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    core.pipeline.process("bus-7", [make_window(csv_engine.system, 0)])
    begun, go, keep = threading.Event(), threading.Event(), core.pipeline.keep

    def held(*given: Any) -> Any:
        begun.set()
        assert go.wait(20)
        return keep(*given)

    monkeypatch.setattr(core.pipeline, "keep", held)
    job = upload(client, recording, vehicle="bus-7").json()
    assert begun.wait(20)
    answers: list[int] = []
    deleting = threading.Thread(
        target=lambda: answers.append(client.delete("/vehicles/bus-7?confirm=bus-7").status_code)
    )
    deleting.start()
    assert finished(client, job)["error"].startswith("cancelled")
    go.set()
    deleting.join(20)
    assert answers == [204]
    assert client.get("/vehicles/bus-7").status_code == 404
    assert list(core.settings.uploads.iterdir()) == [] and client.get("/recordings").json()["recordings"] == []


def test_no_recent_samples_is_reported(core: Core) -> None:
    with pytest.raises(UserError, match="no recent samples"):
        core.diagnoses.from_excerpt("nobody")
    core.close()


@pytest.mark.parametrize(("speed", "silence"), [(0.0, 60.0), (1.0, math.inf)])
def test_a_replayed_file_is_bounded_in_processor_time_and_silence(tmp_path: Path, speed: float, silence: float) -> None:
    """At the speed of the ride a pause of the recording is a silence."""
    (tmp_path / "a.csv").write_bytes(bytes(10_000_000))
    limits = _limits(Settings(data_dir=tmp_path), tmp_path / "a.csv", speed)
    assert (limits.silence_seconds, limits.seconds, limits.cpu_seconds) == (silence, math.inf, 160)
