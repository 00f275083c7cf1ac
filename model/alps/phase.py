"""When magnitudes of spectra suffice, and when they lose the parameters: an experiment with 1 to 8 inputs.

A mass rests on I springs, each on a support that moves by itself.  With H_i = (k_i + j w c) / (K + j w C - w^2 m),
K and C the sums over the springs, the response is

    Z(w) = sum_i H_i(w) U_i(w)

One input: |Z| / |U| = |H|, which holds the parameter; nothing is lost with the phases.  Several independent inputs:
|Z|^2 = sum_i |H_i U_i|^2 + 2 Re sum_{i<j} H_i U_i conj(H_j U_j), and the second sum, of the size of the first, turns
with the inputs' relative phases.  From magnitudes alone it is noise that no amount of data removes from one window;
only the sum of the squares, smoothed over bins, is left to tell one spring from another.  With the phases the force
balance  -w^2 m Z = sum_i (k_i + j w c) (U_i - Z)  is linear in k_i: F complex equations for I unknowns.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

BINS = np.arange(1, 26)  # Hz: a window of one second at 100 Hz, up to half of its band
MASS = 1000.0  # kg
TOTAL = 4.0e6  # N/m, the springs' sum at nominal: resonance at 10 Hz whatever their number
DAMPING = 1.2e4  # N s/m, sum of the dampers
SPREAD = 0.5
NOISE = 0.01  # of the rms of each signal


def draw(count: int, inputs: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ratios (B, I), measured spectra of the supports (B, F, I) and of the mass (B, F)."""
    ratio = rng.uniform(1 - SPREAD, 1 + SPREAD, (count, inputs))
    omega = 2 * np.pi * BINS

    def circular(*shape: int) -> np.ndarray:
        return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)

    supports = circular(count, len(BINS), inputs)
    stiffness = ratio * TOTAL / inputs
    dynamic = stiffness[:, None, :] + 1j * omega[:, None] * DAMPING / inputs
    denominator = stiffness.sum(1)[:, None] + 1j * omega * DAMPING - omega**2 * MASS
    response = (dynamic * supports).sum(2) / denominator
    noisy = supports + NOISE * circular(count, len(BINS), inputs)
    size = np.sqrt((np.abs(response) ** 2).mean(1, keepdims=True))
    return ratio, noisy, response + NOISE * size * circular(count, len(BINS))


def balance(supports: np.ndarray, response: np.ndarray) -> np.ndarray:
    """Ratios (B, I) by least squares of the complex force balance."""
    inputs, omega = supports.shape[2], 2 * np.pi * BINS
    relative = supports - response[:, :, None]
    rows = relative * TOTAL / inputs
    known = -(omega**2) * MASS * response - 1j * omega * DAMPING / inputs * relative.sum(2)
    rows, known = np.concatenate([rows.real, rows.imag], 1), np.concatenate([known.real, known.imag], 1)
    normal = np.einsum("bfi,bfj->bij", rows, rows)
    return np.linalg.solve(normal, np.einsum("bfi,bf->bi", rows, known)[..., None])[..., 0]


def features(kind: str, supports: np.ndarray, response: np.ndarray) -> torch.Tensor:
    """`magnitude`: log |U|, log |Z|.  `phase`: those, and Z conj(U_i) / (|Z| |U_i|), the phases between them.

    Of spectra U of supports (B, F, I) and Z of a response (B, F), one row for each of B.
    """
    signals = np.concatenate([supports, response[:, :, None]], axis=2)
    size = np.log(np.abs(signals) + 1e-3)
    parts = [size.reshape(len(size), -1)]
    if kind == "phase":
        cross = response[:, :, None] * supports.conj()
        turn = cross / np.abs(cross)
        parts += [turn.real.reshape(len(size), -1), turn.imag.reshape(len(size), -1)]
    return torch.from_numpy(np.concatenate(parts, axis=1)).float()


def network_error(kind: str, inputs: int, windows: int, updates: int, seed: int = 0) -> float:
    """Mean relative error on fresh windows of a supervised network on the features, per spring."""
    rng = np.random.default_rng([seed, inputs])
    ratio, supports, response = draw(windows, inputs, rng)
    known, aims = features(kind, supports, response), torch.from_numpy(ratio).float()
    mean, spread = known.mean(0), known.std(0)
    torch.manual_seed(seed)
    net = nn.Sequential(
        nn.Linear(known.shape[1], 256), nn.ReLU(), nn.Linear(256, 128), nn.ReLU(), nn.Linear(128, inputs)
    )  # fmt: skip
    optimiser = torch.optim.AdamW(net.parameters(), 2e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, updates)
    for _ in range(updates):
        pick = torch.from_numpy(rng.integers(windows, size=256))
        loss = (1 + net((known[pick] - mean) / spread) - aims[pick]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    fresh, supports, response = draw(2000, inputs, np.random.default_rng([seed, inputs, 1]))
    with torch.no_grad():
        found = 1 + net((features(kind, supports, response) - mean) / spread).double().numpy()
    return float((np.abs(found - fresh) / fresh).mean())


def balance_error(inputs: int, seed: int = 0) -> float:
    """Mean relative error of the least-squares force balance on the same fresh windows, untrained."""
    fresh, supports, response = draw(2000, inputs, np.random.default_rng([seed, inputs, 1]))
    return float((np.abs(balance(supports, response) - fresh) / fresh).mean())


def guess_error() -> float:
    """Mean relative error of always answering nominal: (1/2s) integral |1 - r| / r dr over 1 - s .. 1 + s."""
    s = SPREAD
    return float((-np.log(1 - s) - s + s - np.log(1 + s)) / (2 * s)) if s else 0.0
