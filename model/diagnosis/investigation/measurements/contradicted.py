"""A sensor that the other sensors of its bodies contradict, whatever it shows instead of their motion.

Sensors of one kind show y = S x of the motion x of the bodies.  Where they are more than its degrees of freedom, there
are combinations that no motion reaches: the parity space, N^T y = 0 with N^T S = 0, for any force, known or not (Chow
and Willsky 1984).  What is seen there is a fault of one of them, or a body that is not rigid.  Which one it is, a bank
of models tells, each identified without one sensor (dedicated observers, Clark 1978): without the faulty one, the
others of its group show no more than noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from sprung.model.diagnosis.fit.baseline import settled
from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.investigation.configuration.effects import SENSOR_POSITION
from sprung.model.diagnosis.investigation.configuration.fitted import SetupFault
from sprung.model.diagnosis.investigation.measurements.error_form import form_of
from sprung.model.diagnosis.investigation.measurements.floor import (
    is_unexplained,
    leaves_more_than_noise,
    with_noise_anew,
)
from sprung.model.diagnosis.investigation.state import Contradiction, Investigation
from sprung.model.diagnosis.record.signals import drifting, transform
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.mechanics import ACCELERATION, DISPLACEMENT, VELOCITY
from sprung.model.signals import FloatArray

_RANK = 1e-9  # of the largest singular value
_CONNECTED = 1e-6  # of a projection onto the parity space, whose entries are at most 1


def without_contradicted(state: Investigation) -> Investigation | None:
    """The investigation without the sensor that the others contradict; None if there is no such sensor.

    Sensors of groups whose parity is violated are left out, each once.  Without the faulty one, no more than noise is
    left of the others of its group; to leave out one of these is worse.
    """
    if state.calibrations is not None or not is_unexplained(state):
        return None
    rules = state.options.rules.acceptance
    for group in violated(state):
        ranked = sorted(((left_out(state, i), i) for i in group), key=lambda one: one[0].fit.chi_square)
        (rest, sensor), (second, _) = ranked[:2]
        # left-out sensors differ in their own noise, too, of twice as many degrees of freedom as bins
        by_chance = np.sqrt(8 * len(rest.problem.part.grid.omega[rest.problem.part.grid.band])) * rest.fit.reduced
        clearly = second.fit.chi_square - rest.fit.chi_square > rules.isolated * by_chance
        rest = with_noise_anew(rest)
        others = [state.signals.sensor_names[i] for i in group if i != sensor]
        if clearly and not leaves_more_than_noise(rest, others):
            return replace(rest, contradictions=(*state.contradictions, _described(state, rest, sensor)))
    return None


def without_misplaced(state: Investigation) -> Investigation:
    """The investigation without sensors that sit elsewhere than the file says, where others show the same motion.

    What their estimated positions leave would hide unmodelled dynamics, or be taken for it.
    """
    for fault in state.setup_faults:
        if fault.effect is not SENSOR_POSITION or not is_compared(state, fault):
            continue
        sensor = state.signals.sensor_names.index(fault.site.location)
        if any(sensor in members for members, _, _ in _groups(state)):
            state = screened_anew(with_noise_anew(left_out(state, sensor)), state)
    return state


def is_compared(state: Investigation, fault: SetupFault) -> bool:
    """Whether the sensor of a fault of the set-up is among those that are compared."""
    return fault.site.location in state.signals.sensor_names


def violated(state: Investigation) -> list[list[int]]:
    """Groups of sensors whose parity is violated, as positions among the present sensors.

    That is by more than their noise, as declared and with a margin, and than gains within their data sheets make of
    what they show, in a stretch of the spectrum or in a single bin.
    """
    part, rules = state.problem.part, state.options.rules
    shown = part.sensors[part.grid.band][1:]
    sheets = state.system.tolerances[-len(state.system.sensors) :]
    gains = np.array([sheets[index].gain for index in state.signals.sensor_index])
    off = np.hypot(rules.plausible.calibration * gains, rules.verdict.least) * np.abs(shown)
    by_chance = float(np.log(len(shown) / rules.acceptance.alpha))  # of the largest of exponential powers
    found: list[list[int]] = []
    for members, level, parity in _groups(state):
        leak = (off[:, members] / level) ** 2 @ parity**2
        power = np.mean(np.abs((shown[:, members] / level) @ parity) ** 2 / (1 + leak), axis=1)
        of_stretches = [np.mean(stretch) for stretch in np.array_split(power, rules.report.stretches)]
        found += [members] if max(of_stretches) > 1 or np.max(power) > by_chance else []
    return found


def _groups(state: Investigation) -> Iterator[tuple[list[int], FloatArray, FloatArray]]:
    """Groups of sensors with a parity space: positions (m,), noise (m,), a basis of the space in units of it, (m, r).

    Noise is as declared, with a margin, and times what most sensors have more of it than declared.
    """
    usual = float(np.median(state.problem.noise.sensors / state.declared.sensors))
    level = state.options.rules.verdict.slack * max(1.0, usual) * state.declared.sensors
    mechanics, sensors = state.system.mechanics, state.signals.sensor_index
    for kind in (ACCELERATION, VELOCITY, DISPLACEMENT):
        alike = np.flatnonzero(mechanics.sensor_kind[sensors] == kind)
        for group, parity in parity_groups(mechanics.S[sensors[alike]] / level[alike, None]):
            members = alike[group]
            yield members.tolist(), level[members], parity


def parity_groups(rows: FloatArray) -> list[tuple[np.ndarray, FloatArray]]:
    """Groups of sensors with a parity space of their own: positions (m,), and an orthonormal basis of it, (m, r).

    rows: what every sensor shows of the degrees of freedom, in units of its noise, (S, n).
    """
    if not len(rows):
        return []
    u, values, _ = np.linalg.svd(rows)
    basis = u[:, int(np.sum(values > _RANK * max(values.max(initial=0.0), 1e-300))) :]
    projection = basis @ basis.T
    _, label = connected_components(np.abs(projection) > _CONNECTED, directed=False)
    groups = []
    for one in range(label.max() + 1):
        members = np.flatnonzero(label == one)
        values, vectors = np.linalg.eigh(projection[np.ix_(members, members)])  # values of a projection are 0 and 1
        if len(members) > 1 and values[-1] > 0.5:
            groups.append((members, vectors[:, values > 0.5]))
    return groups


def left_out(state: Investigation, sensor: int) -> Investigation:
    """An investigation without one of its sensors, (its position), fitted again under the declared noise of the others.

    What was estimated beside the sensor may have taken its error for their noise.
    """
    kept = np.delete(np.arange(len(state.signals.sensor_index)), sensor)
    name = state.signals.sensor_names[sensor]
    signals = replace(
        state.signals,
        sensors=state.signals.sensors[:, kept],
        sensor_index=state.signals.sensor_index[kept],
        sensor_names=tuple(state.signals.sensor_names[i] for i in kept),
    )
    levels = {"sensors": state.declared.sensors[kept], "least": state.declared.least[kept]}
    declared, noise = replace(state.declared, **levels), replace(state.problem.noise, **levels)
    first, differentiated = signals.part(0, state.held.split), drifting(state.system, signals.sensor_index)
    part = transform(first, noise, state.options.rules.record, differentiated=differentiated)
    problem = replace(state.problem, part=part, sensors=signals.sensor_index, noise=noise)
    terms = tuple(term for term in state.fit.point.terms if term.location != name)
    start = problem.with_filters_anew(replace(state.fit.point, warm_start=(), terms=terms))
    return replace(
        state,
        signals=signals,
        declared=declared,
        problem=problem,
        fit=settled(problem, optimise(problem, start, problem.rules.fit.restarted)),
        held=replace(state.held, signals=signals, noise=noise),
        found=tuple(one for one in state.found if one.trial.term.location != name),
    )


def screened_anew(state: Investigation, base: Investigation) -> Investigation:
    """An investigation without a sensor, with the nominal structure and the candidates that go with it.

    base: the investigation with the sensor.
    """
    fit = state.fit
    if state.found:
        out = {*base.signals.sensor_names} - {*state.signals.sensor_names}
        given = tuple(term for term in base.base.point.terms if term.location not in out)
        start = state.problem.with_filters_anew(replace(base.base.point, warm_start=(), terms=given))
        fit = settled(state.problem, optimise(state.problem, start, state.options.rules.fit.restarted))
    screening = screen(state.problem, state.fit, state.system.catalogue, state.options.project)
    return replace(state, base=fit, first=screening, last=screening)


def _described(state: Investigation, rest: Investigation, sensor: int) -> Contradiction:
    """What a sensor shows beside the motion by the model that was identified without it."""
    run = state.held.run(state.problem.with_filters_anew(rest.fit.point))
    name = state.signals.sensor_names[sensor]
    unit = next(channel.unit for channel in state.system.channels if channel.name == name)
    others = dict(zip(rest.signals.sensor_names, rest.signals.sensors[state.held.split :].T, strict=True))
    form = form_of(run.simulated[:, sensor], run.measured[:, sensor], others, state.signals.sample_rate, unit)
    return Contradiction(name, float(run.per_sensor[sensor]), form)
