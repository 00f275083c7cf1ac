"""`sprung bench experiment`: does the chosen run part look-alikes better than chance, and than T-optimality?

Pairs of laws that are taken for each other act in the strut of a quarter car; the second of each pair gets the values
whose force comes nearest to the first's on the slow run, as after a recording that could not tell.  For every pair and
every run of a menu the evidence is foreseen; then vehicles are drawn of which either model is true, springs and dampers
off by some per cent, and the run that each strategy chose is simulated with noise and judged:

    chosen     largest expected evidence, mean of both directions
    t_optimal  largest squared difference of the best signals in the sensors' noise with the first model true
               (Atkinson and Fedorov, Biometrika 62, 1975)
    random     mean of the menu
    best       the best run in hindsight

Figures: mean evidence for the truth, and the share of vehicles that were distinguished (evidence beyond 10).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from sprung.model.address import LawSetting, LawValue
from sprung.model.experiment.choose import rank_runs
from sprung.model.experiment.drives import loaded, run_inputs
from sprung.model.experiment.evidence import STRONG, fitted, simulated
from sprung.model.experiment.menu import Menu, MenuRun
from sprung.model.experiment.rivals import NoRival, rival
from sprung.model.system import System, parse_system

VEHICLE = """
name: quarter-car
sample_rate: 200
window: 200
bodies:
  wheel: {mass: 45}
  car: {mass: 400}
inputs:
  road:
    kind: displacement
    displacement: {csv: road, noise: 1.0e-5}
    velocity: {csv: rate, noise: 5.0e-4}
elements:
  tyre: {upper: wheel, lower: road, stiffness: 200000, damping: {value: 50, fixed: true}}
  strut: {upper: car, lower: wheel, stiffness: 20000, damping: 1500}
sensors:
  wheel_a: {kind: acceleration, body: wheel, csv: a, noise: 0.1}
  car_a: {kind: acceleration, body: car, csv: b, noise: 0.05}
