"""Jobs: counted attempts, limits, cancelling, and a stop that does not wait for them."""

from __future__ import annotations

import errno
import os
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.exc import OperationalError

from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.diagnosis.task import DiagnosisRequest, DiagnosisResult, Stage
from sprung.service.diagnosis.worker import within
from sprung.service.errors import UserError
from sprung.service.jobs.queue import Jobs, Kind, Progress
from sprung.service.monitoring.engine import Engine
from sprung.service.processes.worker import Emit, WorkerKilled
from sprung.service.settings import Settings
from sprung.service.store import Store, work
from sprung.service.store.work import JobRow
from tests.service_fakes import diagnose, eventually


def stored(store: Store, job_id: str) -> JobRow:
    with store.read() as connection:
        job = work.get_job(connection, job_id)
    assert job is not None
    return job


def left_by_a_dead_process(store: Store, attempts: int, state: str = "running") -> str:
    job = work.JobRow(work.new_id(), "toy", state, None, None, 0.0, None, None, 1, 1, attempts)
    with store.write() as connection:
        work.add_job(connection, job)
    return job.id


def nothing(_job: JobRow, _progress: Progress) -> dict[str, Any]:
    return {}


@pytest.mark.parametrize(
    ("attempts", "state", "becomes"),
    [(1, "running", "done"), (2, "running", "failed"), (0, "queued", "done"), (5, "queued", "done")],
)
def test_a_job_that_killed_its_process_twice_is_failed(store: Store, attempts: int, state: str, becomes: str) -> None:
    job = left_by_a_dead_process(store, attempts, state)
    jobs = Jobs(store, {"toy": Kind(nothing, 60)}, 4)
    jobs.start()
    eventually(lambda: stored(store, job).state not in work.UNFINISHED)
    jobs.close()
    assert stored(store, job).state == becomes
    if becomes == "failed":
        assert "died 2 times" in (stored(store, job).error or "")


@pytest.mark.parametrize(("kills", "becomes"), [(1, "done"), (2, "failed")])
def test_a_job_whose_own_process_was_killed_is_tried_once_more(
    store: Store, caplog: pytest.LogCaptureFixture, kills: int, becomes: str
) -> None:
    left = [kills]

    def killed(_job: JobRow, _progress: Progress) -> dict[str, Any]:
        left[0] -= 1
        if left[0] >= 0:
            raise WorkerKilled("the process was ended by SIGKILL")
        return {}

    jobs = Jobs(store, {"toy": Kind(killed, 60)}, 4)
    jobs.start()
    job = jobs.submit("toy")
    eventually(lambda: stored(store, job.id).state not in work.UNFINISHED)
    assert stored(store, job.id).state == becomes and jobs.waiting == 0
    error = None if becomes == "done" else "the process was ended by SIGKILL, 2 times"
    assert stored(store, job.id).error == error
    assert ["tried once more" in record.message for record in caplog.records] == [True, False][:kills]
    jobs.close()


def test_the_attempt_is_in_the_store_while_the_job_runs_and_gone_after_a_stop_in_order(store: Store) -> None:
    running = threading.Event()

    def forever(_job: JobRow, progress: Progress) -> dict[str, Any]:
        running.set()
        while True:
            progress.check()
            time.sleep(0.01)

    jobs = Jobs(store, {"toy": Kind(forever, 60)}, 4)
    jobs.start()
    job = jobs.submit("toy")
    assert running.wait(10)
    assert (stored(store, job.id).state, stored(store, job.id).attempts) == ("running", 1)
    jobs.close()
    assert (stored(store, job.id).state, stored(store, job.id).attempts) == ("queued", 0)


def test_a_job_past_its_time_is_failed(store: Store) -> None:
    def slow(_job: JobRow, progress: Progress) -> dict[str, Any]:
        while True:
            progress.check()
            time.sleep(0.01)

    jobs = Jobs(store, {"toy": Kind(slow, 0.2)}, 4)
    jobs.start()
    job = jobs.submit("toy")
    eventually(lambda: stored(store, job.id).state == "failed")
    assert stored(store, job.id).error == "the job took longer than 0 s"
    jobs.close()


