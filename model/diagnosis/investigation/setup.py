"""Wrong set-ups: a sign, two channels exchanged, a whole node late, a wrong scale, a sensor elsewhere than stated.

Such a fault is gross and is no physics, but spring and damper values absorb what they can of it and laws imitate the
rest.  So it is sought before any law: every hypothesis is a change of the recorded signals (or of a sensor's position
in the system file) whose misfit against what the nominal structure shows follows from spectra that are known already;
the best few are fitted.  One is accepted when the structure then explains what it did not explain before.

    misfit of a sensor:  sum |Y - P|^2 / sum |Y|^2   over the compared bins, Y measured, P shown by the structure
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.record.signals import Noise, Signals
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.rules import SetupRules
from sprung.model.schema import MotionSensor, SystemFile
from sprung.model.signals import FloatArray
from sprung.model.system import System

ORDINARY = ("sensor_gain", "sensor_lag")  # that screening seeks; they only have to be beaten
_EDGE = 5  # samples beside a cut that a shift between samples spoils
_STEPS = 4  # of a delay
_ORDERS = {"acceleration": 2, "velocity": 1, "displacement": 0}  # derivatives that a kind shows


@dataclass(frozen=True)
class SetupFault:
    """One accepted fault of the set-up."""

    effect: str  # a word of the contract
    location: str  # channels joined by "|"
    value: float | None  # time s, ratio, offset m
    std: float
    before: float  # misfit of all sensors without and with it
    after: float
    axis: int = 0  # of a position


@dataclass(frozen=True)
class Hypothesis:
    """A fault of the set-up and how to undo it."""

    effect: str
    location: str
    value: float | None
    left: float  # misfit by spectra
    undo: Callable[[System, Signals], tuple[System, Signals]]
    axis: int = 0


def without_setup_faults(
    system: System, signals: Signals, declared: Noise, split: int, problem: Problem, fit: Fit
) -> tuple[System, Signals, tuple[SetupFault, ...]]:
    """System and signals with faults of the set-up undone, and which they were."""
    found: list[SetupFault] = []
    present = misfit(fit)
    rules = problem.rules.setup
    while len(found) < rules.most and float(np.max(present)) > rules.strange:
        best = _best(system, signals, declared, split, problem, fit, present)
        if best is None:
            break
        fault, system, mended, problem, fit = best
        split, signals = fitted_samples(signals, mended, split), mended
        if any(fault.location == known.location for known in found):
            break
        found.append(fault)
        present = misfit(fit)
    return system, signals, tuple(found)


def fitted_samples(whole: Signals, cut: Signals, split: int) -> int:
    """How many samples are fitted of signals that lost some at both ends."""
    return split - (whole.samples - cut.samples) // 2


def misfit(fit: Fit) -> FloatArray:
    """Misfit of every sensor, (S,)."""
    part = fit.forward.part
    return _relative(fit.spectrum[part.grid.band][1:], part.sensors[part.grid.band][1:])


def _relative(error: ComplexArray, measured: ComplexArray) -> FloatArray:
    size = np.maximum(np.sum(np.abs(measured) ** 2, axis=0), 1e-300)
    return np.asarray(np.sum(np.abs(error) ** 2, axis=0) / size)


_Accepted = tuple[SetupFault, System, Signals, Problem, Fit]


def _best(
    system: System,
    signals: Signals,
    declared: Noise,
    split: int,
    problem: Problem,
    fit: Fit,
    present: FloatArray,
) -> _Accepted | None:
    """The hypothesis that explains most, fitted, if one explains enough."""
    rules = problem.rules.setup
    shown = [ModelResponse.of(problem, fit.forward)]
    shown.append(
        ModelResponse.of(problem, Forward(system, fit.forward.part, problem.sensors, np.zeros(len(fit.point.theta))))
    )
    promising: dict[tuple[str, str], Hypothesis] = {}
    for one in shown:
        for hypothesis in one.hypotheses(system, signals):
            key = (hypothesis.effect, hypothesis.location)
            share = replace(hypothesis, left=hypothesis.left / one.total)
            if share.left < rules.promising and (key not in promising or share.left < promising[key].left):
                promising[key] = share
    by_left = sorted(promising.values(), key=lambda h: h.left)
    ranked = [h for h in by_left if h.effect not in ORDINARY][: rules.tried]
    if not ranked:
        return None
    ranked += [h for h in by_left if h.effect in ORDINARY][: rules.beside]
    total, best = float(np.sum(present)), None
    for hypothesis in ranked:
        changed, mended = hypothesis.undo(system, signals)
        try:
            other, again = baseline(
                changed, mended, declared, fitted_samples(signals, mended, split), problem.rules, problem.memory
            )
        except (ValueError, FloatingPointError):
            continue
        left = float(np.sum(misfit(again)))
        if left < rules.explains * total and (best is None or left < best[0].after):
            std = _deviation(hypothesis, left)
            fault = SetupFault(
                hypothesis.effect, hypothesis.location, hypothesis.value, std, total, left, hypothesis.axis
            )
            best = fault, changed, mended, other, again
    if best is None or best[0].effect in ORDINARY:
        return None  # the fault of one sensor: sought with everything else, and judged on the held-out part
    return _sharpened(best, declared, fitted_samples(signals, best[2], split))


def _sharpened(accepted: _Accepted, declared: Noise, split: int) -> _Accepted:
    """A delay or scale estimated again on the structure fitted without it, which had absorbed some of it."""
    fault, system, signals, problem, fit = accepted
    names = fault.location.split("|")
    if fault.value is None:
        return accepted
    at = [signals.sensor_names.index(name) for name in names]
    value = fault.value
    for _ in range(problem.rules.setup.rounds):
        shown = ModelResponse.of(problem, fit.forward)
        if fault.effect == "node_delay":
            change = shown.late(at, 0.0)
            value += change
            undo = _advance_sensors(at, change)
        elif fault.effect == "wrong_scale":
            change = shown.ratio(at)
            value *= change
            undo = _scale_sensors(at, change)
        else:
            change = shown.offset(system, at[0], fault.location, fault.axis)[0]
            value += change
            undo = _move_sensor(fault.location, fault.axis, change)
        system, mended = undo(system, signals)
        split, signals = fitted_samples(signals, mended, split), mended
        problem, fit = baseline(system, signals, declared, split, problem.rules, problem.memory)
    left = float(np.sum(misfit(fit)))
    std = shown.value_deviation(fault.effect, at, fit) * (value if fault.effect == "wrong_scale" else 1.0)
    if fault.effect == "wrong_position":
        std = fault.std
    return replace(fault, value=value, std=std, after=left), system, signals, problem, fit


def _deviation(hypothesis: Hypothesis, left: float) -> float:
    """Rough standard deviation of a fault's value: by what is left of the misfit."""
    return 0.0 if hypothesis.value is None else float(abs(hypothesis.value) * np.sqrt(left) / 3)