"""
TRUE = {  # law of the strut: its values; drawn within a factor
    "coulomb_friction": {"force": 20.0, "smoothing": 0.02},
    "quadratic_damping": {"c2": 600.0},
    "cubic_stiffness": {"k3": 4e6},
    "bump_stop": {"gap": 0.01, "stiffness": 10000.0},
}
MENU = Menu(
    runs={
        "slow": MenuRun.model_validate({"track": {"speed": 12.0}, "seconds": 8}),
        "fast": MenuRun.model_validate({"track": {"speed": 50.0}, "seconds": 8}),
        "fast, bad track": MenuRun.model_validate({"track": {"speed": 50.0, "level": 4.0}, "seconds": 8}),
        "heavy": MenuRun.model_validate({"track": {"speed": 25.0}, "seconds": 8, "load": {"car": 150.0}}),
        "body mode": MenuRun.model_validate(
            {"signal": {"kind": "sine", "amplitude": 0.01, "frequency": 1.1}, "seconds": 8}
        ),
        "wheel mode": MenuRun.model_validate(
            {"signal": {"kind": "sine", "amplitude": 0.001, "frequency": 10.0}, "seconds": 8}
        ),
        "sweep": MenuRun.model_validate(
            {"signal": {"kind": "sweep", "amplitude": 0.002, "frequency": 0.5, "to": 15.0}, "seconds": 8}
        ),
    }
)
OFF = 0.03  # of the vehicle's springs and dampers from the models', of their logarithm


def run(seed: int = 20261, count: int = 2, vehicles: int = 2, only: str = "") -> Iterator[dict[str, Any]]:
    """count: rounds over the laws with values drawn anew; vehicles: that are simulated for each pair and direction;
    only: a law that is true, or a pair of laws joined by a colon.  A pair does not depend on the others."""
    torch.set_num_threads(1)
    scores: dict[str, list[float]] = {name: [] for name in ("chosen", "t_optimal", "random", "best")}
    laws = {law.name: law for law in parse_system(VEHICLE).catalogue}
    pairs = [(name, other) for name in TRUE for other in laws[name].confused_with]
    for number in range(count):
        for index, (name, other) in enumerate(pairs):
            if only not in ("", name, f"{name}:{other}"):
                continue
            rng = np.random.default_rng([seed, number, index])
            first = with_law(name, rng.uniform(0.7, 1.5))
            try:
                second = rival(first, "strut", name, other, run_inputs(first, MENU.runs["slow"]))
                figure, found = _one(name, other, first, second, rng, vehicles)
            except (NoRival, ValueError) as error:
                yield {"pair": [name, other], "left_out": str(error)}
                continue
            for strategy, values in found.items():
                scores[strategy] += values
            yield figure
    if not scores["chosen"]:
        return
    for strategy, evidence in scores.items():
        shares = np.array(evidence) > STRONG
        yield {"strategy": strategy, "evidence": round(float(np.mean(evidence)), 1)} | {
            "median": round(float(np.median(evidence)), 1),
            "told_apart": round(float(shares.mean()), 3),
            "vehicles": len(evidence),
        }


def _one(
    name: str, other: str, first: System, second: System, rng: np.random.Generator, vehicles: int
) -> tuple[dict[str, Any], dict[str, list[float]]]:
    models = {"a": first, "b": second}
    ranked = rank_runs(models, MENU)
    foreseen = {one.run: one.evidence for one in ranked}
    difference = {one.run: one.promises["a", "b"].difference for one in ranked}
    chosen, t_optimal = ranked[0].run, max(difference, key=lambda run: difference[run])
    real: dict[str, list[float]] = {run: [] for run in MENU.runs}
    for _ in range(vehicles):
        for true, wrong in (("a", "b"), ("b", "a")):
            vehicle, track = _drawn(models[true], rng), int(rng.integers(2**31))
            for run_name, one in MENU.runs.items():
                values = simulated(vehicle, one, track, rng)
                real[run_name].append(_evidence(models[true], models[wrong], one, values))
    by_mean = {run: float(np.mean(values)) for run, values in real.items()}
    best = max(by_mean, key=lambda run: by_mean[run])
    every = [float(np.mean(at_once)) for at_once in zip(*real.values(), strict=True)]
    found = {"chosen": real[chosen], "t_optimal": real[t_optimal], "random": every, "best": real[best]}
    figure = {
        "pair": [name, other],
        "chosen": chosen,
        "t_optimal": t_optimal,
        "best": best,
        "foreseen": round(foreseen[chosen], 1),
        "evidence": {strategy: round(float(np.mean(values)), 1) for strategy, values in found.items()},
        "by_run": {run: [round(foreseen[run], 1), round(value, 1)] for run, value in by_mean.items()},
    }
    return figure, found


def _evidence(true: System, wrong: System, run: MenuRun, values: np.ndarray) -> float:
    """Log-likelihood ratio for the truth."""
    return fitted(loaded(wrong, run), values).misfit - fitted(loaded(true, run), values).misfit


def with_law(name: str, factor: float) -> System:
    """The vehicle with a law; widths of corners fixed, the first value times a factor."""
    system = parse_system(VEHICLE)
    law = next(one for one in system.catalogue if one.name == name)
    setting: LawSetting = {
        key: LawValue(value=value * (factor if i == 0 else 1.0), fixed=key == "smoothing")
        for i, (key, value) in enumerate(TRUE[name].items())
    }
    if set(setting) != set(law.names):
        raise ValueError(f"{name}: its values are {', '.join(law.names)}")
    part = system.file.elements["strut"].model_copy(update={"laws": ({name: setting},)})
    return System(system.file.model_copy(update={"elements": system.file.elements | {"strut": part}}))


def _drawn(model: System, rng: np.random.Generator) -> System:
    """A vehicle of the model whose springs and dampers are somewhat other ones."""
    elements = dict(model.file.elements)
    for name, part in elements.items():
        changed = {
            quantity: value.model_copy(update={"value": value.value * float(np.exp(OFF * rng.standard_normal()))})
            for quantity in ("stiffness", "damping")
            if not (value := getattr(part, quantity)).fixed
        }
        elements[name] = part.model_copy(update=changed)
    return System(model.file.model_copy(update={"elements": elements}), model.catalogue)
