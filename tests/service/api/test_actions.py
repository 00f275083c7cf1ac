"""What operators do, and what they look at: actions, lists, the newest window, the bundle, the pages."""

from __future__ import annotations

import io
import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import httpx2
import jsonschema
import numpy as np
import pytest
from fastapi.testclient import TestClient
from mcap.reader import make_reader
from sqlalchemy import String, Text, select
from sqlalchemy.exc import IntegrityError, OperationalError

from sprung.model.system import System, parse_system
from sprung.service.api import signals
from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.housekeeping import DAY
from sprung.service.monitoring.engine import Engine
from sprung.service.operations import Operations
from sprung.service.rendering.drawing import Mark, columns, plan_view, side_view, small_view
from sprung.service.settings import Settings
from sprung.service.store import outbox, retention, work
from sprung.service.store.archive import Archive
from sprung.service.store.schema import audit, metadata
from sprung.service.times import from_iso
from tests.clocks import Clocks
from tests.service_fakes import REPORT, START, FakeIdentifier, make_window


def deeds(core: Core) -> list[str]:
    with core.store.read() as connection:
        return list(connection.execute(select(audit.c.action).order_by(audit.c.id)).scalars())


def test_an_alarm_is_acknowledged_once_and_stays_active(client: TestClient, core: Core, broken: str) -> None:
    alarms = client.get("/alarms?acknowledged=false&limit=1").json()
    assert alarms["next"] is not None
    one = alarms["alarms"][0]
    assert client.post("/vehicles/a/acknowledge", json={"alarm": one["id"]}).status_code == 200
    line = client.get("/vehicles").json()["vehicles"][0]
    assert line["unacknowledged"] == line["alarms"] - 1
    client.post("/vehicles/a/acknowledge", json={})
    assert client.get("/vehicles?acknowledged=false").json()["vehicles"] == []
    assert client.get("/vehicles/a").json()["health"] == "out_of_specification"
    assert all(a["acknowledged_by"] == "local" for a in client.get("/vehicles/a/alarms").json()["alarms"])
    assert deeds(core) == ["acknowledge", "acknowledge"]
    assert client.post("/vehicles/a/acknowledge", json={"alarm": 999}).status_code == 404


def test_a_maintenance_closes_alarms_and_learns_anew(
    client: TestClient, core: Core, system: System, broken: str
) -> None:
    one = "secondary_2l.damping"
    answer = client.post("/vehicles/a/maintenance", json={"text": "damper replaced", "parameters": [one]})
    assert answer.status_code == 201 and answer.json()["parameters"] == [one]
    states = {p["name"]: p["state"] for p in client.get("/vehicles/a").json()["parameters"]}
    assert states.pop(one) == "learning" and set(states.values()) <= {"alarm", "ok"}
    client.post("/vehicles/a/maintenance", json={"text": "overhaul"})
    after = client.get("/vehicles/a").json()
    assert after["health"] == "ok" and after["alarms"] == []
    assert 'sprung_alarms_active{severity="alarm",vehicle="a"} 0.0' in client.get("/metrics").text
    core.pipeline.process("a", [make_window(system, 140 + i, 0.3) for i in range(80)])
    assert {p["state"] for p in client.get("/vehicles/a").json()["parameters"]} == {"ok"}
    assert [m["text"] for m in client.get("/vehicles/a/marks").json()["marks"]] == ["overhaul", "damper replaced"]
    wrong = client.post("/vehicles/a/maintenance", json={"text": "x", "parameters": ["wing.stiffness"]})
    assert wrong.status_code == 422 and wrong.json()["errors"][0]["field"] == "parameters"


