"""Batches worked on in pieces that stay in the caches, shared among threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import TypeVar

import numpy as np

from sprung.model.signals import BoolArray, IntArray

CHUNK = 32  # windows
WORKERS = min(2, os.cpu_count() or 1)  # of a diagnosis: each fit holds some 200 MB for a minute of twelve sensors
Piece = TypeVar("Piece")
Result = TypeVar("Result")


def chunks(of: IntArray) -> list[IntArray]:
    """Indices (N,) in pieces of at most `CHUNK`, of nearly equal size."""
    return [np.asarray(part) for part in np.array_split(of, max(1, -(-len(of) // CHUNK)))]


def alike(present: BoolArray, of: IntArray) -> list[IntArray]:
    """The windows `of` in groups with the same signals present; present (B, S)."""
    chosen = present[of]
    if (chosen == chosen[:1]).all():
        return [of]
    patterns, which = np.unique(chosen, axis=0, return_inverse=True)
    return [of[which.reshape(-1) == i] for i in range(len(patterns))]


def share(work: Callable[[Piece], Result], pieces: Sequence[Piece], workers: int) -> list[Result]:
    """Results in order; with more than one worker the pieces are shared among that many threads.

    torch's own threads should then be one (`torch.set_num_threads(1)`): its operations here are too small to split.
    What the caller has set for its context, such as NumPy's handling of overflow, holds in the threads, too.
    """
    if workers > 1 and len(pieces) > 1:
        contexts = [copy_context() for _ in pieces]
        with ThreadPoolExecutor(workers) as pool:
            return list(pool.map(lambda context, piece: context.run(work, piece), contexts, pieces))
    return [work(piece) for piece in pieces]
