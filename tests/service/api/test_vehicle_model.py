"""A vehicle is given a model of its own: hidden friction is found, put to use, and taken back."""

from __future__ import annotations

import http.client
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import firwin
from sqlalchemy import select

from sprung.model.identification.identify import Identifier
from sprung.service.api.vehicle_model import MOST_CHARACTERS
from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.diagnosis.task import DiagnosisRequest, DiagnosisResult, Stage
from sprung.service.errors import UserError
from sprung.service.monitoring.engine import load_engine
from sprung.service.processes.worker import Emit
from sprung.service.settings import Settings
from sprung.service.store.schema import audit
from tests.served import served
from tests.service_fakes import REPORT, eventually

RATE = 200.0
FILE = """
name: quarter-car
sample_rate: 200
window: 200
bodies:
  wheel: {mass: 45}
  car: {mass: 400}
inputs:
  road:
    kind: displacement
    displacement: {csv: road, noise: 1.0e-5}
    velocity: {csv: rate, noise: 5.0e-4}
elements:
  tyre: {upper: wheel, lower: road, stiffness: 200000, damping: {value: 50, fixed: true}}
  strut: {upper: car, lower: wheel, stiffness: 22000, damping: 1400}
sensors:
  wheel_a: {kind: acceleration, body: wheel, csv: a, noise: 0.03}
  car_a: {kind: acceleration, body: car, csv: b, noise: 0.01}
  strut_f: {kind: force, element: strut, csv: f, noise: 2.0}
"""
LAW = "laws: [{coulomb_friction: {force: {value: 58, std: 1}, smoothing: {value: 0.02, fixed: true}}}]"
FOUND = FILE.replace("damping: 1400}", f"damping: 1400, {LAW}}}")
SECONDS = 16


def found(request: DiagnosisRequest, emit: Emit[Stage]) -> DiagnosisResult:
    """A diagnosis that takes no time and knows the answer; the real one has tests of its own."""
    request.out.mkdir(parents=True)
    (request.out / "report.html").write_text("<!-- back --><p>the page</p>")
    assert request.system_text is not None and "quarter-car" in request.system_text
    (request.out / "system.yaml").write_text(FOUND)
    return DiagnosisResult("missing_physics", REPORT)


