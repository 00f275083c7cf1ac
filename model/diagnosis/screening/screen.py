"""Every law at every place with every shape, as a score test on the residual of a fit.

A candidate's force along the fitted motion, taken through the fitted system to the sensors and whitened, is a column
c of unit-noise numbers, like the residual r and the fit's own sensitivities J.  With everything that J can imitate
projected out, c' = c - Q Q^T c, the statistic (c'^T r)^2 / |c'|^2 is chi-square with one degree of freedom when the
candidate is absent (Rao's score test), whatever the parameters have absorbed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy import stats

from sprung.model.chunks import WORKERS, share
from sprung.model.diagnosis.fit.problem import Fit, Problem
from sprung.model.diagnosis.record.spectra import OVERSAMPLING, ComplexArray
from sprung.model.diagnosis.response.terms import WIDER, Term, branch_of, is_waveform
from sprung.model.laws import ElementLaw, Law, Observed, SpringDamper, find_law, observe
from sprung.model.laws.along import force_along
from sprung.model.laws.basis import static_law, trials
from sprung.model.signals import FloatArray
from sprung.model.system import System


@dataclass(frozen=True)
class Hit:
    """One candidate as screened."""

    term: Term  # with the amplitude that the screening found
    score: float  # chi-square
    freedom: int
    family: str  # which group of tests it belongs to: "law", "comb", "mode", "line", "mass", "sensor", "input"
    p_single: float
    beyond: float = 1.0  # the strength that the screening asks for over the most that the law allows, at least 1
    step: FloatArray | None = None  # what the fit's parameters and state would move by, (P + p + 2n,)

    @property
    def location(self) -> str:
        return self.term.location

    @property
    def effect(self) -> str:
        return self.term.law.name


@dataclass(frozen=True)
class Screening:
    """All candidates, best first, with p-values corrected for everything that was tried."""

    hits: tuple[Hit, ...]  # the best shape of every law at every place
    tests: dict[str, int]  # how many were tried per family

    def p_value(self, hit: Hit) -> float:
        """Bonferroni over the family, then over the families."""
        return float(min(1.0, hit.p_single * self.tests[hit.family] * len(self.tests)))

    def localization(self) -> dict[str, float]:
        best: dict[str, float] = {}
        for hit in self.hits:
            best[hit.location] = max(best.get(hit.location, 0.0), hit.score)
        return dict(sorted(best.items(), key=lambda item: -item[1]))


class Projector:
    """Residual and candidates with the fit's sensitivities projected out."""

    def __init__(self, problem: Problem, fit: Fit, project: bool = True) -> None:
        jacobian = fit.jacobian if project else fit.jacobian[:, -len(fit.point.state) :]
        scale = np.linalg.norm(jacobian, axis=0)
        self.kept = scale > 1e-9 * max(scale.max(initial=0.0), 1e-300)
        q, r = np.linalg.qr(jacobian[:, self.kept] / scale[self.kept])
        strong = np.abs(np.diag(r)) > 1e-9
        self.q, self.r, self.scale = q[:, strong], r, scale
        self.strong = strong
        self.residual = fit.residual - self.q @ (self.q.T @ fit.residual)
        self.problem, self.fit = problem, fit
        self.any_law = find_law("cubic_stiffness")  # element_of asks a term for its place only
        grid = problem.part.grid
        self.grid = grid
        assert problem.whitener is not None
        factor = problem.whitener.factor
        shown = fit.forward.sensor_factor[grid.band, :, None]
        plant = fit.forward.plant
        self.of_force = factor @ (plant.sensor_of_force[grid.band] * shown)  # whitened, (F, S, E)
        self.of_support = factor @ (plant.sensor_of_support[grid.band] * shown)  # (F, S, supports)
        self.of_load = factor @ (plant.sensor_of_load[grid.band] * shown)  # (F, S, n)
        self.factor = factor

    @cached_property
    def lean(self) -> FloatArray:
        """What the residual leans on J at the end of a fit whose residual's covariance depends on the parameters.

        Such a fit ends at J^T r = d log det R / 2, not at zero.
        """
        slope = np.concatenate([self.fit.log_det_slope, np.zeros(len(self.fit.point.state))])[-len(self.kept) :]
        lean = np.linalg.lstsq(self.r.T, slope[self.kept] / self.scale[self.kept], rcond=1e-9)[0]
        return np.asarray(self.q @ lean[self.strong] / 2)

    def spread(self, column: FloatArray, change: ComplexArray) -> float:
        """What the residual's determinant adds to the product of a column and the residual.

        change (F, S, inputs): of what the sensors show of the inputs.  Forces along elements need none of it: what
        the determinant makes of them is what it makes of the spring and damper that they resemble.
        """
        if not self.problem.follows:
            return 0.0
        assert self.problem.whitener is not None
        return float(column @ self.lean) - self.problem.whitener.log_det_slope(change) / 2

    @cached_property
    def complex_q(self) -> ComplexArray:
        """The projection's basis as band spectra, (F, S, q)."""
        return self.unpack(self.q)

    @cached_property
    def complex_residual(self) -> ComplexArray:
        return self.unpack(self.residual)

    def unpack(self, packed: FloatArray) -> ComplexArray:
        """Real vectors (2 F S, ...) as weighted band spectra (F, S, ...)."""
        half = len(packed) // 2
        shape = (self.grid.band.stop, -1, *packed.shape[1:])
        return (packed[:half] + 1j * packed[half:]).reshape(shape)

    def pack(self, whitened: ComplexArray) -> FloatArray:
        """Already whitened band spectra (F, S) as a real vector."""
        weighted = whitened * self.grid.weight[:, None]
        return np.concatenate([weighted.real.ravel(), weighted.imag.ravel()])

    def score(self, column: FloatArray, more: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float]:
        """Statistic and amplitude of a column; `more`: product with, and square of, residuals outside the sensors."""
        inside = self.q.T @ column
        size = float(column @ column)
        left = size - float(inside @ inside)
        if left <= 1e-7 * size and more[1] <= 0:
            return 0.0, 0.0
        left = max(left, 1e-7 * size) + more[1]
        product = float(column @ self.residual) + more[0]
        return product**2 / left, product / left


