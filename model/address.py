"""Where recordings keep a signal and its time, and how a recorded number becomes an SI value."""

from __future__ import annotations

from datetime import UTC, date, datetime
from typing import Annotated, Any, Literal
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, field_validator

from sprung.model.signals import TimeColumn
from sprung.model.units import FACTORS, known, to_si

EPOCHS = {  # ns since the Unix epoch
    "unix": 0,
    "excel": -2_209_161_600 * 10**9,  # days since 1899-12-30
    "labview": -2_082_844_800 * 10**9,  # since 1904-01-01
    "matlab": -62_167_219_200 * 10**9 - 86_400 * 10**9,  # datenum: days, 1 is the first of January of the year 0
    "gps": 315_964_800 * 10**9,  # 1980-01-06, without leap seconds
}


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class LawValue(Strict):
    """The value of a law's parameter; `fixed` ones are never estimated."""

    value: float
    std: float | None = Field(default=None, ge=0)  # standard deviation with which it was found
    fixed: bool = False


LawSetting = dict[str, float | LawValue | str]  # parameter to value; text: `with`, `variant`, `formula`, `memory`
Laws = Annotated[
    tuple[Annotated[dict[str, LawSetting], Field(min_length=1, max_length=1)], ...],
    Field(description="laws beyond its nominal behaviour: [{EFFECT: {PARAMETER: value}}]"),
]


def _as_text(raw: Any) -> Any:
    return str(raw) if isinstance(raw, int) and not isinstance(raw, bool) else raw


Column = Annotated[str, BeforeValidator(_as_text, json_schema_input_type=str | int), Field(min_length=1)]


LARGEST = 1e30  # of any value of a system file, SI; beyond it products overflow
SMALLEST = 1 / LARGEST


def zero_or_seen(value: float) -> float:
    """A value that is 0 or large enough to be calculated with."""
    if 0.0 < value < SMALLEST:
        raise ValueError(f"must be 0, or at least {SMALLEST:g}")
    return value


class Address(Strict):
    """Where recordings keep one signal, what their numbers mean, and the standard deviation of one sample.

    SI value = sign (scale recorded + offset) in `unit`; see `model.units.to_si` for volts and counts.
    """

    mcap: str | None = Field(default=None, pattern=r"^/.+\..+$", description="/topic.field of MCAP files")
    can: str | None = Field(default=None, pattern=r"^[^.]+\.[^.]+$", description="Message.Signal of the CAN database")
    csv: Column | None = Field(default=None, description="column of CSV files")
    column: Column | None = Field(default=None, description="column or variable of CSV, Parquet, MAT, HDF5, UFF, TDMS")
    scale: float | None = Field(default=None, description="factor on the recorded number, default 1")
    offset: float = Field(default=0.0, description="added after the scale, in `unit`")
    sign: Literal[1, -1] = Field(default=1, description="-1 where the recording counts the other way")
    unit: str | None = Field(default=None, description="of the scaled number; default SI")
    noise: Annotated[float, AfterValidator(zero_or_seen)] = Field(
        default=0.0, ge=0, le=LARGEST, description="standard deviation of one sample, SI"
    )
    laws: Laws = ()
    range: tuple[float, float] | None = Field(
        default=None, description="[lowest, highest] possible value, SI; others are taken as missing"
    )

    gain_std: float | None = Field(
        default=None, ge=0, description="relative standard deviation of the gain by the data sheet; default 0.015"
    )
    offset_std: float | None = Field(
        default=None,
        ge=0,
        description="standard deviation of the zero by the data sheet, SI; default by the kind of quantity",
    )
    delay_std: float | None = Field(
        default=None,
        ge=0,
        description="standard deviation of the delay relative to other signals by the data sheet, s; default 0.002",
    )

    @field_validator("range")
    @classmethod
    def _ordered(cls, limits: tuple[float, float] | None) -> tuple[float, float] | None:
        if limits is not None and limits[0] >= limits[1]:
            raise ValueError(f"the lowest value {limits[0]:g} is not below the highest {limits[1]:g}")
        return limits

    def conversion(self, si: str) -> tuple[float, float]:
        """Gain and offset from the recorded number to `si`; raises UnitError."""
        return to_si(self.unit, si, self.scale, self.offset, self.sign)


def _instant(raw: Any) -> Any:
    """YAML reads dates by itself; times without a zone are UTC."""
    if isinstance(raw, date) and not isinstance(raw, datetime):
        return datetime(raw.year, raw.month, raw.day, tzinfo=UTC)
    if isinstance(raw, str) and raw not in EPOCHS:
        try:
            raw = datetime.fromisoformat(raw)
        except ValueError:
            return raw
    if isinstance(raw, datetime) and raw.tzinfo is None:
        return raw.replace(tzinfo=UTC)
    return raw


Epoch = Annotated[
    Literal["unix", "excel", "labview", "matlab", "gps"] | datetime | float,
    BeforeValidator(_instant, json_schema_input_type=str | float),
]


class TimeKey(Strict):
    """The time of tabular files: its column, its unit, and the instant at which it is 0."""

    column: Column | None = Field(default=None, description="default: the column called time, t, timestamp ...")
    unit: str | None = Field(default=None, description="s, ms, us, ns, min, h or d; default s")
    epoch: Epoch | None = Field(default=None, description="when time is 0: a date, Unix seconds, excel, labview ...")
    rate: float | None = Field(default=None, gt=0, description="samples per second of tables without a time column")
    zone: str | None = Field(default=None, description="of dates that state none, as Europe/Berlin; default UTC")

    @field_validator("zone")
    @classmethod
    def _known_zone(cls, name: str | None) -> str | None:
        if name is not None:
            try:
                ZoneInfo(name)
            except (ZoneInfoNotFoundError, ValueError, OSError):
                raise ValueError(f"{name!r} is no time zone; give its name, as in Europe/Berlin or UTC") from None
        return name

    def as_column(self) -> TimeColumn:
        """The column as readers need it."""
        unit = None if self.unit is None else FACTORS["s"][known(self.unit, "s") or "s"]
        epoch = None
        if isinstance(self.epoch, str):
            epoch = EPOCHS[self.epoch]
        elif isinstance(self.epoch, datetime):
            epoch = round(self.epoch.timestamp() * 1e6) * 1000
        elif self.epoch is not None:
            epoch = round(self.epoch * 1e9)
        return TimeColumn(self.column, unit, epoch, self.rate, self.zone)
