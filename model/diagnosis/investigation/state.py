"""State of an investigation, as frozen values: inputs, state after every finding, result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from sprung.model.diagnosis.fit.memory import FitMemory
from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation.configuration.fitted import SetupFault
from sprung.model.diagnosis.investigation.verdict import HeldOutErrors, Verdict
from sprung.model.diagnosis.record.channels import Prepared
from sprung.model.diagnosis.record.signals import Noise, Signals
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import RULES, Rules
from sprung.model.diagnosis.screening.score import Screening
from sprung.model.diagnosis.selection.compete import Trial
from sprung.model.diagnosis.selection.holdout import FreeRun, HeldOut
from sprung.model.signals import FloatArray
from sprung.model.system import System
from sprung.model.work import WorkBudget

Progress = Callable[[float, str], None]  # share done, next step in words
_BEGUN, _SOUGHT = 0.25, 0.92  # share done before the first finding is sought, and after the last one
_NO_FURTHER = 0.25  # odds assumed that a finding is the last


def share_done(findings: float) -> float:
    """Share of an investigation that is done once so many findings are made, of an unknown number."""
    return _SOUGHT - (_SOUGHT - _BEGUN) * float((1 - _NO_FURTHER) ** findings)


class Recorded(Protocol):
    """Interface of a recording, as of `replay.record.Record`."""

    @property
    def sample_rate(self) -> float: ...
    @property
    def values(self) -> FloatArray: ...
    @property
    def lost(self) -> int: ...


@dataclass(frozen=True)
class Options:
    """Options of a diagnosis.  The first three switch off parts, to measure their benefit."""

    project: bool = True  # project candidates onto the complement of the nominal parameters
    multiplicity: bool = True  # correct for multiple testing
    held_out: bool = True  # accept a finding only if it improves the part that no fit saw
    unnamed: bool = True  # search unnamed forces and formulas as well
    file: str = ""  # name of the recording, for the report
    rules: Rules = RULES  # all deciding numbers
    memory: FitMemory | None = None  # cache of earlier diagnoses of the same recording
    work: WorkBudget | None = None  # budget of its fits; None: by the rules


@dataclass(frozen=True)
class InputFault:
    """A fault of an input channel."""

    term: Term
    std: float
    score: float
    p_value: float
    runner_up: tuple[str, float] | None


@dataclass(frozen=True)
class NoiseFault:
    """A channel that is significantly noisier than its peers."""

    location: str
    ratio: float  # noise over the noise declared
    std: float  # of the ratio
    usual: float  # the same ratio of its peers
    sigmas: float  # significance of the difference of logarithms
    p_value: float


@dataclass(frozen=True)
class Contradiction:
    """A sensor that shows something else than the motion of its body, which the others determine; it is left out."""

    location: str
    share: float  # rms of what it shows beside that motion, over its rms
    form: str  # of that, in words


@dataclass(frozen=True)
class ClockDrift:
    """A group of sensors whose clock runs at another rate than the others'; it is put right."""

    location: str  # channels joined by "|"
    rate: float  # s/s, by which they become later
    std: float

    def beyond(self, rules: Rules) -> bool:
        """Whether it drifts more than ordinary clocks do."""
        return abs(self.rate) > rules.acceptance.quartz


@dataclass(frozen=True)
class Nominal:
    """The nominal structure identified on the first part of the signals, with the screening of its residual."""

    signals: Signals  # with input faults known so far compensated
    problem: Problem
    fit: Fit
    screening: Screening

    @property
    def split(self) -> int:
        """Number of fitted samples."""
        return self.problem.part.grid.samples


@dataclass(frozen=True)
class AcceptedFinding:
    """One accepted finding with its rivals."""

    trial: Trial
    trials: tuple[Trial, ...]  # its rivals
    runner_up: Trial | None  # the best with another law
    p_value: float
    implausible: tuple[Trial, ...] = ()  # of more evidence, with implausible values


