"""Pictures of the paper's benchmark: latent states, reconstructed frames, kernels, phases."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from sprung.model.alps.evaluate import Predicted
from sprung.model.alps.fit import VisualModel
from sprung.model.alps.kernels import SAMPLE_RATE, KernelView, six_sines
from sprung.model.alps.task import Task

plt.rcParams.update({"font.size": 9, "axes.titlesize": 9, "legend.fontsize": 8})
plt.rcParams.update({"savefig.dpi": 150, "figure.constrained_layout.use": True})
METHOD_NAMES = {
    "alps": "ALPS",
    "no_fourier": "w/o Fourier",
    "no_attention": "w/o attention",
    "autoencoder": "autoencoder",
    "cdm": "CDM",
    "alps_from_sensors": "ALPS from 12 sensors",
}


def states(task: Task, shown: dict[str, Predicted], path: Path, window: int = 0) -> None:
    """True, encoded and simulated states of one test window, a column for each of the paper's methods."""
    shown = {method: found for method, found in shown.items() if method in METHOD_NAMES}
    if not shown:
        return
    picked = range(0, len(task.states), max(1, len(task.states) // 4))
    figure, axes = plt.subplots(
        len(picked), len(shown), figsize=(9, 1.7 * len(picked)), sharex=True, sharey="row", squeeze=False
    )
    time = np.arange(next(iter(shown.values())).true.shape[1]) / task.sample_rate
    for column, (method, found) in enumerate(shown.items()):
        for row, state in enumerate(picked):
            ax = axes[row, column]
            turns = state in task.angles  # drawn as points: a line would cross the picture at every turn
            for values, style, size, label in (
                (found.true, "k." if turns else "k-", 5, "true"),
                (found.encoded, "C0.", 2.5, "encoded"),
                (found.simulated, "C1." if turns else "C1--", 1, "simulated"),
            ):
                line = values[window, :, state].numpy()
                line = (line + np.pi) % (2 * np.pi) - np.pi if turns else line
                ax.plot(time, line, style, ms=size, lw=1, label=label)
            spread = found.true[window, :, state]
            low, high, more = float(spread.min()), float(spread.max()), float(spread.std())
            ax.set_ylim((-np.pi, np.pi) if turns else (low - more, high + more))
            if column == 0:
                ax.set_ylabel(task.states[state])
        axes[0, column].set_title(METHOD_NAMES[method])
        axes[-1, column].set_xlabel("time [s]")
    figure.legend(*axes[-1, 0].get_legend_handles_labels(), ncols=3, loc="outside upper center")
    _save(figure, path)


def frames(task: Task, models: dict[str, VisualModel], shown: dict[str, Predicted], path: Path) -> None:
    """True frames of one test window and what ALPS, CDM and the autoencoder decode."""
    wanted = [m for m in ("alps", "cdm", "autoencoder") if m in models]
    if not wanted or task.render is None:
        return
    steps = np.linspace(0, 99, 8).astype(int)
    figure, axes = plt.subplots(1 + len(wanted), len(steps), figsize=(9, 1.15 * (1 + len(wanted))))
    true = task.render(next(iter(shown.values())).true[0, steps])
    rows = [("true", true)]
    for method in wanted:
        observed = shown[method].observed
        assert observed is not None  # these three decode
        with torch.no_grad():
            model = models[method]
            device = next(model.parameters()).device
            drawn = model.frames.decode(observed[0, steps].to(device)).cpu()
        rows.append((METHOD_NAMES[method], drawn))
    for line, (name, pictures) in zip(axes, rows, strict=True):
        for ax, picture in zip(line, pictures, strict=True):
            ax.imshow(picture.permute(1, 2, 0).clamp(0, 1).numpy())
            ax.set(xticks=[], yticks=[])
        line[0].set_ylabel(name)
    _save(figure, path)


def systems(drawn: dict[str, torch.Tensor], path: Path) -> None:
    """A strip of frames of each system."""
    figure, axes = plt.subplots(len(drawn), 9, figsize=(9, 1.1 * len(drawn)))
    for line, (name, pictures) in zip(axes, drawn.items(), strict=True):
        for ax, picture in zip(line, pictures, strict=True):
            ax.imshow(picture.permute(1, 2, 0).numpy())
            ax.set(xticks=[], yticks=[])
        line[0].set_ylabel(name.replace("_", "\n"))
    _save(figure, path)


def kernels(views: dict[str, KernelView], path: Path) -> None:
    """Fig. 3: the signal, rows of the kernels over distance, their spectra, eigenvalues, the matrices."""
    figure, axes = plt.subplots(2, 4, figsize=(9, 5))
    axes[0, 0].plot(np.arange(200) / SAMPLE_RATE, six_sines(), "k", lw=0.8)
    axes[0, 0].set_title("(a) signal")
    for name, found in views.items():
        style = "--" if name == "k_DFT" else "-"
        axes[0, 1].plot(np.arange(101) - 50, found.row, style, lw=1, label=name)
        axes[0, 2].semilogy(np.arange(1, len(found.row_spectrum)), found.row_spectrum[1:], style, lw=1)
        axes[0, 3].semilogy(found.eigenvalues, style, lw=1)
    axes[0, 1].legend(fontsize=6)
    for ax, title in zip(axes[0, 1:], ("(b) middle row", "(b') its spectrum", "eigenvalues / trace"), strict=True):
        ax.set_title(title)
    for ax, letter, (name, found) in zip(axes[1], "cdef", views.items(), strict=True):
        ax.imshow(found.kernel, vmin=float(found.kernel.min()), vmax=1)
        ax.set_title(f"({letter}) {name}")
    _save(figure, path)


def phases(rows: list[dict[str, Any]], path: Path) -> None:
    """Error over the number of independent inputs."""
    figure, ax = plt.subplots(figsize=(6, 4))
    for key, label in (
        ("magnitude", "network on magnitudes"),
        ("phase", "network with phases"),
        ("balance", "force balance (phases, least squares)"),
    ):
        ax.semilogy([r["inputs"] for r in rows], [100 * r[key] for r in rows], "o-", label=label)
    ax.axhline(100 * rows[0]["guess"], color="k", ls=":", label="always nominal")
    ax.set(xlabel="independent inputs", ylabel="mean error, %")
    ax.legend()
    _save(figure, path)


def train_states(time: np.ndarray, lines: dict[str, dict[str, np.ndarray]], path: Path) -> None:
    """A few states of a test window: {state: {label: values}}."""
    figure, axes = plt.subplots(len(lines), 1, figsize=(8, 1.6 * len(lines)), sharex=True)
    for ax, (state, drawn) in zip(axes, lines.items(), strict=True):
        for label, values in drawn.items():
            ax.plot(time, values, "k-" if label == "true" else "--", lw=1, label=label)
        ax.set_ylabel(state)
    axes[0].legend(ncols=4)
    axes[-1].set_xlabel("time [s]")
    _save(figure, path)


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path)
    plt.close(figure)
