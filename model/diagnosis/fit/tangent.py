"""Tangent of the harmonic balance: sensitivities of laws and motion to small changes."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.fft import irfft, rfft
from scipy.interpolate import CubicSpline

from sprung.model.diagnosis.fit.whitening import Whitener
from sprung.model.diagnosis.record.spectra import DEGREE, OVERSAMPLING, ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.response.harmonic_balance import LawForces
from sprung.model.diagnosis.response.newton import central_slopes
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import SpringDamper
from sprung.model.laws.along import force_along
from sprung.model.laws.basis import StaticLaw
from sprung.model.signals import FloatArray

_KRYLOV, _FINE_KRYLOV, _KRYLOV_TOLERANCE = 16, 60, 3e-3
_CANCELLED = 0.5  # of a vector's length, from which it is made orthogonal once more
_BLOCK = 8  # columns that are solved for together on the oversampled axis, which bounds the memory
_RELATIVE_STEP = 1e-4  # of finite differences


def step_of(term: Term, parameter: int) -> float:
    """Step of a finite difference in a term's internal parameter."""
    if term.law.parameters[parameter].log:
        return _RELATIVE_STEP
    return _RELATIVE_STEP * max(abs(term.parameters[parameter]), term.scales[parameter])


def law_change(forward: Forward, forces: LawForces, term: Term, parameter: int) -> tuple[int, ComplexArray]:
    """Port of a law and the spectrum of its force's derivative along the present trajectory, (F,)."""
    port = forces.index(term)
    if isinstance(term.law, StaticLaw):
        values = term.law.values(forces.deflection[:, port], forces.rate[:, port])
        return port, forward.part.grid.coarse_forces(values[parameter])
    step = step_of(term, parameter)
    change = (law_force(forward, term.moved(parameter, step), forces) - law_force(forward, term, forces)) / step
    return port, forward.part.grid.coarse_forces(change)


def law_change_by_element(forward: Forward, forces: LawForces) -> Iterator[tuple[int, int, ComplexArray]]:
    """Number of a parameter, port of a law, spectrum (F,) of its force's derivative by the parameter's log-ratio.

    Of laws whose force depends on the spring or damper of their element, as that of a valve does.
    """
    for port, term in enumerate(forces.terms):
        element = term.location.partition("|")[0]
        own, present = forward.element_of(term), law_force(forward, term, forces)
        for i, parameter in enumerate(forward.system.parameters):
            if parameter.element != element or parameter.quantity == "mass":
                continue
            more = own._replace(**{parameter.quantity: getattr(own, parameter.quantity) * np.exp(_RELATIVE_STEP)})
            change = _force_of(forward, term, forces, port, more) - present
            if np.any(change):
                yield i, port, forward.part.grid.coarse_forces(change / _RELATIVE_STEP)


def port_motions(
    forward: Forward,
    forces: LawForces,
    theta_forces: ComplexArray,
    loads: dict[int, ComplexArray],
    law_forces: ComplexArray,
    states: int,
) -> FloatArray:
    """Deflection and rate along the laws' ports per unit of every free value, (2, N, m, columns).

    theta_forces (F, P), law_forces (F, P + p, m): sources along elements and ports; loads: on the degrees of freedom,
    (F, n), by column.
    """
    plant, grid = forward.plant, forward.part.grid
    structure = plant.structure
    ports = forward.plant.structure.padded(forces.ports)
    count = law_forces.shape[1]
    of_force = plant.compliance(ports, np.eye(len(structure.H)))  # (F, m, E)
    spectra = (of_force @ ports.T) @ law_forces.transpose(0, 2, 1)
    for i, parameter in enumerate(forward.system.parameters):
        if i not in loads:
            e = forward.system.elements.index(parameter.element)
            spectra[:, :, i] += of_force[:, :, e] * theta_forces[:, i, None]
    for column, load in loads.items():
        spectra[:, :, column] = np.einsum("fmn,fn->fm", plant.deflection_of_load(ports), load)
    free = plant.free_motion(structure.motion_rows(ports), grid.step, grid.samples).reshape(
        grid.samples, 2, len(ports), states
    )
    result = np.empty((2, grid.samples, len(ports), count + states))
    result[0, :, :, :count] = grid.inverse(spectra)
    result[1, :, :, :count] = grid.inverse(1j * grid.omega[:, None, None] * spectra)
    result[:, :, :, count:] = free.transpose(1, 0, 2, 3)
    if plant.floats:
        _set_unconstrained(result, forward, ports, theta_forces, loads, law_forces)
    return result


