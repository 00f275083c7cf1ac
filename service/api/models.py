"""What clients are answered: one model an answer, for the description of the API and for typed clients."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field

Health = Literal["ok", "maintenance_required", "out_of_specification", "check_function", "failure"]
Severity = Literal["warning", "alarm"]
Kind = Literal["change", "misfit", "sensor", "load"]


class ProblemField(BaseModel):
    """What is wrong with one field."""

    field: str
    detail: str


class ProblemAnswer(BaseModel):
    """RFC 9457 problem details."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    instance: str | None = None
    errors: list[ProblemField] = Field(default_factory=list, description="the fields that are wrong")


class FitAnswer(BaseModel):
    """How well a window fits: rms(error) / rms(measured)."""

    nrmse: float | None
    per_sensor: dict[str, float]
    adequate: bool | None = Field(default=None, description="the window fits the model within its noise")
    converged: bool | None = None
    reason: str | None = Field(default=None, description="why nothing, or not all that was asked for, was found")


class WindowParameter(BaseModel):
    """One parameter as one window gives it."""

    name: str
    value: float
    std: float
    unit: str
    nominal: float
    ratio: float = Field(description="value / nominal")
    identifiable: bool = True


class IdentifyAnswer(BaseModel):
    """Answer to `POST /identify`."""

    vehicle: str | None
    model: str
    parameters: list[WindowParameter]
    fit: FitAnswer
    states: dict[str, list[float]] | None = Field(default=None, description="simulated states, with ?states=true")
    tracked: bool | None = Field(default=None, description="the window fed the vehicle's tracker, with ?track=true")
    posterior: list[WindowParameter] | None = None


class UsualAnswer(BaseModel):
    """What is usual for one type of element in one class of vehicles."""

    kind: str
    vehicle_class: str = Field(description="what stands before the last separator of the vehicles' ids")
    vehicles: int
    ratio: float = Field(description="to nominal")
    mean_std: float = Field(description="of its logarithm")
    own_std: float = Field(description="by which elements of the class differ, of the logarithm")
    class_std: float = Field(description="by which classes differ, of the logarithm")


class StandingAnswer(BaseModel):
    """One parameter of one vehicle."""

    vehicle: str
    parameter: str
    ratio: float
    std: float
    usual_ratio: float
    departure: float = Field(description="from the usual value, in standard deviations of the class")
    per_day: float | None = Field(description="change of the logarithm per day, relative to the class")
    per_day_std: float | None
    per_day_sure: float | None = Field(description="exceeded with 95 %; negative where not even the sign is sure")
    crossing_days: list[float | None] = Field(
        description="until an alarm's change from its own first level: 5, 50 and 95 %; null: not within 1000 days"
    )


class CommonAnswer(BaseModel):
    """What the vehicles of a class did together."""

    vehicle_class: str
    kind: str
    time: str
    change: float
    std: float
    temperature: float | None = Field(description="degC, of those that measured it")


class TemperatureAnswer(BaseModel):
    """Dependence of a class's common mode on the temperature."""

    vehicle_class: str
    kind: str
    days: int
    per_kelvin: float = Field(description="change of the logarithm")
    std: float
    explained: float = Field(description="share of the common mode's variance")


class KnowledgeAnswer(BaseModel):
    """Answer to `GET /fleet/knowledge`."""

    parameters: int
    usual: list[UsualAnswer]
    worst: list[StandingAnswer]
    fastest: list[StandingAnswer]
    common: list[CommonAnswer]
    temperature: list[TemperatureAnswer]
    expected_crossings: dict[str, float] = Field(description="parameters by days ahead")


class IngestAnswer(BaseModel):
    """Answer to `POST /ingest/estimates`: what became of the windows."""

    vehicle: str
    folded: int = Field(description="tracked or counted now, those that had waited among them")
    waiting: int = Field(description="of the message, kept until the gap before them is filled or given up")
    known: int = Field(description="were there before")


class ParameterAnswer(BaseModel):
    """One parameter as tracked."""

    name: str
    value: float
    std: float
    unit: str
    nominal: float
    ratio: float = Field(description="value / nominal")
    identifiable: bool = Field(description="false: the prior, not a measurement")
    baseline: float | None = Field(description="the vehicle's own healthy value; null while it is learned")
    drift: float | None = Field(description="value / baseline - 1")
    drift_std: float | None
    alarm: Severity | None
    state: Literal["ok", "learning", "not_identifiable", "warning", "alarm"] | None = None
    lost_with: str | None = Field(
        default=None, description="stuck channels, joined by |, without which it is not identifiable"
    )


class AlarmAnswer(BaseModel):
    """One alarm; active while `recovered` is null."""

    id: int | None = None
    vehicle: str | None = None
    parameter: str | None = Field(description="null for a misfit")
    kind: Kind
    onset: str = Field(description="estimated time of the change")
    raised: str = Field(description="time of the window that gave the evidence")
    recovered: str | None
    change: float | None = Field(description="relative to the vehicle's own baseline")
    std: float | None
    severity: Severity
    report: str | None = Field(default=None, description="mismatch report that belongs to it")
    acknowledged: str | None = None
    acknowledged_by: str | None = None
    alternatives: list[str] = Field(default=[], description="indistinguishable alternatives")
    bundle: str | None = Field(default=None, description="the signals around it, as one MCAP file")


class WindowCounts(BaseModel):
    """Windows by outcome."""

    used: int
    repaired: int
    dropped: int
    uninformative: int = 0
    unfitting: int = Field(default=0, description="of the used and repaired ones, those that do not fit the model")


class WindowReason(BaseModel):
    """Why windows were dropped, repaired or not followed."""

    outcome: str
    reason: str
    windows: int
    last: str


