"""Laws and the motion along their ports: forces that depend on the motion that they shape.

    d = d_linear + D f,   f = law(d, d')        over the whole record at once

Harmonic balance by alternating frequency and time (Cameron and Griffin 1989): the plant answers in frequency, the laws
in time on an oversampled grid, to a fixed point with Anderson acceleration (Walker and Ni 2011), around the laws'
equivalent linearisation (`Term.equivalent`, carried by the plant), so that only the law's curvature is left to it.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, rfft

from sprung.model.diagnosis.record.spectra import DEGREE, OVERSAMPLING, ComplexArray
from sprung.model.diagnosis.response.frf import Plant
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import SpringDamper
from sprung.model.laws.along import force_along
from sprung.model.signals import FloatArray

TOLERANCE = 1e-6  # of the law's force
_ITERATIONS = 60
_PATIENCE, _PROGRESS = 16, 0.5  # it is given up when the error has not fallen by this factor in so many iterations
_HISTORY = 8
_REACH = 4.0  # a trajectory this many times the linear one's reach is an iterate that diverges


@dataclass(frozen=True)
class LawForces:
    """Solution of the loop for m laws; forces without the equivalents that the plant carries."""

    terms: list[Term]
    ports: FloatArray  # (m, E)
    deflection: FloatArray  # (4N, m)
    rate: FloatArray  # (4N, m)
    force: FloatArray  # (4N, m)
    converged: bool
    sensors: ComplexArray  # what the forces add to the true signals, periodic part, (F, S)
    deflections: ComplexArray  # what they add to the deflections, periodic part, (F, E)
    q: ComplexArray  # what they add to the degrees of freedom, periodic part, (F, n)
    motion: FloatArray  # polynomial motion that they add, (DEGREE + 1, n)
    rounds: int = 0  # how often a law was asked for its force over the whole record

    def index(self, term: Term) -> int:
        """Which of the laws a term is, whatever its values."""
        return next(i for i, own in enumerate(self.terms) if own.key == term.key)


def warm_start_of(forces: LawForces | None) -> tuple[FloatArray, ...]:
    """The laws' forces as a start for a solution nearby, each (4N,)."""
    return () if forces is None else tuple(forces.force.T)


