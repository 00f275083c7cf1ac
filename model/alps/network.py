"""ALPS and its relatives, assembled: encoder -> estimator -> dynamics -> decoder.

| method | encoder | estimator | dynamics | decoder sees |
|---|---|---|---|---|
| alps | attention | features of abs(FFT) | simulator | simulated states |
| no_fourier | attention | raw states | simulator | simulated states |
| no_attention | MLP and differences | features of abs(FFT) | simulator | simulated states |
| autoencoder | attention | - | - | encoded states |
| cdm | attention | - | learned, with a context | predicted states |
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from sprung.model.alps.config import Method, NetworkConfig
from sprung.model.alps.context import ContextDynamics
from sprung.model.alps.decoder import StateDecoder
from sprung.model.alps.encoder import AttentionEncoder, DifferenceEncoder, Encoded
from sprung.model.alps.estimator import AlpsEstimator, log_magnitudes, raw
from sprung.model.alps.task import WINDOW, Task


@dataclass(frozen=True)
class Passed:
    """What one pass over a batch of windows gives."""

    encoded: Encoded
    parameters: Tensor | None  # (B, P)
    simulated: Tensor  # (B, T, N); the encoded states where a method has no dynamics
    observed: Tensor  # decoded embeddings or sensor values (B, T, E)


class Network(nn.Module):
    """One method on one task; works on embeddings of observations (see `frames.py`)."""

    def __init__(self, task: Task, method: Method, config: NetworkConfig) -> None:
        super().__init__()
        self.task, self.method = task, method
        encoder = DifferenceEncoder if method == "no_attention" else AttentionEncoder
        self.encoder = encoder(task, config)
        # With physics, positions alone are decoded: a picture shows no speed, and a decoder that sees the rates
        # lets the encoder store positions in them.  Without, the latent has no such parts.
        self.shown = tuple(range(len(task.states))) if method in ("autoencoder", "cdm") else task.placed
        seen = len(self.shown) + len(task.angles)
        self.decoder = StateDecoder(seen, config.embedding, config)
        self.estimator: AlpsEstimator | None = None
        self.context: ContextDynamics | None = None
        if method == "cdm":
            self.context = ContextDynamics(task, config)
        elif method != "autoencoder":
            self.estimator = AlpsEstimator(task, config, raw if method == "no_fourier" else log_magnitudes)
            self.encoder.head.straighten(task.placed)

    def forward(self, embeddings: Tensor, inputs: Tensor, horizon: int = WINDOW - 1, warm_up: bool = False) -> Passed:
        """Embeddings (B, T, E), inputs (B, T, I); `horizon` divides T - 1 (multiple shooting).

        In training mode the states are drawn from their posteriors, else they are its means.  During the
        warm-up states mean nothing yet: parameters stay at mid-range (or are read off the states), and with physics
        the decoder is affine.
        """
        encoded = self.encoder(embeddings)
        states = encoded.draw if self.training else encoded.mean
        parameters = None
        if self.estimator is not None:
            parameters = self.estimator.at_middle(len(states)) if warm_up else self.estimator(states)
        simulated = self._rollout(states, parameters, inputs, horizon, warm_up)
        straight = warm_up and self.estimator is not None
        observed = self.decoder(self.task.to_chart(simulated, self.shown), straight)
        return Passed(encoded, parameters, simulated, observed)

    def simulated(self, states: Tensor, inputs: Tensor, horizon: int) -> Tensor:
        """Simulation of encoded states (B, T, N) with the parameters that they give."""
        assert self.estimator is not None
        return self._rollout(states, self.estimator(states), inputs, horizon, warm_up=False)

    def _rollout(
        self, states: Tensor, parameters: Tensor | None, inputs: Tensor, horizon: int, warm_up: bool
    ) -> Tensor:
        """Dynamics from the encoded state at every multiple of `horizon`, float32 (B, T, N)."""
        if self.method == "autoencoder":
            return states
        batch, samples, size = states.shape
        segments = (samples - 1) // horizon
        start = states[:, : samples - 1 : horizon].reshape(-1, size)  # (B segments, N)
        steps = torch.arange(segments)[:, None] * horizon + torch.arange(horizon + 1)
        driven = inputs[:, steps].flatten(0, 1)  # (B segments, horizon + 1, I)
        if parameters is not None:
            each = parameters.repeat_interleave(segments, dim=0)
            if warm_up and self.task.read_off is not None:
                each = self.task.read_off(start)
            path = self.task.simulate(start.double(), each.double(), driven.double()).float()
        else:
            assert self.context is not None
            path = self.context(start, self.context.describe(states, inputs), driven)
        # keep samples 1..horizon of each segment, after the very first state
        return torch.cat([path[::segments, :1], path[:, 1:].reshape(batch, samples - 1, size)], dim=1)
