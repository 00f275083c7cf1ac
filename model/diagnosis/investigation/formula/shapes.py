"""Shapes of the grammar, alone and in pairs, scored along the motion of a fit that has an unnamed force in it.

That force is taken out of the fit's residual, not out of its motion: along a motion that the law has shaped, a right
formula leaves noise, while along that of a model without it even the truth does not.  Every shape with every trial of
its own values is a column; all pairs of columns are scored at once from their products, the best ones then with values
between those of the grid.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.point import Point, advance
from sprung.model.diagnosis.response.terms import Term, evaluated_in_time, typical_scales
from sprung.model.diagnosis.rules import FormulaRules
from sprung.model.diagnosis.screening.elements import TrialElement
from sprung.model.diagnosis.screening.families import ELEMENT
from sprung.model.diagnosis.screening.score import Candidate, Projector
from sprung.model.diagnosis.selection.starts import start_of
from sprung.model.laws.grammar import Shape, forms, formula_cost, law_of
from sprung.model.signals import BoolArray, FloatArray

_SEEN = 1e-7  # of a column's square, left by the projection
_ALIKE = 0.999  # correlation of two columns beyond which their sum is none
_RIDGE = 1e-7  # relative, of normalised sensitivities
_FINER = (1.28, 1.13, 1.06)  # factors on a shape's own values, between those of the grid
_Inner = tuple[float, ...]  # a shape's own values


@dataclass(frozen=True)
class Scored:
    """A sum of one or two shapes with their own values, as scored."""

    parts: tuple[Shape, ...]
    inner: tuple[_Inner, ...]
    score: float
    amplitudes: tuple[float, ...]
    cost: float

    @property
    def worth(self) -> float:
        """Score less what its parts and values cost."""
        return self.score - self.cost

    @property
    def values(self) -> tuple[float, ...]:
        """In the order of `law_of`: amplitude and own values of each shape, the time of the hidden state once."""
        found: list[float] = []
        for number, (form, own, amplitude) in enumerate(zip(self.parts, self.inner, self.amplitudes, strict=True)):
            shared = number > 0 and form.memory and self.parts[0].memory
            found += [amplitude, *(own[:-1] if shared else own)]
        return tuple(found)


def without_last_term(problem: Problem, fit: Fit) -> Fit:
    """A fit whose last term, a force along an element, is left in its motion and is missing in its residual."""
    point, term = fit.point, fit.point.terms[-1]
    projector = Projector(problem, fit)
    spectrum = projector.grid.coarse_forces(fit.force_along(term))[projector.grid.band]
    residual = fit.residual + projector.seen_of(term.port(problem.system), spectrum)
    own = np.zeros(fit.jacobian.shape[1], dtype=bool)
    own[fit.place(len(point.terms) - 1)] = True
    warm_start = point.warm_start[: sum(evaluated_in_time(other) for other in point.terms[:-1])]
    return replace(
        fit,
        point=replace(point, terms=point.terms[:-1], warm_start=warm_start),
        residual=residual,
        chi_square=float(residual @ residual),
        jacobian=fit.jacobian[:, ~own],
    )


@dataclass(frozen=True)
class FormulaSearch:
    """Formulas at one element, scored along the motion of a fit; see `taken_out`."""

    motion: TrialElement
    rules: FormulaRules
    known: dict[tuple[Shape, _Inner], ComplexArray] = field(default_factory=dict)

    @classmethod
    def along(cls, problem: Problem, fit: Fit) -> FormulaSearch:
        """Along the motion of a fit, in place of its last term."""
        location = fit.point.terms[-1].location
        motion = TrialElement.of(Projector(problem, without_last_term(problem, fit)), location)
        return cls(motion, problem.rules.formula)

    @classmethod
    def beside(cls, problem: Problem, fit: Fit) -> FormulaSearch:
        """Along the motion of a fit, beside its last term."""
        motion = TrialElement.of(Projector(problem, fit), fit.point.terms[-1].location)
        return cls(motion, problem.rules.formula)

    def most(self) -> float:
        """Score of the best single shape."""
        return float(np.max(_Columns.of(self).scores))

    def best(self) -> tuple[list[Candidate], list[Candidate]]:
        """The best single shapes, and the best pairs: those whose score is next to that of the best of all."""
        columns = _Columns.of(self)
        ranked = [self._ranked(columns.singles()), self._ranked(columns.pairs())]
        least = self.rules.near * max((one.score for group in ranked for one in group), default=0.0)
        singles, pairs = ([one for one in group if one.score > least][: self.rules.fitted] for group in ranked)
        return [self._candidate(one) for one in singles], [self._candidate(one) for one in pairs]

    def _ranked(self, scored: Iterator[Scored]) -> list[Scored]:
        promising = [one for one, _ in zip(scored, range(self.rules.partners), strict=False)]
        return sorted((self._finer(one) for one in promising), key=lambda one: -one.worth)

    def spectrum(self, form: Shape, inner: _Inner) -> ComplexArray:
        """Force of unit amplitude over the compared bins, (F,)."""
        if (form, inner) not in self.known:
            law = law_of((form,))
            term = Term(law, self.motion.location, law.absent)
            self.known[form, inner] = self.motion.spectra(term, np.array([(1.0, *inner)]))[0]
        return self.known[form, inner]

    def _scored(self, parts: tuple[Shape, ...], inner: tuple[_Inner, ...]) -> Scored:
        spectra = np.stack([self.spectrum(form, own) for form, own in zip(parts, inner, strict=True)])
        score, amplitudes = self.motion.channel.joint(spectra)
        cost = self.cost(sum(form.parts for form in parts), sum(1 + len(form.inner) for form in parts))
        return Scored(parts, inner, score, tuple(float(a) for a in amplitudes), cost)

    def cost(self, parts: int, values: int) -> float:
        """Of a formula of so many parts and values: those by the Bayesian information criterion."""
        return formula_cost(parts) + values * float(np.log(len(self.motion.projector.residual)))

    def _finer(self, start: Scored) -> Scored:
        """With own values around those of the grid; the time of a hidden state is common to both shapes."""
        best = start
        for factor in _FINER:
            for way in (factor, 1 / factor):
                for part, form in enumerate(start.parts):
                    for at in range(len(form.inner)):
                        inner = _moved(best, part, at, way)
                        tried = self._scored(start.parts, inner)
                        best = tried if tried.score > best.score else best
        return best

    def _candidate(self, one: Scored) -> Candidate:
        law = law_of(one.parts)
        scales = typical_scales(law, self.motion.seen)
        variant = " + ".join(form.text for form in one.parts)
        candidate = Candidate(Term(law, self.motion.location, one.values, variant, scales=scales), one.score, ELEMENT)
        return replace(candidate, start=self._start(one, candidate))

    def _start(self, one: Scored, candidate: Candidate) -> Point:
        """Where a fit of the formula begins: everything else moved as its score has it."""
        projector = self.motion.projector
        fit, port = projector.fit, candidate.term.port(projector.problem.system)
        parts = zip(one.amplitudes, one.parts, one.inner, strict=True)
        force = sum(amplitude * self.spectrum(form, own) for amplitude, form, own in parts)
        left = fit.residual - projector.seen_of(port, np.asarray(force))
        scale = np.maximum(np.linalg.norm(fit.jacobian, axis=0), 1e-300)
        step = np.linalg.lstsq(fit.jacobian / scale, left, rcond=_RIDGE)[0] / scale
        first = len(step) - len(fit.point.state)
        return advance(start_of(fit, candidate), np.insert(step, first, np.zeros(len(candidate.term.parameters))))


def _moved(one: Scored, part: int, at: int, factor: float) -> tuple[_Inner, ...]:
    """Own values with one of them times a factor, the hidden state's time in all shapes alike."""
    name = one.parts[part].inner[at]
    return tuple(
        tuple(
            value * factor if (number == part and i == at) or (name == "tau" == form.inner[i]) else value
            for i, value in enumerate(own)
        )
        for number, (form, own) in enumerate(zip(one.parts, one.inner, strict=True))
    )


