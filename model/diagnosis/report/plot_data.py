"""Arrays for the plots of a report (keys in `model.diagnosis.report.report`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.investigation.state import Investigation
from sprung.model.diagnosis.response.terms import Term, evaluated_in_time
from sprung.model.diagnosis.screening.score import Projector
from sprung.model.diagnosis.selection.holdout import FreeRun
from sprung.model.laws import ElementLaw, Motion
from sprung.model.laws.along import force_along
from sprung.model.laws.basis import StaticLaw
from sprung.model.laws.expression import MOTION, parse
from sprung.model.laws.spline import SurfaceLaw
from sprung.model.signals import FloatArray

_MOST = 4000  # samples of a scatter
_BINS = 41  # of a force map along deflection and rate


def plot_data_of(
    state: Investigation, before: FreeRun, after: FreeRun, floor: FloatArray, order: list[tuple[str, str]]
) -> dict[str, NDArray[Any]]:
    """All arrays of an investigation.

    floor: bounded noise (S,), in the sensors' units; order: place and effect of every finding, as reported.
    """
    rate = state.signals.sample_rate
    start = state.held.split + round(state.signals.start * rate)
    arrays: dict[str, NDArray[Any]] = {
        "validation.time": (start + np.arange(len(before.measured))) / rate,
        "validation.measured": before.measured,
        "validation.baseline": before.simulated,
        "validation.augmented": after.simulated,
        "validation.noise": floor,
    }
    scores = state.first.localization()
    arrays["localization.names"] = np.array(list(scores), dtype=str)
    arrays["localization.score"] = np.array(list(scores.values()))
    for term in state.fit.point.terms:
        place = (term.location, term.law.name)
        if isinstance(term.law, ElementLaw) and place in order:
            arrays.update(_of_element(state, term, f"finding.{order.index(place)}"))
    return arrays


def _of_element(state: Investigation, term: Term, key: str) -> dict[str, NDArray[Any]]:
    """Motion of the element, its missing force before and after, and the law."""
    fit, grid = state.fit, state.problem.part.grid
    port = term.port(state.system)
    d_all, v_all = fit.element_motion
    d, v = (d_all @ port)[::4], (v_all @ port)[::4]
    thin = slice(None, None, max(1, len(d) // _MOST))
    time = grid.start + grid.time
    if evaluated_in_time(term):
        law = force_along(term.element_law, term.parameters, d, v, time, fit.forward.element_of(term))
    else:
        law = np.zeros_like(d)
    after, deviation = missing_force(state, fit, port)
    before, _ = missing_force(state, state.base, port)
    by_rate = abs(_share(law, v)) > abs(_share(law, d)) if np.any(law) else False
    x = v if by_rate else d
    grid_x = _axis(x, 0.002)
    mean, std, drawn = binned(x, after + law, law, deviation, grid_x)
    result: dict[str, NDArray[Any]] = {
        f"{key}.time": time[thin],
        f"{key}.deflection": d[thin],
        f"{key}.rate": v[thin],
        f"{key}.force_before": before[thin],
        f"{key}.force_after": after[thin],
        f"{key}.curve_axis": np.array("rate" if by_rate else "deflection"),
        f"{key}.curve_x": grid_x,
        f"{key}.curve_mean": mean,
        f"{key}.curve_std": std,
    }
    if isinstance(term.law, StaticLaw):
        result.update(_surface(state, term, term.law, key, d, v))
    elif isinstance(term.law, SurfaceLaw) and term.law.latent is not None:
        drawn_map = term.law.latent.map((_BINS, _BINS))
        result[f"{key}.map_d"], result[f"{key}.map_v"] = drawn_map.deflection, drawn_map.rate
        result[f"{key}.map_force"], result[f"{key}.map_std"] = drawn_map.force, drawn_map.std
    elif _of_both(term):
        result.update(_formula_map(state, term, key, d, v))
    else:
        result[f"{key}.curve_law"] = drawn
    if term.law.memory and np.any(law):
        part = slice(len(d) // 2, len(d) // 2 + int(3 / grid.step))
        result[f"{key}.loop_x"], result[f"{key}.loop_y"] = d[part], law[part]
    return result


def _surface(
    state: Investigation, term: Term, law: StaticLaw, key: str, d: FloatArray, v: FloatArray
) -> dict[str, NDArray[Any]]:
    """The unnamed force over deflection and rate, with its standard deviation."""
    axis_d, axis_v = _axis(d, 0.005), _axis(v, 0.005)
    mesh_d, mesh_v = np.meshgrid(axis_d, axis_v)
    values = np.stack([np.broadcast_to(b, mesh_d.shape) for b in law.values(mesh_d, mesh_v)])
    keys = [other.key for other in state.fit.point.terms]
    place = state.fit.place(keys.index(term.key))
    block = state.fit.covariance[place, place]
    variance = np.einsum("ivd,ij,jvd->vd", values, block, values)
    return {
        f"{key}.map_d": axis_d,
        f"{key}.map_v": axis_v,
        f"{key}.map_force": np.einsum("i,ivd->vd", np.array(term.parameters), values),
        f"{key}.map_std": np.sqrt(np.maximum(variance, 0)),
    }


def _of_both(term: Term) -> bool:
    """Whether a term is a formula in both deflection and rate."""
    law = term.law
    if not law.of_formula or law.memory:
        return False
    return {"d", "v"} <= parse(law.formula, {*law.names, *MOTION}).names


def _formula_map(state: Investigation, term: Term, key: str, d: FloatArray, v: FloatArray) -> dict[str, NDArray[Any]]:
    """A formula's force over deflection and rate, with its standard deviation."""
    axis_d, axis_v = _axis(d, 0.005), _axis(v, 0.005)
    motion, element = Motion(*np.meshgrid(axis_d, axis_v), 0.0, ()), state.fit.forward.element_of(term)

    def force(values: FloatArray) -> FloatArray:
        return np.asarray(term.element_law.force(motion, tuple(values.tolist()), element), dtype=float)

    place = state.fit.place([other.key for other in state.fit.point.terms].index(term.key))
    block, values = state.fit.covariance[place, place], np.array(term.parameters)
    steps = np.maximum(1e-6 * np.abs(values), 1e-12)
    slopes = np.stack([(force(values + step) - force(values - step)) for step in np.diag(steps)])
    slopes = slopes / (2 * steps[:, None, None])
    variance = np.einsum("ivd,ij,jvd->vd", slopes, block, slopes)
    return {
        f"{key}.map_d": axis_d,
        f"{key}.map_v": axis_v,
        f"{key}.map_force": force(values),
        f"{key}.map_std": np.sqrt(np.maximum(variance, 0)),
    }


