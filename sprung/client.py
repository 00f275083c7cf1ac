"""A typed client of the HTTP API, with nothing but the standard library under it."""

from __future__ import annotations

import json
import mimetypes
import time
import urllib.error
import urllib.parse
import urllib.request
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from sprung.service.api import job_models, models
from sprung.service.api.circumstance_models import CircumstancesAnswer

M = TypeVar("M", bound=BaseModel)
PAGE = 500


class ApiError(Exception):
    """An answer that is an error (RFC 9457): `status`, `problem` and the fields that are wrong."""

    def __init__(self, status: int, problem: models.ProblemAnswer) -> None:
        super().__init__(f"{status}: {problem.detail}")
        self.status = status
        self.problem = problem


class Client:
    """One service.

    token: of `sprung token`, where the service asks for one; timeout: seconds for one answer.

    >>> import sprung
    >>> client = sprung.Client(url)  # "http://localhost:8000" of `sprung serve`
    >>> for line in client.vehicles(sort="urgency"):
    ...     print(line.vehicle, line.health, client.vehicle(line.vehicle).windows.used)
    m1 ok 3
    """

    def __init__(self, base: str = "http://127.0.0.1:8000", token: str | None = None, timeout: float = 30.0) -> None:
        self._base = base.rstrip("/")
        self._headers = {"Accept": "application/json"} | ({"Authorization": f"Bearer {token}"} if token else {})
        self._timeout = timeout

    def vehicles(self, **query: Any) -> Iterator[models.VehicleLine]:
        """Every vehicle that fits the query (`q`, `health`, `silent`, `sort`, ...), page after page."""
        after = None
        while True:
            page = self._get("/vehicles", models.Vehicles, {"limit": PAGE, "after": after} | query)
            yield from page.vehicles
            after = page.next
            if after is None:
                return

    def vehicle(self, vehicle: str) -> models.VehicleAnswer:
        """A vehicle as it stands."""
        return self._get(f"/vehicles/{_quoted(vehicle)}", models.VehicleAnswer)

    def history(self, vehicle: str, parameters: Sequence[str], **query: Any) -> models.ColumnsAnswer:
        """Parameters over time, as columns; `since`, `until`, `resolution` as in the API."""
        wanted = {"parameter": list(parameters), "format": "columns"} | query
        return self._get(f"/vehicles/{_quoted(vehicle)}/history", models.ColumnsAnswer, wanted)

    def circumstances(self, vehicle: str, **query: Any) -> CircumstancesAnswer:
        """How a vehicle ran: loads, temperature, speed; `since`, `until` as in the API."""
        return self._get(f"/vehicles/{_quoted(vehicle)}/circumstances", CircumstancesAnswer, query)

    def export(self, vehicle: str, kind: str = "csv", **query: Any) -> bytes:
        """The history of every parameter as a file: csv, parquet or mcap."""
        return self._send("GET", f"/vehicles/{_quoted(vehicle)}/history", {"format": kind} | query)

    def bundle(self, vehicle: str) -> bytes:
        """Signals, simulation, estimates and events as MCAP."""
        return self._send("GET", f"/vehicles/{_quoted(vehicle)}/bundle")

    def alarms(self, **query: Any) -> Iterator[models.AlarmAnswer]:
        """Alarms of the fleet, newest first (`active`, `vehicle`, `severity`, `kind`, ...)."""
        after = None
        while True:
            page = self._get("/alarms", models.AlarmPage, {"limit": PAGE, "after": after} | query)
            yield from page.alarms
            after = page.next
            if after is None:
                return

    def acknowledge(self, vehicle: str, alarm: int | None = None) -> models.VehicleAnswer:
        """Somebody has seen an alarm, or all that are active."""
        return self._post(f"/vehicles/{_quoted(vehicle)}/acknowledge", models.VehicleAnswer, {"alarm": alarm})

    def note(self, vehicle: str, text: str) -> models.MarkAnswer:
        """Write a note on the time line."""
        return self._post(f"/vehicles/{_quoted(vehicle)}/notes", models.MarkAnswer, {"text": text})

    def maintenance(self, vehicle: str, text: str, parameters: Sequence[str] | None = None) -> models.MarkAnswer:
        """Mark a maintenance; baselines of `parameters` (None: of all) are learned anew."""
        body = {"text": text, "parameters": None if parameters is None else list(parameters)}
        return self._post(f"/vehicles/{_quoted(vehicle)}/maintenance", models.MarkAnswer, body)

    def use_model(
        self, vehicle: str, *, report: str | None = None, version: int | None = None, system: str | None = None
    ) -> models.VehicleModels:
        """Follow a vehicle with what a report found, with an earlier version (0: the service's file), or with the text
        of a system file."""
        chosen = {"report": report, "version": version, "system": system}
        body = {name: value for name, value in chosen.items() if value is not None}
        return self._post(f"/vehicles/{_quoted(vehicle)}/model", models.VehicleModels, body)

    def vehicle_models(self, vehicle: str) -> models.VehicleModels:
        """Every version that a vehicle was followed with."""
        return self._get(f"/vehicles/{_quoted(vehicle)}/models", models.VehicleModels)

    def model_file(self, vehicle: str, version: int) -> str:
        """The system file of a version."""
        return self._send("GET", f"/vehicles/{_quoted(vehicle)}/models/{version}").decode()

    def identify(self, window: Mapping[str, Any], **query: Any) -> models.IdentifyAnswer:
        """Identify one window; its form is that of `POST /identify`."""
        return self._post("/identify", models.IdentifyAnswer, window, query)

    def upload(
        self, path: Path, vehicle: str | None = None, diagnose: bool = False, start: str | None = None
    ) -> job_models.Job:
        """Send a recording to be followed, or to be diagnosed; `wait` for the job.

        start: when it began (RFC 3339), where its times count from 0.
        """
        boundary = uuid.uuid4().hex
        kind = mimetypes.guess_type(path.name)[0] or "application/octet-stream"
        said = {"vehicle": vehicle, "start": start}
        parts = [_field(boundary, name, value) for name, value in said.items() if value is not None]
        head = f'--{boundary}\r\nContent-Disposition: form-data; name="file"; filename="{path.name}"\r\n'
        parts += [f"{head}Content-Type: {kind}\r\n\r\n".encode(), path.read_bytes(), b"\r\n"]
        body = b"".join([*parts, f"--{boundary}--\r\n".encode()])
        place = "/diagnose" if diagnose else "/recordings"
        answer = self._send("POST", place, None, body, f"multipart/form-data; boundary={boundary}")
        return job_models.Job.model_validate_json(answer)

    def job(self, job: str) -> job_models.Job:
        """Where a job stands."""
        return self._get(f"/jobs/{_quoted(job)}", job_models.Job)

    def wait(self, job: str, seconds: float = 600.0, every: float = 0.5) -> job_models.Job:
        """A job once it is done or has failed.  Raises TimeoutError."""
        end = time.monotonic() + seconds
        while (found := self.job(job)).state not in ("done", "failed"):
            if time.monotonic() > end:
                raise TimeoutError(f"job {job} is {found.state} after {seconds:g} s")
            time.sleep(every)
        return found

    def report(self, report: str) -> dict[str, Any]:
        """A mismatch report."""
        found: dict[str, Any] = json.loads(self._send("GET", f"/reports/{_quoted(report)}"))
        return found

    def _get(self, path: str, model: type[M], query: Mapping[str, Any] | None = None) -> M:
        return model.model_validate_json(self._send("GET", path, query))

    def _post(self, path: str, model: type[M], body: Mapping[str, Any], query: Mapping[str, Any] | None = None) -> M:
        answer = self._send("POST", path, query, json.dumps(body).encode(), "application/json")
        return model.model_validate_json(answer)

    def _send(
        self,
        method: str,
        path: str,
        query: Mapping[str, Any] | None = None,
        body: bytes | None = None,
        kind: str | None = None,
    ) -> bytes:
        wanted = {name: _text(value) for name, value in (query or {}).items() if value is not None}
        url = f"{self._base}{path}" + (f"?{urllib.parse.urlencode(wanted, doseq=True)}" if wanted else "")
        headers = dict(self._headers)
        if body is not None:  # a retry of a proxy must not do a thing twice
            headers |= {"Content-Type": kind or "application/json", "Idempotency-Key": str(uuid.uuid4())}
        request = urllib.request.Request(url, body, headers, method=method)
        try:
            with urllib.request.urlopen(request, timeout=self._timeout) as answer:
                found: bytes = answer.read()
                return found
        except urllib.error.HTTPError as error:
            with error:
                raise ApiError(error.code, _problem(error)) from None


def _problem(error: urllib.error.HTTPError) -> models.ProblemAnswer:
    try:
        return models.ProblemAnswer.model_validate_json(error.read())
    except ValueError:  # of a proxy, not of the service
        return models.ProblemAnswer(title=str(error.reason), status=error.code, detail=str(error.reason))


def _text(value: Any) -> Any:
    return str(value).lower() if isinstance(value, bool) else value


def _quoted(part: str) -> str:
    return urllib.parse.quote(part, safe="")


def _field(boundary: str, name: str, value: str) -> bytes:
    return f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n{value}\r\n'.encode()
