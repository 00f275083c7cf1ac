"""A slab on sliding bearings in an earthquake: its simulation without friction is far from its motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.signal import resample_poly

from sprung.model.diagnosis.api import diagnose
from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.fit.misfit import misfit
from sprung.model.diagnosis.fit.optimise import try_optimise
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.screening.families import ELEMENT
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.selection.along_measured import MeasuredMotion
from sprung.model.laws.damping import COULOMB_FRICTION
from sprung.model.signals import FloatArray
from sprung.model.system import parse_system

RATE, MASS, RADIUS = 100.0, 1000.0, 1.5
FAST, SLOW, CHANGES = 785.0, 295.0, 1 / 30  # N, N, m/s: friction of the bearings
SLAB = """
name: slab on sliding bearings
sample_rate: 100
window: 200
bodies: {slab: {mass: {value: 1000, fixed: true}}}
inputs: {table: {kind: support, acceleration: {csv: ground, noise: 0.003}}}
elements: {bearing: {upper: slab, lower: table, stiffness: 6500, damping: 1500}}
sensors:
  a: {kind: acceleration, body: slab, csv: a, noise: 0.003}
  d: {kind: deflection, element: bearing, csv: d, noise: 2.0e-5}
"""


@dataclass
class Earthquake:
    values: FloatArray
    sample_rate: float = RATE
    lost: int = 0


def earthquake(seconds: float = 20.0, fine: int = 40, slow: float = SLOW, *, filtered: bool = False) -> Earthquake:
    """Ground acceleration like an earthquake's, and the slab's acceleration and slide, by steps of 0.25 ms.

    slow: friction at creeping rates, N.  filtered: whether the slab's channels pass an anti-alias filter.
    """
    random, samples = np.random.default_rng(4), int(seconds * RATE)
    time, frequency = np.arange(samples) / RATE, np.fft.rfftfreq(samples, 1 / RATE)
    shape = (frequency > 0.25) / np.sqrt((1 - (frequency / 2.5) ** 2) ** 2 + (frequency / 2) ** 2)
    spectrum = np.fft.rfft(random.standard_normal(samples)) * shape / (1 + (frequency / 15) ** 8)
    quake = np.fft.irfft(spectrum, samples) * np.minimum(time / 2, 1) * np.exp(-np.maximum(time - 10, 0) / 6)
    quake *= 3.5 / np.max(np.abs(quake))
    ground = fine * np.fft.irfft(np.fft.rfft(quake), samples * fine)
    x = v = 0.0
    shown, step = np.empty((samples * fine, 2)), 1 / (RATE * fine)
    for i, pushed in enumerate(ground):
        friction = np.tanh(v / 1e-3) * (FAST + (slow - FAST) * np.exp(-abs(v) / CHANGES))
        a = -(MASS * 9.81 / RADIUS * x + 300.0 * v + friction) / MASS
        shown[i] = a, x
        v += step * (a - pushed)
        x += step * v
    values = np.column_stack([quake, resample_poly(shown, 1, fine, axis=0) if filtered else shown[::fine]])
    return Earthquake(values + random.standard_normal(values.shape) * [0.003, 0.003, 2e-5])


def _with_corner(point: Point, corner: float) -> Point:
    term = point.terms[-1]
    values = np.array(term.parameters)
    values[1] = corner
    return replace(point, terms=(*point.terms[:-1], term.at(values)))


@pytest.mark.slow
def test_what_is_fitted_along_the_measured_motion_begins_near_the_truth() -> None:
    system, record = parse_system(SLAB), earthquake()
    signals = prepare(system, record.values, RATE).signals
    problem, base = baseline(system, signals, declared_noise(system, signals), signals.samples)
    assert np.sqrt(np.mean(misfit(base))) > problem.rules.selection.gross
    measured = MeasuredMotion.of(problem, base)
    assert measured is not None
    term = Term(COULOMB_FRICTION, "bearing", (300.0, 0.01), scales=(300.0, 0.01))
    narrow, wide = measured.starts(Candidate(term, 1.0, ELEMENT))
    assert narrow.terms[-1].parameters[0] == pytest.approx(650, rel=0.15)  # one constant for both
    force, corner, slow, rate = wide.terms[-1].parameters
    assert corner > 30e-3  # blunt: the true one is 1e-3
    assert force == pytest.approx(FAST, rel=0.1) and slow == pytest.approx(SLOW, rel=0.15)
    assert rate == pytest.approx(CHANGES, rel=0.3)
    # down to the noise, and to a few percent of the motion: sticking, it depends on the last digits of the values, and
    # how far a fit gets on those of the corner from which it begins
    starts = [_with_corner(wide, factor * corner) for factor in (0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 1.0, 1.1, 1.2)]
    fits = [fit for start in starts if (fit := try_optimise(problem, start, 20, base.whitener)) is not None]
    simulated = min(fits, key=lambda fit: fit.chi_square)
    assert simulated.reduced < 1.2 and float(np.max(misfit(simulated))) < 2e-3
    assert simulated.point.terms[-1].parameters[0] == pytest.approx(FAST, rel=0.01)


@pytest.mark.slow
def test_a_step_is_not_rejected_for_the_free_motion_beside_it_alone() -> None:
    """A slowly decaying motion that friction dominates: no step from there was accepted, the right ones included."""
    system, record = parse_system(SLAB), earthquake(slow=FAST, filtered=True)
    signals = prepare(system, record.values, RATE).signals
    problem, base = baseline(system, signals, declared_noise(system, signals), signals.samples)
    truth = np.log([MASS * 9.81 / RADIUS / 6500, 300 / 1500])
    blunt = Term(COULOMB_FRICTION, "bearing", (760.0, 0.04), scales=(300.0, 0.01))
    start = Point(truth + 0.03, (blunt,), np.zeros(2))
    begun, fit = (try_optimise(problem, start, steps, base.whitener) for steps in (1, 12))
    assert begun is not None and fit is not None
    assert fit.reduced < 0.1 * begun.reduced
    force, corner = fit.point.terms[0].parameters
    assert force == pytest.approx(FAST, rel=0.03) and corner < 0.01  # 1e-3, far below the rate's change in a sample
    assert fit.point.theta[0] == pytest.approx(truth[0], abs=0.01)


@pytest.mark.slow
def test_friction_that_changes_the_whole_motion_is_named_with_its_values() -> None:
    report = diagnose(parse_system(SLAB), earthquake())
    (first,) = (finding for finding in report.findings if finding.effect != "preload")
    assert (first.location, first.effect) == ("bearing", "coulomb_friction")
    values = {p.name: p.value for p in first.parameters}
    assert values["force"] == pytest.approx(FAST, rel=0.03) and values["slow_force"] == pytest.approx(SLOW, rel=0.05)
