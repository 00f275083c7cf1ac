"""The trained estimator: Fourier features of a window to log-ratios with a covariance.

The force balance of a window (`amortised.features`) is solved by least squares over bins and degrees of freedom.  What
is learned: the weight of every row; how much of the known noise power to take out of the normal equations (noise in the
regressors pulls estimates towards zero); a small network that corrects what remains; and the scale of the covariance.
Everything else is mechanics, so the estimator extrapolates as the mechanics does.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from sprung.model.chunks import chunks, share
from sprung.model.identification.amortised.features import ForceBalance
from sprung.model.signals import BoolArray, FloatArray, IntArray
from sprung.model.simulate.loading import load_terms
from sprung.model.system import System

WEIGHTS = Path(__file__).parents[2] / "weights"
FORMAT = 1
_LOWEST_RATIO = 0.05
_LOST = 2.0  # log-ratio of an estimate at the bounds of its normal equations, 2.3; the network adds some


class ModelError(ValueError):
    """A model directory that cannot be used; the message says why and what to do."""


@dataclass(frozen=True, slots=True)
class EstimatorOutput:
    log_ratio: FloatArray  # shape (B, P), or (B, P + X) with what describes loads
    covariance: FloatArray  # predicted, shape (B, P, P)


@dataclass(frozen=True, slots=True)
class Architecture:
    """Sizes that the weights fit."""

    samples: int
    rows: int
    parameters: int
    hidden: int = 128


class EstimatorNet(nn.Module):
    """Weighted least squares with learned weights, noise compensation, correction and covariance scale."""

    noise: Tensor

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.architecture = architecture
        R, P, hidden = architecture.rows, architecture.parameters, architecture.hidden
        self.log_weight = nn.Parameter(torch.zeros(R))
        self.compensation = nn.Parameter(torch.tensor(2.0))  # share of the noise power removed, by a sigmoid
        self.log_scale = nn.Parameter(torch.zeros(P))  # standard deviation over that of the normal equations
        last = nn.Linear(hidden, P)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.correction = nn.Sequential(nn.Linear(2 * P, hidden), nn.SiLU(), last)
        # Power of noise in every row: products of [regressors, target], shape (R, P + 1, P + 1).
        self.register_buffer("noise", torch.zeros(R, P + 1, P + 1))

    def noise_taken(self) -> Tensor:
        """Expected contribution of noise to the weighted normal equations, to be subtracted, (P + 1, P + 1)."""
        weight = torch.exp(2 * self.log_weight)
        return (weight @ self.noise.flatten(1)).reshape(self.noise.shape[1:]) * torch.sigmoid(self.compensation)

    def load(self, target: Tensor, regressors: Tensor, by_load: Tensor, prior: Tensor) -> Tensor:
        """Estimates of the loads (B, X) from rows (B, R), (B, R, P), (B, R, X); prior: standard deviations (X,)."""
        weight = torch.exp(self.log_weight)[:, None]
        rows = torch.cat([regressors, by_load, target.unsqueeze(2)], dim=2) * weight
        products = rows.mT @ rows
        P, size = self.architecture.parameters, rows.shape[2] - 1
        normal, right = products[:, :size, :size], products[:, :size, size]
        # An upper bound of the rows' variance: what springs and dampers alone leave of the target.
        ridge = 1e-6 * torch.diagonal(normal, dim1=1, dim2=2) + 1e-12
        alone = torch.linalg.solve(normal[:, :P, :P] + torch.diag_embed(ridge[:, :P]), right[:, :P])
        left = (products[:, size, size] - (alone * right[:, :P]).sum(dim=1)).clamp_min(1e-12) / rows.shape[1]
        ridge = torch.cat([ridge[:, :P], left[:, None] / prior**2], dim=1)
        solved: Tensor = torch.linalg.solve(normal + torch.diag_embed(ridge), right)
        return solved[:, P:]

    def forward(self, target: Tensor, regressors: Tensor, noise_taken: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """log-ratio (B, P) and covariance (B, P, P) from rows (B, R) and (B, R, P)."""
        P = self.architecture.parameters
        rows = torch.cat([regressors, target.unsqueeze(2)], dim=2) * torch.exp(self.log_weight)[:, None]
        taken = self.noise_taken() if noise_taken is None else noise_taken
        products = rows.mT @ rows
        raw = products[:, :P, :P]
        diagonal = torch.diagonal(raw, dim1=1, dim2=2)
        # Never take out so much that the normal equations lose their definiteness.
        products = (
            products
            - taken
            * torch.clamp(0.5 * (diagonal / torch.diagonal(taken)[:P].clamp_min(1e-300)).amin(dim=1), max=1.0)[
                :, None, None
            ]
        )
        ridge = torch.diag_embed(1e-6 * diagonal + 1e-12)
        normal, right = products[:, :P, :P] + ridge, products[:, :P, P]
        ratio = torch.linalg.solve(normal, right)
        log_ratio = torch.log(nn.functional.softplus(ratio, beta=20.0) + _LOWEST_RATIO * 0.1).clamp(-2.3, 2.3)
        residual = (rows[:, :, P] - (rows[:, :, :P] @ ratio.unsqueeze(2)).squeeze(2)).square().mean(dim=1)
        inverse = torch.linalg.inv(raw + ridge) * residual[:, None, None]
        std = torch.diagonal(inverse, dim1=1, dim2=2).clamp_min(1e-12).sqrt() / torch.exp(log_ratio)
        known = torch.cat([log_ratio, torch.log(std)], dim=1)
        log_ratio = log_ratio + self.correction(known)
        scale = torch.exp(self.log_scale - log_ratio)
        return log_ratio, inverse * scale[:, :, None] * scale[:, None, :]


@dataclass(frozen=True)
class Manifest:
    """Contents of `manifest.json` beside the weights."""

    format: int
    system: str
    system_digest: str
    features: str
    architecture: dict[str, Any]
    training: dict[str, Any]
    seed: int
    measured: dict[str, Any]
    weights_sha256: str


class Estimator:
    """A trained network with the features it reads."""

    def __init__(self, system: System, net: EstimatorNet, digest: str = "untrained") -> None:
        self.system, self.net, self.digest = system, net.double().eval(), digest
        self.samples = net.architecture.samples
        self.features = ForceBalance(system, self.samples)
        stds = [term.std for term in load_terms(system)][: self.features.simulator.loading.of_loads]
        self.load_prior = torch.as_tensor(stds, dtype=torch.float64)
        with torch.no_grad():
            self.noise_taken = self.net.noise_taken()

    def estimate(self, windows: FloatArray, workers: int = 1, *, loads: bool = False) -> EstimatorOutput:
        """Log-ratios and predicted covariances of windows (B, T, C); `workers`: see `model.chunks`.

        loads: what describes the system's loads is estimated, too, and follows the P parameters in `log_ratio`.
        """

        def work(at: IntArray) -> tuple[FloatArray, FloatArray]:
            with torch.no_grad():
                if loads:
                    target, regressors, by_load = self.features.with_loads(windows[at])
                    change = self.net.load(target, regressors, by_load, self.load_prior)
                    target = target - (by_load @ change.unsqueeze(2)).squeeze(2)
                    log_ratio, covariance = self.net(target, regressors, self.noise_taken)
                    log_ratio = torch.cat([log_ratio, self.features.simulator.loading.terms_of(change)], dim=1)
                else:
                    log_ratio, covariance = self.net(*self.features(windows[at]), self.noise_taken)
            finite = torch.isfinite(log_ratio).all(dim=1)
            return torch.where(finite[:, None], log_ratio, torch.zeros_like(log_ratio)).numpy(), covariance.numpy()

        parts = share(work, chunks(np.arange(len(windows))), workers)
        return EstimatorOutput(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def start(self, windows: FloatArray, workers: int = 1, *, loads: bool = False) -> FloatArray:
        """Log-ratios to refine from, as `estimate` has them; nominal where it is at its bounds.

        There its normal equations hold nothing of some parameter, as of a bogie without any sensor.
        """
        found = self.estimate(windows, workers, loads=loads).log_ratio
        P = len(self.system.parameters)
        lost: BoolArray = np.asarray((np.abs(found[:, :P]) > _LOST).any(axis=1))
        return np.where(lost[:, None], 0.0, found)


def new_estimator(system: System, seed: int = 0) -> EstimatorNet:
    """An untrained network of the right sizes for a system, its first weights drawn from `seed`."""
    features = ForceBalance(system, system.window)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return EstimatorNet(Architecture(system.window, features.rows, len(system.parameters)))


def save_estimator(
    directory: str | Path,
    system: System,
    net: EstimatorNet,
    training: dict[str, Any],
    seed: int,
    measured: dict[str, Any],
) -> Manifest:
    """Write `weights.safetensors` and `manifest.json`; the manifest last, so that half a model never loads."""
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    blob = save({name: tensor.detach().float().contiguous() for name, tensor in net.state_dict().items()})
    manifest = Manifest(
        format=FORMAT,
        system=system.name,
        system_digest=system.digest,
        features="force-balance",
        architecture=asdict(net.architecture),
        training=training,
        seed=seed,
        measured=measured,
        weights_sha256=hashlib.sha256(blob).hexdigest(),
    )
    (directory / "weights.safetensors").write_bytes(blob)
    (directory / "manifest.json").write_text(json.dumps(asdict(manifest), indent=1) + "\n")
    return manifest


def load_estimator(directory: str | Path, system: System) -> Estimator:
    """Load a model for a system.

    Errors: `ModelError` for a model of another system, a damaged or foreign file; pickles are never read.
    """
    directory = Path(directory)
    try:
        raw = json.loads((directory / "manifest.json").read_text(encoding="utf-8"))
        manifest = Manifest(**raw)
        architecture = Architecture(**manifest.architecture)
        blob = (directory / "weights.safetensors").read_bytes()
    except OSError as error:
        raise ModelError(
            f"{directory}: not a model directory (manifest.json and weights.safetensors): {error.strerror}"
        ) from None
    except (ValueError, TypeError) as error:
        raise ModelError(f"{directory}/manifest.json: not a model manifest: {error}") from None
    if manifest.format != FORMAT:
        raise ModelError(f"{directory}: model format {manifest.format}, this version reads {FORMAT}; train again")
    if manifest.system_digest != system.digest:
        raise ModelError(
            f"{directory}: this model was trained for {manifest.system!r} ({manifest.system_digest}), "
            f"the system file is {system.name!r} ({system.digest}); run `sprung train --system FILE`"
        )
    if hashlib.sha256(blob).hexdigest() != manifest.weights_sha256:
        raise ModelError(f"{directory}/weights.safetensors: contents do not match the manifest; the file is damaged")
    net = EstimatorNet(architecture)
    try:
        with safe_open(directory / "weights.safetensors", framework="pt") as file:
            net.load_state_dict({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
    except (SafetensorError, RuntimeError) as error:
        raise ModelError(f"{directory}/weights.safetensors: not the weights of this model: {error}") from None
    return Estimator(system, net, manifest.weights_sha256[:8])


def bundled_estimator(system: System) -> Estimator | None:
    """The shipped model of this very system, or None."""
    for directory in sorted(WEIGHTS.glob("*/")):
        manifest = directory / "manifest.json"
        if manifest.is_file() and json.loads(manifest.read_text())["system_digest"] == system.digest:
            return load_estimator(directory, system)
    return None


def noise_power(features: ForceBalance, rng: np.random.Generator, windows: int = 2000) -> Tensor:
    """Mean products of the rows that measurement noise alone causes, (R, P + 1, P + 1).

    Features are linear in the window, so windows of noise alone give the noise part of any window's rows.
    """
    system = features.system
    noise = np.array([channel.noise for channel in system.channels])
    total = torch.zeros(features.rows, len(system.parameters) + 1, len(system.parameters) + 1, dtype=torch.float64)
    for _ in range(0, windows, 200):
        target, regressors = features(noise * rng.standard_normal((200, features.samples, len(noise))))
        rows = torch.cat([regressors, target.unsqueeze(2)], dim=2)
        total += torch.einsum("bri,brj->rij", rows, rows)
    return total / (200 * len(range(0, windows, 200)))
