"""An unnamed force as a formula: a grammar searched by score tests, the best sums fitted inside the simulation.

Every shape of `model.laws.grammar` is one more candidate at the element where the unnamed force was found: scored with
its own values over a grid, then in pairs.  The best few are refitted as laws beside everything else, and one is
believed where it says as much as the unnamed force with all its freedom did, by evidence and on the held-out part, and
leaves little of what was there: half of a force has no formula.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.screening.elements import TrialElement
from sprung.model.diagnosis.screening.families import ELEMENT
from sprung.model.diagnosis.screening.score import Candidate, Projector
from sprung.model.diagnosis.selection.compete import Trial, compete, noise_bound
from sprung.model.diagnosis.selection.holdout import HeldOut
from sprung.model.laws.grammar import Shape, forms, formula_cost, law_of


@dataclass(frozen=True)
class Scored:
    """One shape with its own values, as screened."""

    form: Shape
    values: tuple[float, ...]  # amplitude, own values
    score: float
    spectrum: ComplexArray  # of the force per unit of amplitude, (F,)

    @property
    def worth(self) -> float:
        """Score less what its parts cost."""
        return self.score - formula_cost(self.form.parts)


def formula_of(problem: Problem, base: Fit, unnamed: Trial, held: HeldOut) -> Trial | None:
    """The formula of an unnamed force; None: only its surface is known.

    base: the model without it.  Single shapes come first; two together only where no single one says as much.
    """
    rules = problem.rules.formula
    motion = TrialElement.of(Projector(problem, base), unnamed.term.location)
    singles = sorted((_best(motion, form) for form in forms()), key=lambda one: -one.worth)
    alone = [_candidate(motion, (one.form,), one.values, one.score) for one in singles[: rules.fitted]]
    found = _believed(problem, base, compete(problem, base, alone), unnamed, held)
    if found is None:
        pairs = [_pair(motion, one, other) for one, other in combinations(singles[: rules.partners], 2)]
        good = sorted((pair for pair in pairs if pair is not None), key=lambda hit: -_worth(hit))
        found = _believed(problem, base, compete(problem, base, good[: rules.fitted]), unnamed, held)
    return None if found is None else _plain(found)


def _believed(problem: Problem, base: Fit, trials: list[Trial], unnamed: Trial, held: HeldOut) -> Trial | None:
    """The formula of most evidence that says as much as the unnamed force, and nearly everything that is to be said."""
    rules = problem.rules.formula
    for trial in trials:
        if not problem.process_noise and _left(problem, trial.fit) > rules.leaves * _left(problem, base):
            continue
        says = trial.evidence >= unnamed.evidence - rules.slack and trial.gain >= rules.says * unnamed.gain
        if trial.finished and says and not trial.fit.bounded and not held.compare(unnamed.fit, trial.fit).refuted:
            return trial
    return None


def _left(problem: Problem, fit: Fit) -> float:
    """Chi-square per degree of freedom beyond what noise may leave."""
    return max(fit.reduced - noise_bound(problem, fit), 0.0)


def _worth(hit: Candidate) -> float:
    return hit.score - hit.term.law.prior_cost


def _best(motion: TrialElement, form: Shape) -> Scored:
    """A shape at the values of its own that score best."""
    law = law_of((form,))
    trials = law.shapes(motion.seen)
    spectra = motion.spectra(Term(law, motion.location, law.absent), trials)
    scores, amplitudes = motion.channel.scores(spectra)
    i = int(np.argmax(scores))
    values = tuple(float(v) for v in law.scaled(trials[i], float(amplitudes[i])))
    return Scored(form, values, float(scores[i]), spectra[i] / trials[i][0])


def _candidate(motion: TrialElement, parts: tuple[Shape, ...], values: tuple[float, ...], score: float) -> Candidate:
    law = law_of(parts)
    scales = tuple(max(abs(spec.typical(motion.seen)), 1e-12) for spec in law.parameters)
    term = Term(law, motion.location, values, " + ".join(form.text for form in parts), scales=scales)
    return Candidate(term, score, ELEMENT)


def _pair(motion: TrialElement, one: Scored, other: Scored) -> Candidate | None:
    """Two shapes together; None for two hidden states, which would need a time each."""
    if one.form.memory and other.form.memory:
        return None
    score, (a, b) = motion.channel.joint(np.stack([one.spectrum, other.spectrum]))
    values = (float(a), *one.values[1:], float(b), *other.values[1:])
    return _candidate(motion, (one.form, other.form), values, score)


def _plain(trial: Trial) -> Trial:
    """A trial without the variant that told formulas apart."""
    point = trial.fit.point
    term = replace(point.terms[-1], variant="")
    return replace(trial, fit=replace(trial.fit, point=replace(point, terms=(*point.terms[:-1], term))))
