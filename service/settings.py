"""Every setting of the service in one place, read once at start and passed down.

Environment variables `SPRUNG_<NAME>` set the defaults of the command line's options.
"""

from __future__ import annotations

import ipaddress
import json
import logging
import os
import sys
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, SecretStr, ValidationError, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from sprung.service.errors import UserError

log = logging.getLogger("sprung")
PREFIX = "SPRUNG_"
MOST_DAYS = 100_000.0  # of what is kept: 270 years; times in ns have 64 bits
OTHERS = ("TOKEN", "DEBUG")  # variables that are read elsewhere


def default_data_dir() -> Path:
    """Where this platform keeps a user's application data."""
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Application Support"
    else:
        base = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share")
    return base / "sprung"


def _listed(given: Any) -> Any:
    """Text as its parts."""
    if not isinstance(given, str):
        return given
    return json.loads(given) if given.lstrip().startswith("[") else given.replace(",", " ").split()


# Separated by commas or spaces, or a JSON list
Listed = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_listed)]


class Settings(BaseSettings):
    """Bounds are deliberate: every queue, body, file and label set of the service has one."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, frozen=True, extra="ignore", allow_inf_nan=False)

    data_dir: Path = Field(default_factory=default_data_dir)  # uploads, reports and the embedded store
    store: str | None = None  # SQLAlchemy URL; None: sprung.db in data_dir
    system: Path | None = None  # None: the bundled Manchester vehicle
    dbc: Path | None = None  # None: the bundled one, where it has the system's CAN signals
    weights: Path | None = None  # directory of a trained estimator; None: the bundled one
    weights_key: Path | None = None  # public key (Ed25519, PEM) by which `weights` must be signed; None: by nobody

    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=0, le=65535)
    max_body_bytes: int = Field(default=2_000_000, gt=0)  # one window of 28 channels is about 60 kB
    max_upload_bytes: int = Field(default=2_000_000_000, gt=0)
    admin_token: SecretStr | None = None  # one more token that allows everything, of at least 20 characters
    open: bool = False  # take requests without tokens on any address: only behind something that asks for them
    oidc_issuer: str = ""  # of an OpenID Connect provider, as in https://login.example.org/realms/works; empty: none
    oidc_client_id: str = ""  # the provider's name for this service
    oidc_client_secret: SecretStr | None = None  # where the provider gave one
    oidc_audience: str = ""  # of access tokens that programs send; empty: the client's id
    oidc_claim: str = "groups"  # where tokens name groups, as in realm_access.roles
    oidc_groups: dict[str, list[str]] = {}  # scopes by group, as JSON: {"maintenance": ["operate", "fleet:north-"]}
    oidc_session_hours: float = Field(default=8.0, gt=0, le=24)  # before people sign in again
    allowed_hosts: Listed = ()  # host names that are served; none: any, where tokens are needed
    trusted_proxies: Listed = ()  # addresses or networks whose X-Forwarded-* are believed
    log_format: Literal["text", "json"] = "text"
    log_level: Literal["debug", "info", "warning", "error"] = "warning"
    connections: int = Field(default=1000, gt=0)  # in all; fewer where the system allows fewer open files
    client_connections: int = Field(default=256, gt=0)  # of one address
    header_seconds: float = Field(default=10.0, gt=0)  # in which a request's header must come
    body_idle_seconds: float = Field(default=10.0, gt=0)  # without a byte of a body
    client_broken_per_second: float = Field(default=50.0, gt=0)  # requests that one address breaks off; more: refused
    client_requests_per_second: float = Field(default=500.0, gt=0)  # of one address or token; more are 429
    tls_certificate: Path | None = None  # PEM; with it, HTTPS
    tls_key: Path | None = None  # PEM; where it is not in the certificate's file
    tls_client_ca: Path | None = None  # PEM; with it, clients must show a certificate of this authority
    shutdown_seconds: int = Field(default=20, gt=0)

    apart: bool = True  # identify and track, each in a process of its own, where there are two processors
    compute_queue: int = Field(default=64, gt=0)  # windows waiting for the numerics before 503
    job_queue: int = Field(default=16, gt=0)  # uploads and diagnoses waiting before 503
    min_free_bytes: int = Field(default=200_000_000, ge=0)  # on the disk of data_dir; below, not ready and no uploads
    max_uploads_bytes: int = Field(default=20_000_000_000, gt=0)  # all uploads and excerpts that are kept
    recording_seconds: float = Field(default=7200.0, gt=0)  # that reading an upload may take in all
    reading_silence_seconds: float = Field(default=60.0, gt=0)  # that it may go on without any sample
    diagnosis_seconds: float = Field(default=1800.0, gt=0)  # its search ends before and reports what it found
    isolate_reading: bool = True  # commands, too, read recordings in a process of their own
    worker_memory_bytes: int = Field(default=4_000_000_000, gt=0)  # of a process that reads an upload or diagnoses
    batch_windows: int = Field(default=128, gt=0)  # windows identified and stored in one transaction

    parameter_series_vehicles: int = Field(default=20, ge=0)  # vehicles with per-parameter metrics
    vehicles_in_memory: int = Field(default=1000, gt=0)  # tracker states held between windows
    ring_vehicles: int = Field(default=100, gt=0)  # vehicles whose recent samples are held, 1.3 MB each
    ring_seconds: float = Field(default=60.0, gt=0)

    late_seconds: float = Field(
        default=10.0, ge=0
    )  # that an estimate waits for those before it: POST /ingest/estimates
    silent_seconds: float = Field(default=600.0, gt=0)  # nothing heard for so long: the vehicle is shown as silent

    public_url: str = ""  # where people reach the pages, as in https://sprung.example.org; for links in notifications
    webhooks: Listed = ()  # URLs that events are posted to
    webhook_networks: Listed = ()  # that receivers may lie in beside public addresses, as in 10.0.0.0/8,127.0.0.0/8
    webhook_secret: str | None = None  # signs them (Standard Webhooks); whsec_... or any text
    mail_to: Listed = ()  # addresses that events are mailed to
    mail_from: str = "sprung@localhost"
    smtp_host: str = ""
    smtp_port: int = Field(default=25, ge=1, le=65535)
    smtp_starttls: bool = False
    smtp_user: str | None = None
    smtp_password: str | None = None

    alarm_signals_vehicle: int = Field(default=20, ge=0)  # alarms of one vehicle whose minute of raw signals is kept
    alarm_signals_bytes: int = Field(default=1_000_000_000, gt=0)  # that those of all vehicles may take

    misfit_seconds: float = Field(default=30.0, gt=0)  # windows not fitting for so long start a diagnosis
    misfit_pause_seconds: float = Field(default=3600.0, gt=0)  # before the same vehicle is diagnosed again

    retention_store_bytes: int | None = Field(default=None, gt=0)  # the oldest windows (PostgreSQL: months) go
    retention_windows_days: float = Field(
        default=30.0, gt=0, le=MOST_DAYS
    )  # by the time of the data and of storing, whichever is later
    retention_minutes_days: float = Field(default=730.0, gt=0, le=MOST_DAYS)  # one-minute roll-ups
    archive: str | None = None  # folder or address (s3://...) for windows that are old, as Parquet; None: they are gone
    retention_uploads_days: float = Field(default=7.0, gt=0, le=MOST_DAYS)

    @field_validator("trusted_proxies")
    @classmethod
    def _networks(cls, given: tuple[str, ...]) -> tuple[str, ...]:
        for one in given:
            ipaddress.ip_network(one)  # a ValueError that names it: what is misspelt would be trusted by nobody
        return given

    @field_validator("admin_token")
    @classmethod
    def _long_enough(cls, value: SecretStr | None) -> SecretStr | None:
        if value is not None and len(value.get_secret_value()) < 20:
            raise ValueError("a token that can be guessed is none; give at least 20 characters")
        return value

    @property
    def store_url(self) -> str:
        """The store's SQLAlchemy URL."""
        return self.store or f"sqlite:///{self.data_dir / 'sprung.db'}"

    @property
    def uploads(self) -> Path:
        """Where uploads and excerpts lie, under names that the service chose."""
        return self.data_dir / "uploads"

    @property
    def reports(self) -> Path:
        """Where the pages and pictures of mismatch reports lie, a folder each."""
        return self.data_dir / "reports"


def settings_with(options: Mapping[str, Any]) -> Settings:
    """Settings of the environment, overridden by the options that were given (not None).

    Raises UserError that names a variable or option which cannot be used.
    """
    for name, meant in misspelt(os.environ):
        log.warning("%s is no setting; did you mean %s?", name, meant)
    try:
        return Settings(**{name: value for name, value in options.items() if value is not None})
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        raise UserError(f"setting {name} (SPRUNG_{name.upper()}): {first['msg']}") from error


def misspelt(environment: Iterable[str]) -> list[tuple[str, str]]:
    """Variables that are no setting but nearly one, each with that one.

    Others that begin with SPRUNG_ are left alone: Kubernetes, for one, sets some for a service of that name.
    """
    known = [name.upper() for name in Settings.model_fields]
    found = []
    for variable in sorted(environment):
        name = variable.upper().removeprefix(PREFIX)
        if variable.upper().startswith(PREFIX) and name not in (*known, *OTHERS):
            close = get_close_matches(name, known, n=1, cutoff=0.75)
            found += [(variable, f"{PREFIX}{one}") for one in close]
    return found
