"""The measured signals of a recording, sorted by role, and their spectra over one part of it.

Displacement and velocity of the same support are two measurements of one motion.  Both are used: the fused displacement

    D = (D_d / s_d^2 + (V / j w) w^2 / s_v^2) / (1 / s_d^2 + w^2 / s_v^2),   var = 1 / (1 / s_d^2 + w^2 / s_v^2)

drives the model, and the difference V / j w - D_d, which is noise alone and independent of D, determines the noise
levels and the faults of the input channels.  A measured acceleration is fused with what else there is before
(`model.simulate.fusion`); it adds w^4 / s_a^2 to 1 / var.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.integrate import trapezoid

from sprung.model.diagnosis.record.fused import FusedMotion, ParityResiduals, parity_residuals
from sprung.model.diagnosis.record.spectra import ComplexArray, Grid, derivative, detrend_ends
from sprung.model.diagnosis.record.white_noise import roughness, white_noise
from sprung.model.diagnosis.rules import RULES, RecordRules, Rules
from sprung.model.mechanics import DISPLACEMENT, rigid_body_modes
from sprung.model.schema import ForceInput, SupportInput
from sprung.model.sensor_kinds import USUAL_NOISE
from sprung.model.signals import FloatArray
from sprung.model.system import System

_INTEGRATED = 1e3  # an integrated displacement carries no weight of its own
_SEEN = 1e-9  # of a rigid-body motion


@dataclass(frozen=True)
class Signals:
    """A gap-free recording by role.  Sensors that are absent are left out, not NaN."""

    sample_rate: float
    displacement: FloatArray  # of the supports, m, shape (T, supports)
    velocity: FloatArray  # m/s, NaN column where it is not measured, shape (T, supports)
    force: FloatArray  # measured forces, N, shape (T, forces)
    sensors: FloatArray  # shape (T, S)
    sensor_index: np.ndarray  # of the present sensors in the system's order, shape (S,)
    sensor_names: tuple[str, ...]
    support_names: tuple[str, ...]
    force_names: tuple[str, ...]
    integrated: np.ndarray  # supports whose displacement is only an integral, (supports,)
    accelerated: np.ndarray  # supports in whose displacement a measured acceleration is fused already, (supports,)
    start: float = 0.0  # s, time of the first sample since the start of the recording
    speed: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  # m/s, on a track, where measured, (T, 0 or 1)
    averaged: int = 1  # samples as they were recorded in every one of these
    cutoff: float = 0.0  # Hz, of the high-pass filter that they have passed; 0: none
    fused: tuple[FusedMotion, ...] = ()  # of the supports whose acceleration is measured beside something else

    @property
    def samples(self) -> int:
        return len(self.sensors)

    def part(self, start: int, stop: int) -> Signals:
        """A stretch of samples."""
        return replace(
            self,
            displacement=self.displacement[start:stop],
            velocity=self.velocity[start:stop],
            force=self.force[start:stop],
            sensors=self.sensors[start:stop],
            speed=self.speed[start:stop],
            fused=tuple(one.part(start, stop) for one in self.fused),
            start=self.start + start / self.sample_rate,
        )


@dataclass(frozen=True)
class Noise:
    """Standard deviations of one sample of every measured signal."""

    displacement: FloatArray  # m, shape (supports,)
    velocity: FloatArray  # m/s, infinite where not measured, shape (supports,)
    acceleration: FloatArray  # m/s^2, likewise
    force: FloatArray  # N, shape (forces,)
    sensors: FloatArray  # shape (S,)
    least: FloatArray  # of the sensors' levels: far below what was declared, another noise has taken their place, (S,)

    @property
    def process_noise(self) -> bool:
        """Whether laws act along the motion that the sensors saw: a measured force may not be the whole one."""
        return len(self.force) > 0

    def support_variance(self, omega: FloatArray) -> FloatArray:
        """Variance of the fused displacement per bin, shape (F, supports)."""
        w = omega[:, None]
        return 1 / (1 / self.displacement**2 + (w / self.velocity) ** 2 + (w**2 / self.acceleration) ** 2)

    def rate_offset_variance(self, part: Part) -> FloatArray:
        """Variance of `Part.rate_offset` of a part without offsets, (pairs,)."""
        duration = part.grid.samples * part.grid.step
        white = self.velocity**2 / part.grid.samples + 2 * (self.displacement / duration) ** 2
        return np.asarray(white[part.pairs])

    def sensor_variance(self, grid: Grid, differentiated: np.ndarray) -> FloatArray:
        """Variance of the compared sensor signals per bin, (F, S); of positions compared by their rates, of the rate.

        The noise of the record's two ends, where the rate's line is anchored, spreads over all bins alike.
        """
        ends = 2 / (grid.samples * grid.step**2)
        return self.sensors**2 * np.where(differentiated, grid.omega[:, None] ** 2 + ends, 1.0)


@dataclass(frozen=True)
class Part:
    """Signals of one part of the recording on its grid: polynomial ends and periodic spectra."""

    grid: Grid
    support: ComplexArray  # fused displacement without polynomial, (F, supports)
    support_polynomial: FloatArray  # (DEGREE + 1, supports)
    force: ComplexArray  # (F, forces)
    force_polynomial: FloatArray
    sensors: ComplexArray  # (F, S), whole signal
    differentiated: np.ndarray  # sensors that measure a position and are compared by its rate, (S,)
    redundancy: ComplexArray  # V / j w - D_d of the supports with both, zero at zero frequency, (F, pairs)
    pairs: np.ndarray  # which supports, shape (pairs,)
    rate_offset: FloatArray  # mean of the velocity channel less that by the displacement's two ends, m/s, (pairs,)
    displacement: ComplexArray  # of the displacement channel alone, without polynomial, (F, supports)
    velocity: ComplexArray  # of the velocity channel alone, as displacement V / j w, (F, supports)
    parity: tuple[ParityResiduals, ...]  # of the supports whose acceleration is measured beside something else


def declared_noise(system: System, signals: Signals, all_rules: Rules = RULES) -> Noise:
    """Noise as the system file states it; where it states none, a share of the signal.

    Estimates of a sensor's may fall to a share of that, or of what its fastest changes leave room for.
    """
    rules = all_rules.record
    inputs = system.file.inputs.values()
    supports = [source for source in inputs if isinstance(source, SupportInput)]
    forces = [source for source in inputs if isinstance(source, ForceInput)]
    declared = list(system.file.sensors.values())
    averaged = np.sqrt(signals.averaged)
    motion = [_support_noise(source, signals, i, rules.undeclared) for i, source in enumerate(supports)]
    displacement, velocity, acceleration = np.array(motion).reshape(-1, 3).T / averaged
    force = _stated_or_share([source.noise for source in forces], signals.force, rules.undeclared) / averaged
    of_sensors = [declared[i].noise for i in signals.sensor_index]
    sensors = _stated_or_share(of_sensors, signals.sensors, rules.undeclared) / averaged
    least = rules.least_noise * np.minimum(sensors, roughness(signals.sensors, all_rules.white_noise))
    return Noise(displacement, velocity, acceleration, force, sensors, least)


def _support_noise(source: SupportInput, signals: Signals, i: int, undeclared: float) -> tuple[float, float, float]:
    """Noise of a support's displacement (m), velocity (m/s) and acceleration (m/s^2); inf where it is not measured.

    undeclared: of a signal, noise that is not declared.
    """
    stated = {quantity: address.noise for quantity, address in source.measured.items()}
    size, fused = _size(signals.displacement[:, i]), bool(signals.accelerated[i])
    displacement = stated.get("displacement", 0.0) or undeclared * size
    if signals.integrated[i]:
        displacement = _INTEGRATED * max(displacement, size)
    velocity = acceleration = np.inf
    if np.isfinite(signals.velocity[0, i]) or (fused and "velocity" in stated):
        velocity = stated.get("velocity", 0.0) or undeclared * _size(signals.velocity[:, i])
    if fused:
        acceleration = stated.get("acceleration", 0.0) or USUAL_NOISE["m/s^2"]
    return displacement, velocity, acceleration


def _stated_or_share(stated: Sequence[float], series: FloatArray, share: float) -> FloatArray:
    """Noise of channels (m,) as it is stated, else a share of their signals (N, m)."""
    return np.array([noise or share * _size(series[:, i]) for i, noise in enumerate(stated)])


def seen_noise(signals: Signals, declared: Noise, rules: Rules = RULES) -> Noise:
    """Noise of supports whose displacement is measured once: no less than their own fastest changes show.

    A wheel or a table does not move near half the sample rate, so that white noise is what is left there.  Up to
    some times what was declared; what a second measurement shows is estimated from both (`fit.noise.input_noise`).
    """
    once = ~signals.integrated & ~np.isfinite(declared.velocity) & ~np.isfinite(declared.acceleration)
    if not once.any():
        return declared
    shown = np.array([white_noise(series, rules.white_noise) for series in signals.displacement.T])
    level = np.clip(shown, declared.displacement, rules.noise.misdeclared * declared.displacement)
    return replace(declared, displacement=np.where(once, level, declared.displacement))


def _size(series: FloatArray) -> float:
    return float(np.std(series)) or 1.0


def drifting(system: System, sensors: np.ndarray) -> np.ndarray:
    """Which of the given sensors show the position of something that no stiffness holds, (sensors,).

    Such a position is the integral of every disturbance since the start: it wanders without end, its two ends do not
    meet, and its spectrum is all leakage.  Its rate is stationary.
    """
    mechanics = system.mechanics
    stiffness = (mechanics.H.T * mechanics.stiffness) @ mechanics.H
    seen = np.any(np.abs(mechanics.S[sensors] @ rigid_body_modes(stiffness)) > _SEEN, axis=1)
    found: np.ndarray = seen & (mechanics.sensor_kind[sensors] == DISPLACEMENT)
    return found


def rate_of(position: FloatArray, grid: Grid, rules: RecordRules = RULES.record) -> FloatArray:
    """Time derivative of series (N, m), exact within the band: what their ends leave open is a parabola's."""
    polynomial = detrend_ends(position, _end_slopes(position, grid, rules.end_samples, 2), grid)
    rest = grid.forward(position - grid.monomials @ polynomial)
    slope = grid.monomials @ derivative(polynomial, grid.length)
    return np.asarray(grid.inverse(1j * grid.omega[:, None] * rest) + slope)


