"""The frame autoencoder: conv embedding and deconv decoder, trained once per task on unique frames.

Windows overlap (26 windows share 125 frames), so the convolutional embedding is trained and applied per frame, once,
and shared by every method of a task: what the methods differ in comes after it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sprung.model.alps.config import NetworkConfig
from sprung.model.alps.decoder import DeconvolutionalDecoder
from sprung.model.alps.embedding import ConvolutionalEmbedding
from sprung.model.alps.task import Task

_AT_ONCE = 1000  # pictures, which need not all be in memory


class FrameAutoencoder(nn.Module):
    """Pictures (M, 3, 64, 64) -> standardised embeddings (M, E) -> pictures.

    Feature points of untrained convolutions move by hundredths already with the state.  They are scaled to unit
    spread before training (`inner`), so that the decoder can follow them from the first update, and once more after it
    (`outer`), so that every column weighs alike for the networks that work on embeddings.
    """

    inner: Tensor  # (2, E): mean and spread
    outer: Tensor  # (2, E)

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.embed = ConvolutionalEmbedding(config)
        self.draw = DeconvolutionalDecoder(config)
        unit = torch.stack([torch.zeros(config.embedding), torch.ones(config.embedding)])
        self.register_buffer("inner", unit.clone())
        self.register_buffer("outer", unit.clone())

    def encode(self, pictures: Tensor) -> Tensor:
        """(M, 3, 64, 64) -> standardised embeddings (M, E)."""
        return (self._points(pictures) - self.outer[0]) / self.outer[1]

    def decode(self, embeddings: Tensor) -> Tensor:
        """Standardised embeddings (M, E) -> (M, 3, 64, 64)."""
        return self.draw(embeddings * self.outer[1] + self.outer[0])

    def forward(self, pictures: Tensor) -> Tensor:
        """Reconstruction of pictures."""
        return self.draw(self._points(pictures))

    def _points(self, pictures: Tensor) -> Tensor:
        return (self.embed(pictures) - self.inner[0]) / self.inner[1]

    @torch.no_grad()
    def standardise(self, pictures: Tensor, before: bool) -> None:
        """Set the scaling `before` or after training from a sample of pictures."""
        found = self.embed(pictures) if before else self._points(pictures)
        scaling = self.inner if before else self.outer
        scaling.copy_(torch.stack([found.mean(0), found.std(0).clamp_min(1e-4)]))

    @torch.no_grad()
    def encode_rollouts(self, task: Task, states: Tensor) -> Tensor:
        """Render true states (R, T, N) and embed every frame once -> (R, T, E)."""
        assert task.render is not None
        flat = states.reshape(-1, states.shape[-1])
        parts = [self.encode(task.render(part)) for part in flat.split(_AT_ONCE)]
        return torch.cat(parts).reshape(*states.shape[:2], -1)
