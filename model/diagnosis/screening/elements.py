"""Candidates at elements: the best shape of every law, and unnamed (non-parametric) static forces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sprung.model.chunks import WORKERS, share
from sprung.model.diagnosis.record.spectra import OVERSAMPLING, ComplexArray
from sprung.model.diagnosis.response.terms import WIDER, Term, branches_of, evaluated_in_time
from sprung.model.diagnosis.screening.families import ELEMENT, UNNAMED
from sprung.model.diagnosis.screening.places import places
from sprung.model.diagnosis.screening.score import Candidate, Projector, ScalarResponse
from sprung.model.laws import ElementLaw, Law, Observed, SpringDamper, observe
from sprung.model.laws.along import force_along
from sprung.model.laws.basis import static_law, trials
from sprung.model.signals import FloatArray


@dataclass(frozen=True)
class TrialElement:
    """Motion and response of one element, or of a pair, for trial forces."""

    projector: Projector
    location: str
    deflection: FloatArray  # oversampled, (4N,)
    rate: FloatArray
    seen: Observed
    element: SpringDamper
    channel: ScalarResponse

    @classmethod
    def of(cls, projector: Projector, location: str) -> TrialElement:
        """Of an element or a pair."""
        elements = projector.problem.system.elements
        return cls.along(projector, location, np.eye(len(elements))[elements.index(location)])

    @classmethod
    def along(cls, projector: Projector, location: str, port: FloatArray) -> TrialElement:
        """Along a port (E,)."""
        d, v = (motion @ port for motion in projector.fit.element_motion)
        element = projector.fit.forward.element_at(location)
        thin = slice(None, None, OVERSAMPLING)
        k, c = float(element.stiffness), float(element.damping)
        seen = observe(d[thin], v[thin], 1 / projector.grid.step, k, c)
        channel = ScalarResponse.of(projector, projector.of_port(port))
        return cls(projector, location, d, v, seen, element, channel)

    def spectra(self, term: Term, trials: FloatArray) -> ComplexArray:
        """Forces of a law for trial values (m, P) over the compared bins, (m, F); zero where they overflow."""
        found = self.of_terms([term.at(trial) for trial in trials])
        return np.where(np.isfinite(found), found, 0.0)

    def of_terms(self, terms: list[Term]) -> ComplexArray:
        """Forces of the terms of one law over the compared bins, (m, F)."""
        grid = self.projector.grid
        if evaluated_in_time(terms[0]):
            time = grid.start + grid.fine_time
            forces = [
                force_along(term.element_law, term.parameters, self.deflection, self.rate, time, self.element)
                for term in terms
            ]
            return grid.compared_forces(np.array(forces))
        return np.array([self._of_branch(term) for term in terms])

    def _of_branch(self, term: Term) -> ComplexArray:
        """Force of a branch over the compared bins, (F,)."""
        (branch,) = branches_of(term, self.projector.problem.system, self.projector.fit.forward.plant.structure)
        return np.asarray(branch.per_rate(self.projector.grid.omega[self.projector.grid.band]) * self._rate_spectrum)

    @cached_property
    def _rate_spectrum(self) -> ComplexArray:
        """Spectrum of the rate over the compared bins, (F,)."""
        found: ComplexArray = self.projector.grid.compared_spectra(self.rate[None])[0]
        return found


def element_candidates(projector: Projector, laws: tuple[Law, ...]) -> Iterator[tuple[Candidate, int]]:
    """The best shape of every element law at every element or pair, with the number of trials."""
    system = projector.problem.system
    asked = [(law, "") for law in laws if isinstance(law, ElementLaw) and law.screened]
    asked += [(law.wider, WIDER) for law, _ in asked if law.wider is not None and law.wider.screened]
    asked += [(form, variant) for law, _ in asked for variant, form in law.forms]
    candidates = [Term(law, at, law.absent, variant) for law, variant in asked for at in places(system, law)]
    ports = {absent.location: absent.port(system) for absent in candidates}
    elements = {location: TrialElement.along(projector, location, port) for location, port in ports.items()}
    yield from share(lambda absent: _best_shape(elements[absent.location], absent), candidates, WORKERS)
    for location in system.elements:
        if location in elements:
            yield from _unnamed(elements[location])


def _best_shape(motion: TrialElement, nothing: Term) -> tuple[Candidate, int]:
    law, seen = nothing.element_law, motion.seen
    scales = tuple(max(abs(q.typical(seen)), 1e-12) for q in law.parameters)
    trials = law.shapes(seen)
    nothing = replace(nothing, scales=scales)
    absent = Candidate(nothing, 0.0, ELEMENT)
    if not len(trials):
        return absent, 0
    scores, amplitudes = motion.channel.scores(motion.of_terms([nothing.at(trial) for trial in trials]))
    fine = np.array([_admissible(law, t, a) for t, a in zip(trials, amplitudes, strict=True)])
    scores = np.where(fine, scores, 0.0)
    i = int(np.argmax(scores))
    if scores[i] <= 0:
        return absent, len(trials)
    asked = law.scaled(list(trials[i]), float(amplitudes[i]))
    found = law.clip(list(asked))
    term = nothing.at(found)
    beyond = 1.0
    if law.strength is not None and found[law.strength] != law.absent[law.strength]:
        absent_value = law.absent[law.strength]
        beyond = max(1.0, (asked[law.strength] - absent_value) / (found[law.strength] - absent_value))
    return Candidate(term, float(scores[i]), ELEMENT, float(beyond)), len(trials)


def _unnamed(motion: TrialElement) -> Iterator[tuple[Candidate, int]]:
    """Unnamed static forces at one element."""
    for name, basis in trials().items():
        law = static_law(basis, motion.seen)
        scales = tuple(q.typical(motion.seen) for q in law.parameters)
        values = np.array(law.values(motion.deflection, motion.rate))
        score, amplitudes = motion.channel.joint(motion.projector.grid.compared_forces(values))
        term = Term(law, motion.location, tuple(float(a) for a in amplitudes), name, scales=scales)
        yield Candidate(term, score, UNNAMED), 1


def _admissible(law: ElementLaw, trial: FloatArray, amplitude: float) -> bool:
    """Whether an amplitude has the sign of the law."""
    if law.strength is None:
        return amplitude > 0
    value = float(law.scaled(list(trial), amplitude)[law.strength])
    spec = law.parameters[law.strength]
    absent = law.absent[law.strength]
    # beyond the bound the element may be misestimated; only the wrong sign excludes the law
    return (
        spec.low <= value <= spec.high
        or (value < absent and spec.low < absent)
        or (value > absent and spec.high > absent)
    )