def test_names_retirement_and_deletion(client: TestClient, core: Core, broken: str) -> None:
    assert client.patch("/vehicles/a", json={"label": "Car 17"}).json()["label"] == "Car 17"
    assert "Car 17" in client.get("/").text
    assert client.get("/vehicles?q=car%2017").json()["vehicles"][0]["vehicle"] == "a"
    client.patch("/vehicles/a", json={"retired": True})
    assert client.get("/vehicles").json()["vehicles"] == []
    assert 'vehicle="a"' not in client.get("/metrics").text
    assert [v["vehicle"] for v in client.get("/vehicles?retired=true").json()["vehicles"]] == ["a"]
    assert client.delete("/vehicles/a?confirm=b").status_code == 422
    assert client.delete("/vehicles/a?confirm=a").status_code == 204
    assert client.get("/vehicles/a").status_code == 404
    with core.store.read() as connection:
        for table in metadata.tables.values():
            if "vehicle_id" in table.c:
                assert connection.execute(select(table).where(table.c.vehicle_id == "a")).first() is None, table
    assert deeds(core) == ["rename", "retire", "delete"]


def test_the_same_key_does_the_same_thing_once(client: TestClient, broken: str) -> None:
    headers = {"Idempotency-Key": "k1"}
    first = client.post("/vehicles/a/notes", json={"text": "seen"}, headers=headers)
    second = client.post("/vehicles/a/notes", json={"text": "seen"}, headers=headers)
    assert first.json() == second.json() and second.headers["idempotency-replayed"] == "true"
    assert len(client.get("/vehicles/a/marks").json()["marks"]) == 1
    other = client.post("/vehicles/a/notes", json={"text": "another"}, headers=headers)
    assert other.status_code == 422
    files = {"file": ("ride.csv", b"time,a\n0,1\n")}
    jobs = [client.post("/recordings", files=files, headers={"Idempotency-Key": "k2"}).json()["id"] for _ in "ab"]
    assert jobs[0] == jobs[1]
    assert len(client.get("/jobs").json()["jobs"]) == 1


@pytest.mark.parametrize(
    ("path", "request_"),
    [
        ("/vehicles/a/notes", {"json": {"text": "seen"}}),
        ("/vehicles/a/maintenance", {"json": {"text": "overhaul"}}),
        ("/vehicles/a/acknowledge", {"json": {}}),
        ("/recordings", {"files": {"file": ("ride.csv", "time,a\n0,1\n")}}),
    ],
)
def test_what_a_killed_service_had_done_is_not_done_again(
    client: TestClient, core: Core, broken: str, data_dir: Path, path: str, request_: dict[str, Any]
) -> None:
    """The answer never came, so the client sends the request once more."""
    request_ |= {"headers": {"Idempotency-Key": "k1"}}
    command = [sys.executable, "-m", "tests.killed_service", str(data_dir), path, json.dumps(request_)]
    died = subprocess.run(command, capture_output=True, check=False, text=True)
    assert died.returncode == -signal.SIGKILL, died.stderr
    done, marks, jobs = deeds(core), client.get("/vehicles/a/marks").json(), client.get("/jobs").json()
    assert len(done) == 1
    again = client.post(path, **request_)
    assert again.is_success and again.headers["idempotency-replayed"] == "true"
    assert (deeds(core), client.get("/vehicles/a/marks").json(), client.get("/jobs").json()) == (done, marks, jobs)
    if path == "/recordings":
        assert again.headers["location"] == f"/jobs/{jobs['jobs'][0]['id']}"


@pytest.mark.parametrize(("error", "status"), [(OperationalError, 503), (IntegrityError, 409)])
def test_what_cannot_be_kept_is_not_done(
    client: TestClient,
    core: Core,
    broken: str,
    monkeypatch: pytest.MonkeyPatch,
    error: type[OperationalError],
    status: int,
) -> None:
    """The client sends it again: done without the note of its answer, it would be done twice.

    The store is locked, or another process has carried out the same request meanwhile.
    """

    def refused(*_: Any) -> None:
        raise error("INSERT", {}, Exception("database is locked"))

    with monkeypatch.context() as patch:
        patch.setattr("sprung.service.api.idempotency.insert", refused)
        answer = client.post("/vehicles/a/notes", json={"text": "seen"}, headers={"Idempotency-Key": "k1"})
        assert answer.status_code == status and "retry-after" in answer.headers
        assert client.get("/vehicles/a/marks").json()["marks"] == [] and deeds(core) == []
    assert client.post("/vehicles/a/notes", json={"text": "seen"}, headers={"Idempotency-Key": "k1"}).status_code == 201
    assert len(client.get("/vehicles/a/marks").json()["marks"]) == 1


