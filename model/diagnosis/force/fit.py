"""Fits of a component's force to a record: variable projection with strengths as the linear values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares, lsq_linear

from sprung.model.diagnosis.force.lag import Lag
from sprung.model.diagnosis.force.motion import ElementMotion
from sprung.model.diagnosis.force.parts import Part
from sprung.model.diagnosis.force.piece import Values
from sprung.model.diagnosis.force.sizes import MotionSizes
from sprung.model.diagnosis.force.zero_drift import ZeroDrift
from sprung.model.diagnosis.record.white_noise import white_noise
from sprung.model.diagnosis.rules import RULES, ComponentRules
from sprung.model.laws import ElementLaw, SpringDamper
from sprung.model.laws.along import force_along
from sprung.model.laws.channel import SensorResponse, passed
from sprung.model.laws.following import Covariate
from sprung.model.laws.placed import PlacedLaw
from sprung.model.signals import FloatArray

_STEPS = 40  # evaluations of a search for shapes
_ENOUGH = 1e-6  # relative change of the sum of squares, or of the shapes, at convergence
DIRECT = SensorResponse()
_FORGETS = 5.0  # time constants after which the initial state of a filter has decayed
_KEPT = 2_500_000  # samples of columns in a task's cache


@dataclass(frozen=True)
class NominalValues:
    """Spring and damper that the system file fixes; None: free."""

    stiffness: float | None  # N/m, if it is fixed
    damping: float | None  # N s/m, if it is fixed


@dataclass(frozen=True)
class ComponentTask:
    """A record of one component, of which the first `split` samples are fitted."""

    motion: ElementMotion
    force: FloatArray  # N, (T,)
    split: int
    nominal: NominalValues = NominalValues(None, None)
    rules: ComponentRules = RULES.component
    signals: tuple[Covariate, ...] = ()  # on which its parameters may depend
    noise: float = 0.0  # N, of the force, estimated from the record without a model
    least_noise: float = 0.0  # N, as much of it as is noise whatever a model leaves: seen at standstill
    declared: float = 0.0  # N, as stated in the system file; 0: not stated
    held: tuple[PlacedLaw, ...] = ()  # laws with fixed values
    delay_std: float = 0.0  # s, between the channels of force and motion, of the instruments
    lag: float = 0.0  # s, time constant of a first-order filter of the force channel

    @cached_property
    def seen(self) -> MotionSizes:
        return MotionSizes.of(self.motion, self.rules)

    def through(self, channel: SensorResponse) -> ComponentTask:
        """The same with delay and filter of the force channel."""
        if channel == DIRECT:
            return self
        return replace(self, motion=self.motion.delayed(channel.delay), lag=self.lag + channel.lag)

    def columns_of(self, piece: Part, shape: tuple[float, ...]) -> FloatArray:
        """Force per strength of a piece along the motion, (T, m); cached."""
        key = (id(piece), shape)
        if key not in self._columns:
            if len(self._columns) * len(self.force) > _KEPT:
                self._columns.clear()
            self._columns[key] = (piece, self._shown(piece.columns(self.motion, shape)))
        return self._columns[key][1]

    def _shown(self, columns: FloatArray) -> FloatArray:
        """Forces (T, m) as shown by the channel."""
        return passed(columns.T, SensorResponse(lag=self.lag), 1 / self.motion.step).T if self.lag else columns

    @cached_property
    def _columns(self) -> dict[tuple[int, tuple[float, ...]], tuple[Part, FloatArray]]:
        return {}  # holds the piece, so that its id stays unique

    @cached_property
    def noisier(self) -> ComponentTask:
        """The same along a motion with as much noise once more."""
        return replace(self, motion=self.motion.noisier())

    def every(self, stride: int) -> ComponentTask:
        """The same thinned out."""
        return replace(
            self, motion=self.motion.every(stride), force=self.force[::stride], split=-(-self.split // stride)
        )

    def thinned(self, samples: int) -> ComponentTask:
        """The same thinned out evenly, to `samples` or up to twice as many."""
        return self.every(max(1, len(self.force) // samples))

    @cached_property
    def linear(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Columns (T, m) of preload, k and c that are free, a mask of these (3,), and the force less the fixed ones."""
        columns = np.column_stack([np.ones(len(self.force)), self.motion.deflection, self.motion.rate])
        known = np.array([0.0, self.nominal.stiffness or 0.0, self.nominal.damping or 0.0])
        free = np.array([True, self.nominal.stiffness is None, self.nominal.damping is None])
        given = columns @ known + self._held_force
        return self._shown(columns[:, free]), free, self.force - self._shown(given[:, None])[:, 0]

    @property
    def _held_force(self) -> FloatArray:
        """Force of the laws that are held, N, (T,)."""
        motion = self.motion
        element = SpringDamper(self.nominal.stiffness or 0.0, self.nominal.damping or 0.0)
        found = np.zeros(len(self.force))
        for one in self.held:
            assert isinstance(one.law, ElementLaw)
            along, stride = (motion.followed, motion.stride) if one.law.path is not None else (motion, 1)
            d = along.deflection - motion.middle
            found += force_along(one.law, one.values, d, along.rate, along.time, element)[::stride]
        return found


