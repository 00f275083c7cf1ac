"""How large the ingest on Ray Serve becomes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ServingSizes:
    """How much, at most."""

    replicas: int = 8  # that compute
    least: int = 1  # of these; with two, one that dies is not missed
    more_after_seconds: float = 10.0  # of more requests than they should have
    fewer_after_seconds: float = 120.0  # of fewer: one that starts imports for seconds
    cores: float = 0.8  # of a replica: two of them and the door are given room on a machine of two
    batch_windows: int = 32
    batch_messages: int = 64
    batch_wait_seconds: float = 0.02
    queued: int = 256  # requests for each replica that wait; more are 429