def test_a_deletion_that_was_killed_half_way_can_be_repeated(client: TestClient, core: Core, broken: str) -> None:
    """Deleted in the store first, nobody could ask for what is left of it in the archive."""

    class Killed(BaseException):
        pass

    class ArchiveThatDies:
        def remove(self, vehicle: str) -> int:
            raise Killed

    operations = Operations(core.settings, core.pipeline, lambda vehicle: None, cast(Archive, ArchiveThatDies()))
    with pytest.raises(Killed):
        operations.remove("me", "a")
    assert client.delete("/vehicles/a?confirm=a").status_code == 204


@pytest.mark.parametrize("deed", ["notes", "maintenance"])
def test_a_mark_of_the_future_is_refused(client: TestClient, broken: str, deed: str) -> None:
    answer = client.post(f"/vehicles/a/{deed}", json={"text": "seen", "time": "2199-01-01T00:00:00Z"})
    assert answer.status_code == 422 and answer.json()["errors"] == [{"field": "time", "detail": "is in the future"}]
    assert client.get("/vehicles/a/marks").json()["marks"] == []


def test_a_key_outlives_a_leap_of_the_hosts_clock_also_while_the_service_is_stopped(
    client: TestClient, core: Core, broken: str, tmp_path: Path
) -> None:
    clocks = Clocks(START)

    def send() -> httpx2.Response:
        return client.post("/vehicles/a/notes", json={"text": "seen"}, headers={"Idempotency-Key": "k"})

    def start_anew() -> None:
        core.housekeeping.clock = clocks.retention(tmp_path / "clock.json")
        core.housekeeping.clock.now()

    start_anew()
    assert "idempotency-replayed" not in send().headers
    clocks.passed(3600, leap=400 * DAY)
    assert send().headers["idempotency-replayed"] == "true"
    clocks.passed(3600, leap=-400 * DAY)
    core.housekeeping.clock.now()
    clocks.passed(60, leap=40 * DAY)
    start_anew()
    assert send().headers["idempotency-replayed"] == "true"
    clocks.passed(2 * 86_400)
    assert "idempotency-replayed" not in send().headers


@pytest.mark.parametrize("path", ["/recordings", "/diagnose"])
def test_a_key_that_was_used_for_another_upload_is_refused(client: TestClient, path: str) -> None:
    headers = {"Idempotency-Key": "k"}

    def send(name: str = "ride.csv", content: bytes = b"time,a\n0,1\n", vehicle: str = "a") -> httpx2.Response:
        return client.post(path, files={"file": (name, content)}, data={"vehicle": vehicle}, headers=headers)

    first = send()
    assert first.status_code == 202
    for other in (send(content=b"time,a\n0,2\n"), send(name="other.csv"), send(vehicle="b")):
        assert other.status_code == 422 and other.json()["errors"][0]["field"] == "Idempotency-Key"
    again = send()
    assert again.json() == first.json() and again.headers["idempotency-replayed"] == "true"
    headers["Idempotency-Key"] = "another"
    assert send(content=b"time,a\n0,2\n").json()["id"] != first.json()["id"]


def test_a_body_counts_however_its_type_is_written(client: TestClient, broken: str) -> None:
    headers = {"Idempotency-Key": "k", "Content-Type": "Application/JSON ; charset=utf-8"}
    first, other = (
        client.post("/vehicles/a/notes", content=f'{{"text": "{text}"}}', headers=headers) for text in ("one", "two")
    )
    assert (first.status_code, other.status_code) == (201, 422)


