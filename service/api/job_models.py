"""Answers on jobs and their results: recordings, reports, notifications."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field


class Job(BaseModel):
    """Work that goes on after its request was answered."""

    id: str
    kind: str
    state: Literal["queued", "running", "done", "failed"]
    recording: str | None
    vehicle: str | None
    progress: float
    result: dict[str, Any] | None
    error: str | None
    created: str
    updated: str


class JobPage(BaseModel):
    """Jobs, newest first."""

    jobs: list[Job]
    next: str | None


class ReportLine(BaseModel):
    """A mismatch report in a list."""

    id: str
    vehicle: str | None
    recording: str | None
    verdict: str
    findings: list[str] = Field(description="a sentence each")
    created: str
    page: str


class ReportPage(BaseModel):
    """Reports, newest first."""

    reports: list[ReportLine]
    next: str | None


class RecordingAnswer(BaseModel):
    """A file or stream that was read."""

    id: str
    vehicle: str | None
    name: str
    source: str
    size_bytes: int | None
    kept: bool = Field(description="the file is still there and can be diagnosed")
    start: str | None = Field(description="when it began, as its sender has said; used where its times count from 0")
    created: str
    finished: str | None
    tally: dict[str, Any] | None


class RecordingPage(BaseModel):
    """Recordings, newest first."""

    recordings: list[RecordingAnswer]
    next: str | None


class Delivery(BaseModel):
    """A notification on its way."""

    id: str
    type: str
    target: str
    state: Literal["waiting", "delivered", "dead"]
    attempts: int
    next_attempt: str | None
    error: str | None
    created: str


class DeliveryPage(BaseModel):
    """Notifications, newest first."""

    deliveries: list[Delivery]
    next: str | None
