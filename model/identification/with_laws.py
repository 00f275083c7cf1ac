"""Windows of a system whose file has laws: the linear identification around the laws' forces.

A law's force is one more force on the two ends of its element.  Along the motion of a window it is known,

    f = law(d, v; p),       d, v from the states that the last round identified,

so that a window with laws is a window of the linear system with measured forces f.  Rounds of (motion, forces, linear
maximum likelihood) are repeated until the forces no longer change the sensors by a share of their noise.  This solves
J(x)^H R^-1 r(x) = 0 with the residual r of the non-linear model and the sensitivities J of the linear one: consistent
whatever the laws, and as sharp as maximum likelihood where the laws' slopes are small beside the element's stiffness
and damping.

Values of laws are estimated from the profile of chi-square, c(p) = min_x c(x, p), by a quadratic through trial values:

    step = -H^-1 c',   Cov(p) = 2 H^-1,   Cov(x, p) = (dx/dp) Cov(p),   Cov(x) = Cov(x | p) + (dx/dp) Cov(p) (dx/dp)^T

(Raue et al. 2009 on profile likelihood).  Forces are evaluated on a grid OVERSAMPLING times finer, between samples by
the cubic through deflection and rate, and brought back to the samples behind a band-limiting filter.  Laws with
memory are refused: their state at the start of a window is not known, and beside their slopes the rounds do not settle.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import firwin, upfirdn

from sprung.model.identification.linearise import PRIOR_STD
from sprung.model.identification.refine import IDENTIFIABLE_STD, Refined, Refiner
from sprung.model.identifier import Identifies, StageTimes, UnusableWindow
from sprung.model.laws import ElementLaw, Motion, SpringDamper
from sprung.model.laws.placed import PlacedLaw
from sprung.model.mechanics import FORCE
from sprung.model.schema import ForceInput
from sprung.model.signals import Estimate, FloatArray
from sprung.model.system import System

OVERSAMPLING = 16
ROUNDS = 8  # of motion and forces
PROFILES = 4  # of the laws' values
_SETTLED = 0.3  # rms change of a force's effect on the sensors, in their noise, at which rounds end
_TRIAL = 0.05  # relative change of a law's value for the quadratic
_REACH = 8  # samples of the filter to each side
_CLOSE = 1.0  # step in standard deviations, after which another profile would change little
_MOSTLY = 0.8  # of the windows, of which that has to hold
_MOST = 1.0  # largest step of a law's log-ratio


@dataclass(frozen=True, slots=True)
class Acting:
    """One law with the elements that it acts on."""

    placed: PlacedLaw
    law: ElementLaw
    weights: FloatArray  # over the elements, (E,)
    element: int  # whose stiffness and damping it sees
    free: tuple[int, ...]  # parameters that are estimated


def acting_laws(system: System) -> list[Acting]:
    """The laws that windows are identified with.  Errors: `UnusableWindow` for one that no window can hold."""
    found = []
    for placed in system.laws:
        law = placed.law
        if law.name.startswith("sensor_"):
            continue  # undone in the signals
        if not isinstance(law, ElementLaw) or law.memory or law.name.startswith("time_varying"):
            raise UnusableWindow(
                f"{placed.location}: windows cannot be identified with {law.name} in place; "
                "diagnose, simulate and compare can use it"
            )
        at = [system.elements.index(name) for name in placed.places]
        for group in [at] if law.where == "pair" else [[e] for e in at]:
            weights = np.zeros(len(system.elements))
            weights[group[0]] = 1.0
            if len(group) == 2:
                weights[group[1]] = -1.0
            free = tuple(i for i, (v, f) in enumerate(zip(placed.values, placed.fixed, strict=True)) if v > 0 and not f)
            found.append(Acting(placed, law, weights, group[0], free))
    return found


def without_laws(system: System, laws: list[Acting]) -> System:
    """The linear system with two more measured forces for every element that a law acts on."""
    bare = {name: element.model_copy(update={"laws": ()}) for name, element in system.file.elements.items()}
    inputs = dict(system.file.inputs)
    for index, element in _pulled(laws):
        source = system.file.elements[system.elements[element]]
        for side in ("upper", "lower"):
            end = getattr(source, side)
            if end in system.file.bodies:
                inputs[f"law{index}_{element}_{side}"] = ForceInput(kind="force", body=end, position=source.position)
    return System(system.file.model_copy(update={"elements": bare, "inputs": inputs}))


def _pulled(laws: list[Acting]) -> list[tuple[int, int]]:
    return [(i, int(e)) for i, acting in enumerate(laws) for e in np.flatnonzero(acting.weights)]


@dataclass(slots=True)
class IdentifierWithLaws:
    """Identifies windows of one system with laws; parameters are `system.tracked`.

    inner: the identifier of `without_laws(system, ...)`.
    """

    system: System
    laws: list[Acting]
    inner: Identifies
    linear: System
    workers: int = 1
    times: StageTimes = field(default_factory=StageTimes)
    _refiners: dict[int, Refiner] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """Names the model that made an estimate."""
        return self.system.digest

    def identify(self, windows: FloatArray, start: FloatArray | None = None, *, states: bool = False) -> list[Estimate]:
        """One `Estimate` per window over `system.tracked`; see `model.identifier.Identifies`."""
        begin = time.perf_counter()
        windows = np.asarray(windows, dtype=np.float64)
        if windows.ndim != 3 or windows.shape[2] != len(self.system.channels):
            raise UnusableWindow(f"windows: shape (B, T, {len(self.system.channels)}) expected, {windows.shape} came")
        if len(windows) == 0:
            return []
        B, P = len(windows), len(self.system.parameters)
        values = self._values(B, None if start is None else start[:, P:])
        x = np.zeros((B, P)) if start is None else np.asarray(start[:, :P])
        forces = np.zeros((B, windows.shape[1], len(self.laws)))
        solved, forces = self._rounds(windows, x, values, forces, ROUNDS)
        profile = None
        for _ in range(PROFILES if any(acting.free for acting in self.laws) else 0):
            profile = self._profile(windows, solved, values, forces)
            values = profile.values
            solved, forces = self._rounds(windows, solved.log_ratio, values, forces, 3)
            if profile.settled:
                break
        found = self.inner.identify(self._with_forces(windows, forces), solved.log_ratio, states=states)
        result = [self._extended(estimate, b, values, profile) for b, estimate in enumerate(found)]
        self.times = StageTimes(0.0, time.perf_counter() - begin)
        return result

    def _values(self, B: int, log_ratio: FloatArray | None) -> list[FloatArray]:
        """Values of every law per window, (B, parameters)."""
        found, at = [], 0
        for acting in self.laws:
            values = np.tile(np.array(acting.placed.values), (B, 1))
            for i in acting.free:
                if log_ratio is not None:
                    values[:, i] *= np.exp(log_ratio[:, at])
                at += 1
            found.append(values)
        return found

    def _refiner(self, samples: int) -> Refiner:
        if samples not in self._refiners:
            self._refiners[samples] = Refiner(self.linear, samples, self.workers)
        return self._refiners[samples]

    def _rounds(
        self, windows: FloatArray, x: FloatArray, values: list[FloatArray], forces: FloatArray, most: int
    ) -> tuple[Refined, FloatArray]:
        """Linear identification and forces in turn, until the forces settle.

        Changes shrink by about the same factor from round to round; where two of them show it, what is still to come
        is added at once (Aitken's extrapolation).
        """
        refiner = self._refiner(windows.shape[1])
        last: FloatArray | None = None
        for count in range(most):
            first = count == 0 and not forces.any()
            solved = refiner.refine(self._with_forces(windows, forces), x, iterations=3 if first else 1, states=True)
            x = solved.log_ratio
            change = self._forces(windows, solved, values) - forces
            if last is None:
                forces = forces + change
            else:
                shrunk = np.sum(change * last, axis=(1, 2)) / np.maximum(np.sum(last**2, axis=(1, 2)), 1e-300)
                shrunk = np.clip(shrunk, -0.8, 0.7)
                forces = forces + change / (1 - shrunk)[:, None, None]
            last = change
            if np.all(self._effect(change) < _SETTLED):
                break
        return solved, forces

    def _effect(self, forces: FloatArray) -> FloatArray:
        """rms of forces over what the noise of the sensors hides: mass times noise of the lightest body's, (B,)."""
        m = self.system.mechanics
        noise = float(np.min(self.system.sensor_noise)) * float(np.min(m.mass[m.mass > 0]))
        scale: FloatArray = np.sqrt(np.mean(forces**2, axis=(1, 2))) / noise
        return scale

    def _with_forces(self, windows: FloatArray, forces: FloatArray) -> FloatArray:
        """Windows of the linear system: inputs, the laws' forces on both ends, sensors without their direct share."""
        inputs = len(self.system.inputs)
        columns = []
        for index, element in _pulled(self.laws):
            source = self.system.file.elements[self.system.elements[element]]
            pull = forces[:, :, index] * self.laws[index].weights[element]
            for side, sign in (("upper", -1.0), ("lower", 1.0)):
                if getattr(source, side) in self.system.file.bodies:
                    columns.append(sign * pull)
        sensors = windows[:, :, inputs:].copy()
        m = self.system.mechanics
        for sensor in np.flatnonzero(m.sensor_kind == FORCE):
            share = np.array([acting.weights @ m.L[sensor] for acting in self.laws])
            sensors[:, :, sensor] -= forces @ share
        return np.concatenate([windows[:, :, :inputs], np.stack(columns, axis=2), sensors], axis=2)

    def _forces(self, windows: FloatArray, solved: Refined, values: list[FloatArray]) -> FloatArray:
        """The laws' forces along the identified motion, band-limited, at the samples, (B, T, laws)."""
        d, v, a = self._motion(windows, solved)
        k, c = self._element_values(solved.log_ratio)
        t = np.arange(d.shape[1]) / self.system.sample_rate
        fine = np.arange((len(t) - 1) * OVERSAMPLING + 1) / (OVERSAMPLING * self.system.sample_rate)
        d_fine = CubicHermiteSpline(t, d, v, axis=1)(fine)
        v_fine = CubicHermiteSpline(t, v, a, axis=1)(fine)
        found = []
        for acting, p in zip(self.laws, values, strict=True):
            motion = Motion(d_fine @ acting.weights, v_fine @ acting.weights)
            at = acting.element
            element = SpringDamper(k[:, at, None], c[:, at, None])
            found.append(acting.law.force(motion, list(p.T[:, :, None]), element))
        return _band_limited(np.stack(found, axis=2))

    def _motion(self, windows: FloatArray, solved: Refined) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Deflection, rate and its slope of every element, (B, T, E)."""
        m, n = self.system.mechanics, self.system.mechanics.n
        drives = self._refiner(windows.shape[1]).model.knots(
            np.concatenate([windows[:, :, : len(self.system.inputs)], self._no_forces(windows)], axis=2)
        )
        supports = self._refiner(windows.shape[1]).model.simulator.supports.numpy()
        states = solved.states
        d = states[:, :, :n] @ m.H.T + drives[:, :, supports] @ m.G.T
        v = states[:, :, n:] @ m.H.T + drives[:, :, supports + 1] @ m.G.T
        return d, v, np.gradient(v, 1 / self.system.sample_rate, axis=1, edge_order=2)

    def _no_forces(self, windows: FloatArray) -> FloatArray:
        extra = len(self.linear.inputs) - len(self.system.inputs)
        return np.zeros((*windows.shape[:2], extra))

    def _element_values(self, log_ratio: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Stiffness and damping of every element, (B, E)."""
        m = self.system.mechanics
        k, c = (np.tile(nominal, (len(log_ratio), 1)) for nominal in (m.stiffness, m.damping))
        for column, parameter in enumerate(self.system.parameters):
            if parameter.quantity in ("stiffness", "damping"):
                into = k if parameter.quantity == "stiffness" else c
                into[:, self.system.elements.index(parameter.element)] *= np.exp(log_ratio[:, column])
        return k, c

    def _profile(self, windows: FloatArray, solved: Refined, values: list[FloatArray], forces: FloatArray) -> Profile:
        """A quadratic through chi-square at trial values of the laws, its minimum and curvature."""
        free = [(law, i) for law, acting in enumerate(self.laws) for i in acting.free]
        B, L = len(windows), len(free)
        size = np.full(L, _TRIAL)
        base = self._cost(solved)

        def changed(steps: FloatArray) -> list[FloatArray]:
            """Values after steps of their logarithms, (B, L) or (L,)."""
            result = [v.copy() for v in values]
            for which, (law, i) in enumerate(free):
                result[law][:, i] *= np.exp(steps[..., which])
            return result

        def trial(*moved: int) -> tuple[FloatArray, FloatArray]:
            """Chi-square and parameters with some values moved up (index) or down (-1 - index)."""
            steps = np.zeros(L)
            for which in moved:
                steps[which if which >= 0 else -1 - which] = size[which] if which >= 0 else -size[-1 - which]
            again, _ = self._rounds(windows, solved.log_ratio, changed(steps), forces, 2)
            return self._cost(again), again.log_ratio

        slope, hessian = np.zeros((B, L)), np.zeros((B, L, L))
        moves = np.zeros((B, solved.log_ratio.shape[1], L))
        for a in range(L):
            (up, x_up), (down, x_down) = trial(a), trial(-1 - a)
            slope[:, a] = (up - down) / (2 * size[a])
            hessian[:, a, a] = (up + down - 2 * base) / size[a] ** 2
            moves[:, :, a] = (x_up - x_down) / (2 * size[a])
        for a, b in combinations(range(L), 2):
            both, _ = trial(a, b)
            single = base + size[a] * slope[:, a] + size[b] * slope[:, b]
            single += 0.5 * (size[a] ** 2 * hessian[:, a, a] + size[b] ** 2 * hessian[:, b, b])
            hessian[:, a, b] = hessian[:, b, a] = (both - single) / (size[a] * size[b])
        curvature, vectors = np.linalg.eigh(hessian)
        curved = (vectors * np.maximum(curvature, 0.0)[:, None]) @ np.swapaxes(vectors, 1, 2)
        covariance = 2 * np.linalg.inv(curved + 2 / PRIOR_STD**2 * np.eye(L))
        step = np.clip(-0.5 * (covariance @ slope[:, :, None])[:, :, 0], -_MOST, _MOST)
        std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        small = np.abs(step) < np.maximum(_CLOSE * std, 1e-3)
        return Profile(changed(step), covariance, moves, bool(np.mean(small) > _MOSTLY))

    def _cost(self, solved: Refined) -> FloatArray:
        cost: FloatArray = solved.chi_square * solved.freedom
        return cost

    def _extended(self, estimate: Estimate, b: int, values: list[FloatArray], profile: Profile | None) -> Estimate:
        """The estimate with the laws' values beside the linear parameters."""
        if profile is None:
            return estimate
        known = [
            np.log(values[law][b, i] / acting.placed.values[i])
            for law, acting in enumerate(self.laws)
            for i in acting.free
        ]
        scale = max(estimate.chi_square, 1.0)
        P, L = len(estimate.log_ratio), len(known)
        own = profile.covariance[b] * scale
        moves = np.where(estimate.identifiable[:, None], profile.moves[b], 0.0)
        across = moves @ own
        told = np.sqrt(np.diag(own)) < IDENTIFIABLE_STD
        covariance = np.empty((P + L, P + L))
        covariance[:P, :P] = estimate.covariance + across @ moves.T
        covariance[:P, P:], covariance[P:, :P] = across, across.T
        covariance[P:, P:] = own
        for at in np.flatnonzero(~told):
            covariance[P + at, :] = covariance[:, P + at] = 0.0
            covariance[P + at, P + at] = PRIOR_STD**2
        return replace(
            estimate,
            log_ratio=np.concatenate([estimate.log_ratio, np.where(told, known, 0.0)]),
            covariance=covariance,
            identifiable=np.concatenate([estimate.identifiable, told]),
        )


@dataclass(frozen=True, slots=True)
class Profile:
    """What chi-square says of the laws' values; L free ones."""

    values: list[FloatArray]  # of every law, (B, parameters), at the minimum
    covariance: FloatArray  # of their log-ratios, (B, L, L)
    moves: FloatArray  # of the linear log-ratios per log-ratio of a law, (B, P, L)
    settled: bool  # the last step was small beside the deviations


def _band_limited(fine: FloatArray) -> FloatArray:
    """Signals (B, fine grid, L) behind a filter at half the sample rate, at the samples."""
    reach = _REACH * OVERSAMPLING
    taps = firwin(2 * reach + 1, 1 / OVERSAMPLING, window=("kaiser", 6.0))
    padded = np.concatenate(
        [2 * fine[:, :1] - fine[:, reach:0:-1], fine, 2 * fine[:, -1:] - fine[:, -2 : -reach - 2 : -1]], 1
    )
    shown = upfirdn(taps, padded, down=OVERSAMPLING, axis=1)[:, 2 * _REACH :]
    return shown[:, : (fine.shape[1] - 1) // OVERSAMPLING + 1]