def test_tokens_of_one_name_share_no_answers(client: TestClient, core: Core, broken: str) -> None:
    answers = []
    for fleet in ("", "a"):
        text, _ = core.tokens.create("depot", ["operate"], fleet)
        headers = {"Idempotency-Key": "k", "Authorization": f"Bearer {text}"}
        answers.append(client.post("/vehicles/a/notes", json={"text": "seen"}, headers=headers))
    assert [answer.status_code for answer in answers] == [201, 201]
    assert "idempotency-replayed" not in answers[1].headers


def test_wrong_notes_are_refused(client: TestClient, broken: str) -> None:
    for body, field in (
        ({}, "text"),
        ({"text": ""}, "text"),
        ({"text": "x", "time": "noon"}, "time"),
        ({"text": "x", "who": 1}, "who"),
    ):
        answer = client.post("/vehicles/a/notes", json=body)
        assert answer.status_code == 422 and answer.json()["errors"][0]["field"] == field, body


def test_the_newest_window_measured_and_simulated(client: TestClient, broken: str, system: System) -> None:
    answer = client.get("/vehicles/a/window").json()
    assert set(answer["sensors"]) == set(system.sensors)
    trace = answer["sensors"]["car_1l"]
    assert len(trace["measured"]) == len(trace["simulated"]) == system.window
    assert np.subtract(trace["measured"], trace["simulated"]) == pytest.approx(trace["residual"], rel=1e-3, abs=1e-9)
    assert client.get("/vehicles/nobody/window").status_code == 404


def test_the_bundle_is_read_by_mcap_itself(client: TestClient, broken: str, system: System) -> None:
    client.post("/vehicles/a/notes", json={"text": "looked at"})
    answer = client.get("/vehicles/a/bundle")
    reader = make_reader(io.BytesIO(answer.content), validate_crcs=True)
    topics: dict[str, int] = {}
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        assert schema is not None and schema.encoding == "jsonschema"
        topics[channel.topic] = topics.get(channel.topic, 0) + 1
        if channel.topic != "/events" and topics[channel.topic] > 10:  # all others of a topic are made the same way
            continue
        body, wanted = json.loads(message.data), json.loads(schema.data)
        assert set(wanted["required"]) <= set(body) <= set(wanted["properties"])
        if schema.name == "foxglove.Log":
            jsonschema.validate(body, FOXGLOVE_LOG)
    assert topics["/signals/car_1l"] >= 6000
    assert topics["/compared/car_1l"] >= 5900
    assert topics["/estimate/secondary_2l/damping"] > 50
    assert topics["/events"] >= 3
    assert {"/fit", "/signals/wheel_11l.displacement"} <= set(topics)


def logged(content: bytes) -> list[str]:
    """What the events of a bundle about itself say."""
    found = make_reader(io.BytesIO(content)).iter_messages(topics=["/events"])
    bodies = [json.loads(message.data) for _, _, message in found]
    return [body["message"] for body in bodies if body["name"] == "bundle"]


@pytest.fixture
def brief(engine: Engine, data_dir: Path, system: System) -> Iterator[tuple[TestClient, Core]]:
    """A service that holds ten seconds of samples, and a vehicle with an alarm that was raised longer ago."""
    core = build_core(Settings(data_dir=data_dir, ring_seconds=10.0), engine)
    with TestClient(create_app(core), raise_server_exceptions=False) as client:
        core.pipeline.process("a", [make_window(system, i) for i in range(80)])
        for first in range(80, 140, 2):  # as they come live
            core.pipeline.process("a", [make_window(system, first + i, 0.3) for i in range(2)])
        yield client, core