class VehicleLine(BaseModel):
    """A vehicle in the list of the fleet."""

    vehicle: str
    label: str | None
    health: Health
    last_window: str | None = Field(description="start of the newest window, as recorded; null: none has come yet")
    received: str | None = Field(description="when it came, by the service's clock")
    silent: bool = Field(description="nothing came for longer than SPRUNG_SILENT_SECONDS")
    alarms: int = Field(description="active ones of either severity")
    unacknowledged: int
    largest: str | None = Field(description="parameter with the largest drift")
    drift: float | None
    learned: float = Field(description="share of the parameters that have a baseline")
    retired: str | None


class Vehicles(BaseModel):
    """Answer to `GET /vehicles`."""

    vehicles: list[VehicleLine]
    next: str | None = Field(description="`after` of the following page; null at the end")
    counts: dict[str, int] = Field(default_factory=dict, description="vehicles by health, whatever health is asked for")


class VehicleAnswer(BaseModel):
    """Answer to `GET /vehicles/{id}`."""

    vehicle: str
    label: str | None
    retired: str | None
    model: str
    model_version: int = Field(description="0: the service's system file; else one of the vehicle's own")
    health: Health
    last_window: str | None
    received: str | None
    silent: bool
    fit: FitAnswer | None
    parameters: list[ParameterAnswer]
    alarms: list[AlarmAnswer]
    windows: WindowCounts
    reasons: list[WindowReason] = Field(description="why windows were dropped, repaired or did not fit")


class PointAnswer(BaseModel):
    """A point of a history; of several windows where `windows` says so."""

    time: str
    value: float
    std: float
    lower95: float = Field(description="value - 1.96 std: the 95 % band")
    upper95: float
    low: float = Field(description="smallest of the windows' values within the point; no confidence band")
    high: float = Field(description="largest of the windows' values within the point")
    ratio: float = Field(description="value / nominal")
    windows: int


class History(BaseModel):
    """One parameter over time, oldest first; points where it was not identifiable are left out."""

    vehicle: str
    parameter: str
    unit: str
    nominal: float
    resolution: float = Field(description="seconds per point; 0: single windows")
    points: list[PointAnswer]


class Histories(BaseModel):
    """Several parameters over time."""

    vehicle: str
    resolution: float
    histories: list[History]


class ColumnAnswer(BaseModel):
    """One parameter as columns; null where it was not identifiable."""

    unit: str
    nominal: float
    baseline: float | None
    value: list[float | None]
    std: list[float | None]


class ColumnsAnswer(BaseModel):
    """`format=columns`: small, for plots."""

    vehicle: str
    resolution: float
    time: list[int] = Field(description="ms since the epoch")
    windows: list[int]
    parameters: dict[str, ColumnAnswer]


class Alarms(BaseModel):
    """A vehicle's alarms, newest first."""

    vehicle: str
    alarms: list[AlarmAnswer]


class AlarmPage(BaseModel):
    """Alarms of the fleet, newest first."""

    alarms: list[AlarmAnswer]
    next: str | None


class ModelVersionAnswer(BaseModel):
    """One system file of a vehicle, with its estimates."""

    version: int = Field(description="0: the service's system file")
    in_use: bool
    report: str | None = Field(description="the diagnosis that it comes from")
    created: str | None
    by: str
    windows: int = Field(description="that were identified with it")
    fitting: int = Field(description="of these, those that fit it")
    first_window: str | None
    last_window: str | None
    laws: list[str] = Field(description="beyond springs and dampers")
    baselines: dict[str, float] = Field(description="as they were learned under it")
    error: str | None = Field(description="why it cannot be used any more")


class ModelUseAnswer(BaseModel):
    """Since when a version was in use."""

    version: int
    since: str
    by: str


class VehicleModels(BaseModel):
    """What a vehicle was and is followed with; before the first of `uses` it was the service's file."""

    vehicle: str
    in_use: int
    versions: list[ModelVersionAnswer]
    uses: list[ModelUseAnswer]


class MarkAnswer(BaseModel):
    """A note, a maintenance or another model on a vehicle's time line."""

    id: int
    kind: Literal["note", "maintenance", "model"]
    time: str
    text: str
    parameters: list[str] | None = Field(description="baselines learned anew; empty: all; null: none")
    author: str
    created: str


class Marks(BaseModel):
    """Marks of a vehicle, newest first."""

    vehicle: str
    marks: list[MarkAnswer]


class Trace(BaseModel):
    """One sensor of a window."""

    unit: str
    measured: list[float | None]
    simulated: list[float | None]
    residual: list[float | None]
    nrmse: float | None


class WindowAnswer(BaseModel):
    """Measured against simulated of a vehicle's newest window."""

    vehicle: str
    start: str
    sample_rate: float
    adequate: bool
    reason: str | None = Field(description="why nothing, or not all that was asked for, was found")
    sensors: dict[str, Trace]


class Live(BaseModel):
    """The process runs."""

    status: Literal["ok"]


class Ready(BaseModel):
    """The service can work."""

    status: Literal["ok"]
    model: str
    waiting: int
    feeds: list[dict[str, Any]] = Field(default_factory=list, description="live buses and how they are")
    processes: list[dict[str, Any]] = Field(
        default_factory=list,
        description="that identify and track; for one that ended the service does so itself until another has begun",
    )


class SystemPart(BaseModel):
    """An element of the system, as a client needs it to draw or to name it."""

    name: str
    upper: str
    lower: str
    position: list[float] | None
    parameters: list[str]


class SystemAnswer(BaseModel):
    """What is monitored."""

    name: str
    model: str
    sample_rate: float
    window: int
    parameters: list[dict[str, Any]]
    elements: list[SystemPart]
    sensors: list[str]
    channels: list[str]
