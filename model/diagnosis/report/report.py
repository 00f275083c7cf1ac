"""Reports: the data behind the JSON of the contract and the plots.

`Report.to_dict()` is the public form.  `Report.plot_data` holds the arrays of the plots; every key is optional.
T: samples of the held-out part; S: sensors in the system's order; i: number of a finding.

    validation.time (T,) s, validation.measured / .baseline / .augmented (T, S), validation.noise (S,)
    localization.names (L,), localization.score (L,)
    finding.i.time / .deflection / .rate / .force_before / .force_after (n,)
    finding.i.curve_axis ("deflection" | "rate"), .curve_x / .curve_mean / .curve_std / .curve_law (m,);
        NaN where no sample lies
    finding.i.loop_x / .loop_y (p,)
    track.time (W,) s, track.frequency / .std (W, modes) Hz
    finding.i.map_d (a,), .map_v (b,), .map_force / .map_std (b, a)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sprung.model.diagnosis.investigation.verdict import Verdict
from sprung.model.diagnosis.kinds import EffectKind

READABLE = 1e5  # numbers below it are written out


@dataclass(frozen=True, slots=True)
class ReportedParameter:
    """One identified number of the nominal structure."""

    name: str  # "primary_11l.stiffness"
    value: float
    std: float
    nominal: float
    unit: str


@dataclass(frozen=True, slots=True)
class LawParameter:
    """One identified number of a law."""

    name: str
    value: float
    std: float
    unit: str

    @property
    def determined(self) -> bool:
        """Whether the value is significant: it exceeds its standard deviation."""
        return not self.std > abs(self.value)

    def words(self) -> str:
        """As in 395 +- 6 N, rounded by the standard deviation."""
        if not self.determined:
            return "not determined"
        unit = "" if self.unit == "1" else f" {self.unit}"
        if not math.isfinite(self.std) or self.std <= 0:
            return f"{self.value:.4g}{unit}"
        digits = max(2, math.ceil(math.log10(max(abs(self.value), self.std) / self.std)) + 1)
        value, std = f"{self.value:.{min(digits, 6)}g}", f"{self.std:.2g}"
        if max(abs(self.value), self.std) < READABLE:  # 347 to two digits is 350, which `g` writes as 3.5e+02
            value, std = (f"{float(text):.0f}" if "e+" in text else text for text in (value, std))
        return f"{value} +- {std}{unit}"


@dataclass(frozen=True, slots=True)
class IdentifiedLaw:
    """One law of the final model with its values, as in a system file."""

    location: str
    effect: str
    parameters: tuple[LawParameter, ...]
    variant: str = ""  # of body laws: the mode's shape, the direction of a force
    formula: str = ""  # of a law found by regression, in d, v and z
    memory: str = ""  # the rate of z

    def to_dict(self) -> dict[str, Any]:
        """Without a variant or a formula where there is none."""
        texts = {name: getattr(self, name) for name in ("variant", "formula", "memory") if getattr(self, name)}
        return {"location": self.location, "effect": self.effect} | texts | {"parameters": plain(self.parameters)}


@dataclass(frozen=True, slots=True)
class FitFigures:
    """Free-run error relative to the measured signal, on samples that no fit saw."""

    nrmse: float  # sqrt of the mean over sensors of per_sensor^2
    per_sensor: Mapping[str, float]  # rms(error) / rms(measured)


@dataclass(frozen=True, slots=True)
class CandidateRow:
    """One row of the evidence table: a law at a place, as it was tried.

    Finding after finding is sought, each beside those before it: a fitted law is compared with others of its step.
    """

    location: str
    effect: str
    score: float  # chi-square of the screening, or, of laws read from a force along the motion, the fall of chi-square
    p_value: float  # corrected for multiple testing
    delta_bic: float | None = None  # against the model of its step without it; None: screened only, or not compared
    step: int | None = None  # which finding was sought, from 1; None: screened only


@dataclass(frozen=True, slots=True)
class Finding:
    """One unmodelled effect, its location, and its significance."""

    location: str  # element, body, sensor or input
    effect: str  # a word of the contract's table
    kind: EffectKind  # what it speaks for
    parameters: tuple[LawParameter, ...]
    p_value: float | None  # None: nothing was tested
    delta_bic: float | None  # against the model without this finding; negative: better; None: nothing compared
    runner_up: tuple[str, float | None] | None = None  # (effect, delta_bic) of the next best law
    runner_up_location: str | None = None
    family: str | None = None  # of look-alikes, if none of them is clearly better
    # other places at which the same law, or the inverse fault of the set-up, explains the recording equally well
    elsewhere: tuple[str, ...] = ()
    advice: str | None = None  # experiment that would distinguish the look-alikes
    sentence: str = ""
    quoted: tuple[LawParameter, ...] = ()  # derived values: yield force, loop area, forces at given rates
    # evidence over each fitted look-alike
    look_alikes: Mapping[str, float] = field(default_factory=dict)
    formula: str = ""  # of a law found by regression, in deflection d, rate v and a hidden state z
    memory: str = ""  # the rate of z

    def to_dict(self) -> dict[str, Any]:
        """As JSON, without empty fields."""
        result: dict[str, Any] = {
            "location": self.location,
            "effect": self.effect,
            "kind": self.kind.value,
            "parameters": plain(self.parameters),
            "p_value": plain(self.p_value),
            "delta_bic": plain(self.delta_bic),
            "runner_up": None,
            "sentence": self.sentence,
        }
        if self.runner_up is not None:
            effect, delta_bic = self.runner_up
            place = {} if self.runner_up_location is None else {"location": self.runner_up_location}
            result["runner_up"] = {"effect": effect, "delta_bic": plain(delta_bic)} | place
        names = ("formula", "memory", "family", "elsewhere", "advice", "quoted", "look_alikes")
        more = {name: getattr(self, name) for name in names}
        return result | {name: plain(value) for name, value in more.items() if value}


@dataclass(frozen=True, slots=True)
class Unexplained:
    """Share of the held-out measured variance that neither the model nor bounded noise explains.

    If the free run loses its phase, of unmeasured forces in the inertia forces, and of no sensor.
    """

    share: float = 0.0  # mean over sensors
    per_sensor: Mapping[str, float] = field(default_factory=dict)
    where: str = ""  # place, size and frequencies of it, in words


@dataclass(frozen=True, slots=True)
class RecordingFacts:
    """The diagnosed recording."""

    file: str
    seconds: float
    samples: int
    lost: int
    used: str = ""  # the diagnosed stretch in words, if not all of it


@dataclass(frozen=True, slots=True)
class TrackPoint:
    """Natural frequencies of one window of a recording without measured inputs."""

    begin: float  # s
    end: float
    frequency: tuple[float, ...]  # Hz, the lowest first
    deviation: tuple[float, ...]  # Hz
    adequate: bool  # whether the structure explains the window

    def to_dict(self) -> dict[str, Any]:
        modes = [[plain(f), plain(s)] for f, s in zip(self.frequency, self.deviation, strict=True)]
        return {"begin": self.begin, "end": self.end, "frequencies": modes, "adequate": self.adequate}


@dataclass(frozen=True, slots=True)
class Report:
    """The result of one diagnosis."""

    system: str
    recording: RecordingFacts
    verdict: Verdict
    baseline: tuple[ReportedParameter, ...]
    baseline_validation: FitFigures
    findings: tuple[Finding, ...]
    augmented: tuple[ReportedParameter, ...]
    augmented_validation: FitFigures
    noise_floor: FitFigures
    localization: Mapping[str, float]  # location -> best score
    candidates: tuple[CandidateRow, ...] = ()
    changes: tuple[str, ...] = ()  # parameters that differ from nominal, in words
    explained: float | None = None  # share of the excess error that the findings explain, held-out part
    unexplained: Unexplained = Unexplained()
    laws: tuple[IdentifiedLaw, ...] = ()  # of the final model, those of the system file first
    calibration: tuple[IdentifiedLaw, ...] = ()  # errors within tolerance: not findings
    noise: Mapping[str, float] = field(default_factory=dict)  # channel -> estimated standard deviation of one sample
    summary: str = ""
    advice: tuple[str, ...] = ()  # limits and recommendations
    track: tuple[TrackPoint, ...] = ()  # without measured inputs: natural frequencies over time
    plot_data: dict[str, NDArray[Any]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """The JSON of the contract, with extra keys that readers may ignore."""
        fit = {
            "baseline": {"parameters": self.baseline, "validation": self.baseline_validation},
            "findings": [f.to_dict() for f in self.findings],
            "augmented": {"parameters": self.augmented, "validation": self.augmented_validation},
        }
        rest = ("noise_floor", "localization", "candidates", "changes", "explained", "unexplained")
        more = {"laws": [law.to_dict() for law in self.laws]}
        more["calibration"] = [law.to_dict() for law in self.calibration]
        more |= {name: getattr(self, name) for name in ("noise", "summary", "advice")}
        if self.track:
            more["track"] = [point.to_dict() for point in self.track]
        head = {"system": self.system, "recording": self.recording, "verdict": self.verdict}
        whole: dict[str, Any] = plain(head | fit | {name: getattr(self, name) for name in rest} | more)
        return whole


def plain(value: Any) -> Any:
    """A value as JSON can hold it: dataclasses by their fields; None stands for a number that is not finite."""
    if isinstance(value, LawParameter):
        entry = {"name": value.name, "value": plain(value.value), "std": plain(value.std), "unit": value.unit}
        return entry if value.determined else entry | {"determined": False}
    if is_dataclass(value):
        return {one.name: plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, Mapping):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value