@dataclass(frozen=True)
class _Columns:
    """Every shape with every trial of its own values."""

    search: FormulaSearch
    shapes: tuple[Shape, ...]
    first: np.ndarray  # column of each shape's first trial, (forms,)
    inner: list[_Inner]  # of each column, (M,)
    spectra: ComplexArray  # (M, F)
    scores: FloatArray  # of single columns, (M,)

    @classmethod
    def of(cls, search: FormulaSearch) -> _Columns:
        motion, shapes = search.motion, forms()
        first: list[int] = []
        inner: list[_Inner] = []
        spectra: list[ComplexArray] = []
        for form in shapes:
            law = law_of((form,))
            trials = law.shapes(motion.seen)
            first.append(len(inner))
            own = [tuple(float(x) for x in trial[1:]) for trial in trials]
            found = motion.spectra(Term(law, motion.location, law.absent), trials) / trials[:, :1]
            search.known.update({(form, values): one for values, one in zip(own, found, strict=True)})
            inner += own
            spectra.append(found)
        h = np.concatenate(spectra)
        return cls(search, shapes, np.array(first), inner, h, motion.channel.scores(h)[0])

    def singles(self) -> Iterator[Scored]:
        """Shapes, each at the best values of its own, by worth."""
        best = np.maximum.reduceat(self.scores, self.first)
        for at in np.argsort(self._costs(1)[0] - best):
            here = slice(self.first[at], None if at + 1 == len(self.first) else self.first[at + 1])
            column = self.first[at] + int(np.argmax(self.scores[here]))
            yield self.search._scored((self.shapes[at],), (self.inner[column],))

    def pairs(self) -> Iterator[Scored]:
        """Pairs of shapes, each at the best values of its own, by worth."""
        product, gram, size = self.search.motion.channel.products(self.spectra)
        left = np.diag(gram)
        scale = np.where(left > _SEEN * size, 1 / np.sqrt(np.maximum(left, 1e-300)), 0.0)
        p, r = product * scale, gram * scale * scale[:, None]
        with np.errstate(all="ignore"):
            score = (p**2 + p[:, None] ** 2 - 2 * r * p * p[:, None]) / (1 - r**2)
        score[~(np.abs(r) < _ALIKE) | self._unequal_memories()] = 0.0
        best = np.maximum.reduceat(np.maximum.reduceat(score, self.first, axis=0), self.first, axis=1)
        worth = np.triu(best - self._costs(2), 1)
        ends = [*self.first, len(self.inner)]
        for flat in np.argsort(-worth, axis=None):
            i, j = np.unravel_index(int(flat), worth.shape)
            if worth[i, j] <= 0:
                return
            block = score[ends[i] : ends[i + 1], ends[j] : ends[j + 1]]
            a, b = np.unravel_index(int(np.argmax(block)), block.shape)
            inner = self.inner[ends[i] + a], self.inner[ends[j] + b]
            yield self.search._scored((self.shapes[i], self.shapes[j]), inner)

    def _costs(self, count: int) -> FloatArray:
        """Of single shapes, (1, forms), or of pairs, (forms, forms)."""
        sizes = [np.array([form.parts for form in self.shapes]), np.array([1 + len(f.inner) for f in self.shapes])]
        parts, values = (of[None] if count == 1 else of + of[:, None] for of in sizes)
        found: FloatArray = np.vectorize(self.search.cost, otypes=[float])(parts, values)
        return found

    def _unequal_memories(self) -> BoolArray:
        """Pairs of columns with hidden states of different times, (M, M)."""
        ends = np.append(self.first, len(self.inner))
        memory = np.repeat([form.memory for form in self.shapes], np.diff(ends))
        time = np.array([own[-1] if m else 0.0 for own, m in zip(self.inner, memory, strict=True)])
        found: BoolArray = memory & memory[:, None] & (time != time[:, None])
        return found
