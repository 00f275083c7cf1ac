"""Candidates at elements: the best shape of every law, and static forces without a name."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from sprung.model.chunks import WORKERS, share
from sprung.model.diagnosis.record.spectra import OVERSAMPLING, ComplexArray
from sprung.model.diagnosis.response.terms import WIDER, Term, branch_of, is_waveform
from sprung.model.diagnosis.screening.families import ELEMENT, UNNAMED
from sprung.model.diagnosis.screening.places import places
from sprung.model.diagnosis.screening.score import Candidate, Projector, ScalarResponse
from sprung.model.laws import ElementLaw, Law, Observed, SpringDamper, observe
from sprung.model.laws.along import force_along
from sprung.model.laws.basis import static_law, trials
from sprung.model.signals import FloatArray


@dataclass(frozen=True)
class TrialElement:
    """One element of a fit as trial forces see it."""

    projector: Projector
    location: str
    deflection: FloatArray  # oversampled, (4N,)
    rate: FloatArray
    seen: Observed
    element: SpringDamper
    channel: ScalarResponse

    @classmethod
    def of(cls, projector: Projector, location: str) -> TrialElement:
        """Of a fit's projector."""
        index = projector.problem.system.elements.index(location)
        d, v = (motion[:, index] for motion in projector.fit.element_motion)
        seen, element = _seen(projector, location, d, v)
        channel = ScalarResponse(projector, projector.of_force[:, :, index])
        return cls(projector, location, d, v, seen, element, channel)

    def spectra(self, term: Term, trials: FloatArray) -> ComplexArray:
        """Forces of a law for trial values (m, P) over the compared bins, (m, F); zero where they overflow."""
        of = [
            _force_spectrum(self.projector, term.at(trial), self.deflection, self.rate, self.element)
            for trial in trials
        ]
        return np.where(np.isfinite(of), of, 0.0)[:, self.projector.grid.band]


def element_candidates(projector: Projector, laws: tuple[Law, ...]) -> Iterator[tuple[Candidate, int]]:
    """The best shape of every element law at every element or pair, and how many shapes were tried."""
    system = projector.problem.system
    d_all, v_all = projector.fit.element_motion
    channels: dict[str, ScalarResponse] = {}
    asked = [(law, "") for law in laws if isinstance(law, ElementLaw) and law.screened]
    asked += [(law.wider, WIDER) for law, _ in asked if law.wider is not None and law.wider.screened]
    candidates = [Term(law, at, law.absent, variant) for law, variant in asked for at in places(system, law)]
    for absent in candidates:
        location = absent.location
        if location not in channels:
            port = absent.port(system)
            channels[location] = ScalarResponse(projector, projector.of_force[:, :, : len(port)] @ port)

    def best(absent: Term) -> tuple[Candidate, int]:
        return _best_shape(projector, absent, d_all, v_all, channels[absent.location])

    yield from share(best, candidates, WORKERS)
    for index, location in enumerate(system.elements):
        if location in channels:
            yield from _unnamed(projector, location, d_all[:, index], v_all[:, index], channels[location])


def _best_shape(
    projector: Projector, nothing: Term, d_all: FloatArray, v_all: FloatArray, channel: ScalarResponse
) -> tuple[Candidate, int]:
    grid, law = projector.grid, nothing.element_law
    port = nothing.port(projector.problem.system)
    d, v = d_all @ port, v_all @ port
    seen, element = _seen(projector, nothing.location, d, v)
    scales = tuple(max(abs(q.typical(seen)), 1e-12) for q in law.parameters)
    trials = law.shapes(seen)
    nothing = replace(nothing, scales=scales)
    absent = Candidate(nothing, 0.0, ELEMENT)
    if not len(trials):
        return absent, 0
    terms = [nothing.at(trial) for trial in trials]
    spectra = np.array([_force_spectrum(projector, term, d, v, element)[grid.band] for term in terms])
    scores, amplitudes = channel.scores(spectra)
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


def _unnamed(
    projector: Projector, location: str, d: FloatArray, v: FloatArray, channel: ScalarResponse
) -> Iterator[tuple[Candidate, int]]:
    """Static forces without a name at one element."""
    grid = projector.grid
    seen, _ = _seen(projector, location, d, v)
    for name, basis in trials().items():
        law = static_law(basis, seen)
        scales = tuple(q.typical(seen) for q in law.parameters)
        values = np.column_stack(law.values(d, v))
        spectra = grid.coarse_spectrum(values)[grid.band].T
        score, amplitudes = channel.joint(spectra)
        term = Term(law, location, tuple(float(a) for a in amplitudes), name, scales=scales)
        yield Candidate(term, score, UNNAMED), 1


def _seen(projector: Projector, location: str, d: FloatArray, v: FloatArray) -> tuple[Observed, SpringDamper]:
    element = projector.fit.forward.element_at(location)
    thin = slice(None, None, OVERSAMPLING)
    k, c = float(element.stiffness), float(element.damping)
    return observe(d[thin], v[thin], 1 / projector.grid.step, k, c), element


def _force_spectrum(
    projector: Projector, term: Term, d: FloatArray, v: FloatArray, element: SpringDamper
) -> ComplexArray:
    """Spectrum of the law's force along a motion, (F,)."""
    grid = projector.grid
    if is_waveform(term):
        time = grid.start + grid.fine_time
        force = force_along(term.element_law, term.parameters, d, v, time, element)
        return grid.coarse_spectrum(force)
    branch = branch_of(term, 0, float(element.damping))
    assert branch is not None
    factor = branch.impedance(grid.omega)
    # series impedances vanish at zero frequency, so the rate carries them and ends that do not meet do no harm
    per_rate = np.zeros_like(factor)
    per_rate[1:] = factor[1:] / (1j * grid.omega[1:])
    return per_rate * grid.coarse_spectrum(v)


def _admissible(law: ElementLaw, trial: FloatArray, amplitude: float) -> bool:
    """Whether the amplitude found has the law's sign."""
    if law.strength is None:
        return amplitude > 0
    value = float(law.scaled(list(trial), amplitude)[law.strength])
    spec = law.parameters[law.strength]
    absent = law.absent[law.strength]
    # More than the bound says that the element was misread; only the other sign is none of the law's.
    return (
        spec.low <= value <= spec.high
        or (value < absent and spec.low < absent)
        or (value > absent and spec.high > absent)
    )
