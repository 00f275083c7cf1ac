"""The tables.  Changes go through a new file in `service/migrations/versions`; a test compares the two.

Times are ns since the Unix epoch.  Arrays (`LargeBinary`) are little-endian float64 in the order of the
model's parameters or sensors, which its row in `models` names: one row per window instead of one per window
and parameter keeps the store small (about 1 kB a window) and its inserts fast.
"""

from __future__ import annotations

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    UniqueConstraint,
)

STAGING = "staging:"  # digests of models whose history is not shown yet begin so (`service.store.staging`)
LONGEST_NAME = 1000  # characters of what an alarm is about: a fault that many channels share names them all

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
        "pk": "pk_%(table_name)s",
    }
)

vehicles = Table(
    "vehicles",
    metadata,
    Column("id", String(128), primary_key=True),
    Column("created_ns", BigInteger, nullable=False),
    Column("label", String(128), nullable=True),  # what people call it; the id stays what recordings call it
    Column("retired_ns", BigInteger, nullable=True),  # no longer in service: out of the fleet's list, data kept
)

fleet_status = Table(  # one row a vehicle, written with its tracker: lists of the fleet read nothing else
    "fleet_status",
    metadata,
    Column("vehicle_id", String(128), ForeignKey("vehicles.id"), primary_key=True),
    Column("model_id", Integer, ForeignKey("models.id"), nullable=False),
    Column("revision", Integer, nullable=False),  # of the tracker that it was made from
    Column("health", String(24), nullable=False),  # NAMUR NE 107
    Column("urgency", Integer, nullable=False),  # larger comes first: health, unacknowledged alarms, their number
    Column("alarms", Integer, nullable=False),  # active, of severity alarm
    Column("warnings", Integer, nullable=False),  # active, of severity warning
    Column("unacknowledged", Integer, nullable=False),  # active, of either severity
    Column("earlier", Integer, nullable=False),  # of these, raised under an earlier model and never closed
    Column("largest", String(160), nullable=True),  # parameter with the largest drift
    Column("drift", Float, nullable=True),  # of it, relative to the vehicle's own baseline
    Column("drift_std", Float, nullable=True),
    Column("nrmse", Float, nullable=True),  # of the newest identified window
    Column("learned", Float, nullable=False),  # share of the parameters that have a baseline
    Column("elements", String(400), nullable=False),  # a letter an element, for the small drawing
    Column("last_window_ns", BigInteger, nullable=True),  # as recorded
    Column("received_ns", BigInteger, nullable=False),  # by this machine's clock
    Column("used", Integer, nullable=False),  # windows since the model is in use
    Column("repaired", Integer, nullable=False),
    Column("dropped", Integer, nullable=False),
    Column("uninformative", Integer, nullable=False),
    Column("unfitting", Integer, nullable=False),  # of the used and repaired ones, those that do not fit the model
    Index("ix_fleet_status_urgency_vehicle_id", "urgency", "vehicle_id"),
)

window_reasons = Table(  # why windows were dropped, repaired or not followed
    "window_reasons",
    metadata,
    Column("vehicle_id", String(128), ForeignKey("vehicles.id"), primary_key=True),
    Column("model_id", Integer, ForeignKey("models.id"), primary_key=True),
    Column("outcome", String(20), primary_key=True),
    Column("reason", String(200), primary_key=True),
    Column("windows", Integer, nullable=False),
    Column("last_ns", BigInteger, nullable=False),  # start of the newest such window
)

models = Table(  # what was identified with: a system file and a trained estimator
    "models",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("digest", String(80), nullable=False, unique=True),
    Column("system", String(200), nullable=False),
    Column("description", JSON, nullable=False),  # {"parameters": [{name, unit, nominal}], "sensors": [name]}
    Column("created_ns", BigInteger, nullable=False),
)

recordings = Table(
    "recordings",
    metadata,
    Column("id", String(36), primary_key=True),
    Column("vehicle_id", String(128), ForeignKey("vehicles.id"), nullable=True),
    Column("name", String(255), nullable=False),  # as the user called it; never used as a path
    Column("source", String(20), nullable=False),  # file, upload, live
    Column("file", String(64), nullable=True),  # name inside the upload folder, chosen by the service
    Column("size_bytes", BigInteger, nullable=True),
    Column("tally", JSON, nullable=True),  # {"used": n, ...}
    Column("created_ns", BigInteger, nullable=False),
    Column("finished_ns", BigInteger, nullable=True),
    Column("began_ns", BigInteger, nullable=True),  # as its sender has said, for times that count from 0
    Column("kept_since_ns", BigInteger, nullable=True),  # by the clock of retention; null: created_ns
)

