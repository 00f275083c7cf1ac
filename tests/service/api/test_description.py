"""The description of the API keeps its word: every answer has a model, real answers fit it, clients can rely on it."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from sprung.client import ApiError, Client
from sprung.model.system import System
from sprung.service.core import Core
from sprung.service.rendering.render import STATIC
from tests.served import served, worsen

NO_JSON = {"/metrics", "/events", "/vehicles/{id}/bundle", "/reports/{id}/page", "/reports/{id}/system"}
NO_JSON |= {"/vehicles/{id}/models/{version}"}  # a file
EMPTY = {("/vehicles/{id}", "delete")}


@pytest.fixture
def address(core: Core, system: System) -> Iterator[str]:
    """That of a running service with one alarmed vehicle."""
    with served(core) as port:
        worsen(core, system)
        yield f"http://127.0.0.1:{port}"


def test_every_answer_has_a_model_and_every_error_is_a_problem(client: TestClient) -> None:
    schema = client.get("/openapi.json").json()
    assert "HTTPValidationError" not in schema["components"]["schemas"]
    for path, methods in schema["paths"].items():
        for method, operation in methods.items():
            answers = operation["responses"]
            assert "422" in answers and "503" in answers, path
            assert "404" in answers or "{" not in path, path
            for status, answer in answers.items():
                if int(status) >= 400:
                    assert list(answer["content"]) == ["application/problem+json"], (path, status)
                elif path not in NO_JSON and (path, method) not in EMPTY:
                    assert answer["content"]["application/json"]["schema"], (path, status)


PATHS = (
    "/vehicles",
    "/vehicles/a",
    "/vehicles/a/alarms",
    "/vehicles/a/history?parameter=primary_11l.stiffness",
    "/vehicles/a/history?parameter=primary_11l.stiffness&parameter=primary_11l.damping",
    "/vehicles/a/history?parameter=primary_11l.stiffness&format=columns",
    "/vehicles/a/window",
    "/vehicles/a/marks",
    "/alarms",
    "/jobs",
    "/reports",
    "/recordings",
    "/deliveries",
    "/system",
    "/health/live",
    "/health/ready",
)


def test_real_answers_fit_their_models(client: TestClient, core: Core, system: System) -> None:
    worsen(core, system)
    for path in PATHS:
        answer = client.get(path)
        assert answer.status_code == 200, (path, answer.text)
        route = path.split("?", maxsplit=1)[0]
        (model,) = [one.response_field for one in core_routes(client) if _describes(one, route)][:1]
        assert model is not None, path
        _, errors = model.validate(answer.json(), {}, loc=("body",))
        assert not errors, (path, errors)
        assert client.head(path).status_code == 200 and client.head(path).content == b""


def _describes(one: Any, route: str) -> bool:
    return one.path in (route, route.replace("/a", "/{id}", 1))


def core_routes(client: TestClient) -> list[Any]:
    """The application's routes, however they are nested."""
    found: list[Any] = []

    def walk(routes: Any) -> None:
        for route in routes:
            found.extend([route] if getattr(route, "response_field", None) is not None else [])
            walk(getattr(getattr(route, "original_router", None), "routes", []))

    walk(client.app.routes)  # type: ignore[attr-defined]
    return found


def test_the_typed_client_reads_and_acts(address: str, system: System) -> None:
    client = Client(address)
    assert [line.vehicle for line in client.vehicles(sort="urgency", silent=False)] == ["a"]
    vehicle = client.vehicle("a")
    assert vehicle.health == "out_of_specification" and len(vehicle.parameters) == len(system.parameters)
    columns = client.history("a", ["primary_11l.stiffness"])
    assert len(columns.time) == len(columns.parameters["primary_11l.stiffness"].value) == 140
    assert client.export("a").startswith(b"time,seconds,windows,")
    assert len(list(client.alarms(active=True))) == len(vehicle.alarms)
    client.acknowledge("a")
    assert client.maintenance("a", "overhaul").author == "local"
    assert client.vehicle("a").health == "ok"
    with pytest.raises(ApiError) as refused:
        client.vehicle("nobody")
    assert refused.value.status == 404 and "nobody" in refused.value.problem.detail


def test_the_typed_client_uploads(address: str, tmp_path: Path, reading_here: None) -> None:
    client = Client(address)
    (tmp_path / "ride.csv").write_text("time,a\n0,1\n0.01,2\n")
    job = client.upload(tmp_path / "ride.csv", vehicle="b")
    assert client.wait(job.id, 60).state in ("done", "failed")
    job = client.upload(tmp_path / "ride.csv", vehicle="b", start="2026-09-21T14:13:20Z")
    with urllib.request.urlopen(f"{address}/recordings") as answer:
        starts = {line["id"]: line["start"] for line in json.load(answer)["recordings"]}
    assert starts[job.recording] == "2026-09-21T14:13:20.000Z" and None in starts.values()


def test_a_generated_client_reads_a_vehicle(address: str, tmp_path: Path) -> None:
    tool = shutil.which("openapi-python-client", path=str(Path(sys.executable).parent))  # CI does not activate it
    if tool is None:
        pytest.skip("needs openapi-python-client")
    with urllib.request.urlopen(f"{address}/openapi.json") as answer:
        (tmp_path / "openapi.json").write_bytes(answer.read())
    command = [tool, "generate", "--path", "openapi.json", "--meta", "none", "--output-path", "made"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "WARNING" not in done.stdout + done.stderr, done.stdout + done.stderr
    script = (
        "from made import Client; from made.models import ProblemAnswer, VehicleAnswer\n"
        "from made.api.vehicles import vehicle_vehicles_id_get as route\n"
        f"client = Client('{address}')\n"
        "got, none = route.sync('a', client=client), route.sync('nobody', client=client)\n"
        "assert isinstance(got, VehicleAnswer) and isinstance(none, ProblemAnswer), (got, none)\n"
        "print(got.health, len(got.parameters), none.status)"
    )
    read = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert read.stdout.split() == ["out_of_specification", "24", "404"], read.stdout + read.stderr


def test_files_of_others_are_those_that_were_published() -> None:
    vendor = STATIC / "vendor"
    listed = json.loads((vendor / "VENDOR.json").read_text())
    hashes = {n: h for part in listed.values() if isinstance(part, dict) for n, h in part["files"].items()}
    kept = {p.name for p in vendor.iterdir() if p.suffix in (".js", ".css")}
    assert kept == set(hashes)
    for name, digest in hashes.items():
        assert hashlib.sha256((vendor / name).read_bytes()).hexdigest() == digest, name


def test_static_files_are_kept_by_browsers_and_change_their_address(client: TestClient) -> None:
    page = client.get("/").text
    link = page.split('rel="stylesheet" href="')[1].split('"')[0]
    answer = client.get(link)
    assert answer.status_code == 200 and "immutable" in answer.headers["cache-control"]
    assert client.get("/static/../render.py").status_code == 404


def test_docs_are_interactive_from_files_of_the_service(client: TestClient) -> None:
    page = client.get("/docs").text
    assert "swagger-ui-bundle.js" in page and "http" not in page.replace("http-equiv", "")
