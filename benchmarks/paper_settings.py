"""What one run of the paper's benchmark was asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sprung.model.alps.config import Budget
from sprung.model.alps.fit import TimeLimit

CORE = "core"
EXTRA = (
    "autoencoder_plain", "cdm_plain", "alps_plain", "no_opening", "no_affine_head", "all_states_shown", "no_phases",
    "no_tempering", "no_falling_prior", "scales_halved", "scales_doubled", "hamiltonian", "decoder_free",
)  # fmt: skip


@dataclass(frozen=True)
class PaperSettings:
    """One task, one seed."""

    task: str
    method: str | None  # one, several between commas, or "core"; None: every method
    budget: Budget
    seed: int
    out: Path
    device: str
    until: float | None  # time.monotonic() at which to stop

    @property
    def folder(self) -> Path:
        """Where checkpoints of this task and budget lie."""
        return self.out / self.budget / self.task

    @property
    def pictures(self) -> Path:
        """Where figures of this budget go."""
        folder = self.out / self.budget / "pictures"
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    @property
    def clock(self) -> TimeLimit:
        return TimeLimit() if self.until is None else TimeLimit(self.until)

    def wants(self, method: str) -> bool:
        """Whether a row was asked for: all of them, the paper's own and the untrained ones, or those that are named."""
        if self.method is None:
            return True
        named = self.method.split(",")
        return method in named or (CORE in named and method not in EXTRA)


def row_name(row: dict[str, Any], seed: int) -> str:
    """What the file of a row is called, and that of its errors."""
    what = row.get("method") or f"{row.get('inputs')}-inputs"
    return f"{row['task']}-{what}-s{seed}"