def _set_unconstrained(
    motions: FloatArray,
    forward: Forward,
    ports: FloatArray,
    theta_forces: ComplexArray,
    loads: dict[int, ComplexArray],
    law_forces: ComplexArray,
) -> None:
    """Columns of `port_motions` of a system that nothing holds: forces have polynomial parts, too."""
    plant = forward.plant
    for j in range(law_forces.shape[1]):
        motions[:, :, :, j] = _floating(forward, ports, ports, law_forces[:, j, :, None])[..., 0]
    for i, parameter in enumerate(forward.system.parameters):
        if i not in loads:
            unit = np.eye(len(plant.structure.H))[forward.system.elements.index(parameter.element)]
            motions[:, :, :, i] += _floating(forward, unit[None], ports, theta_forces[:, i, None, None])[..., 0]
    for column, load in loads.items():
        motions[:, :, :, column] = _floating_under(forward, load, ports)


def _floating_under(forward: Forward, load: ComplexArray, ports: FloatArray) -> FloatArray:
    """Motion along ports (m, E) of an unconstrained system under a load (F, n), (2, N, m)."""
    plant, grid = forward.plant, forward.part.grid
    rest, line = plant.without_line(load)
    steady = plant.polynomial_response(line_load(line)) @ (ports @ plant.structure.H).T
    swinging = np.einsum("fmn,fn->fm", plant.deflection_of_load(ports), rest)
    deflection = grid.inverse(swinging) + grid.monomials @ steady
    rate = grid.inverse(1j * grid.omega[:, None] * swinging) + grid.monomials @ plant.derivative(steady)
    return np.stack([deflection, rate])


def line_load(line: FloatArray) -> FloatArray:
    """Polynomial loads (DEGREE + 1, n) from their constants and slopes (2, n)."""
    load = np.zeros((DEGREE + 1, line.shape[1]))
    load[:2] = line
    return load


def _floating(forward: Forward, sources: FloatArray, ports: FloatArray, force: ComplexArray) -> FloatArray:
    """Motion along ports (m, E) of an unconstrained system under forces (F, s, columns) along sources (s, E).

    (2, N, m, columns): mean and end-to-end line of a force act through polynomials.
    """
    plant, grid = forward.plant, forward.part.grid
    H = plant.structure.H
    shape = (len(grid.omega), len(sources), -1)
    rest, line = plant.without_line(force.reshape(len(grid.omega), -1))
    line = line.reshape(2, len(sources), -1)
    answer = plant.compliance(ports, sources) @ rest.reshape(shape)
    lines = np.array([plant.line_motion(w) for w in sources])  # (s, 2, DEGREE + 1, n)
    polynomial = np.einsum("skpn,mn,ksc->pmc", lines, ports @ H, line)
    steady = np.stack([polynomial, plant.derivative(polynomial)])
    swinging = np.stack([grid.inverse(answer), grid.inverse(1j * grid.omega[:, None, None] * answer)])
    found: FloatArray = swinging + np.einsum("tp,kpmc->ktmc", grid.monomials, steady)
    return found


def tangent(
    forward: Forward,
    forces: LawForces,
    motions: FloatArray,
    correction: SmootherCorrection | None,
    *,
    fine: bool = False,
) -> tuple[ComplexArray, float]:
    """Spectra (F, m, columns) of the laws' reaction to small motions along their ports.

    The second is the work: evaluations of one law along the oversampled record that cost as much.

    The tangent along the trajectory less the equivalent, which is part of the plant, in closed loop with the plant:
    f = s (d0 + D f) with the slopes s over time, solved for all columns at once.  Laws with memory have no
    instantaneous tangent; their equivalent is used instead.

    fine: on the oversampled axis.  Stops change their slope within a sample, by far more than the plant's stiffness.
    """
    if fine and correction is None and not forward.plant.floats and np.isfinite(motions).all():
        return _fine_tangent(forward, forces, motions)
    plant, grid = forward.plant, forward.part.grid
    slopes = np.stack([_slopes(forward, forces, i) for i in range(len(forces.terms))], axis=2)  # (2, N, m)
    ports = forward.plant.structure.padded(forces.ports)
    compliance = plant.compliance(ports, ports)
    if correction is not None:
        compliance[grid.band] -= correction.deflection @ correction.seen
    if plant.floats:
        return _floating_tangent(forward, ports, slopes, motions, correction)
    # single precision suffices for a tolerance of a few thousandths; time is last, where transforms are contiguous
    along = slopes.transpose(0, 2, 1).astype(np.float32)[:, None]  # (2, 1, m, N)
    moving = motions.transpose(0, 3, 2, 1).astype(np.float32)  # (2, columns, m, N)
    right = np.ascontiguousarray(np.sum(along * moving, axis=0))
    compliance = np.ascontiguousarray(compliance.transpose(1, 2, 0)).astype(np.complex64)  # (m, m, F)
    jw = (1j * grid.omega).astype(np.complex64)

    def close(force: FloatArray) -> FloatArray:
        moved = np.einsum("abf,cbf->caf", compliance, rfft(force))
        d, v = irfft(np.stack([moved, jw * moved]), grid.samples)
        return np.asarray(force - along[0] * d - along[1] * v)

    found, steps = _gmres(close, right)
    return grid.forward(found.astype(np.float64).transpose(2, 1, 0)), steps * len(right) * len(ports) / OVERSAMPLING


