"""Filters of sensors as candidates: high-pass filters of accelerometers, and resonances on their mountings.

A filter H shows (H - 1) y beside the truth y.  It is sought at trial corners or frequencies over what the record shows:
a resonance for every sensor alone, what instruments of a kind usually share also for those of a body and for all.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.screening.families import FILTER
from sprung.model.diagnosis.screening.score import Candidate, Projector, ScalarResponse
from sprung.model.laws import Law, SensorLaw
from sprung.model.schema import MotionSensor
from sprung.model.signals import FloatArray

_SHORTER, _LONGER = 0.3, 3.0  # of a trial's corner, to which its amplitude moves the start of a fit


def filter_candidates(projector: Projector, laws: tuple[Law, ...]) -> Iterator[tuple[Candidate, int]]:
    """The best trial of every filter, in each of its forms, at every sensor or group that may have it."""
    filters = [law for law in laws if isinstance(law, SensorLaw) and law.filters and "sensor" in law.at]
    if not filters:
        return
    channels, least = _Channels(projector), FILTER.look_elsewhere(projector.problem.rules.screening)
    for law in filters:
        trials = {variant: _Trials.of(projector, form) for variant, form in [("", law), *law.forms.items()]}
        for members in _groups(projector, law):
            seen = channels.together(members)
            for variant, form in [("", law), *law.forms.items()]:
                count = len(trials[variant].values)
                if not count:
                    break  # it would be beyond what the record shows
                best = _best(channels, Term(form, "", form.absent, variant), trials[variant], members, seen)
                yield best, count
                if best.score <= least:
                    break  # its other forms resemble it, and show as little


class _Channels:
    """What the sensors show, in products with the residual, the projection's basis and each other."""

    def __init__(self, projector: Projector) -> None:
        problem, fit, grid = projector.problem, projector.fit, projector.grid
        self.projector = projector
        self.truth = problem.shown_of_smoothed(fit.forward, fit.spectrum)[grid.band]
        weighted = projector.factor * grid.weight[:, None, None]
        whitened = weighted.conj().transpose(0, 2, 1)
        self._product = (whitened @ projector.complex_residual[:, :, None])[:, :, 0]
        self._inside = whitened @ projector.complex_q
        self._gram = whitened @ weighted

    def together(self, members: tuple[int, ...]) -> ScalarResponse:
        """Of sensors that all show a scalar spectrum times their truth beside it."""
        at = list(members)
        conjugate = self.truth[:, at].conj()
        product = np.einsum("fi,fi->f", conjugate, self._product[:, at])
        inside = np.einsum("fi,fiq->fq", conjugate, self._inside[:, at])
        size = np.einsum("fi,fij,fj->f", conjugate, self._gram[:, at][:, :, at], conjugate.conj(), optimize=True)
        return ScalarResponse(product, size.real, inside)

    def scored(self, members: tuple[int, ...], change: ComplexArray) -> tuple[float, float]:
        """Score and amplitude of one spectrum, with the derivative of the log determinant."""
        projector, band, at = self.projector, self.projector.grid.band, list(members)
        shown = np.zeros_like(self.truth)
        shown[:, at] = self.truth[:, at] * change[:, None]
        column = projector.pack((projector.factor @ shown[:, :, None])[:, :, 0])
        of_inputs = np.zeros_like(projector.fit.forward.of_inputs[band])
        of_inputs[:, at] = projector.fit.forward.of_inputs[band][:, at] * change[:, None, None]
        return projector.score(column, (projector.spread(column, of_inputs), 0.0))


class _Trials(NamedTuple):
    """Values of a filter that are tried, and what it then adds to a signal, per truth."""

    values: FloatArray  # (trials, P)
    changes: ComplexArray  # (trials, F)

    @classmethod
    def of(cls, projector: Projector, law: SensorLaw) -> _Trials:
        """Over what the record shows."""
        assert law.trials is not None and law.response is not None
        grid = projector.grid
        omega = grid.omega[grid.band]
        values = law.trials(1 / grid.length, float(omega[-1]) / (2 * np.pi))
        changes = [section.at(1j * omega) - 1 for one in values for section in law.response(one).sections]
        return cls(values, np.array(changes))


def _groups(projector: Projector, law: SensorLaw) -> list[tuple[int, ...]]:
    """Sensors that may have a filter, by their index among those present: each alone, and those that may share it."""
    system = projector.problem.system
    sensors = [system.file.sensors[system.sensors[index]] for index in projector.problem.sensors]
    able = [i for i, sensor in enumerate(sensors) if sensor.kind in law.kinds]
    found: list[tuple[int, ...]] = [(i,) for i in able]
    if law.shared:
        of_body: dict[str, list[int]] = {name: [] for name in system.bodies}
        for i in able:
            sensor = sensors[i]
            if isinstance(sensor, MotionSensor):
                of_body[sensor.body].append(i)
        found += [tuple(group) for group in (*of_body.values(), able) if len(group) > 1]
    return list(dict.fromkeys(found))


def _best(
    channels: _Channels, absent: Term, trials: _Trials, members: tuple[int, ...], seen: ScalarResponse
) -> Candidate:
    """The best trial at sensors that share a filter; absent: the filter without place and values."""
    problem, law = channels.projector.problem, absent.law
    scores, amplitudes = seen.scores(trials.changes)
    best = int(np.argmax(np.where(amplitudes > 0, scores, -1.0)))
    score, amplitude = float(scores[best]), float(amplitudes[best])
    if problem.process_noise:
        score, amplitude = channels.scored(members, trials.changes[best])
    values = trials.values[best].copy()
    if np.isfinite(law.absent[0]):  # at first order, what it adds grows with the value
        values[0] *= np.clip(amplitude, _SHORTER, _LONGER)
    names = "|".join(problem.system.sensors[problem.sensors[i]] for i in members)
    term = replace(absent, location=names, scales=tuple(map(float, values))).at(values)
    return Candidate(term, score if amplitude > 0 else 0.0, FILTER)
