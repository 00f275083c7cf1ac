"""The state of an investigation as frozen values: what goes in, every step between two findings, what comes out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from sprung.model.diagnosis.fit.memory import FitMemory
from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation.setup import SetupFault
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

Progress = Callable[[float, str], None]  # share done, what comes next


class Recorded(Protocol):
    """What is needed of a recording; `replay.record.Record` has it."""

    @property
    def sample_rate(self) -> float: ...
    @property
    def values(self) -> FloatArray: ...
    @property
    def lost(self) -> int: ...


@dataclass(frozen=True)
class Options:
    """How to diagnose.  The first three switch parts off, for measuring what each is worth."""

    project: bool = True  # take out of every candidate what the nominal parameters can imitate
    multiplicity: bool = True  # account for the number of candidates tried
    held_out: bool = True  # accept a finding only if it improves the part that no fit saw
    unnamed: bool = True  # whether forces without a name, and their formulas, are sought, too
    file: str = ""  # name of the recording, for the report
    rules: Rules = RULES  # every number that decides
    memory: FitMemory | None = None  # of the same recording's earlier diagnoses
    work: WorkBudget | None = None  # what its fits may cost; None: as the rules say


@dataclass(frozen=True)
class InputFault:
    """A fault of an input channel and what it explains."""

    term: Term
    std: float
    score: float
    p_value: float
    runner_up: tuple[str, float] | None


@dataclass(frozen=True)
class NoiseFault:
    """A channel that is noisier than its peers by more than chance."""

    location: str
    ratio: float  # noise over the noise declared
    std: float  # of the ratio
    usual: float  # the same ratio of its peers
    sigmas: float  # by which the logarithm of the ratio leaves theirs
    p_value: float


@dataclass(frozen=True)
class Nominal:
    """The nominal structure identified on the first part of the signals, and what its residual shows."""

    signals: Signals  # with input faults known so far compensated
    problem: Problem
    fit: Fit
    screening: Screening

    @property
    def split(self) -> int:
        """How many samples were fitted."""
        return self.problem.part.grid.samples


@dataclass(frozen=True)
class Found:
    """One accepted finding with what it was chosen among."""

    trial: Trial
    trials: tuple[Trial, ...]  # that could have been chosen instead
    runner_up: Trial | None  # the best with another law
    p_value: float
    implausible: tuple[Trial, ...] = ()  # that say more, with values that their laws cannot have


@dataclass(frozen=True)
class Widened:
    """A fit with one of its laws wider."""

    fit: Fit
    index: int  # of the term
    fall: float  # of chi-square against the narrower one
    gain: float  # twice the log-likelihood ratio
    evidence: float  # gain less what the further parameters cost


@dataclass(frozen=True)
class TriedWider:
    """What the wider forms of a fit's laws come to."""

    of: Fit
    best: Widened | None  # None: no law has one


@dataclass(frozen=True)
class Investigation:
    """Everything known between two findings."""

    system: System
    options: Options
    prepared: Prepared
    declared: Noise  # of the signals, as the system file states it
    signals: Signals  # with input faults compensated
    problem: Problem
    base: Fit  # the nominal structure
    fit: Fit  # with the findings so far, on the first part; what is judged on the held-out part
    held: HeldOut
    first: Screening
    last: Screening
    found: tuple[Found, ...] = ()
    input_faults: tuple[InputFault, ...] = ()
    setup_faults: tuple[SetupFault, ...] = ()
    notes: tuple[str, ...] = ()
    wider: TriedWider | None = None  # of the present fit or an earlier one; None: not tried yet
    calibrations: int | None = None  # how many of the given terms are gains and zeros in order; None: none has shown

    @property
    def given(self) -> int:
        """How many laws the system file itself puts in place: the first terms of every fit."""
        return len(self.base.point.terms)


@dataclass(frozen=True)
class Judgement:
    """What an investigation comes to."""

    errors: HeldOutErrors  # of the held-out part, per sensor
    verdict: Verdict
    floor: FloatArray  # bounded noise, in the sensors' units, (S,)
    rejected: float | None  # error over the signal of a model that does not describe the recording
    lost_phase: bool  # the free run's errors say little: judged was how the motion goes on
    parts: int  # changes of the structure that were needed, where they are too many to be believed; else 0
    ended: str  # what the search ended at, its "budget of work" or "limit of time"; empty where it came to its end
    carried: bool  # the findings carry the verdict: what they explain outweighs what they leave
    place: str  # where most of what is left is seen
    where: str  # the same in words, with size and frequencies; empty where nothing is left


@dataclass(frozen=True)
class Outcome:
    """A finished investigation, with everything that the report is made from."""

    investigation: Investigation
    final: Fit  # the model on the whole recording, where that succeeds: its values are reported
    before: FreeRun  # held-out part without the findings
    after: FreeRun  # held-out part with the findings
    noise_faults: tuple[NoiseFault, ...]
    judgement: Judgement