def test_an_alarms_bundle_holds_its_signals_when_it_is_long_over(
    brief: tuple[TestClient, Core], system: System
) -> None:
    client, core = brief
    first = client.get("/vehicles/a/alarms").json()["alarms"][-1]
    assert first["bundle"] == f"/vehicles/a/bundle?alarm={first['id']}"
    answer = client.get(first["bundle"])
    assert "alarm-" in answer.headers["content-disposition"]
    times = [m.log_time for _, _, m in make_reader(io.BytesIO(answer.content)).iter_messages(["/signals/car_1l"])]
    onset, raised = (from_iso(first[name]) for name in ("onset", "raised"))
    assert times[0] <= onset <= raised <= times[-1] < make_window(system, 130).start
    assert ["the onset of alarm" in text for text in logged(answer.content)] == [True]
    rows = [row for row in client.get("/recordings").json()["recordings"] if row["source"] == "alarm"]
    files = list(core.settings.uploads.iterdir())
    assert len(rows) == len(files) == 1, "alarms of one cause share their signals"
    files[0].unlink()
    assert ["could not be read" in text for text in logged(client.get(first["bundle"]).content)] == [True]
    assert client.get("/vehicles/a/bundle?alarm=999").status_code == 404
    assert client.get("/vehicles/a/bundle?alarm=0").status_code == 422


def test_signals_of_alarms_are_bounded_and_go_with_the_vehicle(brief: tuple[TestClient, Core]) -> None:
    client, core = brief
    with core.store.write() as connection:
        assert retention.surplus_alarm_signals(connection, "a", 1, 1_000_000_000) == []
    files = list(core.settings.uploads.iterdir())
    assert len(files) == 1
    with core.store.read() as connection:
        assert retention.surplus_alarm_signals(connection, "b", 1, 1) == [files[0].name], "more than all may take"
        connection.rollback()
    assert client.delete("/vehicles/a?confirm=a").status_code == 204
    assert list(core.settings.uploads.iterdir()) == []


def test_a_bundle_is_not_made_for_its_head(client: TestClient, broken: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "bundle", None)
    monkeypatch.setattr(signals, "compare_all", None)
    answer = client.head("/vehicles/a/bundle")
    assert answer.status_code == 200 and answer.headers["content-disposition"].endswith('"a.mcap"')
    assert client.head("/vehicles/nobody/bundle").status_code == 404
    assert client.head("/vehicles/a/bundle?alarm=999").status_code == 404


@pytest.mark.parametrize("kind", ["csv", "mcap"])
def test_histories_as_files_hold_every_parameter(client: TestClient, broken: str, system: System, kind: str) -> None:
    answer = client.get(f"/vehicles/a/history?format={kind}")
    assert answer.headers["content-disposition"].endswith(f'a-history.{kind}"')
    if kind == "csv":
        head, *rows = answer.text.splitlines()
        assert head.split(",")[:4] == [
            "time", "seconds", "windows", f"{system.parameters[0].name} [N/m]",
        ]  # fmt: skip
        assert len(head.split(",")) == 3 + 2 * len(system.parameters) and len(rows) == 140
        assert float(rows[-1].split(",")[3]) == pytest.approx(system.parameters[0].nominal * np.exp(0.3), rel=0.01)
    else:
        topics = {channel.topic for _, channel, _ in make_reader(io.BytesIO(answer.content)).iter_messages()}
        assert topics == {f"/estimate/{p.element}/{p.quantity}" for p in system.parameters}


def test_histories_as_parquet(client: TestClient, broken: str, system: System) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    table = parquet.read_table(io.BytesIO(client.get("/vehicles/a/history?format=parquet").content))
    assert table.num_rows == 140 and system.parameters[0].name in table.column_names
    assert table.schema.metadata[b"vehicle"] == b"a"


def test_pages_show_states_and_what_to_do(client: TestClient, core: Core, system: System, broken: str) -> None:
    page = client.get("/pages/vehicles/a").text
    assert "All of them together" in page and 'class="spring alarm"' in page
    assert page.count('class="element"') == len(system.elements)
    assert page.count('data-sensor="') >= len(system.sensors)
    core.pipeline.process("young", [make_window(system, i) for i in range(5)])
    assert "no baseline yet" in client.get("/pages/vehicles/young").text
    core.pipeline.process("lossy", [make_window(system, i, outcome="dropped") for i in range(5)])
    assert "Most windows are dropped" in client.get("/pages/vehicles/lossy").text
    assert "acknowledge" in client.get("/pages/alarms").text
    assert client.get("/pages/work").status_code == 200


