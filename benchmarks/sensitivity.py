"""`sprung bench sensitivity`: what a diagnosis says when one of its deciding numbers is another.

Every number of `model.diagnosis.rules` is set to both ends of its range, one at a time, and recordings of the
independent generator are diagnosed again: a healthy vehicle, laws strong and weak, faults of sensors, a wrong set-up,
and a component test.  Work that a number cannot change is not done again: a number of the verdict or the report is
varied on finished investigations, one of the evidence or the selection on begun ones, and fits with the same start are
remembered.  One line per number: on how many recordings it was varied, where verdict, place or name changed and to
what, and by how many decades p-values moved elsewhere.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import Field, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from sprung.benchmarks.generator import draw_cases, make_recordings, read_vehicle
from sprung.benchmarks.setups import Falsified, falsified, in_order
from sprung.model.diagnosis.api import DiagnosisError, Options, Report, diagnose
from sprung.model.diagnosis.component.measured import is_component_test
from sprung.model.diagnosis.fit.memory import FitMemory
from sprung.model.diagnosis.investigation.course import Investigation, Outcome
from sprung.model.diagnosis.investigation.diagnose import begun, concluded, under, with_findings
from sprung.model.diagnosis.investigation.judgement import judged
from sprung.model.diagnosis.report.narrate import narrate
from sprung.model.diagnosis.rules import RULES, Rules
from sprung.model.laws import CATALOGUE
from sprung.model.signals import FloatArray
from sprung.model.system import MANCHESTER, System, load_system, parse_system

LAST = ("verdict", "report")  # stages that read finished investigations
LATE = ("evidence", "selection", "plausible", "acceptance", "noise")  # stages that go on from begun ones
FIRST = ("input_faults", "input_rounds", "input_rival", "input_rivals", "input_done")  # of acceptance, but decide early
SETUPS = ("node_delay", "wrong_scale", "sign_reversed")
RATE = 100.0  # Hz
RIG = """
name: damper on a test bench
sample_rate: 100
window: 64
inputs:
  rod: {kind: displacement, displacement: {csv: d, noise: 1e-6}}
elements:
  damper: {upper: rod, lower: ground, stiffness: 4.0e4, damping: 1.5e3}
sensors:
  cell: {kind: force, element: damper, csv: F, noise: 2.0}
