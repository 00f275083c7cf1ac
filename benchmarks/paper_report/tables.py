"""Rows of a task as a Markdown table: several seeds become mean and standard deviation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

ORDER = (
    "zero", "opening", "output_error", "alps", "no_fourier", "no_attention", "autoencoder", "cdm",
    "autoencoder_plain", "cdm_plain", "alps_plain", "no_opening", "no_affine_head", "all_states_shown", "no_phases",
    "no_tempering", "no_falling_prior", "scales_halved", "scales_doubled", "hamiltonian", "decoder_free",
    "alps_smoothed", "alps_known_sensors", "alps_from_sensors", "bound_known_sensors", "bound_from_sensors",
    "guess_nominal", "alps_many", "force_balance", "refined", "refined_noisy_inputs", "refined_trajectory",
    "sensors_refined", "sensors_output_error",
)  # fmt: skip
COLUMNS: dict[str, tuple[str, ...]] = {
    "visual": (
        "SE", "SE_affine", "SE_affine_relative", "OE", "PE", "PE_relative", "PE_unseen_relative", "PE_below_relative",
        "PE_noisy_relative", "forecast_relative",
    ),
    "train": ("SE", "SE_relative", "PE", "PE_relative"),
    "train_changing": ("PE_relative", "error_at_bound", "SE", "PE", "windows", "samples", "iterations"),
    "train_drifting": ("PE_relative", "PE", "windows"),
    "poor_opening": ("SE_affine", "SE_affine_relative", "PE", "PE_relative"),
    "kernels": (
        "first_eigenvalue_share", "eigenvalues_above_0.1_percent_of_first", "upper_half_band_share_of_row_spectrum",
        "row_minimum",
    ),
    "phase": ("magnitude", "phase", "balance", "guess"),
    "phase_information": ("magnitudes", "spectra", "guess"),
    "features": (
        "PE_training_magnitudes", "PE_magnitudes", "PE_unseen_magnitudes", "PE_training_raw", "PE_raw", "PE_unseen_raw",
    ),
    "window_information": (
        "PE_states", "PE_magnitudes", "PE_states_inputs_known", "PE_magnitudes_inputs_known", "PE_guess",
    ),
}  # fmt: skip


def table(task: str, rows: list[dict[str, Any]]) -> str:
    """Markdown table of a task's rows, the paper's values in brackets; seeds where methods differ in them."""
    columns = COLUMNS.get(task, COLUMNS["visual"])
    methods = by_method(rows)
    differ = len({seeds_of(same) for same in methods.values()}) > 1
    lines = head("method", *(["seeds"] if differ else []), *columns)
    for method, same in methods.items():
        seeds = [seeds_of(same)] if differ else []
        lines.append(line(method, *seeds, *(cell(same, column) for column in columns)))
    return "\n".join(lines)


def explained_table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown table: R^2 of each state by method; methods without are left out."""
    columns = list(dict.fromkeys(key for row in rows for key in row if key.startswith("R2 ")))
    lines = head("method", *columns)
    for method, same in by_method(rows).items():
        if any(row.get(column) is not None for row in same for column in columns):
            lines.append(line(method, *(cell(same, column) for column in columns)))
    return "\n".join(lines)


def seeds_of(rows: Sequence[dict[str, Any]]) -> str:
    """The seeds of rows, "0, 1, 2"."""
    return ", ".join(str(seed) for seed in sorted({int(row.get("seed", 0)) for row in rows}))


def by_method(rows: Sequence[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Rows of each method, in the order in which tables show methods; unknown ones last."""
    names = {name_of(row) for row in rows}
    keys = sorted(names, key=lambda name: (ORDER.index(name) if name in ORDER else 99, name))
    return {key: [row for row in rows if name_of(row) == key] for key in keys}


def name_of(row: dict[str, Any]) -> str:
    """What the first column says of a row."""
    return str(row.get("method") or f"{row['inputs']} inputs")


def cell(rows: Sequence[dict[str, Any]], column: str) -> str:
    """Mean ± standard deviation over the rows of a method, and the paper's value."""
    values = [row[column] for row in rows if row.get(column) is not None]
    paper = rows[0].get("paper", {}).get(column)
    if not values:
        return "-" if paper is None else f"- ({paper:.4g})"
    text = f"{np.mean(values):.4g}"
    counts = all(isinstance(value, int) for value in values) and len(set(values)) == 1
    if len(values) > 1 and not counts:
        text += f" ± {np.std(values, ddof=1):.2g}"
    return text if paper is None else f"{text} ({paper:.4g})"


def head(*columns: str) -> list[str]:
    """The two lines with which a Markdown table begins."""
    return [line(*columns), "|---" * len(columns) + "|"]


def line(*cells: str) -> str:
    """One line of a Markdown table."""
    return f"| {' | '.join(cells)} |"