def missing_force(state: Investigation, fit: Fit, port: FloatArray) -> tuple[FloatArray, float]:
    """Force along a port that explains the residual of a fit, N, (N,), and its standard deviation.

    Bin by bin with a flat prior cut where the sensors see nothing: f = (r^H R^-1 y) / (r^H R^-1 r + prior).
    """
    projector = Projector(state.problem, fit)
    response = projector.of_force[:, :, : len(port)] @ port
    residual = projector.factor @ fit.spectrum[projector.grid.band][:, :, None]
    seen = np.sum(np.abs(response) ** 2, axis=1)
    prior = 1e-3 * float(np.max(seen)) + 1e-300
    estimate = np.einsum("fs,fs->f", response.conj(), residual[:, :, 0]) / (seen + prior)
    spectrum = np.zeros(len(projector.grid.omega), dtype=complex)
    spectrum[projector.grid.band] = estimate
    variance = float(np.mean(seen / (seen + prior) ** 2))
    return projector.grid.inverse(spectrum), float(np.sqrt(variance))


def _axis(x: FloatArray, outside: float) -> FloatArray:
    low, high = np.quantile(x, [outside, 1 - outside])
    return np.linspace(float(low), float(high), _BINS)


def _share(force: FloatArray, signal: FloatArray) -> float:
    return float(np.corrcoef(force, signal)[0, 1]) if np.std(signal) > 0 and np.std(force) > 0 else 0.0


def binned(
    x: FloatArray, force: FloatArray, law: FloatArray, deviation: float, grid: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean of the force (N,) over bins of x (N,), its standard deviation, and the law's mean in the same bins.

    deviation: standard deviation of one sample of the force, N; grid: centres of the bins (m,), in ascending order.
    Bins without a sample are NaN.
    """
    edges = np.concatenate([[-np.inf], (grid[1:] + grid[:-1]) / 2, [np.inf]])
    which = np.digitize(x, edges) - 1
    count = np.bincount(which, minlength=len(grid))
    samples = np.where(count > 0, count, np.nan)
    mean = np.bincount(which, force, len(grid)) / samples
    drawn = np.bincount(which, law, len(grid)) / samples
    return mean, deviation / np.sqrt(samples) * 2.0, drawn
