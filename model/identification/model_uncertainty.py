"""Systematic uncertainty of the estimates from masses, inertias and positions in the system file, and from sampling.

A window cannot distinguish a heavier axle from softer springs: the scale of all forces comes from the masses alone.
Masses are therefore taken as stated, and their uncertainty is propagated to the estimates.  With the normal matrix A
summed over the windows of an average ride, and r the change of the sensors' signals for one uncertain constant that is
one standard deviation off, the estimate x is biased by

    D = (A_xx + prior)^-1 J_x' r,        covariance of x from all constants: sum of D D'

For a tracker, x contains parameters, loads, and gains and delays of channels (a sensor that measures force directly
contradicts wrong masses, which then appears as its gain).  A tracker averages so many windows that it would soon claim
to know a spring better than anybody knows a bogie's mass; it therefore assigns small default uncertainties to constants
for which the file states none: masses, inertias, positions of springs and sensors.  Constants that are off by more than
three of these no longer fit, which is reported; what fits is within three standard deviations.

Laws add a sampling error: a stop so stiff that its body bounces on it at a fifth of the sample rate is simulated
between samples to some thousandths of its force only, with the same error in every window.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.likelihood.gauss_newton import Linearisation, WindowBatch
from sprung.model.identification.likelihood.linearise import PRIOR_STD, WindowModel, as_rows
from sprung.model.identification.measurements.calibration import DeviationSensitivity
from sprung.model.identification.measurements.deviations import deviations
from sprung.model.laws import ElementLaw
from sprung.model.schema import ElementSensor, SystemFile
from sprung.model.signals import FloatArray
from sprung.model.simulate.linear import Discrete, LinearSimulator
from sprung.model.system import System

TOGETHER_STD = 0.01  # relative, common to all masses without `std` (bogies of one drawing); no window shows it
MASS_STD = 0.005  # relative, of each of them beside that; four times as much fits no window
INERTIA_STD = 0.005  # relative, of a roll or pitch inertia beyond that of its mass; likewise
# of a body's furthest point, of where springs and sensors are: 3 mm on a bogie, 2 cm on a car; likewise
PLACE_STD = 0.002
INERTIAS = "roll_inertia", "pitch_inertia"
_WINDOWS = 8  # of the simulated reference ride; sensitivities differ little between them
_RIDE = 120.0  # windows that a tracker soon has averaged
_BOUNCE = 4.0  # relative error of a law's stiffness by (bounce / sample rate)^4; measured: 0.6 % at 0.195, none at 0.09
_STEP = 0.1  # of a standard deviation: small enough to be linear


@dataclass(frozen=True, slots=True, eq=False)
class ModelUncertainty:
    """Covariances of the estimates due to uncertain constants and to sampling."""

    parameters: FloatArray  # of the log-ratios, shape (P, P)
    deviations: FloatArray  # of gains, delays and loads, see `measurements.deviations`, shape (H, H)

    @property
    def none(self) -> bool:
        """Whether there is none."""
        return not self.parameters.any()


def model_uncertainty(system: System, *, loads: bool, tracked: bool = False) -> ModelUncertainty:
    """Systematic uncertainty of the estimates of a system; loads: with its loads unknown.

    tracked: for a tracker, which also estimates gains and delays, and assigns default uncertainties to masses and
    positions.  With laws, or without measured inputs, masses are taken as exact; for laws see `sampling_uncertainty`.
    """
    H = len(deviations(system))
    none = ModelUncertainty(np.diag(sampling_uncertainty(system)), np.zeros((H, H)))
    if system.laws or system.on_track or not system.file.inputs or not system.bodies:
        return none
    wrong = [*_masses(system.file, system.doubtful_masses)]
    if tracked:
        wrong += [
            *_together(system),
            *_masses(system.file, _unstated_masses(system)),
            *_inertias(system),
            *_places(system.file),
        ]
    return _computed(system, wrong, loads, tracked) if wrong else none


def sampling_uncertainty(system: System) -> FloatArray:
    """Variances (P,) of the log-ratios of law stiffnesses due to sampling, by the bounce frequency of their bodies."""
    mechanics, names = system.whole_system.mechanics, [p.name for p in system.tracked]
    found = np.zeros(len(names))
    for placed in system.laws:
        if not isinstance(placed.law, ElementLaw) or len(placed.places) > 1:
            continue
        element = system.elements.index(placed.location)
        mobility = float(mechanics.H[element] ** 2 @ (1 / mechanics.mass))  # 1/kg
        for spec, name, value in zip(placed.law.parameters, placed.names, placed.values, strict=True):
            if spec.unit == "N/m" and name in names:
                bounce = np.sqrt((mechanics.stiffness[element] + abs(value)) * mobility) / (2 * np.pi)
                found[names.index(name)] = (_BOUNCE * (bounce / system.sample_rate) ** 4) ** 2
    return found


def _computed(system: System, wrong: list[SystemFile], loads: bool, tracked: bool) -> ModelUncertainty:
    P, stated = len(system.parameters), deviations(system)
    model = WindowModel(system, system.window)
    runs = simulate_runs(system, np.zeros((_WINDOWS, P)), system.window, np.random.default_rng(0))
    loading = model.simulator.loading
    X = len(loading) if tracked else loading.of_loads if loads else 0
    with torch.no_grad():
        data = model.batch(model.knots(runs.values), runs.values, np.ones(len(system.sensors), dtype=bool))
        at = model.linearise(torch.zeros(_WINDOWS, P + X, dtype=torch.float64), data)
        measured = 2 * len(system.channels) if tracked else 0
        one = _ReferenceRide(model, at, data, measured)
        here = one.outputs(model.simulator)
        shown = [one.slope(one.outputs(LinearSimulator(replace(system, file=file))) - here) for file in wrong]
        information = one.information().sum(axis=0) * (_RIDE / _WINDOWS if tracked else 1.0)
    gradient = np.stack(shown, axis=1) / _STEP * (_RIDE / _WINDOWS if tracked else 1.0)
    spread = np.array([PRIOR_STD] * P + [term.std for term in loading.terms][:X] + [d.std for d in stated[:measured]])
    moved = np.linalg.solve(information + np.diag(spread**-2.0), gradient)
    C = len(system.channels)
    beside = np.zeros((len(stated), len(wrong)))
    beside[:measured], beside[2 * C : 2 * C + X] = moved[P + X :], moved[P : P + X]
    return ModelUncertainty(moved[:P] @ moved[:P].T, beside @ beside.T)


class _ReferenceRide:
    """Windows at nominal values: their information, and the gradients that other signals would cause."""

    def __init__(self, model: WindowModel, at: Linearisation, data: WindowBatch, measured: int) -> None:
        """measured: how many of the deviations are unknown, the first ones."""
        self.model, self.at, self.data, self.measured = model, at, data, measured
        self.sensitivity = DeviationSensitivity(model)
        self.second = model.chord(at, at.x, at.x0, data)
        self.shown = model.sensitivities.by_drive(at, self.sensitivity.motions(data), data)
        columns, redundant = self.sensitivity.columns(at, self.second, data, self.shown)
        self.columns = as_rows(columns[..., :measured]).double()
        self.redundant = None if redundant is None else as_rows(redundant[..., :measured]).double()

    def outputs(self, other: LinearSimulator) -> Tensor:
        """Sensor signals of a vehicle in these windows, (B, T, S)."""
        one = other.discretise(other.element_values(self.at.x[:1]))  # nominal in all windows
        parts = (one.Ad, one.G0, one.G1, one.C, one.D)
        discrete = Discrete(*(part.expand(len(self.at.x), -1, -1) for part in parts))
        return other.states(discrete, self.data.w, self.at.x0) @ discrete.C.mT + self.data.w @ discrete.D.mT

    def slope(self, more: Tensor) -> FloatArray:
        """Gradient (U,) of the log-likelihood by parameters, loads and unknown deviations, for additional sensor
        signals `more` (B, T, S); summed over the windows."""
        at, model = self.at, self.model
        shown = more @ model.compression.matrix(self.data.present).mT
        r = as_rows(at.whiten @ model.band.spectra(shown).unsqueeze(3)).mT
        left = r - at.free.mT @ torch.cholesky_solve(at.free @ r, at.factor)
        gradient = self.columns @ left
        if self.redundant is not None:
            over = model.band.spectra(more @ self.sensitivity.dropped(self.data.present).mT)
            gradient = gradient + self.redundant @ as_rows((model.noise.weight[:, None] * over).unsqueeze(3)).mT
        return torch.cat([at.sensitivities @ left, gradient], dim=1).squeeze(2).sum(dim=0).numpy()

    def information(self) -> FloatArray:
        """Information of each window on parameters, loads and unknown deviations, without priors, (B, U, U)."""
        inverse = np.linalg.inv(self.at.covariance.numpy())
        own = inverse - np.diag(self.model.precision[: inverse.shape[1]].numpy())
        n = self.measured
        if not n:
            return np.asarray(own)
        cross, profiled, _ = self.sensitivity.evidence(self.at, self.second, self.data, self.shown).numpy()
        cross, profiled = cross[:, :, :n], profiled[:, :n, :n]
        across = -inverse @ cross
        whole = profiled + cross.transpose(0, 2, 1) @ inverse @ cross
        return np.block([[own, across], [across.transpose(0, 2, 1), whole]])


def _unstated_masses(system: System) -> dict[str, float]:
    """Bodies whose mass has no stated uncertainty: no loads, not estimated, not fixed."""
    settled = {load.body for load in system.loads} | {p.element for p in system.parameters if p.quantity == "mass"}
    settled |= {*system.doubtful_masses}
    bodies = system.file.bodies.items()
    return {n: MASS_STD for n, b in bodies if n not in settled and b.mass.std is None and not b.mass.fixed}


def _masses(file: SystemFile, stds: dict[str, float]) -> Iterator[SystemFile]:
    """The file with one mass after the other, and its inertias, larger by a step of its uncertainty."""
    for name, std in stds.items():
        body, more = file.bodies[name], 1 + _STEP * std
        heavier = {"mass": body.mass.model_copy(update={"value": body.mass.value * more})}
        inertias = {k: getattr(body, k) * more for k in INERTIAS if getattr(body, k)}
        yield _with_body(file, name, heavier | inertias)


def _together(system: System) -> Iterator[SystemFile]:
    """The file with all masses without stated uncertainty larger."""
    file = system.file
    for name in _unstated_masses(system):
        (file,) = _masses(file, {name: TOGETHER_STD})
    if file is not system.file:
        yield file


def _inertias(system: System) -> Iterator[SystemFile]:
    """The file with one inertia after the other larger, of bodies with neither stated nor estimated mass."""
    for name in _unstated_masses(system).keys() - set(system.built):
        body = system.file.bodies[name]
        for kind in INERTIAS:
            if getattr(body, kind):
                yield _with_body(system.file, name, {kind: getattr(body, kind) * (1 + _STEP * INERTIA_STD)})


def _places(file: SystemFile) -> Iterator[SystemFile]:
    """The file with one spring or sensor after the other moved by a step of its uncertainty along x, then along y."""
    reach = {name: _reach(file, name) for name, body in file.bodies.items() if body.roll_inertia or body.pitch_inertia}
    for name, element in file.elements.items():
        ends = [reach[end] for end in (element.upper, element.lower) if end in reach]
        for position in _moved(element.position, np.min(ends, axis=0) if ends else np.zeros(2)):
            changed = element.model_copy(update={"position": position})
            yield file.model_copy(update={"elements": {**file.elements, name: changed}})
    for name, sensor in file.sensors.items():
        if isinstance(sensor, ElementSensor) or sensor.body not in reach:
            continue
        for position in _moved(sensor.position, reach[sensor.body]):
            moved = sensor.model_copy(update={"position": position})
            yield file.model_copy(update={"sensors": {**file.sensors, name: moved}})


def _reach(file: SystemFile, body: str) -> FloatArray:
    """Largest distance of springs and sensors of a body from its position, along x and y."""
    points = [e.position for e in file.elements.values() if body in (e.upper, e.lower)]
    points += [s.position for s in file.sensors.values() if not isinstance(s, ElementSensor) and s.body == body]
    known = np.array([p for p in points if p is not None]).reshape(-1, 2)
    return np.asarray(np.abs(known - file.bodies[body].position).max(axis=0, initial=0.0))


def _moved(position: tuple[float, float] | None, reach: FloatArray) -> Iterator[tuple[float, float]]:
    """A position moved by a step of its uncertainty along one axis after the other, where it matters."""
    if position is not None:
        for axis in np.flatnonzero(reach):
            at = np.array(position)
            at[axis] += _STEP * PLACE_STD * reach[axis]
            yield float(at[0]), float(at[1])


def _with_body(file: SystemFile, name: str, update: dict[str, object]) -> SystemFile:
    return file.model_copy(update={"bodies": {**file.bodies, name: file.bodies[name].model_copy(update=update)}})