class Channel:
    """Scores of columns that are one response (F, S) times a scalar spectrum h (F,): all trials at once."""

    def __init__(self, projector: Projector, response: ComplexArray) -> None:
        weighted = (response * projector.grid.weight[:, None]).conj()
        self.product = np.einsum("fs,fs->f", weighted, projector.complex_residual)
        self.size = np.sum(np.abs(weighted) ** 2, axis=1)
        self.inside = np.einsum("fs,fsq->fq", weighted, projector.complex_q, optimize=True)

    def scores(self, h: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Statistics and amplitudes of trials h (trials, F)."""
        conj = h.conj()
        product = np.real(conj @ self.product)
        size = np.abs(h) ** 2 @ self.size
        inside = np.real(conj @ self.inside)
        left = size - np.sum(inside**2, axis=1)
        visible = left > 1e-7 * size
        left = np.where(visible, left, 1.0)
        return np.where(visible, product**2 / left, 0.0), np.where(visible, product / left, 0.0)

    def joint(self, h: ComplexArray) -> tuple[float, FloatArray]:
        """Statistic and amplitudes of several columns h (m, F) together."""
        conj = h.conj()
        inside = np.real(conj @ self.inside)
        gram = np.real((conj * self.size) @ h.T) - inside @ inside.T
        product = np.real(conj @ self.product)
        scale = 1 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
        values, vectors = np.linalg.eigh(gram * scale * scale[:, None])
        good = values > 1e-6
        turned = vectors[:, good].T @ (product * scale)
        return float(np.sum(turned**2 / values[good])), scale * (vectors[:, good] @ (turned / values[good]))


def screen(
    problem: Problem, fit: Fit, laws: tuple[Law, ...], project: bool = True, exclude: frozenset[tuple[str, str, str]] = frozenset()
) -> Screening:
    """Screen all candidates on the residual of a fit."""
    from sprung.model.diagnosis.screening.bodies import body_hits
    from sprung.model.diagnosis.screening.harmonics import comb_hits
    from sprung.model.diagnosis.screening.sensors import measurement_hits

    projector = Projector(problem, fit, project)
    hits: list[Hit] = []
    tests: dict[str, int] = {}
    for group in (element_hits, comb_hits, body_hits, measurement_hits):
        for hit, count in group(projector, laws):
            tests[hit.family] = tests.get(hit.family, 0) + count
            if hit.score > 0 and hit.term.key not in exclude:
                hits.append(hit)
    hits.sort(key=lambda h: (h.p_single, -h.score))
    return Screening(tuple(hits), tests or {"law": 1})


def element_hits(projector: Projector, laws: tuple[Law, ...]) -> Iterator[tuple[Hit, int]]:
    """The best shape of every element law at every element or pair, and how many shapes were tried."""
    system = projector.problem.system
    d_all, v_all = projector.fit.element_motion
    channels: dict[str, Channel] = {}
    asked = [(law, "") for law in laws if isinstance(law, ElementLaw)]
    asked += [(law.wider, WIDER) for law, _ in asked if law.wider is not None]
    candidates = [Term(law, at, law.absent, variant) for law, variant in asked for at in places(system, law)]
    for absent in candidates:
        location = absent.location
        if location not in channels:
            port = absent.port(system)
            channels[location] = Channel(projector, projector.of_force[:, :, : len(port)] @ port)

    def best(absent: Term) -> tuple[Hit, int]:
        return _best_shape(projector, absent, d_all, v_all, channels[absent.location])

    yield from share(best, candidates, WORKERS)
    for index, location in enumerate(system.elements):
        if location in channels:
            yield from _unnamed(projector, location, d_all[:, index], v_all[:, index], channels[location])


def places(system: System, law: ElementLaw) -> list[str]:
    """Locations of an element law: elements, or pairs of elements between the same bodies at the same x."""
    elements = system.file.elements
    if law.where == "element":
        return list(elements)
    pairs = level_pairs(system, list(elements))
    return [f"{a}|{b}" for a, b in pairs if elements[a].lower == elements[b].lower]


def wheelsets(system: System) -> list[str]:
    """The two supports of every axle, "left|right"."""
    elements, inputs = system.file.elements, set(system.file.inputs)
    stands_on = {name: next(iter({e.upper, e.lower} & inputs), None) for name, e in elements.items()}
    pairs = level_pairs(system, [name for name, support in stands_on.items() if support is not None])
    return [f"{stands_on[a]}|{stands_on[b]}" for a, b in pairs if stands_on[a] != stands_on[b]]


def level_pairs(system: System, names: list[str]) -> list[tuple[str, str]]:
    """Pairs of elements below the same body at the same x."""
    pairs = []
    for a, b in combinations(names, 2):
        first, second = system.file.elements[a], system.file.elements[b]
        level = first.position and second.position and first.position[0] == second.position[0]
        if level and first.upper == second.upper:
            pairs.append((a, b))
    return pairs


def _best_shape(
    projector: Projector, nothing: Term, d_all: FloatArray, v_all: FloatArray, channel: Channel
) -> tuple[Hit, int]:
    grid, law = projector.grid, nothing.law
    assert isinstance(law, ElementLaw)
    port = nothing.port(projector.problem.system)
    d, v = d_all @ port, v_all @ port
    seen, element = _seen(projector, nothing.location, d, v)
    scales = tuple(max(abs(q.typical(seen)), 1e-12) for q in law.parameters)
    trials = law.shapes(seen)
    nothing = replace(nothing, scales=scales)
    absent = Hit(nothing, 0.0, 1, "law", 1.0)
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
    return Hit(term, float(scores[i]), 1, "law", float(stats.chi2.sf(scores[i], 1)), float(beyond)), len(trials)


def _unnamed(
    projector: Projector, location: str, d: FloatArray, v: FloatArray, channel: Channel
) -> Iterator[tuple[Hit, int]]:
    """Static forces without a name at one element."""
    grid = projector.grid
    seen, _ = _seen(projector, location, d, v)
    for name, basis in trials().items():
        law = static_law(basis, seen)
        count = len(law.parameters)
        scales = tuple(q.typical(seen) for q in law.parameters)
        values = np.column_stack(law.values(d, v))
        spectra = grid.coarse_spectrum(values)[grid.band].T
        score, amplitudes = channel.joint(spectra)
        term = Term(law, location, tuple(float(a) for a in amplitudes), name, scales=scales)
        yield Hit(term, score, count, "unnamed", float(stats.chi2.sf(score, count))), 1


def _seen(projector: Projector, location: str, d: FloatArray, v: FloatArray) -> tuple[Observed, SpringDamper]:
    element = projector.fit.forward.element_of(Term(projector.any_law, location, ()))
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
        force = force_along(term.law, term.parameters, d, v, time, element)  # type: ignore[arg-type]
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
