"""Harmonic balance of laws and plant: restoring forces that depend on the motion they act on.

    d = d_linear + D f,   f = law(d, d')        over the whole record at once

Alternating frequency/time method (Cameron and Griffin 1989): the plant is evaluated in the frequency domain, the laws
in the time domain on an oversampled grid.  The fixed point is found with Anderson acceleration (Walker and Ni 2011).
The laws' equivalent linearisation (`Term.equivalent`) is part of the plant, so that only their curvature is iterated.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft

from sprung.model.diagnosis.record.spectra import OVERSAMPLING, ComplexArray
from sprung.model.diagnosis.response.frf import Plant
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import SpringDamper
from sprung.model.laws.along import force_along
from sprung.model.signals import FloatArray

TOLERANCE = 1e-6  # relative, of the laws' forces
_ITERATIONS = 60  # of the laws' forces at most
_PATIENCE, _PROGRESS = 16, 0.5  # abandoned if the error has not fallen by this factor in as many iterations
_HISTORY = 8  # iterates that Anderson acceleration combines
_REACH = 4.0  # times the linear response's amplitude, to which diverging iterates are clipped


@dataclass(frozen=True)
class LawForces:
    """Converged harmonic balance of m laws; forces are less the equivalents, which are part of the plant."""

    terms: list[Term]
    ports: FloatArray  # (m, E)
    deflection: FloatArray  # (4N, m)
    rate: FloatArray  # (4N, m)
    force: FloatArray  # (4N, m)
    converged: bool
    sensors: ComplexArray  # response of the sensors' true signals, periodic part, (F, S)
    deflections: ComplexArray  # response of the deflections, periodic part, (F, E)
    q: ComplexArray  # response of the degrees of freedom, periodic part, (F, n)
    motion: FloatArray  # polynomial response, (DEGREE + 1, n)
    line: FloatArray  # polynomial part of the forces along the elements, (DEGREE + 1, E)
    evaluations: int = 0  # of a law over the whole record, until the solution

    def index(self, term: Term) -> int:
        """Index of the law at the term's place, regardless of its parameter values."""
        return next(i for i, own in enumerate(self.terms) if own.key == term.key)


def warm_start_of(forces: LawForces | None) -> tuple[FloatArray, ...]:
    """The laws' forces as initial guess for a nearby solution, each (4N,)."""
    return () if forces is None else tuple(forces.force.T)