@dataclass(frozen=True)
class ModelResponse:
    """What a model makes the sensors show of every input, and what they measured."""

    forward: Forward
    measured: ComplexArray  # (F, S), compared bins without the first
    of_support: ComplexArray  # of each support, (F, S, supports)
    rest: ComplexArray  # of everything else, (F, S)
    motion: ComplexArray  # degrees of freedom, (F, n)
    omega: FloatArray
    step: float
    samples: int
    rules: SetupRules

    @classmethod
    def of(cls, problem: Problem, forward: Forward) -> ModelResponse:
        part, plant = forward.part, forward.plant
        band = slice(1, part.grid.band.stop)
        of_support = plant.sensor_of_support[band] * part.support[band][:, None, :]
        rest = np.einsum("fsi,fi->fs", plant.sensor_of_measured_force[band], part.force[band])
        return cls(
            forward,
            part.sensors[band],
            of_support,
            rest,
            forward.linear_motion[band],
            part.grid.omega[band],
            part.grid.step,
            part.grid.samples,
            problem.rules.setup,
        )

    @property
    def sensors(self) -> ComplexArray:
        """(F, S)."""
        return self.of_support.sum(axis=2) + self.rest

    @property
    def total(self) -> float:
        return float(np.sum(_relative(self.measured - self.sensors, self.measured)))

    def hypotheses(self, system: System, signals: Signals) -> Iterator[Hypothesis]:
        """All of them with the misfit that they leave."""
        yield from self._signs(signals)
        yield from self._exchanges(system, signals)
        yield from self._nodes(system, signals)
        yield from self._positions(system, signals)
        yield from self._ordinary(signals)

    def _ordinary(self, signals: Signals) -> Iterator[Hypothesis]:
        """Gain and lag of single sensors: no faults of a set-up, but what a position may be mistaken for."""
        shown, own = self.sensors, _relative(self.measured - self.sensors, self.measured)
        for i, name in enumerate(signals.sensor_names):
            ratio, late = self.ratio([i]), self.late([i], 0.0)
            turned = np.exp(-1j * self.omega * late)
            for effect, value, answer, undo in (
                ("sensor_gain", ratio, ratio * shown[:, [i]], _scale_sensors([i], ratio)),
                ("sensor_lag", late, turned[:, None] * shown[:, [i]], _advance_sensors([i], late)),
            ):
                alone = _relative(self.measured[:, [i]] - answer, self.measured[:, [i]])[0]
                if ratio > 0 and abs(late) < self.rules.latest:
                    yield Hypothesis(effect, name, value, float(np.sum(own) - own[i] + alone), undo)

    def _signs(self, signals: Signals) -> Iterator[Hypothesis]:
        shown, own = self.sensors, _relative(self.measured - self.sensors, self.measured)
        turned = _relative(self.measured + shown, self.measured)
        for i, name in enumerate(signals.sensor_names):
            left = float(np.sum(own) - own[i] + turned[i])
            yield Hypothesis("sign_reversed", name, None, left, _turn_sensor(i))
        for j, name in enumerate(signals.support_names):
            error = self.measured - shown + 2 * self.of_support[:, :, j]
            yield Hypothesis(
                "sign_reversed", name, None, float(np.sum(_relative(error, self.measured))), _turn_support(j)
            )
        if len(signals.force_names) == 1:
            error = self.measured - shown + 2 * self.rest
            left = float(np.sum(_relative(error, self.measured)))
            yield Hypothesis("sign_reversed", signals.force_names[0], None, left, _turn_force)

    def _exchanges(self, system: System, signals: Signals) -> Iterator[Hypothesis]:
        shown = self.sensors
        own = _relative(self.measured - shown, self.measured)
        kinds = [list(system.file.sensors.values())[i].kind for i in signals.sensor_index]
        for i, j in combinations(range(len(own)), 2):
            if kinds[i] == kinds[j]:
                pair = _relative(self.measured[:, [j, i]] - shown[:, [i, j]], self.measured[:, [j, i]])
                names = f"{signals.sensor_names[i]}|{signals.sensor_names[j]}"
                left = float(np.sum(own) - own[i] - own[j] + np.sum(pair))
                yield Hypothesis("channels_swapped", names, None, left, _exchange_sensors(i, j))
        plant, part = self.forward.plant, self.forward.part
        band = slice(1, part.grid.band.stop)
        for i, j in combinations(range(len(signals.support_names)), 2):
            G, u = plant.sensor_of_support[band], part.support[band]
            change = (G[:, :, i] - G[:, :, j]) * (u[:, j] - u[:, i])[:, None]
            names = f"{signals.support_names[i]}|{signals.support_names[j]}"
            left = float(np.sum(_relative(self.measured - shown - change, self.measured)))
            yield Hypothesis("channels_swapped", names, None, left, _exchange_supports(i, j))

    def _nodes(self, system: System, signals: Signals) -> Iterator[Hypothesis]:
        """Groups of sensors that share a node: late together, or on another scale."""
        shown = self.sensors
        size = np.maximum(np.sum(np.abs(self.measured) ** 2, axis=0), 1e-300)
        own = _relative(self.measured - shown, self.measured)
        lags = (np.arange(self.samples) + self.samples // 2) % self.samples - self.samples // 2
        near = np.abs(lags) * self.step <= self.rules.latest
        full = np.zeros((self.samples // 2 + 1, len(own)), dtype=complex)
        full[1 : len(shown) + 1] = shown.conj() * self.measured / size
        agree = np.fft.irfft(full, self.samples, axis=0)[near] * self.samples
        power = np.sum(np.abs(shown) ** 2, axis=0) / size
        for names, at in groups(system, signals):
            rest = float(np.sum(own) - np.sum(own[at]))
            if len(at) > 1 and len(at) < len(own):
                total = agree[:, at].sum(axis=1)
                best = int(np.argmax(total))
                late = self.late(at, float(lags[near][best] * self.step))
                turned = shown[:, at] * np.exp(-1j * self.omega[:, None] * late)
                left = rest + float(np.sum(_relative(self.measured[:, at] - turned, self.measured[:, at])))
                yield Hypothesis("node_delay", names, late, left, _advance_sensors(at, late))
            ratio = float(np.sum(np.real(full[1 : len(shown) + 1, at])) / max(np.sum(power[at]), 1e-300))
            if ratio > self.rules.scale or 0 < ratio < 1 / self.rules.scale:
                left = rest + float(
                    np.sum(_relative(self.measured[:, at] - ratio * shown[:, at], self.measured[:, at]))
                )
                yield Hypothesis("wrong_scale", names, ratio, left, _scale_sensors(at, ratio))

    def late(self, at: list[int], late: float) -> float:
        """Common delay of a group from a rough one, s, by Gauss-Newton steps between samples."""
        shown, weight = self.sensors[:, at], 1 / np.maximum(np.sum(np.abs(self.measured[:, at]) ** 2, axis=0), 1e-300)
        for _ in range(_STEPS):
            turned = shown * np.exp(-1j * self.omega[:, None] * late)
            slope = -1j * self.omega[:, None] * turned
            step = np.sum(np.real(slope.conj() * (self.measured[:, at] - turned)) * weight)
            late += float(step / max(np.sum(np.abs(slope) ** 2 * weight), 1e-300))
        return late

    def ratio(self, at: list[int]) -> float:
        """Common ratio of measured over shown signals of a group."""
        shown, weight = self.sensors[:, at], 1 / np.maximum(np.sum(np.abs(self.measured[:, at]) ** 2, axis=0), 1e-300)
        product = np.sum(np.real(shown.conj() * self.measured[:, at]) * weight)
        return float(product / max(np.sum(np.abs(shown) ** 2 * weight), 1e-300))

    def value_deviation(self, effect: str, at: list[int], fit: Fit) -> float:
        """Standard deviation of a delay or of the logarithm of a ratio, by what the fit leaves of the group."""
        shown, left = self.sensors[:, at], np.sum(np.abs(fit.spectrum[1 : len(self.omega) + 1, at]) ** 2)
        slope = self.omega[:, None] * shown if effect == "node_delay" else shown
        return float(np.sqrt(left / max(np.sum(np.abs(slope) ** 2), 1e-300) / max(shown.size, 1)))

    def _positions(self, system: System, signals: Signals) -> Iterator[Hypothesis]:
        """Sensors on bodies that turn, elsewhere than the file says: along x or y."""
        shown, own = self.sensors, _relative(self.measured - self.sensors, self.measured)
        listed = list(system.file.sensors.items())
        dofs = list(system.mechanics.dofs)
        for i, index in enumerate(signals.sensor_index):
            name, sensor = listed[int(index)]
            if not isinstance(sensor, MotionSensor):
                continue
            for axis, turn in ((0, "pitch"), (1, "roll")):
                if sensor.kind not in _ORDERS or f"{sensor.body}.{turn}" not in dofs:
                    continue
                offset, change = self.offset(system, i, name, axis)
                if abs(offset) < self.rules.offset:
                    continue
                error = self.measured[:, i] - shown[:, i]
                alone = _relative((error - offset * change)[:, None], self.measured[:, [i]])[0]
                left = float(np.sum(own) - own[i] + alone)
                yield Hypothesis("wrong_position", name, offset, left, _move_sensor(name, axis, offset), axis)

    def offset(self, system: System, i: int, name: str, axis: int) -> tuple[float, ComplexArray]:
        """By how much a sensor sits elsewhere along an axis, m, and what one metre would change, (F,)."""
        sensor = system.file.sensors[name]
        assert isinstance(sensor, MotionSensor)
        dof = system.mechanics.dofs.index(f"{sensor.body}.{('pitch', 'roll')[axis]}")
        change = (1j * self.omega) ** _ORDERS[sensor.kind] * self.motion[:, dof]
        error = self.measured[:, i] - self.sensors[:, i]
        size = max(float(np.sum(np.abs(change) ** 2)), 1e-300)
        return float(np.sum(np.real(change.conj() * error)) / size), change


def groups(system: System, signals: Signals) -> Iterator[tuple[str, list[int]]]:
    """Channels that may share a fault: each alone, those of one body, those of one kind, all."""
    listed = list(system.file.sensors.values())
    present = [listed[int(i)] for i in signals.sensor_index]
    seen: set[tuple[int, ...]] = set()
    bodies = [getattr(sensor, "body", None) for sensor in present]
    kinds = [sensor.kind for sensor in present]
    trials = [[i] for i in range(len(present))]
    trials += [[i for i, b in enumerate(bodies) if b == body] for body in dict.fromkeys(bodies) if body is not None]
    trials += [[i for i, k in enumerate(kinds) if k == kind] for kind in dict.fromkeys(kinds)]
    trials.append(list(range(len(present))))
    for at in trials:
        if tuple(at) not in seen:
            seen.add(tuple(at))
            yield "|".join(signals.sensor_names[i] for i in at), at


_Undo = Callable[[System, Signals], tuple[System, Signals]]


def _with_sensors(change: Callable[[FloatArray, float], FloatArray]) -> _Undo:
    def undo(system: System, signals: Signals) -> tuple[System, Signals]:
        return system, replace(signals, sensors=change(signals.sensors.copy(), signals.sample_rate))

    return undo


def _turn_sensor(i: int) -> _Undo:
    def change(series: FloatArray, rate: float) -> FloatArray:
        series[:, i] *= -1
        return series

    return _with_sensors(change)


def _scale_sensors(at: list[int], ratio: float) -> _Undo:
    def change(series: FloatArray, rate: float) -> FloatArray:
        series[:, at] /= ratio
        return series

    return _with_sensors(change)


def _exchange_sensors(i: int, j: int) -> _Undo:
    def change(series: FloatArray, rate: float) -> FloatArray:
        series[:, [i, j]] = series[:, [j, i]]
        return series

    return _with_sensors(change)


def _advance_sensors(at: list[int], late: float) -> _Undo:
    """Sensors earlier by a delay; what they no longer have at the ends is cut off of all signals."""

    def undo(system: System, signals: Signals) -> tuple[System, Signals]:
        series, rate = signals.sensors.copy(), signals.sample_rate
        time = np.arange(len(series)) / rate
        line = series[:1, at] + (series[-1:, at] - series[:1, at]) * (time / time[-1])[:, None]
        omega = 2 * np.pi * np.fft.rfftfreq(len(series), 1 / rate)
        spectrum = np.fft.rfft(series[:, at] - line, axis=0) * np.exp(1j * omega * late)[:, None]
        series[:, at] = np.fft.irfft(spectrum, len(series), axis=0) + line
        lost = int(np.ceil(abs(late) * rate)) + _EDGE
        return system, replace(signals, sensors=series).part(lost, len(series) - lost)

    return undo


def _turn_support(j: int) -> _Undo:
    def undo(system: System, signals: Signals) -> tuple[System, Signals]:
        displacement, velocity = signals.displacement.copy(), signals.velocity.copy()
        displacement[:, j] *= -1
        velocity[:, j] *= -1
        return system, replace(signals, displacement=displacement, velocity=velocity)

    return undo


def _exchange_supports(i: int, j: int) -> _Undo:
    def undo(system: System, signals: Signals) -> tuple[System, Signals]:
        displacement, velocity = signals.displacement.copy(), signals.velocity.copy()
        displacement[:, [i, j]], velocity[:, [i, j]] = displacement[:, [j, i]], velocity[:, [j, i]]
        return system, replace(signals, displacement=displacement, velocity=velocity)

    return undo


def _turn_force(system: System, signals: Signals) -> tuple[System, Signals]:
    return system, replace(signals, force=-signals.force)


def _move_sensor(name: str, axis: int, offset: float) -> _Undo:
    def undo(system: System, signals: Signals) -> tuple[System, Signals]:
        sensor = system.file.sensors[name]
        assert isinstance(sensor, MotionSensor)
        position = list(sensor.position or system.file.bodies[sensor.body].position)
        position[axis] += offset
        moved = sensor.model_copy(update={"position": (position[0], position[1])})
        file: SystemFile = system.file.model_copy(update={"sensors": {**system.file.sensors, name: moved}})
        return System(file), signals

    return undo
