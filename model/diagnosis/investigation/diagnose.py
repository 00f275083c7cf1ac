"""Where a simulation departs from a recording, what was left out, the model with it, and how much better it fits."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from sprung.model.diagnosis.fit.noise import force_noise, input_noise, refreshed
from sprung.model.diagnosis.fit.problem import Fit, Problem
from sprung.model.diagnosis.investigation.inputs import InputFault, best_input_fault, input_faults_of
from sprung.model.diagnosis.investigation.surface import with_surface
from sprung.model.diagnosis.record.channels import Prepared, prepare
from sprung.model.diagnosis.record.signals import Noise, Signals, declared_noise, drifting, transform
from sprung.model.diagnosis.record.split import cut
from sprung.model.diagnosis.report.report import Report
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.screening.screen import Hit, Screening, screen
from sprung.model.diagnosis.selection.compete import Trial, compete, preferred, runner_up, shortlist
from sprung.model.diagnosis.selection.holdout import HeldOut
from sprung.model.laws import CATALOGUE, ElementLaw, Law
from sprung.model.laws.basis import UNKNOWN
from sprung.model.signals import FloatArray
from sprung.model.system import System

Progress = Callable[[float, str], None]

# a finding beside earlier ones counts from this share of what they are worth: at the same place and elsewhere
_MINOR_BESIDE, _MINOR_ELSEWHERE = 0.05, 0.002
_MINOR_FOLLOWED = 0.01  # elsewhere, where the gain is of logarithms: a law is simulated no better than that
_MOST_LEFT = 0.5  # or from this share of what they left of forces that nobody measured
_ASTRAY = 1.5  # rise of the reduced chi-square from the first part to the whole recording


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
    alpha: float = 1e-3  # chance of a false finding per recording before the held-out check
    train_share: float = 0.7  # of the recording, from its start
    most_findings: int = 4
    file: str = ""  # name of the recording, for the report
    catalogue: tuple[Law, ...] = CATALOGUE


@dataclass
class Found:
    """One accepted finding with what it was chosen among."""

    trial: Trial
    trials: list[Trial]  # that could have been chosen instead
    runner_up: Trial | None  # the best with another law
    p_value: float


@dataclass
class Course:
    """Everything that a diagnosis went through; the report is made from it."""

    system: System
    options: Options
    prepared: Prepared
    signals: Signals  # with input faults mended
    noise: Noise
    problem: Problem
    base: Fit
    fit: Fit  # on the first part; what is judged on the held-out part
    held: HeldOut
    first: Screening
    last: Screening
    found: list[Found] = field(default_factory=list)
    input_faults: list[InputFault] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    final: Fit | None = None  # the same model on the whole recording

    @property
    def split(self) -> int:
        """How many samples were fitted."""
        return self.problem.part.grid.samples

    @property
    def reported(self) -> Fit:
        """The fit whose values the report gives."""
        return self.final or self.fit


def diagnose(
    system: System, record: Recorded, options: Options | None = None, progress: Progress | None = None
) -> Report:
    """Diagnose a recording whose columns are in the order of `system.channels`.

    Errors: `DiagnosisError` when the recording cannot be used at all.
    """
    from sprung.model.diagnosis.report.narrate import narrate

    options = options or Options()
    tell = progress or (lambda share, text: None)
    course = investigate(system, record, options, tell)
    tell(0.95, "report")
    report = narrate(course, record)
    tell(1.0, "done")
    return report


def investigate(system: System, record: Recorded, options: Options, tell: Progress) -> Course:
    """Baseline, then finding after finding until the rest is noise."""
    tell(0.02, "channels and noise")
    prepared = prepare(system, record.values, record.sample_rate)
    signals, split = cut(prepared.signals, options.train_share)
    declared = declared_noise(system, signals)
    tell(0.05, "nominal structure identified again")
    problem, base = baseline(system, signals, declared, split)
    tell(0.2, "screening all laws at all places")
    screening = screen(problem, base, options.catalogue, options.project)
    course = Course(
        system,
        options,
        prepared,
        signals,
        problem.noise,
        problem,
        base,
        base,
        None,  # type: ignore[arg-type]  # the held-out part comes below, when faulty inputs are mended
        screening,
        screening,
    )
    _mend_inputs(course, declared, tell)
    course.held = HeldOut(system, course.signals, course.problem.noise, course.split)
    if course.held.still:
        course.notes.append("the last part of the recording hardly moves: findings could not be checked on it")
    for number in range(options.most_findings):
        if not _next_finding(course, number, tell):
            break
    tell(0.93, "the model on the whole recording")
    course.final = _on_everything(course)
    return course


def _on_everything(course: Course) -> Fit:
    """The model fitted to the whole recording, once it has been judged; the first part's where that goes astray."""
    rated = drifting(course.system, course.signals.sensor_index)
    part = transform(course.signals, course.problem.noise, rated=rated)
    problem = replace(course.problem, part=part, whitener=None, smoothed=None)
    fit = problem.try_fit(course.held.run(course.fit.point).point, 4)
    return fit if fit is not None and fit.reduced < _ASTRAY * course.fit.reduced else course.fit