@dataclass(frozen=True)
class WidenedFit:
    """A fit with one of its laws wider."""

    fit: Fit
    index: int  # of the term
    fall: float  # of chi-square against the narrower one
    gain: float  # twice the log-likelihood ratio
    evidence: float  # gain less what the further parameters cost
    instead: Trial | None = None  # the rival of the last finding whose law it is; None: the finding's own


@dataclass(frozen=True)
class TriedWider:
    """Result of the wider forms of a fit's laws."""

    of: Fit
    best: WidenedFit | None  # None: no law has one


@dataclass(frozen=True)
class TriedTrials:
    """All fitted candidates of a competition."""

    beside: Fit
    trials: tuple[Trial, ...]


@dataclass(frozen=True)
class Investigation:
    """State between two findings."""

    system: System
    options: Options
    prepared: Prepared
    declared: Noise  # of the signals, as the system file states it
    signals: Signals  # with input faults compensated
    problem: Problem
    base: Fit  # the nominal structure
    fit: Fit  # with the findings so far, on the first part; judged on the held-out part
    held: HeldOut
    first: Screening
    last: Screening
    found: tuple[AcceptedFinding, ...] = ()
    input_faults: tuple[InputFault, ...] = ()
    setup_faults: tuple[SetupFault, ...] = ()
    contradictions: tuple[Contradiction, ...] = ()  # sensors that were left out
    clock_drifts: tuple[ClockDrift, ...] = ()
    only: str = ""  # the sensor at which faults are sought; empty: everything is sought everywhere
    notes: tuple[str, ...] = ()
    wider: TriedWider | None = None  # of the present fit or an earlier one; None: not tried yet
    tried: TriedTrials | None = None  # of the last competition, which may be repeated under other options
    calibrations: int | None = None  # number of calibration errors among the given terms; None: none was found

    @property
    def given(self) -> int:
        """Number of laws of the system file, the first terms of every fit."""
        return len(self.base.point.terms)

    def refutes(self, fit: Fit) -> bool:
        """Whether the held-out part refutes a fit beside the present one; not where it hardly moves, or is not used."""
        return self.options.held_out and not self.held.still and self.held.compare(self.fit, fit).refuted


@dataclass(frozen=True)
class HeldOutRuns:
    """The held-out part simulated without and with the findings, beside its noise."""

    before: FreeRun
    after: FreeRun
    noisy: tuple[NoiseFault, ...]  # sensors with a noise that only their peers speak against
    noise: Noise  # as far as bounded
    floor: FloatArray  # bounded noise, in the sensors' units, (S,)
    errors: HeldOutErrors


@dataclass(frozen=True)
class Judgement:
    """Judgement of an investigation."""

    errors: HeldOutErrors  # of the held-out part, per sensor
    reported: HeldOutErrors  # what is explained and left: these, or shares of forces if the phase is lost
    verdict: Verdict
    floor: FloatArray  # bounded noise, in the sensors' units, (S,)
    error: float  # of the model over the signal; if its phase is lost, of unmeasured over inertia forces
    rejected: bool  # whether the error rejects the model
    lost_phase: bool  # whether the verdict is based on unmeasured forces, not on the free run
    nothing_fits: bool  # whether the model is rejected, or most is left of what is not known by phase
    parts: int  # number of structural changes, if too many to be plausible; else 0
    ended: str  # "budget of work" or "limit of time" that ended the search; else empty
    carried: bool  # whether the findings explain more than they leave, and imitate no other force
    imitated: str  # the place of a law that imitates another force; else empty
    place: str  # of most of the misfit
    where: str  # the same in words, with size and frequencies; empty without misfit


@dataclass(frozen=True)
class Outcome:
    """Result of a finished investigation, from which the report is made."""

    investigation: Investigation
    final: Fit  # on the whole recording if that succeeds, with the reported values
    runs: HeldOutRuns
    judgement: Judgement