"""


@dataclass(frozen=True)
class Said:
    """What a report decides."""

    verdict: str
    findings: tuple[tuple[str, str], ...]  # location and effect, or its look-alikes
    p_values: tuple[float | None, ...]

    @classmethod
    def of(cls, report: Report) -> Said:
        """From a report."""
        names = tuple((f.location, f.family or f.effect) for f in report.findings)
        return cls(report.verdict, names, tuple(f.p_value for f in report.findings))

    def decades(self, other: Said) -> float:
        """Largest move of a p-value, in powers of ten; those below 1e-30 count as that."""
        pairs = zip(self.p_values, other.p_values, strict=False)
        moves = [abs(np.log10(max(a, 1e-30) / max(b, 1e-30))) for a, b in pairs if a is not None and b is not None]
        return float(max(moves, default=0.0))


@dataclass(frozen=True)
class Subject:
    """A recording with everything that is known of it under the usual rules."""

    name: str
    system: System
    record: Falsified
    options: Options
    said: Said
    state: Investigation | None = None  # begun; None for a component test
    outcome: Outcome | None = None

    def again(self, stage: str, name: str, rules: Rules) -> Said:
        """What is said under other rules, doing again what they can change."""
        if self.state is None or self.outcome is None:
            return Said.of(diagnose(self.system, self.record, replace(self.options, rules=rules)))
        if stage in LAST:
            done = self.outcome
            state = under(done.investigation, rules)
            judgement = judged(state, done.before, done.after, done.noise_faults)
            return Said.of(narrate(replace(done, investigation=state, judgement=judgement), self.record))
        if stage in LATE and name not in FIRST:
            state = with_findings(under(self.state, rules), _silent)
        else:
            state = with_findings(begun(self.system, self.record, replace(self.options, rules=rules), _silent), _silent)
        return Said.of(narrate(concluded(state, _silent), self.record))


def run(
    budget: Literal["quick", "full"] = "quick", seed: int = 4711, stage: str = "", count: int = 0, seconds: float = 0.0
) -> Iterator[dict[str, Any]]:
    """Yields one line per recording, one per number, and the totals.

    budget: `quick` has 8 recordings of 15 s, `full` 40 of 60 s; count and seconds say otherwise.
    stage: of the rules, if only one is asked for.
    """
    count = count or (8 if budget == "quick" else 40)
    lines = {(name, one.name): Line(name, one) for name, one in RULES.constants() if stage in ("", name)}
    began, done = time.process_time(), 0
    for name, system, record in recordings(count, seconds or (15.0 if budget == "quick" else 60.0), seed):
        subject = _known(name, system, record)  # one at a time: remembered fits take a gigabyte
        yield {"recording": name, "verdict": subject.said.verdict, "findings": subject.said.findings}
        for line in lines.values():
            line.vary(subject)
        done += 1
    yield from (line.figure() for line in lines.values())
    yield {
        "numbers": len(lines),
        "that_change_something": sum(bool(line.changed) for line in lines.values()),
        "recordings": done,
        "cpu_seconds": round(time.process_time() - began, 1),
    }


@dataclass
class Line:
    """What one number changes, over all recordings that its stage reads."""

    stage: str
    number: Field[Any]
    changed: list[dict[str, Any]] = field(default_factory=list)
    decades: float = 0.0
    tried: int = 0

    def vary(self, subject: Subject) -> None:
        """Set the number to both ends of its range on a recording."""
        if (self.stage == "component") != (subject.state is None):
            return
        self.tried += 1
        for end in self.number.metadata["range"]:
            if end == self.number.default:
                continue
            try:
                said = subject.again(self.stage, self.number.name, RULES.varied(self.stage, self.number.name, end))
            except DiagnosisError as error:
                self.changed.append({"recording": subject.name, "at": end, "error": str(error)})
                continue
            if (said.verdict, said.findings) == (subject.said.verdict, subject.said.findings):
                self.decades = max(self.decades, said.decades(subject.said))
            else:
                self.changed.append({"recording": subject.name, "at": end, **_difference(subject.said, said)})

    def figure(self) -> dict[str, Any]:
        """The line that is printed."""
        return {
            "stage": self.stage,
            "number": self.number.name,
            "value": self.number.default,
            "range": list(self.number.metadata["range"]),
            "recordings": self.tried,
            "changed": self.changed,
            "p_value_decades": round(self.decades, 2),
            "reason": self.number.metadata["reason"],
        }


def _difference(before: Said, after: Said) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if before.verdict != after.verdict:
        found["verdict"] = [before.verdict, after.verdict]
    if before.findings != after.findings:
        found["findings"] = [before.findings, after.findings]
    return found


def _known(name: str, system: System, record: Falsified) -> Subject:
    """A recording diagnosed under the usual rules, with the steps on the way."""
    options = Options(file=name, catalogue=CATALOGUE, memory=FitMemory())
    if is_component_test(system, record.values):
        return Subject(name, system, record, options, Said.of(diagnose(system, record, options)))
    state = begun(system, record, options, _silent)
    outcome = concluded(with_findings(state, _silent), _silent)
    return Subject(name, system, record, options, Said.of(narrate(outcome, record)), state, outcome)


def recordings(count: int, seconds: float, seed: int) -> Iterator[tuple[str, System, Falsified]]:
    """Recordings of the bundled vehicle, a wrong set-up among them, and component tests at the end."""
    system, vehicle = load_system(), read_vehicle(MANCHESTER)
    rigs = max(1, count // 8)
    kinds = ["clean", "coulomb_friction", "bump_stop", "sensor_gain", "sensor_noise", "bouc_wen", "damper_asymmetry"]
    random = np.random.default_rng(seed)
    strong = draw_cases(vehicle, (count - rigs + 1) // 2, seed, kinds, 0.3)
    cases = [*strong, *draw_cases(vehicle, count - rigs - len(strong), seed + 1, kinds, 1.5)]
    for number, made in enumerate(make_recordings(vehicle, cases, seconds)):
        values = in_order(system, made.values)
        record, what = Falsified("", frozenset(), values), made.case.kind
        if what == "clean" and number < len(strong):  # the others stay healthy
            record = falsified(system, values, SETUPS[number % len(SETUPS)], random)
            what = record.effect
        yield f"{number}-{what}", system, record
    for number in range(rigs):
        yield f"rig-{number}", parse_system(RIG), _rig(seconds, np.random.default_rng(seed + 2 + number))


def _rig(seconds: float, random: np.random.Generator) -> Falsified:
    """A damper with dry friction under two sines."""
    t = np.arange(int(seconds * RATE)) / RATE
    sines = [(0.012, 0.7, 0.3), (0.004, 1.9, 1.0)]
    d: FloatArray = sum(size * np.sin(2 * np.pi * f * t + phase) for size, f, phase in sines)  # type: ignore[assignment]
    v: FloatArray = sum(  # type: ignore[assignment]
        size * 2 * np.pi * f * np.cos(2 * np.pi * f * t + phase) for size, f, phase in sines
    )
    force = 3.6e4 * d + 1.3e3 * v + random.uniform(40.0, 160.0) * np.tanh(v / 1e-3)
    noise = random.standard_normal((2, len(t)))
    return Falsified("", frozenset(), np.column_stack([d + 1e-6 * noise[0], force + 2.0 * noise[1]]))


def _silent(share: float, text: str) -> None:
    """Nobody watches."""
