"""Faults of measurements as candidates, told from physics by redundancy and by causality.

A wrong sensor is wrong alone: its residual is a copy (gain), a derivative (lag) or a constant (bias), while the
other sensors on the same rigid body and the bodies that it would act on contradict it; the projection and the joint
whitening of `Projector` do that weighing.  Input channels have a witness of their own, the second measurement of the
same support (`measured`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy import stats

from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.forward import BOTH, DELAY
from sprung.model.diagnosis.response.terms import Term, supports
from sprung.model.diagnosis.screening.places import wheelsets
from sprung.model.diagnosis.screening.score import Hit, Projector
from sprung.model.laws import Law, ParameterSpec, SensorLaw
from sprung.model.signals import FloatArray


def measurement_hits(projector: Projector, laws: tuple[Law, ...]) -> Iterator[tuple[Hit, int]]:
    """Gain, lag and bias of every sensor and input channel."""
    by_name = {law.name: law for law in laws if isinstance(law, SensorLaw)}
    yield from _sensor_hits(projector, by_name)
    yield from _input_hits(projector, by_name)


def _sensor_hits(projector: Projector, laws: dict[str, SensorLaw]) -> Iterator[tuple[Hit, int]]:
    problem, fit, grid = projector.problem, projector.fit, projector.grid
    band = grid.band
    truth = problem.shown_of_smoothed(fit.forward, fit.spectrum)[band]
    constant = np.zeros(len(truth), dtype=complex)
    constant[0] = np.sqrt(grid.samples)
    jw = 1j * grid.omega[band]
    own = np.eye(len(problem.sensors))[:, None, :, None] * fit.forward.of_inputs[band]  # of one sensor each
    for i, index in enumerate(problem.sensors):
        name = problem.system.sensors[index]
        for effect, signal in (
            ("sensor_gain", truth[:, i]),
            ("sensor_lag", -jw * truth[:, i]),
            ("sensor_bias", constant),
        ):
            if effect not in laws or (effect == "sensor_bias" and problem.part.rated[i]):
                continue  # a position that is compared by its rate shows no bias
            column = projector.pack(projector.factor[:, :, i] * signal[:, None])
            copied = {"sensor_gain": 1.0, "sensor_lag": -jw[:, None, None]}.get(effect, 0.0)
            score, amplitude = projector.score(column, (projector.spread(column, own[i] * copied), 0.0))
            start = 1.0 + amplitude if effect == "sensor_gain" else amplitude
            scale = {"sensor_gain": 0.1, "sensor_lag": 0.1 * grid.step}.get(effect, max(abs(amplitude), 1e-9))
            term = Term(laws[effect], name, (float(start),), scales=(scale,))
            yield Hit(term, score, 1, "sensor", float(stats.chi2.sf(score, 1))), 1
            if effect == "sensor_lag":
                for other in (
                    Term(laws[effect], name, (float(start),), DELAY, scales=(scale,)),
                    Term(_with_delay(laws[effect]), name, (float(start), 0.0), BOTH, scales=(scale, scale)),
                ):
                    yield Hit(other, 0.999 * score, 1, "sensor", float(stats.chi2.sf(0.999 * score, 1))), 1


def _with_delay(law: SensorLaw) -> SensorLaw:
    """A first-order lag with a transport delay besides."""
    delay = ParameterSpec("delay", "s", -1.0, 1.0, "transport delay besides the lag", lambda seen: 0.001)
    return replace(law, parameters=(*law.parameters, delay))


def _input_hits(projector: Projector, laws: dict[str, SensorLaw]) -> Iterator[tuple[Hit, int]]:
    """Gain and lag of the channels of supports that are measured twice, and gain of forces."""
    problem, grid = projector.problem, projector.grid
    part, noise = problem.part, problem.noise
    band = grid.band
    omega = grid.omega[band]
    G = projector.of_support
    names = supports(problem.system)
    for at, support in enumerate(part.pairs):
        precision_d = 1 / noise.displacement[support] ** 2
        precision_v = (omega / noise.velocity[support]) ** 2
        share_d = precision_d / (precision_d + precision_v)
        integrated = noise.velocity[support] / np.maximum(omega, omega[1])
        spread = np.hypot(noise.displacement[support], integrated)
        periodic = part.support[band, support]
        witness = part.redundancy[band, at]
        for channel, share, sign in (("displacement", share_d, -1.0), ("velocity", 1 - share_d, 1.0)):
            for effect, signal in (("sensor_gain", periodic), ("sensor_lag", -1j * omega * periodic)):
                if effect not in laws:
                    continue
                column = projector.pack(-G[:, :, support] * (share * signal)[:, None])
                beside = _pack(sign * signal / spread, grid.weight)
                shown = _pack(witness / spread, grid.weight)
                score, amplitude = projector.score(column, (float(beside @ shown), float(beside @ beside)))
                start = 1.0 + amplitude if effect == "sensor_gain" else amplitude
                scale = 0.1 if effect == "sensor_gain" else 0.1 * grid.step
                term = Term(laws[effect], f"{names[support]}.{channel}", (float(start),), scales=(scale,))
                yield Hit(term, score, 1, "input", float(stats.chi2.sf(score, 1))), 1
    if "axle_delay" in laws:
        yield from _axle_hits(projector, laws["axle_delay"])
    yield from _force_hits(projector, laws)


def _axle_hits(projector: Projector, law: SensorLaw) -> Iterator[tuple[Hit, int]]:
    """Both wheels of an axle late together, all that is measured of them: no witness but the vehicle."""
    part, grid = projector.problem.part, projector.grid
    system = projector.problem.system
    names = supports(system)
    for location in wheelsets(system):
        at = [names.index(wheel) for wheel in location.split("|")]
        late = 1j * grid.omega[grid.band, None] * part.support[grid.band][:, at]
        score, amplitude = projector.score(
            projector.pack(np.einsum("fsa,fa->fs", projector.of_support[:, :, at], late))
        )
        term = Term(law, location, (float(amplitude),), scales=(0.1 * grid.step,))
        yield Hit(term, score, 1, "input", float(stats.chi2.sf(score, 1))), 1


def _force_hits(projector: Projector, laws: dict[str, SensorLaw]) -> Iterator[tuple[Hit, int]]:
    """Gain and offset of measured forces."""
    problem, fit, grid = projector.problem, projector.fit, projector.grid
    part, band = problem.part, grid.band
    names = [n for n, s in problem.system.file.inputs.items() if s.kind == "force"]
    plant = fit.forward.plant
    for i, name in enumerate(names):
        direction = plant.structure.F[:, i]
        response = projector.of_load @ direction
        effects = []
        if "sensor_gain" in laws:
            effects.append(("sensor_gain", projector.pack(-response * part.force[band, i, None])))
        if "sensor_bias" in laws:
            load = np.zeros((part.force_polynomial.shape[0], len(direction)))
            load[0] = -direction  # the true force is the measured one less the offset
            q = plant.polynomial_response(load)
            shown = plant.polynomial_sensors(q, np.zeros_like(part.support_polynomial))
            spectrum = (grid.monomial_spectra @ shown)[band] * fit.forward.sensor_factor[band]
            effects.append(("sensor_bias", projector.pack((projector.factor @ spectrum[:, :, None])[:, :, 0])))
        for effect, column in effects:
            score, amplitude = projector.score(column)
            start = 1.0 + amplitude if effect == "sensor_gain" else amplitude
            term = Term(laws[effect], name, (float(start),), scales=(max(abs(amplitude), 1e-9),))
            yield Hit(term, score, 1, "force", float(stats.chi2.sf(score, 1))), 1


def _pack(spectrum: ComplexArray, weight: FloatArray) -> FloatArray:
    weighted = spectrum * weight
    return np.concatenate([weighted.real, weighted.imag])