@dataclass(frozen=True)
class ComponentModel:
    """Pieces and their shapes."""

    pieces: tuple[Part, ...] = ()
    shapes: tuple[tuple[float, ...], ...] = ()

    def plus(self, piece: Part, shape: tuple[float, ...]) -> ComponentModel:
        return ComponentModel((*self.pieces, piece), (*self.shapes, shape))

    def without(self, index: int) -> ComponentModel:
        keep = [i for i in range(len(self.pieces)) if i != index]
        return ComponentModel(tuple(self.pieces[i] for i in keep), tuple(self.shapes[i] for i in keep))

    def replaced(self, index: int, piece: Part, shape: tuple[float, ...]) -> ComponentModel:
        """With one law replaced."""
        return ComponentModel(
            (*self.pieces[:index], piece, *self.pieces[index + 1 :]),
            (*self.shapes[:index], shape, *self.shapes[index + 1 :]),
        )

    @property
    def channel(self) -> SensorResponse:
        """Delay and filter of the force channel relative to the motion."""
        for piece, shape in zip(self.pieces, self.shapes, strict=True):
            if isinstance(piece, Lag):
                return piece.response(shape)
        return DIRECT

    def columns(self, task: ComponentTask) -> FloatArray:
        """(T, m) of all pieces."""
        late = task.through(self.channel)
        found = [late.columns_of(p, s) for p, s in zip(self.pieces, self.shapes, strict=True)]
        return np.column_stack(found) if found else np.zeros((len(task.force), 0))

    @property
    def signs(self) -> tuple[int, ...]:
        return tuple(sign for piece in self.pieces for sign in piece.signs)

    @property
    def wandering(self) -> tuple[bool, ...]:
        """Which columns are a drift of the zero, (m,)."""
        return tuple(isinstance(piece, ZeroDrift) for piece in self.pieces for _ in piece.signs)

    @property
    def count(self) -> int:
        """Number of free values of the laws."""
        return sum(len(p.signs) + len(p.shapes) for p in self.pieces)


NO_LAWS = ComponentModel()


@dataclass(frozen=True)
class ComponentFit:
    """A fitted model."""

    task: ComponentTask
    model: ComponentModel
    preload: float  # N, force at zero deflection
    element: SpringDamper
    strengths: FloatArray  # of all pieces' columns
    residual: FloatArray  # N, measured less modelled, whole record, (T,)

    @property
    def error(self) -> float:
        """Mean square of the fitted part's residual, N^2."""
        return float(np.mean(self.residual[: self.task.split] ** 2))

    @property
    def held_out(self) -> float:
        """Mean square of the held-out part's residual, N^2."""
        return float(np.mean(self.residual[self.task.split :] ** 2))

    @property
    def force(self) -> FloatArray:
        """Modelled force, N, (T,)."""
        return self.task.force - self.residual

    @cached_property
    def noise(self) -> float:
        """Noise of the load cell, N: as the record shows it, but no more than the fastest changes that are left.

        Friction and stops change a force as fast as noise does: with them in the model, their jumps are no noise.
        """
        return min(self.task.noise, max(self.task.least_noise, white_noise(self.residual)))

    @cached_property
    def motion_noise(self) -> float:
        """Noise of the motion through spring, damper and laws, N."""
        motion, model = self.task.motion, self.model
        linear = self.element.stiffness * motion.deflection_noise, self.element.damping * motion.rate_noise
        by_laws = (model.columns(self.task.noisier) - model.columns(self.task)) @ self.strengths
        return float(np.sqrt(np.sum(np.square(linear)) + np.mean(by_laws**2)))

    @property
    def at_noise(self) -> bool:
        """Whether the residual is at the noise level that the record shows: then no law is missing.

        The noise of a differentiated motion lies in few bins, whose random patterns resemble laws.
        """
        level = self.task.rules.at_noise * (self.noise**2 + self.motion_noise**2)
        return max(self.error, self.held_out) < level

    @property
    def floor(self) -> float:
        """Noise floor of the force, N: of the cell, shown or declared, and of the motion.

        What is declared, and the noise of the motion, count up to a fiftieth of the force.
        """
        most = self.task.rules.declared * float(np.std(self.task.force))
        return float(np.hypot(max(self.noise, min(self.task.declared, most)), min(self.motion_noise, most)))

    @property
    def leaves_more(self) -> bool:
        """Whether the residual exceeds the noise floor: the model is then not exact."""
        return max(self.error, self.held_out) > self.task.rules.above * self.floor**2

    def leaves_hardly_more(self, best: ComponentFit) -> bool:
        """Whether hardly more power beyond noise is left than by another model, in either part."""
        noise, most = best.floor**2, self.task.rules.hardly_more
        pairs = ((self.error, best.error), (self.held_out, best.held_out))
        return all(here - noise < most * (there - noise) for here, there in pairs)

    def strengths_of(self, index: int) -> FloatArray:
        counts = [len(piece.signs) for piece in self.model.pieces]
        first = sum(counts[:index])
        return self.strengths[first : first + counts[index]]

    def values(self, index: int) -> Values:
        """The law's own parameters of a piece."""
        piece = self.model.pieces[index]
        return piece.values(self.strengths_of(index), self.model.shapes[index], self.element)

    def quoted(self, index: int) -> Values:
        """Values of a piece that engineers quote, by name, with units."""
        piece = self.model.pieces[index]
        return piece.quoted(self.strengths_of(index), self.model.shapes[index], self.element)