class HarmonicBalance:
    """Laws and the motion along their ports under the laws' forces, on the oversampled axis.

    terms (m,) at elements with the springs and dampers `elements`, along ports (m, E) of the plant; d0 and v0 (4N, m)
    are deflection and rate along them without the laws' forces.
    """

    def __init__(
        self,
        plant: Plant,
        terms: list[Term],
        ports: FloatArray,
        elements: list[SpringDamper],
        motion: tuple[FloatArray, FloatArray],
    ) -> None:
        self.plant, self.grid = plant, plant.grid
        H = plant.structure.H
        self.terms, self.ports, self.elements = terms, ports, elements
        self.wide = plant.structure.widened(ports)
        self._drive(*motion)
        self.compliance = self._compliance(self.wide)  # (4N / 2 + 1, m, m)
        self.jw = 2j * np.pi * np.fft.rfftfreq(len(self.d0), self.grid.step / OVERSAMPLING)
        self.lines = np.array([plant.line_motion(port) for port in self.wide])  # (m, 2, DEGREE + 1, n)
        self.line_d = np.einsum("bkpn,an->kpab", self.lines, self.wide @ H)
        self.powers = self.grid.fine_monomials
        self.rounds = 0  # how often a law was asked for its force

    def _drive(self, d0: FloatArray, v0: FloatArray) -> None:
        self.d0, self.v0 = d0, v0
        self.reach = _REACH * np.abs(d0).max(axis=0), _REACH * np.abs(v0).max(axis=0)

    def driven(self, motion: tuple[FloatArray, FloatArray]) -> HarmonicBalance:
        """The same loop under other inputs or from another state: deflection and rate without the laws' forces."""
        other = copy(self)
        other._drive(*motion)
        return other

    def law(self, d: FloatArray, v: FloatArray) -> FloatArray:
        """Forces along a motion (4N, m), without what the plant carries."""
        return np.column_stack([self.law_of(i, d, v) for i in range(len(self.terms))])

    def law_of(self, index: int, d: FloatArray, v: FloatArray) -> FloatArray:
        """Force of one of the laws along a motion (4N, m) of all, (4N,)."""
        self.rounds += 1
        term, time = self.terms[index], self.grid.start + self.grid.fine_time
        d, v = (np.clip(x[:, index], -reach[index], reach[index]) for x, reach in zip((d, v), self.reach, strict=True))
        force = force_along(term.element_law, term.parameters, d, v, time, self.elements[index])
        found: FloatArray = force - term.equivalent[0] * d - term.equivalent[1] * v
        return found

    def answer(self, force: FloatArray, converged: bool = True) -> LawForces:
        """What forces (4N, m) do to the system."""
        plant, grid = self.plant, self.grid
        d, v = self.motion(force)
        fine_spectrum, line = self.decompose(force)
        spectrum = fine_spectrum[: len(grid.omega)] / (OVERSAMPLING * np.sqrt(grid.samples))
        motion = np.einsum("bkpn,kb->pn", self.lines, line[:2])
        sensors = np.einsum("fsb,fb->fs", plant.sensor_of_force @ self.wide.T, spectrum)
        q = -np.einsum("fnm,fm->fn", plant.receptance, spectrum @ (self.wide @ plant.structure.H))
        deflections = q @ plant.structure.H.T
        return LawForces(self.terms, self.ports, d, v, force, converged, sensors, deflections, q, motion, self.rounds)

    def _compliance(self, ports: FloatArray) -> ComplexArray:
        """Deflection along the ports per force along them, also above the record's Nyquist frequency.

        A law with a kink answers its own harmonics there: below from the plant, above from the state equations,
        D = rows (j w - A)^-1 B by modes.
        """
        plant = self.plant
        s = plant.structure
        known = plant.compliance(ports, ports)
        fine = 2 * np.pi * np.fft.rfftfreq(OVERSAMPLING * self.grid.samples, self.grid.step / OVERSAMPLING)
        values, vectors = np.linalg.eig(s.state_matrix())
        rows = s.motion_rows(ports)[: len(ports)] @ vectors
        columns = np.linalg.lstsq(vectors, s.force_columns(ports).astype(complex), rcond=None)[0]
        high = fine[len(known) :]
        above = (rows / (1j * high[:, None] - values)[:, None, :]) @ columns
        return np.concatenate([known, above])

    def decompose(self, force: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """Periodic spectrum on the oversampled axis' bins, (4N / 2 + 1, m), and polynomial, (DEGREE + 1, m).

        The polynomial is the line that joins the ends, and the mean.
        """
        line = np.zeros((DEGREE + 1, force.shape[1]))
        line[1] = force[-1] - force[0]
        rest = force - self.powers[:, 1:2] * line[1]
        line[0] = rest.mean(axis=0)
        return rfft(rest - line[0], axis=0), line

    def motion(self, force: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Deflection and rate, 2 x (4N, m)."""
        spectrum, line = self.decompose(force)
        answer = np.einsum("fab,fb->af", self.compliance, spectrum)
        swinging = irfft(np.stack([answer, self.jw * answer]), len(self.d0))  # both at once: contiguous, so quick
        steady = np.einsum("kpab,kb->pa", self.line_d, line[:2])
        d, v = swinging.transpose(0, 2, 1)
        return self.d0 + d + self.powers @ steady, self.v0 + v + self.powers @ self.plant.derivative(steady)


def fixed_point(
    step: Callable[[FloatArray], FloatArray],
    start: FloatArray,
    tolerance: float = TOLERANCE,
    patience: int = _PATIENCE,
) -> tuple[FloatArray, bool]:
    """f = step(f) by Anderson acceleration; returns the best point and whether the tolerance was met."""
    shape = start.shape
    x = start.ravel()
    image = step(start).ravel()
    history = _History(x.size)
    best, best_size, sizes = image, np.inf, []
    for iteration in range(_ITERATIONS):
        residual = image - x
        size = float(np.linalg.norm(residual))
        if not np.isfinite(size):
            break
        if size < best_size:
            best, best_size = image, size
        if size <= tolerance * max(float(np.linalg.norm(image)), 1e-300):
            return image.reshape(shape), True
        sizes.append(best_size)
        if iteration >= patience and best_size > _PROGRESS * sizes[-patience]:
            break
        x = history.mixed(image, residual)
        image = step(x.reshape(shape)).ravel()
    return best.reshape(shape), False


class _History:
    """The last images and residuals of a fixed-point iteration, as differences from one to the next."""

    def __init__(self, size: int) -> None:
        self.images, self.residuals = np.empty((_HISTORY - 1, size)), np.empty((_HISTORY - 1, size))
        self.gram = np.zeros((_HISTORY - 1, _HISTORY - 1))  # of the differences of residuals
        self.count = 0
        self.last: tuple[FloatArray, FloatArray] | None = None

    def mixed(self, image: FloatArray, residual: FloatArray) -> FloatArray:
        """The next point: the image less what the differences make of the residual by least squares."""
        if self.last is not None:
            at = self.count % len(self.images)  # the oldest makes room
            self.count += 1
            np.subtract(image, self.last[0], out=self.images[at])
            np.subtract(residual, self.last[1], out=self.residuals[at])
            known = min(self.count, len(self.images))
            self.gram[at, :known] = self.gram[:known, at] = self.residuals[:known] @ self.residuals[at]
        self.last = image, residual
        if not self.count:
            return image
        known = min(self.count, len(self.images))
        gram = self.gram[:known, :known].copy()
        gram[np.diag_indices_from(gram)] *= 1 + 1e-10
        weights = np.linalg.lstsq(gram, self.residuals[:known] @ residual, rcond=1e-14)[0]
        found: FloatArray = image - weights @ self.images[:known]
        return found