def _floating_tangent(
    forward: Forward,
    ports: FloatArray,
    slopes: FloatArray,
    motions: FloatArray,
    correction: SmootherCorrection | None,
) -> tuple[ComplexArray, float]:
    """As `tangent`, of a system that nothing holds: forces have polynomial parts, too."""
    grid = forward.part.grid
    along_d, along_v = slopes[0, :, :, None], slopes[1, :, :, None]

    def close(force: FloatArray) -> FloatArray:
        force = force.transpose(2, 1, 0)
        spectrum = grid.forward(force)
        d, v = _floating(forward, ports, ports, spectrum)
        if correction is not None:
            d, v = (d, v) - correction.motion(correction.seen @ spectrum[grid.band])
        return np.ascontiguousarray((force - along_d * d - along_v * v).transpose(2, 1, 0))

    right = np.ascontiguousarray((along_d * motions[0] + along_v * motions[1]).transpose(2, 1, 0))
    found, steps = _gmres(close, right)
    return grid.forward(found.transpose(2, 1, 0)), steps * len(right) * len(ports) / OVERSAMPLING


def _fine_tangent(forward: Forward, forces: LawForces, motions: FloatArray) -> tuple[ComplexArray, float]:
    """As `tangent`, on the oversampled axis, for one force along each distinct port."""
    grid, plant = forward.part.grid, forward.plant
    _, first, place = np.unique(forces.ports, axis=0, return_index=True, return_inverse=True)
    each = np.stack([_fine_slopes(forward, forces, i) for i in range(len(forces.terms))], axis=1).astype(np.float32)
    slopes = np.stack([each[:, place == k].sum(axis=1) for k in range(len(first))], axis=1)  # (2, u, 4N)
    count = OVERSAMPLING * grid.samples
    balance = forward.harmonic_balance(np.zeros(plant.structure.states))
    assert balance is not None, "there are laws"
    compliance = balance.compliance[:, first[:, None], first].transpose(1, 2, 0)
    compliance, jw = np.ascontiguousarray(compliance).astype(np.complex64), balance.jw.astype(np.complex64)

    def moved(force: FloatArray) -> FloatArray:
        answer = np.einsum("abf,cbf->caf", compliance, rfft(force))
        return np.asarray(irfft(np.stack([answer, jw * answer]), count))

    def close(force: FloatArray) -> FloatArray:
        return np.asarray(force - np.sum(slopes[:, None] * moved(force), axis=0))

    def reaction(motion: FloatArray) -> tuple[ComplexArray, float]:
        spline = CubicSpline(np.arange(grid.samples), motion[:, :, first], axis=1)
        along = spline(np.arange(count) / OVERSAMPLING).astype(np.float32).transpose(0, 3, 2, 1)  # (2, columns, u, 4N)
        force, steps = _gmres(close, np.sum(slopes[:, None] * along, axis=0), _FINE_KRYLOV)
        result = np.sum(each[:, None] * (along + moved(force))[:, :, place], axis=0)
        return grid.coarse_forces(result.transpose(2, 1, 0).astype(np.float64)), steps * force.shape[0] * force.shape[1]

    columns = motions.shape[3]
    parts, work = zip(*(reaction(motions[..., at : at + _BLOCK]) for at in range(0, columns, _BLOCK)), strict=True)
    return np.concatenate(parts, axis=2), sum(work)