def test_a_misfit_tells_what_became_of_its_diagnosis(
    client: TestClient, core: Core, system: System, identifier: FakeIdentifier
) -> None:
    identifier.chi_square = 5.0
    core.pipeline.process("a", [make_window(system, i) for i in range(12)])
    assert "no diagnosis yet" in client.get("/pages/vehicles/a").text
    row = work.JobRow("one", "diagnosis", "running", None, "a", 0.1, None, None, START, START)
    with core.store.write() as connection:
        work.add_job(connection, row)
    assert "diagnosis running" in client.get("/pages/vehicles/a").text
    with core.store.write() as connection:
        work.update_job(connection, "one", START, state="failed", error="the job took longer than 600 s")
    assert "diagnosis failed</a>: the job took longer than 600 s" in client.get("/pages/vehicles/a").text


def test_data_in_pages_cannot_break_out(client: TestClient, broken: str) -> None:
    client.post("/vehicles/a/notes", json={"text": "</script><script>alert(1)</script>"})
    client.patch("/vehicles/a", json={"label": "<b>x</b>"})
    for path in ("/pages/vehicles/a", "/"):
        text = client.get(path).text
        assert "<script>alert" not in text and "<b>x</b>" not in text


FOXGLOVE_LOG = {  # what Foxglove publishes of its schema foxglove.Log, without descriptions
    "type": "object",
    "properties": {
        "timestamp": {
            "type": "object",
            "properties": {
                "sec": {"type": "integer", "minimum": 0},
                "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
            },
        },
        "level": {"enum": [0, 1, 2, 3, 4, 5]},
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer", "minimum": 0},
    },
    "additionalProperties": False,
}


RIG = """
name: rig
sample_rate: 200
window: 128
bodies:
  body: {mass: 300.0}
inputs:
  shaker: {kind: displacement, displacement: {csv: z, noise: 1e-5}}
elements:
  strut: {upper: body, lower: shaker, stiffness: 18500.0, damping: 1190.0}
sensors:
  top: {kind: acceleration, body: body, csv: a, noise: 0.01}
"""


def test_a_test_rig_is_not_drawn_as_a_railway_vehicle(system: System) -> None:
    rig = parse_system(RIG)
    drawn = side_view(rig, {"strut.stiffness": Mark("ok")}, {"top": Mark("ok")})
    assert 'class="wheel"' not in drawn and 'class="table"' in drawn
    assert side_view(system, {}, {}).count('class="wheel"') == 8
    assert "strut: not estimated" not in plan_view(rig, {"strut.stiffness": Mark("ok")})


def test_a_wheel_whose_motion_is_measured_wrongly_is_marked(system: System) -> None:
    drawn = side_view(system, {}, {"wheel_21r.displacement": Mark("suspect"), "wheel_11l.velocity": Mark("absent")})
    assert drawn.count('class="wheel"') == 6
    suspect, absent = drawn.index('class="wheel suspect"'), drawn.index('class="wheel absent"')
    assert "wheel_21r.displacement: suspect" in drawn[suspect : suspect + 200].lower()
    assert "<title>wheel_11l.velocity" in drawn[absent : absent + 200]


def test_names_that_are_wider_than_their_column_are_written_smaller(system: System) -> None:
    file = QUARTER.split("```")[0]
    drawn = side_view(parse_system(file.replace("strut", "left_damper_strut")), {}, {})
    assert 'class="name long"' in drawn and ">left_damper_strut<" in drawn
    assert 'class="name long"' not in side_view(system, {}, {}) + plan_view(system, {})


def test_pages_show_one_kind_of_time_and_say_that_the_service_is_away() -> None:
    static = Path(__file__).parents[3] / "service" / "rendering" / "static"
    scripts = {path.name: path.read_text() for path in static.glob("*.js")}
    assert not [name for name, text in scripts.items() if "toLocale" in text]
    assert scripts["acts.js"].count("fetch(") == 1 and "The service does not answer" in scripts["acts.js"]


QUARTER = (Path(__file__).parents[3] / "docs" / "tutorial.md").read_text().split("`quarter.yaml`:\n\n```yaml\n")[1]