windows = Table(  # PostgreSQL keeps a partition a month (`service.store.partitions`): the key holds the time
    "windows",
    metadata,
    Column("vehicle_id", String(128), ForeignKey("vehicles.id"), primary_key=True),
    Column("start_ns", BigInteger, primary_key=True),
    Column("model_id", Integer, ForeignKey("models.id"), primary_key=True),
    Column("stored_ns", BigInteger, nullable=False),
    Column("recording_id", String(36), ForeignKey("recordings.id"), nullable=True),
    Column("outcome", String(16), nullable=False),  # used, repaired, dropped, uninformative
    Column("reason", String(200), nullable=True),
    Column("repaired_samples", Integer, nullable=False),
    Column("tracked", Boolean, nullable=False),  # False: dropped, or older than what the tracker had seen
    Column("nrmse", Float, nullable=True),
    Column("chi_square", Float, nullable=True),
    Column("adequate", Boolean, nullable=True),
    Column("converged", Boolean, nullable=True),
    Column("iterations", Integer, nullable=True),
    Column("log_ratio", LargeBinary, nullable=True),  # log(theta / nominal), shape (P,)
    Column("std", LargeBinary, nullable=True),  # of log_ratio, shape (P,)
    Column("identifiable", LargeBinary, nullable=True),  # one byte each, shape (P,)
    Column("per_sensor", LargeBinary, nullable=True),  # nrmse, shape (S,)
    Column("posterior", LargeBinary, nullable=True),  # log-ratios that the tracker believed after it, shape (P,)
    Column("posterior_std", LargeBinary, nullable=True),  # shape (P,)
    Column("loads", Text, nullable=True),  # JSON {"car": [by the window, believed]}, each [kg, std] or null
    Index("ix_windows_stored_ns", "stored_ns"),
    postgresql_partition_by="RANGE (start_ns)",
)

pending = Table(  # estimates that were received and wait for the windows before them
    "pending",
    metadata,
    Column("vehicle_id", String(128), ForeignKey("vehicles.id"), primary_key=True),
    Column("model_id", Integer, ForeignKey("models.id"), primary_key=True),
    Column("start_ns", BigInteger, primary_key=True),
    Column("received_ns", BigInteger, nullable=False),
    Column("message", LargeBinary, nullable=False),
    Index("ix_pending_received_ns", "received_ns"),
)

rollups = Table(  # posteriors over long ranges
    "rollups",
    metadata,
    Column("vehicle_id", String(128), ForeignKey("vehicles.id"), primary_key=True),
    Column("model_id", Integer, ForeignKey("models.id"), primary_key=True),
    Column("resolution_s", Integer, primary_key=True),
    Column("bucket_ns", BigInteger, primary_key=True),
    Column("windows", Integer, nullable=False),
    Column("mean", LargeBinary, nullable=False),  # of log_ratio, shape (P,)
    Column("std", LargeBinary, nullable=False),  # mean of the posterior's std, shape (P,)
    Column("low", LargeBinary, nullable=False),
    Column("high", LargeBinary, nullable=False),
    Column("updated_ns", BigInteger, nullable=False),
)

circumstances = Table(  # how vehicles ran, beside histories: means of minutes and hours
    "circumstances",
    metadata,
    Column("vehicle_id", String(128), ForeignKey("vehicles.id"), primary_key=True),
    Column("resolution_s", Integer, primary_key=True),
    Column("bucket_ns", BigInteger, primary_key=True),
    Column("means", JSON, nullable=False),  # {"car.load": [windows, kg], "temperature": [windows, degC], ...}
    Column("updated_ns", BigInteger, nullable=False),
)

tracker_states = Table(
    "tracker_states",
    metadata,
    Column("vehicle_id", String(128), ForeignKey("vehicles.id"), primary_key=True),
    Column("model_id", Integer, ForeignKey("models.id"), primary_key=True),
    Column("last_window_ns", BigInteger, nullable=False),  # start of the last window that was fed
    Column("revision", Integer, nullable=False),
    Column("state", JSON, nullable=False),
    Column("updated_ns", BigInteger, nullable=False),
)

reports = Table(
    "reports",
    metadata,
    Column("id", String(36), primary_key=True),
    Column("vehicle_id", String(128), ForeignKey("vehicles.id"), nullable=True),
    Column("recording_id", String(36), ForeignKey("recordings.id"), nullable=True),
    Column("verdict", String(40), nullable=False),
    Column("report", JSON, nullable=False),
    Column("created_ns", BigInteger, nullable=False),
)

alarms = Table(
    "alarms",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("vehicle_id", String(128), ForeignKey("vehicles.id"), nullable=False),
    Column("model_id", Integer, ForeignKey("models.id"), nullable=False),
    Column("kind", String(10), nullable=False),  # change, misfit
    Column("parameter", String(LONGEST_NAME), nullable=False),  # empty for a misfit: NULL would not be unique
    Column("opened_ns", BigInteger, nullable=False),
    Column("onset_ns", BigInteger, nullable=False),
    Column("closed_ns", BigInteger, nullable=True),
    Column("change", Float, nullable=True),  # relative to the vehicle's own baseline
    Column("std", Float, nullable=True),
    Column("peak", Float, nullable=True),  # the largest change so far
    Column("severity", String(20), nullable=False),
    Column("report_id", String(36), ForeignKey("reports.id"), nullable=True),
    Column("acknowledged_ns", BigInteger, nullable=True),
    Column("acknowledged_by", String(128), nullable=True),
    Column("alternatives", JSON, nullable=True),  # what the evidence does not tell it from, ["bogie1_1l.gain"]
    Index("ix_alarms_opened_ns", "opened_ns"),
    UniqueConstraint("vehicle_id", "model_id", "kind", "parameter", "opened_ns"),
)