def test_jobs_are_cancelled_while_they_run_and_while_they_wait(store: Store) -> None:
    begun = threading.Event()

    def slow(_job: JobRow, progress: Progress) -> dict[str, Any]:
        begun.set()
        while True:
            progress.check()
            time.sleep(0.01)

    jobs = Jobs(store, {"toy": Kind(slow, 60), "quick": Kind(nothing, 60)}, 4)
    jobs.start()
    first, second, third = jobs.submit("toy"), jobs.submit("toy"), jobs.submit("quick")
    assert begun.wait(10)
    jobs.cancel(second.id, "anna")
    jobs.cancel(first.id, "anna")
    eventually(lambda: stored(store, third.id).state == "done")
    assert [stored(store, job.id).error for job in (first, second)] == ["cancelled by anna"] * 2
    assert jobs.cancel(third.id, "anna").state == "done"
    jobs.close()


def test_a_short_job_does_not_wait_for_a_long_one_of_another_kind(store: Store) -> None:
    end = threading.Event()

    def slow(_job: JobRow, _progress: Progress) -> dict[str, Any]:
        return {"ended": end.wait(30)}

    jobs = Jobs(store, {"slow": Kind(slow, 60), "quick": Kind(nothing, 60)}, 4)
    jobs.start()
    long = jobs.submit("slow")
    eventually(lambda: stored(store, long.id).state == "running")
    short = jobs.submit("quick")
    eventually(lambda: stored(store, short.id).state == "done")
    assert stored(store, long.id).state == "running"
    end.set()
    eventually(lambda: stored(store, long.id).state == "done")
    jobs.close()


def test_a_store_that_refuses_the_end_of_a_job_is_asked_again(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sprung.service.jobs.queue.RETRY_SECONDS", 0.05)
    refusals = 3

    def refusing(connection: Any, job_id: str, now: int, **values: Any) -> None:
        nonlocal refusals
        if refusals and values.get("state") in ("running", "done"):
            refusals -= 1
            raise OperationalError("UPDATE", {}, Exception("database is locked"))
        real(connection, job_id, now, **values)

    real = work.update_job
    monkeypatch.setattr("sprung.service.jobs.queue.work.update_job", refusing)
    jobs = Jobs(store, {"toy": Kind(nothing, 60)}, 4)
    jobs.start()
    job = jobs.submit("toy")
    eventually(lambda: stored(store, job.id).state == "done")
    assert refusals == 0
    jobs.close()


@pytest.mark.parametrize(
    "trouble",
    [
        OperationalError("SELECT", {}, Exception("database is locked")),
        OSError(errno.ENOSPC, "No space left on device"),
        OSError(errno.EMFILE, "Too many open files"),
        MemoryError(),
    ],
)
def test_a_job_that_the_machine_refuses_for_a_while_is_done(
    store: Store, monkeypatch: pytest.MonkeyPatch, trouble: Exception
) -> None:
    monkeypatch.setattr("sprung.service.retrying.FIRST_RETRY", 0.01)
    troubles = [trouble] * 3

    def refused(_job: JobRow, _progress: Progress) -> dict[str, Any]:
        if troubles:
            raise troubles.pop()
        return {"done": True}

    jobs = Jobs(store, {"toy": Kind(refused, 60)}, 4)
    jobs.start()
    job = jobs.submit("toy")
    eventually(lambda: stored(store, job.id).state not in work.UNFINISHED)
    jobs.close()
    assert (stored(store, job.id).state, stored(store, job.id).result) == ("done", {"done": True})


def test_a_job_that_is_refused_for_good_ends_with_its_time_when_it_is_cancelled_and_with_the_service(
    store: Store,
) -> None:
    def refused(_job: JobRow, _progress: Progress) -> dict[str, Any]:
        raise OSError(errno.EROFS, "Read-only file system")

    jobs = Jobs(store, {"short": Kind(refused, 0.2), "long": Kind(refused, 60)}, 4)
    jobs.start()
    short, cancelled, last = jobs.submit("short"), jobs.submit("long"), jobs.submit("long")
    eventually(lambda: stored(store, short.id).state == "failed")
    assert stored(store, short.id).error == "the job took longer than 0 s; last: Read-only file system"
    jobs.cancel(cancelled.id, "anna")
    eventually(lambda: stored(store, last.id).state == "running")
    jobs.close()
    assert [stored(store, job.id).state for job in (cancelled, last)] == ["failed", "queued"]


def test_an_unknown_kind_is_failed_not_fatal(store: Store) -> None:
    job = left_by_a_dead_process(store, 0, "queued")
    jobs = Jobs(store, {"other": Kind(nothing, 60)}, 4)
    jobs.start()
    eventually(lambda: stored(store, job).state == "failed")
    jobs.close()


@pytest.fixture
def core(engine: Engine, tmp_path: Path) -> Core:
    core = build_core(Settings(data_dir=tmp_path / "data"), engine)
    core.diagnosis_jobs.task = diagnose
    return core


def ask_for(client: TestClient, name: str) -> str:
    job: str = client.post("/diagnose", files={"file": (name, b"x" * 100)}).json()["id"]
    return job


@pytest.mark.parametrize(
    ("name", "told"),
    [("wrong.mcap", "an unexpected error"), ("deadly.mcap", "the process of the diagnosis was ended by SIGKILL")],
)
def test_a_diagnosis_that_breaks_fails_and_the_next_one_works(core: Core, name: str, told: str) -> None:
    with TestClient(create_app(core)) as client:
        bad, good = ask_for(client, name), ask_for(client, "good.mcap")
        assert eventually(lambda: stored(core.store, good).state == "done")
        assert eventually(lambda: stored(core.store, bad).state == "failed")  # a deadly one is tried twice
        assert told in (stored(core.store, bad).error or "")
        assert [path.name for path in core.settings.reports.iterdir()] == [good]


def finds_no_room_at_first(request: DiagnosisRequest, emit: Emit[Stage]) -> DiagnosisResult:
    """A diagnosis whose report does not fit onto the disk until the third time."""
    tries = request.out.parent / "tries"
    tries.parent.mkdir(parents=True, exist_ok=True)
    count = len(tries.read_text()) if tries.exists() else 0
    tries.write_text("x" * (count + 1))
    if count < 2:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(request.out))
    return diagnose(request, emit)


