"""Rows of the analysis: kernels of Fig. 3, and when magnitudes lose the parameters."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from benchmarks import paper_pictures
from benchmarks.paper_settings import Settings
from model.alps import kernels, phase

INPUTS = (1, 2, 4, 8)


def kernel_rows(settings: Settings) -> Iterator[dict[str, Any]]:
    """Spectra of the four composed kernels on the paper's signal."""
    views = {name: kernels.view(name) for name in kernels.FEATURES}
    for name, found in views.items():
        yield {
            "task": "kernels",
            "method": name,
            "first_eigenvalue_share": round(float(found.eigenvalues[0]), 4),
            "eigenvalues_above_0.1_percent_of_first": found.width(),
            "upper_half_band_share_of_row_spectrum": round(found.high_share(), 4),
            "row_minimum": round(float(found.row.min()), 4),
        }
    paper_pictures.kernels(views, settings.pictures / "kernels.png")


def phase_rows(settings: Settings) -> Iterator[dict[str, Any]]:
    """Mean relative error of the spring constants over the number of independent inputs."""
    windows, updates = (10_000, 600) if settings.budget == "quick" else (100_000, 10_000)
    rows = []
    for inputs in INPUTS:
        row = {
            "inputs": inputs,
            "guess": phase.guess_error(),
            "magnitude": phase.network_error("magnitude", inputs, windows, updates, settings.seed),
            "phase": phase.network_error("phase", inputs, windows, updates, settings.seed),
            "balance": phase.balance_error(inputs, settings.seed),
        }
        rows.append(row)
        yield {"task": "phase", "seed": settings.seed, "windows": windows, "updates": updates} | {
            k: round(v, 5) for k, v in row.items()
        }
    if settings.seed == 0:
        paper_pictures.phases(rows, settings.pictures / "phase.png")
