"""`sprung bench several-laws [--count 12] [--seed 1]`: three to five laws at once, two of them at one element.

The independent generator conceals laws of the catalogue in the bundled vehicle.  A law counts where its signal-to-noise
ratio, for a test that knows places and names of all of them and leaves to the others what they imitate, is at least
twice its limit.  A finding is right where a law of its name is at its place, whatever else is there.  Forces that are
reported without a name, or by a formula, are no names: they are counted apart, as are those where no law acts at all.
Where the report says "one or the other" that is no name either; it is right where the law is among them.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sprung.benchmarks.generator.draw import Case, add_law, draw_cases
from sprung.benchmarks.generator.laws import LAWS
from sprung.benchmarks.generator.make import make_with_each_missing
from sprung.benchmarks.generator.vehicle import Vehicle, read_vehicle
from sprung.benchmarks.structure import LIMIT, VISIBLE, MadeSamples, in_order
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.report.report import Report
from sprung.model.system import MANCHESTER, load_system

WEAK = 0.5  # laws from the middle of their range on
NAMED = tuple(name for name, law in LAWS.items() if law.named)


Place = tuple[str, str]  # an element and a law's name


@dataclass(frozen=True)
class ScoredLaws:
    """What a report says of several laws, beside the truth."""

    truth: dict[Place, float]  # each law's strength over what is seen at all
    named: list[Place]
    either: list[tuple[str, list[str]]]  # one of several laws, which look alike
    unnamed: list[str]  # elements with a force of no law

    @classmethod
    def of(cls, report: Report, truth: dict[Place, float]) -> ScoredLaws:
        """From a report."""
        listed = {f.effect: f.kind is not EffectKind.UNLISTED for f in report.findings}
        return cls(
            truth,
            [(f.location, f.effect) for f in report.findings if listed[f.effect] and f.family is None],
            [(f.location, f.family.split(" or ")) for f in report.findings if f.family is not None],
            [f.location for f in report.findings if not listed[f.effect]],
        )

    @property
    def right(self) -> list[Place]:
        """True ones among the laws that are named."""
        return [one for one in self.named if one in self.truth]

    @property
    def among(self) -> list[Place]:
        """True ones among those of which a report says that it is one of several."""
        return [(at, law) for at, laws in self.either for law in laws if (at, law) in self.truth]

    @property
    def due(self) -> list[Place]:
        """Those that are strong enough to be named."""
        return [one for one, limits in self.truth.items() if limits >= VISIBLE]

    @property
    def missed(self) -> list[Place]:
        """Those of them that are not said."""
        return [one for one in self.due if one not in self.named + self.among]

    @property
    def misplaced(self) -> list[str]:
        """Elements with a force of no law which have no law."""
        return [at for at in self.unnamed if at not in {place for place, _ in self.truth}]

    @property
    def whole(self) -> bool:
        """Whether all is said as it is."""
        return set(self.named) == set(self.truth) and not self.unnamed and not self.either


def run(count: int = 12, seed: int = 1, seconds: float = 60.0) -> Iterator[dict[str, Any]]:
    """Yields one line per recording, then precision and recall."""
    vehicle, system = read_vehicle(MANCHESTER), load_system(MANCHESTER)
    scored = []
    for number in range(count):
        case = drawn(vehicle, np.random.default_rng([seed, number]))
        values, ratios = make_with_each_missing(vehicle, case, seconds)
        began = time.process_time()
        report = diagnose(system, MadeSamples(in_order(vehicle, system, values)), Options(file=f"several-{number}"))
        truth = {(place, law): ratio / LIMIT for (place, law, _), ratio in zip(case.effects, ratios, strict=True)}
        one = ScoredLaws.of(report, truth)
        scored.append(one)
        yield {
            "number": number,
            "truth": [[*law, round(limits, 1)] for law, limits in truth.items()],
            "verdict": report.verdict,
            "said": one.named,
            "either": one.either,
            "unnamed": one.unnamed,
            "false": [law for law in one.named if law not in truth],
            "missed": one.missed,
            "cpu_seconds": round(time.process_time() - began, 1),
        }
    yield summary(scored)


def summary(scored: Sequence[ScoredLaws]) -> dict[str, Any]:
    """Precision and recall."""
    said, visible = sum(len(one.named) for one in scored), sum(len(one.due) for one in scored)
    right, missed = sum(len(one.right) for one in scored), sum(len(one.missed) for one in scored)
    return {
        "recordings": len(scored),
        "names": said,
        "either": sum(len(one.either) for one in scored),
        "among_them": sum(len(one.among) for one in scored),
        "unnamed": sum(len(one.unnamed) for one in scored),
        "unnamed_where_nothing_is": sum(len(one.misplaced) for one in scored),
        "precision": round(right / said, 3) if said else None,
        "visible": visible,
        "recall": round((visible - missed) / visible, 3) if visible else None,
        "recordings_wholly_right": sum(one.whole for one in scored),
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
