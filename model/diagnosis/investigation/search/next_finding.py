"""One step of an investigation: the competing candidates, the accepted one, and the model refitted with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import finished, refreshed
from sprung.model.diagnosis.fit.misfit import is_gross
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.investigation.formula.trial import with_formula
from sprung.model.diagnosis.investigation.measurements.calibration import (
    calibrated,
    with_free_gains,
    without_calibrations,
)
from sprung.model.diagnosis.investigation.measurements.data_sheets import may_be_calibration
from sprung.model.diagnosis.investigation.measurements.floor import leaves_more_than_noise, leaves_what_sampling_leaves
from sprung.model.diagnosis.investigation.search.along_motion import law_along_motion
from sprung.model.diagnosis.investigation.search.masses import imitates_errors
from sprung.model.diagnosis.investigation.search.minor import is_minor, sought, untried
from sprung.model.diagnosis.investigation.search.surface import with_surface
from sprung.model.diagnosis.investigation.search.widened import (
    adopt_wider,
    best_wider,
    is_better,
    rivals_of_wider,
    share_an_element,
    with_wider_rivals,
    with_wider_tried,
)
from sprung.model.diagnosis.investigation.state import (
    AcceptedFinding,
    Investigation,
    Progress,
    TriedTrials,
    WidenedFit,
    share_done,
)
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.diagnosis.selection.along_measured import sharpened
from sprung.model.diagnosis.selection.compete import Trial, compete, preferred, runner_up, shortlist
from sprung.model.diagnosis.selection.evidence import chance_on_whole
from sprung.model.diagnosis.selection.plausible import doubt, hardly_there

_FITTED, _CHECKED = 0.5, 0.7  # of one finding's work


@dataclass(frozen=True)
class _Competition:
    """Fitted candidates of one step, sorted out."""

    plausible: list[Trial]  # all with plausible values, whether findings or not
    findings: list[Trial]  # of these, the ones whose evidence makes them findings
    leading: list[Trial]  # the findings in order of preference
    implausible: list[tuple[Trial, str]]  # of more evidence than any finding, with the reason for doubt
    tried: list[Trial]  # all of them, in the forms in which they were candidates

    def before(self, other: _Competition) -> _Competition:
        """This one, whose leading trial is the best of both if it has one, with the trials of another one behind it."""
        best = self.leading[0].evidence if self.leading else -np.inf
        return _Competition(
            [*self.plausible, *other.plausible],
            [*self.findings, *other.findings],
            [*self.leading, *other.leading],
            [*self.implausible, *((trial, reason) for trial, reason in other.implausible if trial.evidence > best)],
            [*self.tried, *other.tried],
        )


def next_finding(state: Investigation, number: int, progress: Progress) -> Investigation:
    """The investigation with one more finding; without one if the residual is noise or no candidate is accepted."""
    if state.calibrations is not None and leaves_what_sampling_leaves(state):
        return state
    candidates = _candidates(state)
    if candidates or share_an_element(state):
        state = with_wider_tried(state)
    wide = best_wider(state)
    promised = max((candidate.score for candidate in candidates), default=0.0)
    if wide is not None and wide.fall > promised and is_better(state, wide, []):
        candidates = []
    elif not candidates:
        return state

    def report(text: str) -> None:
        progress(share_done(number), text)

    competition = _competition(state, candidates, report)
    widened = wide is not None and is_better(state, wide, competition.leading)
    if wide is not None and widened:
        beside = _beside_narrow(state, wide, candidates, report)
        widened = is_better(state, wide, beside.leading)
        competition = beside.before(competition)
    tried = TriedTrials(state.fit, tuple(competition.tried))
    notes = (*state.notes, *(_implausible_note(*one) for one in competition.implausible))
    state = replace(state, tried=tried, notes=notes)
    if wide is not None and widened:
        return next_finding(adopt_wider(state, wide), number, progress)
    if not competition.leading:
        return _calibrated_alone(state)
    progress(share_done(number + _FITTED), f"checking {competition.leading[0].term.location}")
    return _with_leading(state, competition, lambda text: progress(share_done(number + _CHECKED), text))


def _as_good_error(state: Investigation, chosen: Trial, trials: Sequence[Trial]) -> Trial | None:
    """The trial that may be an error of calibration, and explains as much as the chosen one or nearly so.

    Such errors exist on every rig; a linear part that explains a little more imitates one.
    """
    least = chosen.evidence if chosen.term.law.in_time else state.options.rules.acceptance.nearly * chosen.evidence
    return next((one for one in trials if one.evidence >= least and may_be_calibration(state, one.term)), None)


def _calibrated_alone(state: Investigation) -> Investigation:
    """The investigation with calibration errors where these alone explain what no candidate does; else as it is."""
    errors = [one for one in state.last.candidates if may_be_calibration(state, one.term)]
    if state.calibrations is not None or not errors or not leaves_more_than_noise(state):
        return state
    other = calibrated(state, max(errors, key=lambda one: one.score).term)
    return other if other.calibrations and not leaves_more_than_noise(other) else state


def _with_leading(state: Investigation, competition: _Competition, progress: Callable[[str], None]) -> Investigation:
    """The investigation with the leading candidate as a finding; without it if it may be chance, or is refuted.

    A candidate within the data sheet of its instrument is not a finding, nor is one that other masses and instruments
    together explain better: masses and instruments are calibrated then, even if the held-out part refutes the one that
    stands for all of them.
    """
    trials, note = with_formula(state, competition.findings, competition.leading)
    chosen = trials[0]
    p_value = _p_value(state, chosen)
    if p_value > state.options.rules.acceptance.alpha:
        return state
    error = _as_good_error(state, chosen, trials)
    if state.calibrations is None and (error is not None or imitates_errors(state, chosen)):
        state = calibrated(state, (error or chosen).term)
        if state.calibrations:
            return state
    if state.refutes(chosen.fit):
        return state
    second = runner_up(state.problem, state.fit, untried(state, state.last.candidates), chosen, competition.plausible)
    state, trial = _refitted(state, chosen, trials)
    rivals = tuple(t for t in trials if t is not trial)
    found = AcceptedFinding(trial, rivals, second, p_value, tuple(t for t, _ in competition.implausible))
    progress("screening the residual")
    last = screen(state.problem, state.fit, state.problem.system.catalogue, state.options.project)
    return replace(state, found=(*state.found, found), last=last, notes=(*state.notes, *note))


def _candidates(state: Investigation) -> list[Candidate]:
    """The candidates of the last screening that are worth a fit."""
    options, rules = state.options, state.options.rules
    gross = is_gross(state.problem, state.fit)
    screening = without_calibrations(state)
    # what is not sought sets no scale for the others
    screening = replace(screening, candidates=tuple(sought(state, screening.candidates)))
    chosen = shortlist(screening, rules.acceptance.alpha, options.multiplicity, rules, gross=gross, whole=_whole(state))
    alone = law_along_motion(state) if gross and chosen and not state.found else None
    if alone is not None:  # instead of the same law from where screening sees it
        chosen = [alone, *(candidate for candidate in chosen if candidate.term.key != alone.term.key)]
    return untried(state, chosen)


def _competition(
    state: Investigation,
    candidates: list[Candidate],
    progress: Callable[[str], None],
    instead: WidenedFit | None = None,
) -> _Competition:
    """All candidates fitted, and which of them are findings.

    instead: the wider form of a law that would be adopted without them; what explains more is no inaccuracy of it.
    """
    if not candidates:
        return _Competition([], [], [], [], [])
    rules = state.options.rules
    known = state.tried.trials if state.tried is not None and state.tried.beside is state.fit else ()
    fitted = compete(state.problem, state.fit, candidates, progress, known)
    tried = with_wider_rivals(state, fitted)
    doubts = [(trial, doubt(trial.fit, trial.term, rules.plausible, before=state.fit)) for trial in tried]
    plausible = [trial for trial, reason in doubts if reason is None]
    present = [trial for trial in tried if trial.finished and not hardly_there(trial.fit, rules.plausible)]
    beyond = np.inf if instead is None else instead.evidence
    worthy = [t for t in present if t.evidence > 0 and (t.evidence > beyond or not is_minor(state, t))]
    findings = [t for t in worthy if _contains(plausible, t)]
    leading = preferred(findings, rules.selection)
    leading.sort(key=lambda t: t.candidate.family.rank)  # faults of the inputs first, of forces as of motions
    best = max((trial.evidence for trial in leading), default=-np.inf)
    implausible = [(t, reason) for t, reason in doubts if reason and t.evidence > best and _contains(worthy, t)]
    return _Competition(plausible, findings, leading, implausible, fitted)


def _beside_narrow(
    state: Investigation, wide: WidenedFit, tried: list[Candidate], progress: Callable[[str], None]
) -> _Competition:
    """The competition of second laws at the element of a law that would be widened, without those tried before."""
    known = {candidate.term.key for candidate in tried}
    rivals = [rival for rival in rivals_of_wider(state, wide) if rival.term.key not in known]
    beside = _competition(state, rivals, progress, wide)
    return replace(beside, leading=[trial for trial in beside.leading if _is_acceptable(state, trial)])


def _contains(trials: list[Trial], trial: Trial) -> bool:
    """Whether a list contains this very trial: fits are compared by identity."""
    return any(trial is one for one in trials)


def _is_acceptable(state: Investigation, trial: Trial) -> bool:
    """Whether a trial is neither chance nor refuted by the held-out part."""
    return _p_value(state, trial) <= state.options.rules.acceptance.alpha and not state.refutes(trial.fit)


def _p_value(state: Investigation, chosen: Trial) -> float:
    """Chance of the chosen trial under noise alone, by its fit and by its score, corrected for all tests."""
    candidate, alpha = chosen.candidate, state.options.rules.acceptance.alpha
    tests = state.last.tried(candidate.family) if state.options.multiplicity else 1
    gains = [(chosen.gain, chosen.freedom), (candidate.score, candidate.freedom)]
    held = state.held
    return chance_on_whole(gains, tests, alpha, _whole(state), lambda: held.compare(state.fit, chosen.fit).evidence)


def _whole(state: Investigation) -> float:
    """Length of the recording over that of its fitted part; 1 where the held-out part is not asked, or says little."""
    if not state.options.held_out or state.held.still or state.problem.process_noise:
        return 1.0
    return state.held.signals.samples / state.held.split


def _implausible_note(trial: Trial, reason: str) -> str:
    name = trial.term.law.name.replace("_", " ")
    return f"{name} at {trial.term.location} fits better, but is implausible and not named: {reason}"


def _refitted(state: Investigation, chosen: Trial, trials: list[Trial]) -> tuple[Investigation, Trial]:
    """The model with the chosen law and noise levels estimated anew, and the variant of the law that fits best then."""
    fit = chosen.fit if chosen.named else _with_surface(state, chosen.fit)
    problem, fit = refreshed(state.problem, with_free_gains(state, fit))
    sharp = sharpened(problem, fit) if is_gross(problem, state.fit) else fit
    if sharp is not fit:
        problem, fit = refreshed(problem, sharp)
    state = replace(state, problem=problem, fit=fit)
    trial, fit = _variant(state, chosen, trials)
    problem, fit = finished(problem, fit)
    return replace(state, problem=problem, fit=fit, held=replace(state.held, noise=problem.noise)), trial


def _variant(state: Investigation, chosen: Trial, trials: list[Trial]) -> tuple[Trial, Fit]:
    """The best variant of the chosen law at the noise estimated with it; at a higher level they were equivalent."""
    best = chosen, state.fit
    for rival in trials:
        if rival is not chosen and rival.term.key[:2] == chosen.term.key[:2] and rival.named:
            fit = try_optimise(state.problem, with_free_gains(state, rival.fit).point, 6, state.fit.whitener)
            extra_cost = (rival.gain - rival.evidence) - (best[0].gain - best[0].evidence)
            if fit is not None and best[1].deviance - fit.deviance > extra_cost:
                best = rival, fit
    return best


def _with_surface(state: Investigation, fit: Fit) -> Fit:
    """The fit with its unnamed force as an estimated surface, if that predicts the held-out part better."""
    surface = with_surface(state.problem, fit)
    if surface is None:
        return fit
    return surface if state.held.compare(fit, surface).gain > 0 else fit