def _end_slopes(series: FloatArray, grid: Grid, count: int, degree: int) -> tuple[FloatArray, FloatArray]:
    """Slopes of series (N, m) at the first and the last sample, per second, each (m,), of polynomials through few."""
    ends = np.vander(np.arange(min(count, len(series))) * grid.step, degree + 1)
    first, last = (np.linalg.lstsq(ends, part[: len(ends)], rcond=None)[0][-2] for part in (series, series[::-1]))
    return first, -last


def transform(
    signals: Signals, noise: Noise, rules: RecordRules = RULES.record, *, differentiated: np.ndarray | None = None
) -> Part:
    """Spectra of a part.

    `differentiated`: sensors whose series are compared by their rates (`drifting`), (S,).
    """
    grid = Grid(signals.samples, 1 / signals.sample_rate, signals.start, rules.compared, signals.cutoff)
    sensors = signals.sensors
    differentiated = np.zeros(sensors.shape[1], dtype=bool) if differentiated is None else differentiated
    if differentiated.any():
        sensors = np.where(differentiated, rate_of(sensors, grid, rules), sensors)
    has_rate = np.isfinite(noise.velocity) & ~signals.accelerated
    polynomial, D, V = _support_spectra(signals, has_rate, grid, rules)
    pairs = np.flatnonzero(has_rate & ~signals.integrated)
    force_polynomial = np.zeros((grid.monomials.shape[1], signals.force.shape[1]))
    if signals.force.shape[1]:
        force_polynomial = detrend_ends(signals.force, None, grid)
    return Part(
        grid=grid,
        support=_fused(D, V, noise, has_rate, grid),
        support_polynomial=polynomial,
        force=grid.forward(signals.force - grid.monomials @ force_polynomial),
        force_polynomial=force_polynomial,
        sensors=grid.forward(sensors),
        differentiated=differentiated,
        redundancy=(V - D)[:, pairs],
        pairs=pairs,
        rate_offset=_rate_offset(signals, grid)[pairs],
        displacement=D,
        velocity=V,
        parity=tuple(
            one for fused in signals.fused if (one := parity_residuals(fused, grid.step, signals.averaged)) is not None
        ),
    )