def places(drawn: str, kind: str) -> dict[str, tuple[float, float]]:
    """px by what is written there in texts of one class."""
    found = re.findall(rf'<text class="{kind}" x="([\d.]+)" y="([\d.]+)">(\w+)<', drawn)
    return {name: (float(x), float(y)) for x, y, name in found}


def test_what_stands_above_each_other_hides_no_name(system: System) -> None:
    quarter = parse_system(QUARTER.split("```")[0])
    drawn, plan = side_view(quarter, {}, {}), plan_view(quarter, {})
    names, bodies, sensors = (places(drawn, kind) for kind in ("name", "bodyname", "sensorname"))
    assert bodies["sprung"][1] < sensors["travel"][1] < bodies["unsprung"][1]  # beside the strut that it measures
    assert sensors["travel"][0] > names["strut"][0] + 30 < sensors["wheel"][0]  # clear of spring and damper
    assert sensors["body"][0] == names["strut"][0]
    above = places(plan, "name")
    assert above["strut"][0] - above["tyre"][0] > 7 * (len("strut") + len("tyre")) / 2
    box = re.search(
        r'<rect class="body" x="([\d.]+)"[^>]*width="([\d.]+)"[^>]*/><text class="bodyname" x="([\d.]+)', drawn
    )
    assert box is not None and float(box[1]) + float(box[2]) > float(box[3]) + 7 * len("unsprung")
    assert 'class="vehicle wide"' in side_view(system, {}, {}) and 'class="vehicle wide"' not in drawn


@pytest.mark.parametrize("letters", ["ao", "oa"])
def test_the_worst_of_a_place_is_seen_in_the_list(letters: str) -> None:
    quarter = parse_system(QUARTER.split("```")[0])
    assert re.findall(r'"dot (\w+)"', small_view(quarter, columns(quarter), letters)) == ["ok", "alarm"]


STATES = {"state", "kind", "severity", "health", "source", "verdict", "name", "digest", "fleet"}  # are compared


def test_no_text_in_the_store_becomes_markup(client: TestClient, core: Core, broken: str) -> None:
    """Whatever way it came in: every column of text that is neither a key nor one of a few words holds some."""
    evil = "<img src=x onerror=alert(1)>\"'"
    client.post("/vehicles/a/notes", json={"text": "x"})
    client.post("/vehicles/a/maintenance", json={"text": "x", "parameters": ["secondary_2l.damping"]})
    token = core.tokens.create("x", ["read"])[0]
    with core.store.write() as connection:
        recording = work.RecordingRow("r", "a", "x", "upload", None, 1, None, START, None)
        work.add_recording(connection, recording)
        for state in ("failed", "running"):
            work.add_job(connection, work.JobRow(state, "diagnosis", state, "r", "a", 0.1, None, "x", START, START))
        work.add_report(connection, work.ReportRow("p", "a", "r", "missing_physics", REPORT, START))
        event = {"data": {"vehicle": "a", "page": ""}}
        row = outbox.DeliveryRow("d", "sprung.report.ready", "x", event, "dead", 1, START, "x", START, START)
        outbox.add_delivery(connection, row)
        for table in metadata.sorted_tables:
            texts = [c for c in table.c if isinstance(c.type, String | Text) and not c.primary_key]
            for column in texts:
                if not column.foreign_keys and not column.name.endswith("_id") and column.name not in STATES:
                    connection.execute(table.update().where(column.is_not(None)).values({column.name: column + evil}))
    seen = 0
    for path in ("/", "/pages/vehicles/a", "/pages/vehicles/a/standing", "/pages/alarms", "/pages/work"):
        answer = client.get(path, headers={"accept": "text/html", "authorization": f"Bearer {token}"})
        text = answer.text
        assert answer.status_code == 200 and "<h1>Sign in" not in text
        assert "<img" not in text.replace('<img src="data:', "") and "onerror=alert(1)>" not in text, path
        seen += text.count("&lt;img src=x")
    assert seen >= 5