@pytest.fixture(scope="module")
def ride(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A strut with 60 N of friction that its file does not know, by DOP853, through a recorder's filter, with noise."""
    rng = np.random.default_rng(11)
    t = np.arange(int(SECONDS * RATE)) / RATE
    f, phase = rng.uniform(0.4, 25, 120), rng.uniform(0, 6.3, 120)
    road = (8e-3 / f / 4 * np.sin(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
    speed = (8e-3 / 2 * np.pi * np.cos(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
    u = CubicHermiteSpline(t, road, speed)
    rate = u.derivative()

    def pull(x: Any) -> Any:
        v = x[3] - x[2]
        return 22e3 * (x[1] - x[0]) + 1400 * v + 60 * np.tanh(v / 0.02)

    def slope(time: float, x: np.ndarray) -> list[float]:
        tyre = 2e5 * (x[0] - u(time)) + 50 * (x[2] - rate(time))
        return [x[2], x[3], (pull(x) - tyre) / 45, -pull(x) / 400]

    fine = np.arange(8 * (len(t) - 1) + 1) / (8 * RATE)
    x = solve_ivp(slope, (0, t[-1]), np.zeros(4), t_eval=fine, rtol=1e-7, atol=1e-10, max_step=1 / RATE).y
    tyre = 2e5 * (x[0] - u(fine)) + 50 * (x[2] - rate(fine))
    sensors = np.stack([(pull(x) - tyre) / 45, -pull(x) / 400, pull(x)], axis=1)
    taps = firwin(8 * 64 + 1, 0.9 / 8)
    shown = np.apply_along_axis(np.convolve, 0, sensors, taps, "same")[::8]
    clean = np.concatenate([road[:, None], speed[:, None], shown], axis=1)
    noisy = clean + rng.normal(0, [1e-5, 5e-4, 0.03, 0.01, 2.0], clean.shape)
    path = tmp_path_factory.mktemp("ride") / "ride.csv"
    rows = np.column_stack([1.79e9 + t, noisy])[200:-200]
    np.savetxt(path, rows, delimiter=",", header="time,road,rate,a,b,f", comments="", fmt=["%.3f"] + ["%.9g"] * 5)
    return path


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    path = tmp_path / "car.yaml"
    path.write_text(FILE)
    return Settings(system=path, data_dir=tmp_path / "data")


def started(settings: Settings) -> Core:
    core = build_core(settings, load_engine(settings))
    core.diagnosis_jobs.task = found
    return core


@pytest.fixture
def core(settings: Settings) -> Core:
    return started(settings)


@pytest.fixture
def client(core: Core) -> Iterator[TestClient]:
    with TestClient(create_app(core)) as running:
        yield running


def sent(client: TestClient, ride: Path, where: str) -> dict[str, Any]:
    """Upload the ride of vehicle a and wait for what became of it."""
    with open(ride, "rb") as stream:
        number = client.post(where, files={"file": ("ride.csv", stream)}, data={"vehicle": "a"}).json()["id"]

    def ended() -> Any:
        job = client.get(f"/jobs/{number}").json()
        return job if job["state"] in ("done", "failed") else None

    job = eventually(ended, 120.0)
    assert job["state"] == "done", job
    result: dict[str, Any] = job["result"]
    return result


def misfits(client: TestClient) -> list[dict[str, Any]]:
    return [a for a in client.get("/vehicles/a/alarms?active=true").json()["alarms"] if a["kind"] == "misfit"]


@pytest.mark.slow
def test_what_a_diagnosis_found_is_used_and_taken_back(
    client: TestClient, core: Core, settings: Settings, ride: Path, reading_here: None
) -> None:
    before = sent(client, ride, "/recordings")
    assert before["fitting"]["adequate"] < 0.2 * before["windows"]["used"] and len(misfits(client)) == 1
    assert client.get("/vehicles/a").json()["model_version"] == 0
    report = sent(client, ride, "/diagnose")["report"]
    page = client.get(f"/reports/{report}/page").text
    assert f'href="/pages/vehicles/a#use={report}"' in page

    answer = client.post("/vehicles/a/model", json={"report": report})
    assert answer.status_code == 200, answer.text
    assert answer.json()["in_use"] == 1 and answer.json()["versions"][1]["laws"] == ["strut: coulomb_friction"]
    assert misfits(client) == []
    after = sent(client, ride, "/recordings")
    assert after["fitting"]["adequate"] > 0.9 * after["windows"]["used"] and misfits(client) == []
    vehicle = client.get("/vehicles/a").json()
    assert vehicle["model_version"] == 1 and vehicle["health"] == "ok"
    friction = next(p for p in vehicle["parameters"] if p["name"] == "strut.coulomb_friction.force")
    assert abs(friction["value"] - 60) < 4 * friction["std"]

    # what was estimated before stays, under its version
    points = client.get("/vehicles/a/history?parameter=strut.damping&resolution=raw").json()["points"]
    assert len(points) >= 0.9 * after["windows"]["used"]
    assert client.get("/vehicles/a/history?parameter=strut.damping&model=0").status_code == 200
    assert client.get("/vehicles/a/history?parameter=strut.damping&model=2").status_code == 404
    force = "/vehicles/a/history?parameter=strut.coulomb_friction.force"
    assert client.get(force).status_code == 200 and client.get(f"{force}&model=0").status_code == 422
    window = client.get("/vehicles/a/window").json()
    residual = np.array(window["sensors"]["strut_f"]["residual"])
    assert window["adequate"] and residual.std() < 4.0  # N; the noise is 2

    assert client.post("/vehicles/a/model", json={"version": 0}).json()["in_use"] == 0
    back = client.get("/vehicles/a").json()
    assert back["model_version"] == 0 and "strut.coulomb_friction.force" not in {p["name"] for p in back["parameters"]}
    again = client.post("/vehicles/a/model", json={"report": report}).json()  # by the page's button: no second version
    assert again["in_use"] == 1 and len(again["versions"]) == 2
    assert len(client.post("/vehicles/a/model", json={"system": FOUND}).json()["uses"]) == len(again["uses"]) == 3
    kept = client.get("/vehicles/a").json()["parameters"]
    assert kept == vehicle["parameters"]  # its tracker went on where it had been

    told = client.get("/vehicles/a/models").json()
    assert [use["version"] for use in told["uses"]] == [1, 0, 1]
    assert told["versions"][1]["fitting"] == after["fitting"]["adequate"]
    assert told["versions"][0]["windows"] == before["windows"]["used"]
    assert client.get("/vehicles/a/models/1").text == FOUND
    with core.store.read() as connection:
        rows = connection.execute(select(audit.c.detail).where(audit.c.action == "model").order_by(audit.c.id))
        assert [row.detail["version"] for row in rows] == [1, 0, 1]
    assert [m["kind"] for m in client.get("/vehicles/a/marks").json()["marks"]] == ["model"] * 3
    assert 'id="usemodel"' in client.get("/pages/vehicles/a").text

    client.__exit__(None, None, None)
    with TestClient(create_app(started(settings))) as later:
        there = later.get("/vehicles/a").json()
        assert there["model_version"] == 1 and there["parameters"] == kept


def test_wrong_models_are_refused_in_one_line(client: TestClient, core: Core, ride: Path) -> None:
    core.pipeline.process("a", [])
    assert client.post("/vehicles/a/model", json={"version": 1}).status_code == 404
    assert client.post("/vehicles/a/model", json={"report": "none"}).status_code == 404
    assert client.post("/vehicles/a/model", json={}).status_code == 422
    assert client.post("/vehicles/a/model", json={"version": 0, "system": FILE}).status_code == 422
    assert client.post("/vehicles/nobody/model", json={"system": FOUND}).status_code == 404
    many = FOUND.replace("laws: [", "laws: [" + 12 * "{cubic_stiffness: {k3: 1.0e+6}}, ")
    nothing = FOUND.replace(LAW, 'laws: [{formula: {formula: "a * d / 0", a: 1}}]')
    files = (FILE.replace("window: 200", "window: 100"), "bodies: [", many, nothing)
    for text, said in zip(files, ("window", "system file", "13 laws", "no finite force"), strict=True):
        answer = client.post("/vehicles/a/model", json={"system": text})
        assert answer.status_code == 422 and said in answer.json()["detail"], answer.text
    assert client.post("/vehicles/a/model", json={"system": FOUND}).json()["in_use"] == 1
    assert client.request("DELETE", "/vehicles/a?confirm=a").status_code == 204
    assert client.get("/vehicles/a/models").status_code == 404


def test_a_system_file_may_be_as_long_as_described(client: TestClient, core: Core) -> None:
    """And no body that is described is beyond the limit of bodies."""
    core.pipeline.process("a", [])
    text = FOUND + "# a long history\n" * ((MOST_CHARACTERS - len(FOUND)) // 17)
    assert client.post("/vehicles/a/model", json={"system": text}).status_code == 200
    answer = client.post("/vehicles/a/model", json={"system": "a" * (MOST_CHARACTERS + 1)})
    assert answer.status_code == 422 and answer.json()["errors"][0]["field"] == "system"


def test_models_are_tried_one_after_the_other(core: Core, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many are sent at once: others keep the threads, and the interpreter's time."""
    core.pipeline.process("a", [])
    at_once = [0, 0]  # now, at most

    def slow(*_: object) -> int:
        at_once[0] += 1
        at_once[1] = max(at_once)
        time.sleep(0.05)
        at_once[0] -= 1
        raise UserError("no")

    monkeypatch.setattr(core.operations, "give_model", slow)
    with served(core) as port:

        def give(_: int) -> int:
            with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=60)) as connection:
                kind = {"content-type": "application/json"}
                connection.request("POST", "/vehicles/a/model", b'{"system": "x"}', kind)
                return connection.getresponse().status

        with ThreadPoolExecutor(50) as people:
            assert set(people.map(give, range(50))) == {422}
    assert at_once == [0, 1]


def test_a_model_whose_windows_take_too_long_is_refused(
    client: TestClient, core: Core, monkeypatch: pytest.MonkeyPatch
) -> None:
    core.pipeline.process("a", [])
    monkeypatch.setattr("sprung.service.monitoring.engines.OWN_SECONDS", 1e-4)
    answer = client.post("/vehicles/a/model", json={"system": FOUND})
    assert answer.status_code == 422 and "of processor time" in answer.json()["detail"]
    hung = [f"hung{i}: {{mass: 1}}" for i in range(61)]
    held = [f"e{i}: {{upper: hung{i}, lower: car, stiffness: 1000, damping: 1}}" for i in range(61)]
    large = FILE.replace("  car: {mass: 400}", "\n  ".join(["  car: {mass: 400}", *hung]))
    large = large.replace("sensors:", "  " + "\n  ".join(held) + "\nsensors:")
    answer = client.post("/vehicles/a/model", json={"system": large})
    assert answer.status_code == 422 and "bodies" in answer.json()["detail"], answer.text


def test_windows_without_values_are_dropped_with_the_reason(
    client: TestClient, core: Core, monkeypatch: pytest.MonkeyPatch
) -> None:
    core.pipeline.process("a", [])
    assert client.post("/vehicles/a/model", json={"system": FOUND}).status_code == 200
    with core.store.read() as connection:
        identifier = core.pipeline.engines.of(connection, "a").engine.identifier
    assert isinstance(identifier, Identifier) and identifier.seconds == 10.0
    identifier.seconds = 0.0
    moved = np.random.default_rng(4).normal(0, 1, (200, 5)).T.tolist()
    channels = dict(zip(["road.displacement", "road.velocity", "wheel_a", "car_a", "strut_f"], moved, strict=True))
    answer = client.post("/identify?track=true", json={"vehicle": "a", "sample_rate": 200, "channels": channels}).json()
    reason = "not identified: took longer than 0 s of processor time"
    assert answer["fit"]["reason"] == reason and not answer["fit"]["adequate"]
    assert client.get("/vehicles/a").json()["windows"]["dropped"] == 1
    assert reason in client.get("/pages/vehicles/a").text
    metrics = client.get("/metrics").text
    assert 'reason="not identified: took longer than 0 s of processor time",vehicle="a"} 1.0' in metrics


def test_a_version_of_another_service_file_gives_way_to_it(settings: Settings, ride: Path) -> None:
    core = started(settings)
    with TestClient(create_app(core)) as client:
        core.pipeline.process("a", [])
        client.post("/vehicles/a/model", json={"system": FOUND})
    assert settings.system is not None
    settings.system.write_text(FILE.replace("csv: f,", "csv: g,").replace("strut_f", "strut_g"))
    with TestClient(create_app(started(settings))) as client:
        assert client.get("/vehicles/a").json()["model_version"] == 0
        assert "channels" in client.get("/vehicles/a/models").json()["versions"][1]["error"]