def bounded_solution(columns: FloatArray, target: FloatArray, signs: tuple[int, ...]) -> tuple[FloatArray, float]:
    """Least squares with signs (1, -1, 0 for either) of the unknowns; solution and sum of squares left."""
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0] = 1.0
    q, r = np.linalg.qr(columns / scale)
    right = q.T @ target
    rest = float(target @ target - right @ right)
    solved = np.linalg.lstsq(r, right, rcond=1e-10)[0]
    sign = np.array(signs)
    if np.any(solved * sign < 0):
        low = np.where(sign > 0, 0.0, -np.inf)
        high = np.where(sign < 0, 0.0, np.inf)
        solved = lsq_linear(r, right, (low, high), method="bvls").x
    left = right - r @ solved
    return solved / scale, max(rest + float(left @ left), 0.0)


def fitted(task: ComponentTask, model: ComponentModel) -> ComponentFit:
    """Strengths, preload, spring and damper for given shapes, on the fitted part; a drift of the zero on the whole."""
    base, free, force = task.through(model.channel).linear
    columns = np.column_stack([base, model.columns(task)])
    late = model.channel.delay + _FORGETS * model.channel.lag
    if late != 0.0:  # the motion before the record is unknown
        earlier = task.motion.time - late
        known = (earlier >= task.motion.time[0]) & (earlier <= task.motion.time[-1])
        columns, force = columns * known[:, None], force * known
    signs = tuple(np.array([0, 1, 1])[free].tolist()) + model.signs
    train = slice(0, task.split)
    solved, _ = bounded_solution(columns[train], force[train], signs)
    values = np.array([0.0, task.nominal.stiffness or 0.0, task.nominal.damping or 0.0])
    values[free] = solved[: int(free.sum())]
    residual = force - columns @ solved
    if any(model.wandering):  # beside the preload, which is the first column
        zero = np.array([True, *[False] * (len(solved) - 1 - len(model.wandering)), *model.wandering])
        moved = np.linalg.lstsq(columns[:, zero], residual)[0]
        solved[zero] += moved
        residual -= columns[:, zero] @ moved
        values[0] = solved[0]
    element = SpringDamper(float(values[1]), float(values[2]))
    return ComponentFit(task, model, float(values[0]), element, solved[int(free.sum()) :], residual)


def refined(task: ComponentTask, model: ComponentModel) -> ComponentFit:
    """The fit with shapes optimised jointly for all pieces, from a model's shapes."""
    start = np.array([value for shape in model.shapes for value in shape])
    if not len(start):
        return fitted(task, model)
    limits = [limit for piece in model.pieces for limit in piece.limits(task.seen)]
    log = np.array([low > 0 for low, _ in limits])
    low, high = np.array(limits, dtype=float).T
    low, high = (np.where(log, np.log(np.where(log, x, 1.0)), x) for x in (low, high))
    wider = 0.5 * (task.rules.limits - 1) * (high - low)
    low, high = low - wider, high + wider
    inner = np.where(log, np.log(np.where(log, start, 1.0)), start)
    inner = np.clip(inner, low + 1e-9 * (high - low), high - 1e-9 * (high - low))

    def at(x: FloatArray) -> ComponentModel:
        values = np.where(log, np.exp(np.where(log, x, 0.0)), x).tolist()
        shapes = []
        for piece in model.pieces:
            shapes.append(tuple(values[: len(piece.shapes)]))
            values = values[len(piece.shapes) :]
        return ComponentModel(model.pieces, tuple(shapes))

    size = float(np.std(task.force[: task.split])) or 1.0

    def residual(x: FloatArray) -> FloatArray:
        return fitted(task, at(x)).residual[: task.split] / size

    found = least_squares(
        residual, inner, bounds=(low, high), diff_step=1e-3, max_nfev=_STEPS, x_scale=0.3, ftol=_ENOUGH, xtol=_ENOUGH
    )
    best, first = fitted(task, at(found.x)), fitted(task, model)
    return best if best.error <= first.error else first