class HarmonicBalance:
    """Equations of m laws and the plant between them, on the oversampled time axis (4N samples).

    terms: (m,), at the springs and dampers `elements`, along ports (m, E) of the plant.
    motion: deflection (m) and rate (m/s) along the ports without the laws' forces, each (4N, m).
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
        self.wide = plant.structure.padded(ports)
        self._drive(*motion)
        self.compliance = self._compliance(self.wide)  # (2N + 1, m, m)
        self.jw = 2j * np.pi * np.fft.rfftfreq(len(self.d0), self.grid.step / OVERSAMPLING)
        self.lines = np.array([plant.line_motion(port) for port in self.wide])  # (m, 2, DEGREE + 1, n)
        self.line_d = np.einsum("bkpn,an->kpab", self.lines, self.wide @ H)
        self.powers = self.grid.fine_monomials
        self.evaluations = 0  # of a law over the whole record

    def _drive(self, d0: FloatArray, v0: FloatArray) -> None:
        self.d0, self.v0 = d0, v0
        self.reach = _REACH * np.abs(d0).max(axis=0), _REACH * np.abs(v0).max(axis=0)

    def under(self, motion: tuple[FloatArray, FloatArray]) -> HarmonicBalance:
        """The same equations with another motion without the laws' forces (other inputs or another initial state)."""
        other = copy(self)
        other._drive(*motion)
        return other

    def law_forces(self, d: FloatArray, v: FloatArray) -> FloatArray:
        """Forces (4N, m) along a motion, each (4N, m), less the equivalents."""
        return np.column_stack([self.law_force(i, d, v) for i in range(len(self.terms))])

    def law_force(self, index: int, d: FloatArray, v: FloatArray) -> FloatArray:
        """Force (4N,) of one law along a motion of all, each (4N, m), less its equivalent."""
        self.evaluations += 1
        term, time = self.terms[index], self.grid.start + self.grid.fine_time
        d, v = (np.clip(x[:, index], -reach[index], reach[index]) for x, reach in zip((d, v), self.reach, strict=True))
        force = force_along(term.element_law, term.parameters, d, v, time, self.elements[index])
        found: FloatArray = force - term.equivalent[0] * d - term.equivalent[1] * v
        return found

    def solution(self, force: FloatArray, converged: bool = True) -> LawForces:
        """Response of the system to forces (4N, m)."""
        plant, grid = self.plant, self.grid
        d, v = self.motion(force)
        fine_spectrum, line = grid.split_law_forces(force)
        spectrum = fine_spectrum[: len(grid.omega)] / (OVERSAMPLING * np.sqrt(grid.samples))
        motion = np.einsum("bkpn,kb->pn", self.lines, line[:2])
        sensors = np.einsum("fsb,fb->fs", plant.sensor_of_force @ self.wide.T, spectrum)
        q = -np.einsum("fnm,fm->fn", plant.receptance, spectrum @ (self.wide @ plant.structure.H))
        deflections = q @ plant.structure.H.T
        return LawForces(
            self.terms,
            self.ports,
            d,
            v,
            force,
            converged,
            sensors,
            deflections,
            q,
            motion,
            line @ self.wide,
            self.evaluations,
        )

    def _compliance(self, ports: FloatArray) -> ComplexArray:
        """Deflection along ports (m, E) per force along them, (2N + 1, m, m), up to the oversampled Nyquist frequency.

        Laws with kinks produce harmonics above the record's Nyquist frequency.  Below it the plant's receptance is
        used, above it the modal form of the state equations, rows (j w - A)^-1 B.
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

    def motion(self, force: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Deflection and rate along the ports under forces (4N, m), each (4N, m)."""
        return self.motion_of(*self.grid.split_law_forces(force))

    def motion_of(self, spectrum: ComplexArray, line: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The same under forces that are split into a transform (2N + 1, m) and a polynomial (DEGREE + 1, m)."""
        answer = np.einsum("fab,fb->af", self.compliance, spectrum)
        swinging = irfft(np.stack([answer, self.jw * answer]), len(self.d0))  # one transform of contiguous series
        steady = np.einsum("kpab,kb->pa", self.line_d, line[:2])
        d, v = swinging.transpose(0, 2, 1)
        return self.d0 + d + self.powers @ steady, self.v0 + v + self.powers @ self.plant.derivative(steady)


def fixed_point(
    step: Callable[[FloatArray], FloatArray],
    start: FloatArray,
    tolerance: float = TOLERANCE,
    patience: int = _PATIENCE,
) -> tuple[FloatArray, bool]:
    """f = step(f), of any shape, by Anderson acceleration; returns the best point and whether the tolerance was met."""
    shape = start.shape
    x = start.ravel()
    image = step(start).ravel()
    history = _AndersonHistory(x.size)
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
        x = history.next_iterate(image, residual)
        image = step(x.reshape(shape)).ravel()
    return best.reshape(shape), False


class _AndersonHistory:
    """Differences of successive images and residuals of a fixed-point iteration, of the last few iterates."""

    def __init__(self, size: int) -> None:
        self.images, self.residuals = np.empty((_HISTORY - 1, size)), np.empty((_HISTORY - 1, size))
        self.gram = np.zeros((_HISTORY - 1, _HISTORY - 1))  # of the differences of residuals
        self.count = 0
        self.last: tuple[FloatArray, FloatArray] | None = None

    def next_iterate(self, image: FloatArray, residual: FloatArray) -> FloatArray:
        """The next iterate: the image less the combination of differences that minimises the residual."""
        if self.last is not None:
            at = self.count % len(self.images)  # the oldest is overwritten
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