def test_a_diagnosis_whose_report_finds_no_room_is_made_when_there_is(
    core: Core, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("sprung.service.retrying.FIRST_RETRY", 0.01)
    core.diagnosis_jobs.task = finds_no_room_at_first
    with TestClient(create_app(core)) as client:
        job = ask_for(client, "good.mcap")
        assert eventually(lambda: stored(core.store, job).state == "done", 60.0)
    assert caplog.text.count("No space left on device; trying again") == 2


def tells_its_time(request: DiagnosisRequest, emit: Emit[Stage]) -> DiagnosisResult:
    """A diagnosis that tells how long it may search."""
    return replace(diagnose(request, emit), verdict=f"{request.search_seconds:.1f}")


def test_the_search_of_a_diagnosis_ends_before_its_process_is_ended(engine: Engine, tmp_path: Path) -> None:
    core = build_core(Settings(data_dir=tmp_path / "data", diagnosis_seconds=50.0), engine)
    core.diagnosis_jobs.task = tells_its_time
    with TestClient(create_app(core)) as client:
        job = ask_for(client, "good.mcap")
        assert eventually(lambda: stored(core.store, job).state == "done")
        with core.store.read() as connection:
            report = work.get_report(connection, job)
    assert report is not None and report.verdict == "30.0"


def test_a_running_diagnosis_is_cancelled_over_http_and_does_not_hold_up_a_stop(core: Core) -> None:
    with TestClient(create_app(core)) as client:
        job = ask_for(client, "endless.mcap")
        eventually(lambda: stored(core.store, job).progress > 0)
        answer = client.post(f"/jobs/{job}/cancel").json()
        assert (answer["state"], answer["error"]) == ("failed", "cancelled by local")
        assert client.post("/jobs/nothing/cancel").status_code == 404
        second = ask_for(client, "endless too.mcap")
        eventually(lambda: stored(core.store, second).progress > 0)
        begun = time.monotonic()
        core.jobs.close()
        assert time.monotonic() - begun < 5.0
        assert stored(core.store, second).state == "queued"


def test_a_file_that_is_sent_twice_is_kept_once_and_diagnosed_once_at_a_time(core: Core) -> None:
    with TestClient(create_app(core)) as client:
        first = ask_for(client, "endless.mcap")
        eventually(lambda: stored(core.store, first).progress > 0)
        assert ask_for(client, "endless.mcap") == first
        for_another = client.post(
            "/diagnose", files={"file": ("endless.mcap", b"x" * 100)}, data={"vehicle": "another"}
        ).json()
        assert for_another["id"] != first and for_another["recording"] != stored(core.store, first).recording_id
        other_content = client.post("/diagnose", files={"file": ("endless.mcap", b"y" * 100)}).json()
        assert other_content["id"] not in (first, for_another["id"])
        assert len(list(core.settings.uploads.iterdir())) == 3
        client.post(f"/jobs/{first}/cancel")
        again = ask_for(client, "endless.mcap")
        assert again != first and stored(core.store, again).recording_id == stored(core.store, first).recording_id
        assert len(list(core.settings.uploads.iterdir())) == 3
        kept = core.settings.uploads
        for path in kept.iterdir():  # gone, as after a restoration without uploads: sent again, it is kept again
            path.unlink()
        assert stored(core.store, ask_for(client, "endless.mcap")).recording_id not in (None, again)
        assert len(list(kept.iterdir())) == 1


def test_what_a_dead_process_left_half_written_is_deleted_at_start(core: Core) -> None:
    uploads, reports = core.settings.uploads, core.settings.reports
    half = (uploads / "a.mcap.part", reports / "x.7.part" / "y")
    unknown = (uploads / "nobodys.csv", reports / "of a vehicle that was deleted" / "report.html")
    for path in (*half, *unknown, uploads / "kept.csv", reports / "kept" / "report.html"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("x")
    with core.store.write() as connection:
        work.add_recording(
            connection, work.RecordingRow("r", None, "n", "upload", "kept.csv", 1, None, time.time_ns(), None)
        )
        work.add_report(connection, work.ReportRow("kept", None, "r", "consistent", {}, 1))
    with TestClient(create_app(core)):
        assert [path.name for path in uploads.iterdir()] == ["kept.csv"]
        assert [path.name for path in reports.iterdir()] == ["kept"]


def test_files_of_a_store_that_was_moved_away_stay(core: Core) -> None:
    """Somebody moves a damaged store aside and starts the service before the other one is in its place."""
    kept = (core.settings.uploads / "a.csv", core.settings.reports / "r" / "report.html")
    half = core.settings.uploads / "b.csv.part"
    for path in (*kept, half):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("x")
    with TestClient(create_app(core)):
        assert all(path.exists() for path in kept) and not half.exists()


def test_a_diagnosis_whose_report_is_kept_is_not_made_again(core: Core) -> None:
    """The service was killed after it had stored the report, and before it noted that the job was done."""
    with TestClient(create_app(core)) as client:
        job = ask_for(client, "good.mcap")
        assert eventually(lambda: stored(core.store, job).state == "done")
        page = core.settings.reports / job
        before = page.stat().st_ino
    core.diagnosis_jobs.task = no_task
    with core.store.write() as connection:
        work.update_job(connection, job, 1, state="running", attempts=1, result=None)
    again = core.diagnosis_jobs.run(stored(core.store, job), Progress(lambda share: None, threading.Event(), 60.0))
    assert again["report"] == job and page.stat().st_ino == before


def no_task(_request: DiagnosisRequest, _emit: Emit[Stage]) -> DiagnosisResult:
    pytest.fail("the diagnosis is made again")


def test_a_cancelled_reading_ends_with_its_reason(store: Store) -> None:
    progress = Progress(lambda share: None, threading.Event(), seconds=-1.0)
    with pytest.raises(UserError, match="took longer"):
        progress.check()


def test_progress_that_comes_too_soon_after_the_last_is_noted_later(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    noted: list[float] = []
    progress = Progress(noted.append, threading.Event(), seconds=1000.0)
    progress.step(0.02)
    now[0] += 0.01
    progress.step(0.05)
    assert noted == [0.02]
    now[0] += 2
    progress.check()
    progress.check()
    assert noted == [0.02, 0.05]
    progress.step(0.04)  # never backwards
    now[0] += 2
    progress.check()
    assert noted == [0.02, 0.05]


def test_a_long_stage_of_a_diagnosis_moves_and_never_ends_before_it_does() -> None:
    shares = [within(Stage(0.05, "screening"), seconds).share for seconds in (0, 2, 10, 60, 600)]
    assert shares == sorted(shares) and shares[0] == 0.05 and shares[1] > 0.055 and shares[-1] <= 0.15
    assert within(Stage(0.95, "report"), 1e6).share <= 0.99
