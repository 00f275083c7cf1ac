"""Ranking of runs by their expected power to discriminate between models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations

from sprung.model.experiment.evidence import KNOWN, Promise, promise
from sprung.model.experiment.menu import Menu
from sprung.model.system import System

_SEED = 0  # of the runs that are simulated: the same menu is ranked alike every time


@dataclass(frozen=True, slots=True)
class RankedRun:
    """One run with its expected evidence."""

    run: str
    evidence: float  # expected log-likelihood ratio for the truth, of the pair that it parts worst
    chance: float  # that this evidence is strong
    per_cost: float
    promises: dict[tuple[str, str], Promise]  # by (the true one, the other)


def rank_runs(
    models: dict[str, System],
    menu: Menu,
    known: float = KNOWN,
    tell: Callable[[str], None] = lambda line: None,
) -> list[RankedRun]:
    """Runs of the menu, by expected evidence per cost.

    Either of two models may be true: a run counts by the mean of both, and among several models by its worst pair.
    """
    found = []
    for name, run in menu.runs.items():
        tell(name)
        promises = {(a, b): promise(models[a], models[b], run, known, _SEED) for a, b in permutations(models, 2)}
        worst = min(_pairs(promises), key=lambda pair: _mean([p.evidence for p in pair]))
        evidence = _mean([p.evidence for p in worst])
        found.append(RankedRun(name, evidence, _mean([p.chance for p in worst]), evidence / run.cost, promises))
    return sorted(found, key=lambda ranked: -ranked.per_cost)


def _pairs(promises: dict[tuple[str, str], Promise]) -> list[tuple[Promise, Promise]]:
    return [(one, promises[b, a]) for (a, b), one in promises.items() if a < b]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