jobs = Table(
    "jobs",
    metadata,
    Column("id", String(36), primary_key=True),
    Column("kind", String(20), nullable=False),  # recording, diagnosis
    Column("state", String(10), nullable=False),  # queued, running, done, failed
    Column("recording_id", String(36), ForeignKey("recordings.id"), nullable=True),
    Column("vehicle_id", String(128), nullable=True),
    Column("progress", Float, nullable=False),  # 0..1
    Column("result", JSON, nullable=True),
    Column("error", String(500), nullable=True),
    Column("created_ns", BigInteger, nullable=False),
    Column("updated_ns", BigInteger, nullable=False),
    Column("attempts", Integer, nullable=False, server_default="0"),  # starts that did not end in good order
)

tokens = Table(  # who may ask; the secret itself is kept nowhere
    "tokens",
    metadata,
    Column("id", String(16), primary_key=True),
    Column("digest", String(64), nullable=False, unique=True),  # SHA-256 of the secret, in hex
    Column("name", String(128), nullable=False),
    Column("scopes", JSON, nullable=False),  # ["read", ...]
    Column("fleet", String(128), nullable=False),  # vehicles whose ids begin so; empty: all
    Column("created_ns", BigInteger, nullable=False),
    Column("expires_ns", BigInteger, nullable=True),
    Column("revoked_ns", BigInteger, nullable=True),
)

audit = Table(  # who did what, and when
    "audit",
    metadata,
    Column("id", BigInteger().with_variant(Integer, "sqlite"), primary_key=True),
    Column("time_ns", BigInteger, nullable=False),
    Column("actor", String(160), nullable=False),
    Column("action", String(60), nullable=False),
    Column("target", String(200), nullable=False),
    Column("detail", JSON, nullable=True),
    Index("ix_audit_time_ns", "time_ns"),
)

marks = Table(  # what people wrote on a vehicle's time line
    "marks",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("vehicle_id", String(128), ForeignKey("vehicles.id"), nullable=False),
    Column("kind", String(20), nullable=False),  # note, maintenance
    Column("time_ns", BigInteger, nullable=False),  # what it is about
    Column("text", String(2000), nullable=False),
    Column("parameters", JSON, nullable=True),  # whose baselines were learned anew; null: none, []: all
    Column("author", String(128), nullable=False),
    Column("created_ns", BigInteger, nullable=False),
    Index("ix_marks_vehicle_id_time_ns", "vehicle_id", "time_ns"),
)

vehicle_models = Table(  # system files that single vehicles were given; version 0 is the service's and has no row
    "vehicle_models",
    metadata,
    Column("vehicle_id", String(128), ForeignKey("vehicles.id"), primary_key=True),
    Column("version", Integer, primary_key=True, autoincrement=False),
    Column("model_id", Integer, ForeignKey("models.id"), nullable=False),
    Column("text", Text, nullable=False),  # YAML
    Column("report_id", String(36), nullable=True),  # where it comes from; a report may be gone before it
    Column("author", String(160), nullable=False),
    Column("created_ns", BigInteger, nullable=False),
)

vehicle_model_uses = Table(  # the newest line says which version is in use
    "vehicle_model_uses",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("vehicle_id", String(128), ForeignKey("vehicles.id"), nullable=False),
    Column("version", Integer, nullable=False),
    Column("author", String(160), nullable=False),
    Column("since_ns", BigInteger, nullable=False),
    Index("ix_vehicle_model_uses_vehicle_id", "vehicle_id"),
)

deliveries = Table(  # notifications on their way; those that failed for good stay to be seen
    "deliveries",
    metadata,
    Column("id", String(36), primary_key=True),
    Column("kind", String(64), nullable=False),  # type of the event
    Column("target", String(300), nullable=False),  # an URL, or mailto:ADDRESS
    Column("event", JSON, nullable=False),  # CloudEvents 1.0, structured
    Column("state", String(10), nullable=False),  # waiting, delivered, dead
    Column("attempts", Integer, nullable=False),
    Column("next_ns", BigInteger, nullable=False),
    Column("error", String(300), nullable=True),
    Column("created_ns", BigInteger, nullable=False),
    Column("updated_ns", BigInteger, nullable=False),
    Index("ix_deliveries_state_next_ns", "state", "next_ns"),
)

idempotency = Table(  # answers to requests that carried an Idempotency-Key
    "idempotency",
    metadata,
    Column("key", String(200), primary_key=True),
    Column("request", String(64), nullable=False),  # hash of method, path, caller
    Column("status", Integer, nullable=False),
    Column("body", JSON, nullable=False),
    Column("location", String(200), nullable=True),
    Column("created_ns", BigInteger, nullable=False),
)
