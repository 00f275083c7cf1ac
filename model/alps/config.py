"""Sizes and settings of the paper's networks.  The paper gives none of them: every value here is ours."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

Dynamics = Literal["simulator", "context", "hamiltonian", "none"]


@dataclass(frozen=True)
class Recipe:
    """What makes a method: its parts, and the help that its training gets.

    The last seven are the departures from the paper's text that docs/paper.md lists; rows `no_...` and `alps_plain`
    leave them out one by one and all together.
    """

    dynamics: Dynamics = "simulator"
    attention: bool = True  # else positions frame by frame, rates by first differences
    fourier: bool = True  # the estimator sees abs(FFT) of the states, else the states
    drawn: bool = True  # a decoder shows the simulated states; else the physics is followed in the latent alone
    straight: bool = True  # positions are an affine image of the embedding
    opening: bool = True  # they start from the task's opening, if it has one
    positions_shown: bool = True  # the decoder sees positions only, else all states
    phased: bool = True  # the task's phases, else one: everything over the whole window
    tempered: bool = True  # outliers weigh less, else plain squares
    falling_prior: bool = True  # the prior's weight falls, else it has its last value throughout
    scale: float = 1.0  # factor on the sizes that states are taken to have: how much hangs on knowing them

    @property
    def physical(self) -> bool:
        """Has a simulator, and so an estimator of its parameters."""
        return self.dynamics == "simulator"


_PLAIN = Recipe(straight=False, opening=False, positions_shown=False, phased=False, tempered=False, falling_prior=False)
_HELPED_LATENT = Recipe(dynamics="none", positions_shown=False)  # with nothing else to say it in, all states are shown

RECIPES: dict[str, Recipe] = {
    "alps": Recipe(),
    # the paper's ablations
    "no_fourier": Recipe(fourier=False),
    "no_attention": Recipe(attention=False),
    # its baselines, with the same openings, affine positions, phases and scaled inputs as alps
    "autoencoder": _HELPED_LATENT,
    "cdm": Recipe(dynamics="context"),
    # both as printed
    "autoencoder_plain": replace(_PLAIN, dynamics="none"),
    "cdm_plain": replace(_PLAIN, dynamics="context"),
    # the paper as printed, and each departure left out
    "alps_plain": _PLAIN,
    "no_opening": Recipe(opening=False),
    "no_affine_head": Recipe(straight=False),
    "all_states_shown": Recipe(positions_shown=False),
    "no_phases": Recipe(phased=False),
    "no_tempering": Recipe(tempered=False),
    "no_falling_prior": Recipe(falling_prior=False),
    "scales_halved": Recipe(scale=0.5),
    "scales_doubled": Recipe(scale=2.0),
    # with other physics: an energy that is learned (before the paper), the equations without pictures (after it)
    "hamiltonian": Recipe(dynamics="hamiltonian"),
    "decoder_free": Recipe(attention=False, drawn=False),
}
METHODS = tuple(RECIPES)
Budget = Literal["quick", "full"]
_FULL = 3  # times the updates of `quick`: what a GPU does in minutes
WHOLE_WINDOW = 99  # steps of a window: a simulation that never restarts


@dataclass(frozen=True)
class NetworkConfig:
    """Layer sizes, the same for every method so that they are comparable."""

    convolution: tuple[int, int] = (16, 16)  # channels; kernel 8 stride 4, then kernel 3 stride 1
    deconvolution: tuple[int, int, int] = (32, 16, 8)  # channels from 8 x 8 up to 64 x 64
    embedding: int = 32  # (column, row) of each of 16 feature points
    width: int = 64  # d of the attention
    heads: int = 4
    layers: int = 2
    estimator: tuple[int, int] = (128, 64)
    decoder: int = 128


@dataclass(frozen=True)
class Phase:
    """A stretch of a training run.

    `states`: parameters stay at mid-range (or are read off the states) while the encoder learns what a state is;
    `rates`: the same, and positions stay as they were opened, for random rates would undo them;
    `estimator`: the encoder rests while the estimator learns from its states; `all`: everything moves.
    Methods without an estimator train everything throughout.
    """

    trains: Literal["rates", "states", "estimator", "all"]
    horizon: int  # shooting length, samples; divides WINDOW - 1
    updates: int
    learning_rate: tuple[float, float]  # at its beginning and its end


@dataclass(frozen=True)
class TrainingConfig:
    """One training run."""

    phases: tuple[Phase, ...]
    seed: int = 0
    trajectories: int = 500  # for training
    test_trajectories: int = 200
    batch: int = 16
    estimator_batch: int = 256  # windows are encoded beforehand there, and the simulator's cost hardly grows
    learning_rate: float = 2e-3  # of the frame autoencoder
    checkpoint_every: int = 100
    frame_updates: int = 250  # of the frame autoencoder, shared by every method of a task
    drawing_updates: int = 500  # of its decoder alone afterwards: pictures take longer to learn than feature points
    frame_batch: int = 64
    end_to_end: bool = False  # train the convolutions with the rest, not only in the frame autoencoder
    divergence_start: float = 0.1  # weight of the KL (summed over states, mean over samples): large at first, so
    divergence_weight: float = 1e-4  # that the prior fixes origin and size, then small, so that states are sharp
    divergence_fall: int = 400  # updates over which it falls
    observation_weight: float = 1.0  # squared error of the standardised embedding, mean
    pixel_weight: float = 20.0  # squared error of pixels in [0, 1], mean; end_to_end only
    state_weight: float = 1.0  # squared error of the chart, summed over its columns, mean over samples
    spread_weight: float = 0.1  # without a decoder: positions keep the unit spread of their prior (see `losses.py`)
    outlier: float = 0.1  # squared error beyond which a sample counts less (see `losses.py`); infinite: plain squares

    @property
    def updates(self) -> int:
        """Length of the run."""
        return sum(phase.updates for phase in self.phases)

    def phase(self, step: int) -> tuple[Phase, float]:
        """Phase of an update, and its learning rate there."""
        begin = 0
        for phase in self.phases:
            if step < begin + phase.updates:
                break
            begin += phase.updates
        first, last = phase.learning_rate
        cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, (step - begin) / phase.updates)))
        return phase, last + (first - last) * cosine

    def divergence(self, step: int) -> float:
        """Weight of the KL at an update: geometric fall, then constant."""
        share = min(1.0, step / self.divergence_fall)
        return self.divergence_start * (self.divergence_weight / self.divergence_start) ** share


_QUICK = {
    "pendulum": TrainingConfig(
        phases=(
            Phase("rates", 3, 600, (2e-3, 2e-3)),
            Phase("estimator", 9, 150, (2e-3, 1e-3)),
            Phase("all", 9, 700, (2e-3, 1e-4)),
            Phase("estimator", 33, 500, (2e-3, 5e-4)),
            Phase("estimator", 99, 400, (1e-3, 1e-4)),
        ),
        divergence_start=0.03,
    ),
    "mass_spring_damper": TrainingConfig(
        phases=(Phase("states", 33, 300, (2e-3, 2e-3)), Phase("all", 99, 1200, (2e-3, 2e-5))),
        divergence_start=0.01,
        state_weight=0.2,
    ),
    "two_body": TrainingConfig(
        phases=(
            Phase("states", 3, 200, (2e-3, 2e-3)),
            Phase("states", 9, 200, (2e-3, 2e-3)),
            Phase("states", 33, 100, (2e-3, 1e-3)),
            Phase("all", 33, 300, (2e-3, 1e-3)),
            Phase("all", 99, 300, (1e-3, 1e-4)),
            Phase("estimator", 99, 200, (1e-3, 1e-4)),
        ),
        divergence_start=1e-3,
    ),
}


def for_recipe(config: TrainingConfig, recipe: Recipe) -> TrainingConfig:
    """Settings of a task as a recipe trains: as many updates, without what it leaves out."""
    if not recipe.phased:
        rates = (config.phases[0].learning_rate[0], config.phases[-1].learning_rate[1])
        config = replace(config, phases=(Phase("all", WHOLE_WINDOW, config.updates, rates),))
    if not recipe.tempered:
        config = replace(config, outlier=math.inf)
    if not recipe.falling_prior:
        config = replace(config, divergence_start=config.divergence_weight)
    return config


def training_config(task: str, budget: Budget, seed: int) -> TrainingConfig:
    """Settings of a visual task; `seed` draws data, frames and networks.

    `full` trains the convolutions with the rest, on one GPU: three times the updates, each of twice the windows.
    """
    config = replace(_QUICK[task], seed=seed)
    if budget == "quick":
        return config
    return replace(
        config,
        phases=tuple(replace(phase, updates=_FULL * phase.updates) for phase in config.phases),
        divergence_fall=_FULL * config.divergence_fall,
        test_trajectories=500,
        batch=32,
        learning_rate=1e-3,
        frame_updates=1000,
        drawing_updates=1000,
        end_to_end=True,
    )
