"""Candidates at bodies: another mass, an elastic mode, an unmeasured periodic force.

Elastic modes and periodic forces are narrow-band, so grids of frequencies are scored.  A column is a fixed spectrum
times a scalar function h(w) of the trial, and all projections are one matrix product.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import median_filter

from sprung.model.diagnosis.fit.jacobian import inertial_load, sensitivities_to_loads
from sprung.model.diagnosis.response.forward import structure_of
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import ScreeningRules
from sprung.model.diagnosis.screening.families import LINE, MASS, MODE
from sprung.model.diagnosis.screening.score import MEDIAN_OF_CHI_SQUARE, Candidate, Projector, ScalarResponse
from sprung.model.laws import CLOCK_LEAD, BodyLaw, Law
from sprung.model.mechanics import ACCELERATION, VELOCITY
from sprung.model.signals import FloatArray

_FIRST_RATIO = 0.2, 5.0  # of masses, of a first step to another one


def body_candidates(projector: Projector, laws: tuple[Law, ...]) -> Iterator[tuple[Candidate, int]]:
    """The best trial of every body law at every body, with the number of trials."""
    system = projector.problem.system
    for law in laws:
        if not isinstance(law, BodyLaw):
            continue
        if law.scales:
            yield from _masses(projector, law)
            continue
        for index, name in enumerate(system.bodies):
            if law.load is not None:
                yield _line(projector, law, index, name)
            else:
                yield from _modes(projector, law, index, name)


def _masses(projector: Projector, law: BodyLaw) -> Iterator[tuple[Candidate, int]]:
    """Other masses of bodies; stiffness and damping absorb most of them, so that the laws' reaction counts."""
    fit, problem, band = projector.fit, projector.problem, projector.grid.band
    estimated = {p.name for p in problem.system.parameters}
    held = [name for name in problem.system.bodies if f"{name}.{law.scales}" not in estimated]
    loads = [inertial_load(fit.forward, fit.motions, name) for name in held]
    if held and fit.forces is not None and not problem.process_noise:
        columns = sensitivities_to_loads(problem, fit.forward, fit.forces, fit.whitener, loads)
        scores = [projector.score(column, least=problem.rules.screening.reaction**2) for column in columns.T]
    else:
        shown = [projector.pack(np.einsum("fsn,fn->fs", projector.of_load, load[band])) for load in loads]
        spreads = [
            projector.spread(column, fit.forward.inputs_by_mass(name)[band])
            for column, name in zip(shown, held, strict=True)
        ]
        scores = [projector.score(column, (spread, 0.0)) for column, spread in zip(shown, spreads, strict=True)]
    for name, (score, amplitude) in zip(held, scores, strict=True):
        ratio = float(np.clip(1 + amplitude, *_FIRST_RATIO))
        term = Term(law, name, (ratio,), scales=(ratio,), known=(problem.rules.plausible.masses,))
        yield Candidate(term, score, MASS), 1


def _modes(projector: Projector, law: BodyLaw, index: int, name: str) -> Iterator[tuple[Candidate, int]]:
    """The best elastic mode of a body per shape, to first order in its participation."""
    fit, grid = projector.fit, projector.grid
    system = projector.problem.system
    plant = fit.forward.plant
    band = grid.band
    omega = grid.omega[band]
    bare = structure_of(system, projector.problem.sensors, fit.point.theta)
    element_force = bare.stiffness * fit.motions.deflection[band] + bare.damping * fit.motions.rate[band]  # (F, E)
    kinds = plant.structure.sensor_kind
    frequencies, ratios = _mode_grid(1 / grid.step, projector.problem.rules.screening)
    w0 = 2 * np.pi * frequencies[:, None]
    h = np.reciprocal(w0**2 - omega**2 + 2j * ratios[:, None] * w0 * omega)  # (trials, F)
    for variant in law.variants(system.mechanics, index):
        extended = law.modify(system.mechanics, index, (10.0, 0.02, 1.0), variant)
        shape_e = extended.H[: fit.forward.elements, -1]
        shape_s = extended.S[projector.problem.sensors, -1]
        if not np.any(shape_e) and not np.any(extended.F[-1]):
            continue
        g = -(element_force @ shape_e) / extended.mass[-1]
        jw = 1j * omega[:, None]
        kinematic = np.where(kinds == ACCELERATION, jw**2, np.where(kinds == VELOCITY, jw, 1.0))
        direct = (kinematic * shape_s * fit.forward.sensor_factor[band])[:, :, None]
        answer = (projector.factor @ direct)[:, :, 0]
        impedance = plant.impedance[band, : fit.forward.elements] * shape_e
        answer = answer + np.einsum("fse,fe->fs", projector.of_force[:, :, : fit.forward.elements], impedance)
        score, amplitudes = ScalarResponse.of(projector, answer * g[:, None]).scores(h)
        score = np.where(amplitudes > 0, score, 0.0)
        i = int(np.argmax(score))
        amplitude = amplitudes[i]
        values = (float(frequencies[i]), float(ratios[i]), float(min(max(amplitude, 1e-9), 5.0)))
        term = Term(law, name, values, variant, scales=(1.0, 1.0, max(float(amplitude), 1e-6)))
        yield Candidate(term, float(score[i]), MODE), len(frequencies)


