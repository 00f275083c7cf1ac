"""Cramer-Rao bounds of window estimates, computed in the time domain apart from the product's own likelihood.

Sensitivities are finite differences of the simulated outputs; the covariance of a window is built whole: sensor
noise on the diagonal, and the measured inputs' noise carried by every sample's pulse response.
"""

from __future__ import annotations

import numpy as np
import torch

from sprung.model.signals import FloatArray
from sprung.model.simulate.drives import drives_of
from sprung.model.simulate.fusion import motion
from sprung.model.simulate.linear import LinearSimulator
from sprung.model.system import System


def time_domain_bound(
    system: System, clean: FloatArray, log_ratio: FloatArray, *, fused: bool, offsets: bool = False
) -> FloatArray:
    """Standard deviations (P,) that no unbiased estimator of one window (T, C) can beat; initial state unknown.

    fused: displacement and velocity of a support are known to belong to one motion; otherwise each is an input of
    its own with its own noise.
    offsets: every sensor has one that nobody knows.
    """
    simulator = LinearSimulator(system)
    T, S = len(clean), len(system.sensors)
    w = torch.as_tensor(simulator.knots(clean[None]))
    x = torch.as_tensor(log_ratio)[None]
    values = simulator.element_values(x)
    discrete = simulator.discretise(values)
    free = simulator.free_response(discrete, T)[0].numpy().reshape(T * S, -1)
    if offsets:
        free = np.concatenate([free, np.tile(np.eye(S), (T, 1))], axis=1)
    measured = clean[:, len(system.inputs) :].reshape(-1)
    none = torch.zeros(1, discrete.Ad.shape[1], dtype=torch.float64)
    forced = simulator.simulate(x, w, none)[0].numpy().reshape(-1)
    x0 = torch.as_tensor(np.linalg.lstsq(free, measured - forced, rcond=None)[0][: none.shape[1]])[None]
    step = 1e-5
    shifts = torch.cat([torch.eye(x.shape[1]), -torch.eye(x.shape[1])]).double() * step
    moved = simulator.simulate(x + shifts, w.expand(len(shifts), -1, -1), x0.expand(len(shifts), -1))[0]
    up, down = moved.flatten(1).numpy().reshape(2, x.shape[1], -1)
    J = ((up - down) / (2 * step)).T
    covariance = np.diag(np.tile(system.sensor_noise**2, T)) + _input_covariance(system, simulator, x, T, fused)
    factor = np.linalg.cholesky(covariance)
    J, basis = np.linalg.solve(factor, J), np.linalg.solve(factor, free)
    q, _ = np.linalg.qr(basis / np.linalg.norm(basis, axis=0))
    J = J - q @ (q.T @ J)
    found: FloatArray = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    return found


def _input_covariance(system: System, simulator: LinearSimulator, x: torch.Tensor, T: int, fused: bool) -> FloatArray:
    """Covariance (T S, T S) of outputs from noise of the inputs, each a linear map of its samples' noise."""
    S = len(system.sensors)
    total = np.zeros((T * S, T * S))
    for drive, measured in enumerate(drives_of(system)):
        orders = list(measured.noise)
        if max(measured.noise.values()) == 0:
            continue
        samples = np.diag(np.repeat([measured.noise[order] for order in orders], T))  # of unit noises
        parts = {order: samples[:, i * T : (i + 1) * T] for i, order in enumerate(orders)}
        if fused:
            d, v = motion(parts, simulator.dt, measured.noise)
        else:
            d, v = motion(parts, simulator.dt, dict.fromkeys(orders, 0.0))
        knots = torch.zeros(len(samples), T, simulator.W, dtype=torch.float64)
        knots[:, :, 2 * drive], knots[:, :, 2 * drive + 1] = torch.as_tensor(d), torch.as_tensor(v)
        still = torch.zeros(len(samples), 2 * simulator.H.shape[1], dtype=torch.float64)
        outputs = simulator.simulate(x.expand(len(samples), -1), knots, still)[0].flatten(1).numpy()
        total += outputs.T @ outputs
    return total


def shared_bound(
    system: System, log_ratio: torch.Tensor, states: torch.Tensor, knots: torch.Tensor, *, free: bool
) -> FloatArray:
    """Standard deviations (P,) for parameters that many windows share: states (B, T, N), knots (B, T, W), exact inputs.

    Every window's first state is unknown.  free: the linear map from states and knots to the sensors is unknown too,
    the same for all windows.
    """
    simulator = LinearSimulator(system)
    P, S, step = len(log_ratio), len(system.sensors), 1e-5
    discrete = simulator.discretise(simulator.element_values(log_ratio[None]))
    offsets = torch.cat([torch.eye(P), -torch.eye(P)]).double() * step
    response = simulator.free_response(discrete, states.shape[1])[0].numpy()  # (T, S, N)
    noise = system.sensor_noise
    sizes = torch.cat([states, knots], dim=2).square().mean((0, 1)).sqrt().numpy()
    information = np.zeros(())
    for x, w in zip(states, knots, strict=True):
        outputs, paths = simulator.simulate(log_ratio + offsets, w.expand(2 * P, -1, -1), x[:1].expand(2 * P, -1))
        moved = paths @ discrete.C[0].mT if free else outputs
        J = ((moved[:P] - moved[P:]) / (2 * step)).permute(1, 2, 0).numpy()  # (T, S, P)
        if free:
            seen = np.concatenate([x.numpy(), w.numpy()], axis=1) / sizes  # (T, N + W)
            maps = np.einsum("tk,sr->tsrk", seen, np.eye(S)).reshape(*J.shape[:2], -1)
            J = np.concatenate([J, maps], axis=2)
        J, basis = ((v / noise[:, None]).reshape(-1, v.shape[2]) for v in (J, response))
        q, _ = np.linalg.qr(basis / np.linalg.norm(basis, axis=0))
        J = J - q @ (q.T @ J)
        information = information + J.T @ J
    size = np.sqrt(np.diag(information))
    covariance = np.linalg.pinv(information / np.outer(size, size), rcond=1e-14, hermitian=True)
    found: FloatArray = (np.sqrt(np.diag(covariance)) / size)[:P]
    return found
