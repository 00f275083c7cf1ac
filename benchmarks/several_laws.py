"""`sprung bench several-laws [--count 12] [--seed 1]`: three to five laws at once, two of them at one element.

The independent generator conceals laws of the catalogue in the bundled vehicle.  A law counts where its signal-to-noise
ratio, for a test that knows places and names of all of them and leaves to the others what they imitate, is at least
twice its limit.  A finding is right where a law of its name is at its place, whatever else is there.  Forces that are
reported without a name, or by a formula, are no names: they are counted apart, as are those where no law acts at all.
Where the report says "one or the other" that is no name either; it is right where the law is among them.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from sprung.benchmarks.generator.draw import Case, add_law, draw_cases
from sprung.benchmarks.generator.laws import LAWS
from sprung.benchmarks.generator.make import make_with_each_missing
from sprung.benchmarks.generator.vehicle import Vehicle, read_vehicle
from sprung.benchmarks.structure import LIMIT, VISIBLE, MadeSamples, in_order
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.diagnosis.investigation.verdict import EffectKind
from sprung.model.system import MANCHESTER, load_system

WEAK = 0.5  # laws from the middle of their range on
NAMED = tuple(name for name, law in LAWS.items() if law.named)


def run(count: int = 12, seed: int = 1, seconds: float = 60.0) -> Iterator[dict[str, Any]]:
    """Yields one line per recording, then precision and recall."""
    vehicle, system = read_vehicle(MANCHESTER), load_system(MANCHESTER)
    said = right = visible = found = everything = unnamed = misplaced = either = among_them = 0
    for number in range(count):
        case = drawn(vehicle, np.random.default_rng([seed, number]))
        values, ratios = make_with_each_missing(vehicle, case, seconds)
        began = time.process_time()
        report = diagnose(system, MadeSamples(in_order(vehicle, system, values)), Options(file=f"several-{number}"))
        truth = {(place, law): ratio / LIMIT for (place, law, _), ratio in zip(case.effects, ratios, strict=True)}
        listed = {f.effect: f.kind is not EffectKind.UNLISTED for f in report.findings}
        families = [(f.location, f.family.split(" or ")) for f in report.findings if f.family is not None]
        named_laws = [(f.location, f.effect) for f in report.findings if listed[f.effect] and f.family is None]
        among = [(at, law) for at, laws in families for law in laws if (at, law) in truth]
        forces = [f.location for f in report.findings if not listed[f.effect]]
        unnamed, misplaced = (
            unnamed + len(forces),
            misplaced + sum(at not in {place for place, _ in truth} for at in forces),
        )
        due = [one for one, limits in truth.items() if limits >= VISIBLE]
        said, right = said + len(named_laws), right + sum(one in truth for one in named_laws)
        either, among_them = either + len(families), among_them + len(among)
        visible, found = visible + len(due), found + sum(one in named_laws + among for one in due)
        everything += set(named_laws) == set(truth) and not forces and not families
        yield {
            "number": number,
            "truth": [[*one, round(limits, 1)] for one, limits in truth.items()],
            "verdict": report.verdict,
            "said": named_laws,
            "either": families,
            "unnamed": forces,
            "false": [one for one in named_laws if one not in truth],
            "missed": [one for one in due if one not in named_laws + among],
            "cpu_seconds": round(time.process_time() - began, 1),
        }
    yield {
        "recordings": count,
        "names": said,
        "either": either,
        "among_them": among_them,
        "unnamed": unnamed,
        "unnamed_where_nothing_is": misplaced,
        "precision": round(right / said, 3) if said else None,
        "visible": visible,
        "recall": round(found / visible, 3) if visible else None,
        "recordings_wholly_right": everything,
    }


def drawn(vehicle: Vehicle, random: np.random.Generator) -> Case:
    """A vehicle with three to five laws, the first two at one element."""
    case = draw_cases(vehicle, 1, int(random.integers(2**31)), ["clean"])[0]
    case.kind = "several"
    laws = int(random.integers(3, 6))
    places = [str(place) for place in random.choice(vehicle.elements, laws - 1, replace=False)]
    names = [str(name) for name in random.choice(NAMED, 2, replace=False)]
    names += [str(name) for name in random.choice(NAMED, laws - 2)]
    for place, name in zip([places[0], *places], names, strict=True):
        add_law(case, random, place, name, WEAK)
    return case
