"""ALPS and its relatives, assembled by recipe: encoder -> estimator -> dynamics -> decoder.

| method | encoder | estimator | dynamics | decoder sees |
|---|---|---|---|---|
| alps | attention | features of abs(FFT) | simulator | simulated positions |
| no_fourier | attention | raw states | simulator | simulated positions |
| no_attention | MLP and differences | features of abs(FFT) | simulator | simulated positions |
| decoder_free | MLP and differences | features of abs(FFT) | simulator | - |
| cdm | attention | - | learned, with a context | predicted positions |
| hamiltonian | attention | - | learned energy, with a context | predicted positions |
| autoencoder | attention | - | - | encoded states |

The other methods of `config.RECIPES` differ from these in how they are helped and trained.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from sprung.model.alps.config import RECIPES, NetworkConfig, Recipe
from sprung.model.alps.context import ContextDynamics
from sprung.model.alps.decoder import StateDecoder
from sprung.model.alps.encoder import AttentionEncoder, DifferenceEncoder, Encoded
from sprung.model.alps.estimator import AlpsEstimator, log_magnitudes, raw
from sprung.model.alps.hamiltonian import HamiltonianDynamics
from sprung.model.alps.task import WINDOW, Task


@dataclass(frozen=True)
class Passed:
    """What one pass over a batch of windows gives."""

    encoded: Encoded
    parameters: Tensor | None  # (B, P)
    simulated: Tensor  # (B, T, N); the encoded states where a method has no dynamics
    observed: Tensor | None  # decoded embeddings or sensor values (B, T, E); None without a decoder


class Network(nn.Module):
    """One method on one task; works on embeddings of observations (see `frames.py`)."""

    def __init__(self, task: Task, method: str, config: NetworkConfig, drive: Tensor | None = None) -> None:
        """`drive`: size of each input (I,), by which learned dynamics scale them; None: as they are."""
        super().__init__()
        self.recipe: Recipe = RECIPES[method]
        self.task = task = replace(task, state_scale=tuple(self.recipe.scale * size for size in task.state_scale))
        self.method = method
        encoder = AttentionEncoder if self.recipe.attention else DifferenceEncoder
        self.encoder = encoder(task, config)
        # A picture shows no speed: a decoder that sees rates lets the encoder store positions in them.  Without
        # dynamics nothing else would say what the rates are.
        self.shown = task.placed if self.recipe.positions_shown else tuple(range(len(task.states)))
        self.decoder: StateDecoder | None = None
        if self.recipe.drawn:
            self.decoder = StateDecoder(len(self.shown) + len(task.angles), config.embedding, config)
        self.estimator: AlpsEstimator | None = None
        self.context: ContextDynamics | HamiltonianDynamics | None = None
        if self.recipe.dynamics == "context":
            self.context = ContextDynamics(task, config, drive)
        elif self.recipe.dynamics == "hamiltonian":
            self.context = HamiltonianDynamics(task, config, drive)
        elif self.recipe.physical:
            self.estimator = AlpsEstimator(task, config, log_magnitudes if self.recipe.fourier else raw)
        if self.recipe.straight:
            self.encoder.head.straighten(task.placed)

    def forward(self, embeddings: Tensor, inputs: Tensor, horizon: int = WINDOW - 1, warm_up: bool = False) -> Passed:
        """Embeddings (B, T, E), inputs (B, T, I); `horizon` divides T - 1 (multiple shooting).

        In training mode the states are drawn from their posteriors, else they are its means.  During the
        warm-up states mean nothing yet: parameters stay at mid-range (or are read off the states), and the decoder of
        straight positions is affine.
        """
        encoded = self.encoder(embeddings)
        states = encoded.draw if self.training else encoded.mean
        parameters = None
        if self.estimator is not None:
            parameters = self.estimator.at_middle(len(states)) if warm_up else self.estimator(states)
        simulated = self._rollout(states, parameters, inputs, horizon, warm_up)
        observed = None
        if self.decoder is not None:
            observed = self.decoder(self.task.to_chart(simulated, self.shown), warm_up and self.recipe.straight)
        return Passed(encoded, parameters, simulated, observed)

    def simulated(self, states: Tensor, inputs: Tensor, horizon: int) -> Tensor:
        """Simulation of encoded states (B, T, N) with the parameters that they give."""
        assert self.estimator is not None
        return self._rollout(states, self.estimator(states), inputs, horizon, warm_up=False)

    def forecast(self, embeddings: Tensor, inputs: Tensor) -> Tensor | None:
        """States of a window and of what follows it, by the window alone.

        Embeddings (B, T, E), inputs (B, T + F, I) -> (B, T + F, N); None for a method without dynamics.
        """
        states = self.encoder(embeddings).mean
        start = states[:, 0]
        if self.estimator is not None:
            parameters = self.estimator(states)
            return self.task.simulate(start.double(), parameters.double(), inputs.double())
        if self.context is not None:
            described = self.context.describe(states, inputs[:, : states.shape[1]])
            return self.context(start, described, inputs).double()
        return None

    def _rollout(
        self, states: Tensor, parameters: Tensor | None, inputs: Tensor, horizon: int, warm_up: bool
    ) -> Tensor:
        """Dynamics from the encoded state at every multiple of `horizon`, float32 (B, T, N)."""
        if self.recipe.dynamics == "none":
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