def _support_spectra(
    signals: Signals, has_rate: np.ndarray, grid: Grid, rules: RecordRules
) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Polynomial of the supports' displacement (DEGREE + 1, supports), and what remains by either channel.

    Spectra (F, supports) of the displacement channel, and of the velocity channel as displacement V / j w; has_rate:
    supports that have one, (supports,).
    """
    d, v = signals.displacement, np.where(has_rate, signals.velocity, 0.0)
    polynomial = np.zeros((grid.monomials.shape[1], d.shape[1]))
    if d.shape[1]:
        degrees = rules.end_degree_integrated, rules.end_degree
        both = zip(*(_end_slopes(d, grid, rules.end_samples, degree) for degree in degrees), strict=True)
        slopes = (np.where(signals.accelerated, *pair) for pair in both)
        first, last = (np.where(has_rate, v[at], slope) for at, slope in zip((0, -1), slopes, strict=True))
        polynomial = detrend_ends(d, (first, last), grid)
    D = grid.forward(d - grid.monomials @ polynomial)
    V = grid.forward(v - grid.monomials @ derivative(polynomial, grid.length))
    integrated = np.zeros_like(V)
    integrated[1:] = V[1:] / (1j * grid.omega[1:, None])
    integrated[0] = D[0]
    return polynomial, D, integrated


def _fused(D: ComplexArray, V: ComplexArray, noise: Noise, has_rate: np.ndarray, grid: Grid) -> ComplexArray:
    """Displacement of the supports by both channels, weighted by their noise (module docstring), (F, supports)."""
    precision_d = 1 / noise.displacement**2
    precision_v = np.where(has_rate, (grid.omega[:, None] / noise.velocity) ** 2, 0.0)
    return np.asarray((D * precision_d + V * precision_v) / (precision_d + precision_v), dtype=complex)


def _rate_offset(signals: Signals, grid: Grid) -> FloatArray:
    """Mean of the velocity channel less that by the displacement's two ends, m/s, (supports,)."""
    duration = (grid.samples - 1) * grid.step
    mean_rate = trapezoid(signals.velocity, dx=grid.step, axis=0) / duration
    return np.asarray(mean_rate - (signals.displacement[-1] - signals.displacement[0]) / duration)
