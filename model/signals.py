"""The vocabulary that every folder shares: channels, samples, windows, estimates, tallies.

A leaf: it imports NumPy and nothing of this project.  Letters used everywhere:
B batch, T samples, C channels, F frequencies, E elements, N states, P parameters, S sensors.
Times are int64 nanoseconds since the Unix epoch; values are SI, float64; NaN means "not measured".
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

CURVE = 0.5  # m/s^2, lateral acceleration from which on a window is one of a curve

Outcome = Literal["used", "repaired", "dropped", "uninformative"]


@dataclass(frozen=True, slots=True)
class Channel:
    """One measured signal of a system file and where recordings keep it."""

    name: str  # "wheel_11l.displacement", "car_1l"
    unit: str  # "m", "m/s", "m/s^2", "N"
    noise: float  # standard deviation of one sample, in `unit`
    mcap: str | None = None  # "/topic.field"
    can: str | None = None  # "Message.Signal"
    csv: str | None = None  # "column"
    column: str | None = None  # column or variable of any tabular file
    gain: float = 1.0  # value in `unit` = gain * recorded + offset
    offset: float = 0.0
    range: tuple[float, float] | None = None  # possible values in `unit`; None: by the unit

    @property
    def table(self) -> str | None:
        """Its column in tables."""
        return self.column or self.csv


@dataclass(frozen=True, slots=True)
class TimeColumn:
    """Time column of tables and its unit; None: detected."""

    name: str | None = None
    seconds: float | None = None  # one unit of it, s
    epoch: int | None = None  # ns since the Unix epoch at which it is 0
    rate: float | None = None  # samples per second of a table without times
    zone: str | None = None  # of dates without one, as in "Europe/Berlin"; None: UTC


ANY_TIME = TimeColumn()


@dataclass(frozen=True, slots=True)
class SampleBlock:
    """A run of samples in the order in which a reader met them (columnar for speed)."""

    time: IntArray  # ns since epoch, shape (n,)
    channel: NDArray[np.int32]  # index into the channels the reader was given, shape (n,)
    value: FloatArray  # SI, shape (n,); NaN where the sender marked the value invalid


@dataclass(frozen=True, slots=True)
class Window:
    """tau consecutive samples of every channel on one even time grid."""

    start: int  # time of the first sample, ns since epoch
    sample_rate: float  # Hz
    values: FloatArray  # shape (T, C), columns in the order of the system's channels; NaN column = absent
    outcome: Outcome = "used"
    reason: str | None = None  # why it was repaired or dropped
    repaired_samples: int = 0
    auxiliary: FloatArray | None = None  # mean of `System.auxiliary` while it lasts, shape (A,); NaN: not measured
    new_segment: bool = False  # the first after a jump of the clock, without relation to earlier ones


@dataclass(frozen=True, slots=True)
class Conditions:
    """Operating conditions of a window; NaN if not measured."""

    speed: float = math.nan  # m/s
    temperature: float = math.nan  # degC
    lateral: float = math.nan  # m/s^2, in a curve; the product of speed and yaw rate where only these are measured
    pressure: tuple[float, ...] = ()  # Pa, of the air springs, one for each load

    @property
    def curving(self) -> bool:
        """Whether the vehicle is in a curve that a model of vertical motion need not explain."""
        return abs(self.lateral) > CURVE


FaultKind = Literal["gain", "delay", "frozen", "saturated", "inverted", "swapped", "silent", "noisy"]
# of the whole channel at once, where gains and delays are off by an amount
HARD_FAULTS = ("frozen", "saturated", "inverted", "swapped", "silent", "noisy")


@dataclass(frozen=True, slots=True)
class MeasurementFault:
    """What is wrong with a measurement."""

    channel: str  # several that share it are joined by |
    kind: FaultKind
    # gain: reading over truth; delay: s by which it reads late; frozen, saturated: the reading; noisy: its noise
    value: float  # else 0
    std: float = 0.0


@dataclass(frozen=True, slots=True)
class BuiltOtherwise:
    """Estimated deviation of a body from the system file."""

    body: str
    what: str  # "mass", "roll inertia" ...
    change: float  # relative to the file
    std: float


@dataclass(frozen=True, slots=True, eq=False)
class Deviating:
    """Evidence of a window on H deviations (gains, delays, loads) beside the P parameters.

    For deviations h the parameters are most likely N(x^ + cross (h - point), given), and the log-likelihood of h
    itself is score' (h - point) - (h - point)' information (h - point) / 2.
    """

    point: FloatArray  # deviations that the window was refined at, shape (H,)
    given: FloatArray  # covariance of the log-ratios were the deviations known, shape (P, P)
    cross: FloatArray  # shape (P, H)
    information: FloatArray  # shape (H, H)
    score: FloatArray  # shape (H,)
    freedom: float  # degrees of freedom of the window's chi-square
    whole: bool = True  # False: it speaks of loads only; columns of gains and delays are 0


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimate of the P parameters from one window: log-ratios to nominal, with covariance."""

    log_ratio: FloatArray  # log(theta / nominal), shape (P,)
    covariance: FloatArray  # of log_ratio, shape (P, P); the prior's where not identifiable
    identifiable: BoolArray  # shape (P,)
    nrmse: float  # rms(error) / rms(measured), pooled over sensors
    per_sensor: FloatArray  # nrmse of each sensor, shape (S,); NaN for an absent sensor
    chi_square: float  # weighted residual power per degree of freedom, 1 when the model fits
    adequate: bool  # False: the window does not fit the model; do not trust the numbers
    converged: bool
    iterations: int
    states: FloatArray | None = None  # simulated states, shape (T, N), only when asked for
    outputs: FloatArray | None = None  # simulated sensors, shape (T, S), with the states
    deviating: Deviating | None = None  # where it was asked for, or refined elsewhere than at the system file
    faults: tuple[MeasurementFault, ...] = ()  # that had to be taken back before the window fitted
    informative: bool = True  # False: too little excitation for any conclusion
    running: bool = False  # though it is not informative, the vehicle was moved: its windows are too noisy, or alike
    noise: float = 0.0  # share of noise in what looks like information on the parameters; 0: negligible
    identified: bool = True  # False: there are no values, for the reason
    reason: str | None = None  # why nothing, or not all that was asked for, was found


@dataclass(slots=True)
class Tally:
    """Every message accounted for; `foreign` are messages that the system file does not name."""

    used: int = 0
    repaired: int = 0
    dropped: int = 0
    corrupt: int = 0
    foreign: int = 0
    reasons: Counter[str] = field(default_factory=Counter)

    def as_dict(self) -> dict[str, int]:
        return {
            "used": self.used,
            "repaired": self.repaired,
            "dropped": self.dropped,
            "corrupt": self.corrupt,
            "foreign": self.foreign,
        }