def _mode_grid(sample_rate: float, rules: ScreeningRules) -> tuple[FloatArray, FloatArray]:
    frequencies, ratios = [], []
    for ratio in (rules.mode_damping, 3 * rules.mode_damping):
        count = int(np.log(rules.highest_mode * sample_rate / rules.lowest_mode) / ratio)
        grid = np.geomspace(rules.lowest_mode, rules.highest_mode * sample_rate, max(count, 2))
        frequencies.append(grid)
        ratios.append(np.full(len(grid), ratio))
    return np.concatenate(frequencies), np.concatenate(ratios)


def _line(projector: Projector, law: BodyLaw, index: int, name: str) -> tuple[Candidate, int]:
    """The strongest spectral line of a force on one degree of freedom of a body.

    A sine at the frequency of a bin fills that bin, half way between two it fills both in opposite phase.  Scores are
    normalised by their local median where it exceeds noise, so that broadband misfits are not taken for lines.
    """
    grid, rules = projector.grid, projector.problem.rules.screening
    system = projector.problem.system
    r = projector.complex_residual
    best: tuple[float, float, str] = (0.0, 0.0, "")
    count = 0
    for variant in law.variants(system.mechanics, index):
        dof = system.mechanics.dofs.index(f"{name}.{variant}")
        A = projector.of_load[:, :, dof] * grid.weight[:, None]
        b = np.einsum("fs,fs->f", A.conj(), r)
        n = np.maximum(np.sum(np.abs(A) ** 2, axis=1), 1e-300)
        on = np.abs(b) ** 2 / n
        between = np.abs(b[1:] - b[:-1]) ** 2 / (n[1:] + n[:-1])
        scores = np.empty(2 * len(on) - 1)
        scores[0::2], scores[1::2] = on, between
        scores[: 2 * rules.lowest_line] = 0.0
        scores = scores / np.maximum(1.0, _local_median(scores, rules.reach) / MEDIAN_OF_CHI_SQUARE)
        i = int(np.argmax(scores))
        count += len(scores)
        if scores[i] > best[0]:
            best = (float(scores[i]), i / 2, variant)
    score, bin_number, variant = best
    if not variant:
        return Candidate(Term(law, name, law.absent), 0.0, LINE), count
    return _refined_line(projector, law, name, variant, bin_number, score), count


def _local_median(scores: FloatArray, reach: int) -> FloatArray:
    found: FloatArray = median_filter(scores, size=2 * reach + 1, mode="nearest")
    return found


def _refined_line(
    projector: Projector, law: BodyLaw, name: str, variant: str, bin_number: float, rough: float
) -> Candidate:
    """A line with frequency, amplitude and phase refined by exact columns near the bin."""
    grid = projector.grid
    dof = projector.problem.system.mechanics.dofs.index(f"{name}.{variant}")
    time = grid.start + grid.time + CLOCK_LEAD
    best: tuple[float, float, FloatArray] = (-1.0, 0.0, np.zeros(2))
    channel = ScalarResponse.of(projector, projector.of_load[:, :, dof])
    for offset in np.linspace(-0.6, 0.6, 13):
        frequency = (bin_number + offset) / grid.length
        if frequency <= 0:
            continue
        angle = 2 * np.pi * frequency * time
        spectra = grid.forward(np.column_stack([np.sin(angle), np.cos(angle)]))[grid.band]
        score, solution = channel.joint(spectra.T)
        if score > best[0]:
            best = (score, frequency, solution)
    score, frequency, (sine, cosine) = best
    amplitude = float(np.hypot(sine, cosine))
    values = (amplitude, float(frequency), float(np.arctan2(cosine, sine)))
    term = Term(law, name, values, variant, scales=(max(amplitude, 1e-9), 1.0, projector.problem.rules.screening.phase))
    return Candidate(term, min(score, projector.problem.rules.screening.colour * rough), LINE)