def baseline(system: System, signals: Signals, declared: Noise, split: int) -> tuple[Problem, Fit]:
    """The nominal structure on the first `split` samples, with noise levels estimated on the way."""
    first = signals.part(0, split)
    noise = input_noise(transform(first, declared), declared)
    part = transform(first, noise, rated=drifting(system, signals.sensor_index))
    problem = Problem(system, part, signals.sensor_index, noise)
    n = 2 * system.mechanics.n
    start = Point(np.zeros(len(system.parameters)), (), np.zeros(n))
    if len(noise.force):
        # far from the truth a lightly damped system fits no better in any direction: let the forces take the blame
        lin = problem.linearise(start)
        noise = force_noise(lin.forward, lin.spectrum, noise)
        problem = replace(problem, noise=noise, whitener=None)
    fit = problem.fit(start, iterations=12)
    return refreshed(problem, fit)


def _mend_inputs(course: Course, declared: Noise, tell: Progress) -> None:
    """Faults of input channels come first: everything else is simulated from the inputs."""
    options = course.options
    for _ in range(2):
        hit = best_input_fault(course.first, options.alpha)
        if hit is None:
            return
        tell(0.25, f"input channel {hit.location}")
        fault, signals = input_faults_of(course, hit, declared)
        if fault is None:
            return
        course.input_faults.append(fault)
        course.signals = signals
        course.problem, course.base = baseline(course.system, signals, declared, course.split)
        course.fit, course.noise = course.base, course.problem.noise
        course.last = screen(course.problem, course.base, options.catalogue, options.project)
        course.first = course.last


def _next_finding(course: Course, number: int, tell: Progress) -> bool:
    """Find, fit and accept one more finding; False when the rest is noise."""
    options = course.options

    def new(hits: Iterable[Hit]) -> list[Hit]:
        return [h for h in hits if h.family != "input" and not _repeats(course, h)]

    hits = new(shortlist(course.last, options.alpha, options.multiplicity))
    if not hits:
        return False
    share = 0.25 + 0.17 * number
    tried = compete(course.problem, course.fit, hits, lambda text: tell(share, text))
    trials = preferred([t for t in tried if t.finished and t.evidence > 0 and not _minor(course, t)])
    trials.sort(key=lambda t: t.hit.family != "force")  # faults of the inputs first, of forces as of motions
    if not trials:
        return False
    chosen = trials[0]
    if options.held_out and not course.held.still and course.held.compare(course.fit, chosen.fit).refuted:
        return False
    tests = course.last.tests[chosen.hit.family] * len(course.last.tests) if options.multiplicity else 1
    p_value = max(chosen.p_value(tests), min(1.0, chosen.hit.p_single * tests))
    if p_value > options.alpha:
        return False
    second = runner_up(course.problem, course.fit, new(course.last.hits), chosen, tried)
    fit = chosen.fit if chosen.named else _smoother(course, chosen.fit)
    course.problem, course.fit = refreshed(course.problem, fit)
    trial, course.fit = _variant(course, chosen, trials)
    course.found.append(Found(trial, [t for t in trials if t is not trial], second, p_value))
    course.held.weigh(course.problem.noise)
    tell(share + 0.12, "screening what is left")
    course.last = screen(course.problem, course.fit, options.catalogue, options.project)
    return True


def _variant(course: Course, chosen: Trial, trials: list[Trial]) -> tuple[Trial, Fit]:
    """The variant of a law once the noise is known: beside a misfit that passed for noise, they looked alike."""
    best = chosen, course.fit
    for rival in trials:
        if rival is not chosen and rival.term.key[:2] == chosen.term.key[:2] and rival.named:
            fit = replace(course.problem, smoothed=None).try_fit(rival.fit.point, 6)
            dearer = (rival.gain - rival.evidence) - (best[0].gain - best[0].evidence)
            if fit is not None and best[1].deviance - fit.deviance > dearer:
                best = rival, fit
    return best


def _smoother(course: Course, fit: Fit) -> Fit:
    """The unnamed force of a fit as an estimated surface, if that serves the held-out part better."""
    surface = with_surface(course.problem, fit)
    if surface is None:
        return fit
    return surface if course.held.compare(fit, surface).gain > 0 else fit


def _repeats(course: Course, hit: Hit) -> bool:
    """The same law at the same place, or physics at a place that is unknown already."""
    for term in course.fit.point.terms:
        if hit.term.key[:2] == term.key[:2]:
            return True
        if hit.location == term.location and term.law.name == UNKNOWN:
            return True
    return False


def _minor(course: Course, trial: Trial) -> bool:
    """What a first finding leaves at its own place, when it is little, is its law's inaccuracy and no second law."""
    for index, found in enumerate(course.found):
        if found.trial.term.location != trial.term.location:
            least = _MINOR_FOLLOWED if course.problem.follows else _MINOR_ELSEWHERE
            if trial.gain < least * found.trial.gain:
                return True
        elif not trial.named:
            return True
        elif course.problem.follows:
            left = float(np.sum(course.fit.noise.force**2))
            if trial.worth < min(_MINOR_BESIDE * found.trial.worth, _MOST_LEFT * left):
                return True
        elif trial.worth < _MINOR_BESIDE * _worth(course.fit, index):
            return True
    return False


def _worth(fit: Fit, index: int) -> float:
    """By how much chi-square would rise without a term of a fit, by its strength and that one's deviation (Wald)."""
    term = fit.point.terms[index]
    strength = (term.law.strength if isinstance(term.law, ElementLaw) else None) or 0
    if not term.parameters:
        return 0.0
    absent = term.law.absent[strength] if isinstance(term.law, ElementLaw) else 0.0
    size = term.parameters[strength] - (absent if np.isfinite(absent) else 0.0)
    place = fit.place(index).start + strength
    return float(size**2 / max(fit.covariance[place, place], 1e-300))