def _gmres(
    apply: Callable[[FloatArray], FloatArray], right: FloatArray, krylov: int = _KRYLOV
) -> tuple[FloatArray, int]:
    """Solution x of apply(x) = right, and the steps it took.

    GMRES for all columns, of the first axis, at once (Saad and Schultz 1986).
    """
    columns, flat = len(right), right.reshape(len(right), -1)
    size = np.linalg.norm(flat, axis=1)
    used = size > 0
    if not used.any() or not np.isfinite(size).all():  # what diverged is judged by its residual
        return right, 0
    basis = np.empty((columns, krylov + 1, flat.shape[1]), right.dtype)
    basis[:, 0] = flat / np.where(used, size, 1.0)[:, None]
    hessenberg = np.zeros((columns, krylov + 1, krylov), right.dtype)
    target = np.zeros((columns, krylov + 1, 1), right.dtype)
    target[:, 0, 0] = size
    for k in range(krylov):
        w = apply(basis[:, k].reshape(right.shape)).reshape(flat.shape)
        known, length = basis[:, : k + 1], np.linalg.norm(w, axis=1)
        for _ in range(2):  # the second time where much was taken away (Daniel et al. 1976)
            before = length
            along = known @ w[:, :, None]
            w = w - (along.transpose(0, 2, 1) @ known)[:, 0]
            hessenberg[:, : k + 1, k] += along[:, :, 0]
            length = np.linalg.norm(w, axis=1)
            if np.all(length[used] > _CANCELLED * before[used]):
                break
        if not np.isfinite(length).all():
            return np.full_like(right, np.nan), k + 1
        hessenberg[:, k + 1, k] = length
        solved = np.linalg.pinv(hessenberg[:, : k + 2, : k + 1]) @ target[:, : k + 2]
        left = target[:, : k + 2] - hessenberg[:, : k + 2, : k + 1] @ solved
        if np.max(np.linalg.norm(left[:, :, 0], axis=1)[used] / size[used]) < _KRYLOV_TOLERANCE:
            break
        basis[:, k + 1] = w / np.where(length > 1e-12, length, 1.0)[:, None]
    found = solved.transpose(0, 2, 1) @ basis[:, : solved.shape[1]]
    return np.asarray(found.reshape(right.shape)), k + 1


def _slopes(forward: Forward, forces: LawForces, i: int) -> FloatArray:
    """Slopes of a law over deflection and rate, averaged over every sample, (2, N)."""
    found: FloatArray = _fine_slopes(forward, forces, i).reshape(2, -1, OVERSAMPLING).mean(axis=2)
    return found


def _fine_slopes(forward: Forward, forces: LawForces, i: int) -> FloatArray:
    """Derivatives of a law's force by deflection and rate along the trajectory, less its equivalent's, (2, 4N)."""
    term, grid = forces.terms[i], forward.part.grid
    law = term.element_law
    d, v = forces.deflection[:, i], forces.rate[:, i]
    if law.memory:
        return np.zeros((2, len(d)))
    time = grid.start + grid.fine_time
    element = forward.element_of(term)
    by_d, by_v = central_slopes(lambda a, b: force_along(law, term.parameters, d + a, v + b, time, element), d, v)
    return np.stack([by_d - term.equivalent[0], by_v - term.equivalent[1]])


def law_force(forward: Forward, term: Term, forces: LawForces) -> FloatArray:
    """Force of a law along the present trajectory, (4N,)."""
    return _force_of(forward, term, forces, forces.index(term), forward.element_of(term))


def _force_of(forward: Forward, term: Term, forces: LawForces, port: int, element: SpringDamper) -> FloatArray:
    """Force of a law beside a spring and damper along the present trajectory, (4N,)."""
    time = forward.part.grid.start + forward.part.grid.fine_time
    d, v = forces.deflection[:, port], forces.rate[:, port]
    return force_along(term.element_law, term.parameters, d, v, time, element)


class SmootherCorrection:
    """The part of a motion along the laws' ports that the smoother compensates.

    Inputs are smoothed anew when a value changes, so that the motion changes only as far as the noise of sensors and
    inputs allows: with large force noise, not at all.
    """

    def __init__(self, whitener: Whitener, forward: Forward, forces: LawForces) -> None:
        plant, self.grid = forward.plant, forward.part.grid
        band = self.grid.band
        ports = forward.plant.structure.padded(forces.ports)
        inputs = plant.deflection_of_inputs[band]
        self.deflection = ports @ inputs @ whitener.smoother_gain  # of whitened sensor signals, (F, m, S)
        self.rate = 1j * self.grid.omega[band, None, None] * self.deflection
        if plant.floats:
            steady = ports @ plant.structure.H @ plant.steady_rate @ plant.structure.F
            self.rate[0] = steady @ whitener.smoother_gain[0, plant.structure.G.shape[1] :]
        shown = plant.sensor_of_force[band] * forward.sensor_factor[band, :, None]
        self.seen = whitener.factor @ shown @ ports.T  # whitened sensor signals per force along the ports

    def motion(self, whitened: ComplexArray) -> FloatArray:
        """Compensated deflection and rate along the ports, (2, N, m, c), of whitened sensor signals (F, S, c)."""
        result = np.empty((2, self.grid.samples, self.deflection.shape[1], whitened.shape[2]))
        for k, rows in enumerate((self.deflection, self.rate)):
            spectra = np.zeros((len(self.grid.omega), *result.shape[2:]), dtype=complex)
            spectra[self.grid.band] = rows @ whitened
            result[k] = self.grid.inverse(spectra)
        return result
