"""`sprung bench sensitivity`: what a diagnosis says when one of its deciding numbers is another.

Every number of `model.diagnosis.rules` is set to both ends of its range, one at a time, and recordings are diagnosed
again: healthy vehicles, laws strong and weak, faults of sensors, wrong set-ups, component tests.  They are those of the
independent generator, with the budget `quick` those of a simulated quarter car.  Work that a number cannot change is
not done again: a number of the verdict or the report is varied on finished investigations, one of the evidence or the
selection on begun ones, and fits, screenings and starts that are known are remembered.

One line per recording, with the numbers that change what is said of it; then one line per number: on how many
recordings it was varied, where verdict, place or name changed and to what, and by how many decades p-values moved
elsewhere.
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
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import MANCHESTER, System, load_system, parse_system

LAST = ("verdict", "report")  # stages that read finished investigations
LATE = ("evidence", "selection", "plausible", "acceptance", "noise")  # stages that go on from begun ones
FIRST = ("input_faults", "input_rounds", "input_rival", "input_rivals", "input_done")  # of acceptance, but decide early
SETUPS = ("late sensors", "scale of a node", "sign of a sensor")
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
QUARTER_CAR = """
name: quarter car
sample_rate: 100
window: 100
bodies:
  car: {mass: 8000}
  bogie: {mass: 1300}
inputs:
  wheel: {kind: displacement, displacement: {csv: d, noise: 1.0e-5}, velocity: {csv: v, noise: 5.0e-4}}
elements:
  primary: {upper: bogie, lower: wheel, stiffness: 2.4e+6, damping: 1.0e+4}
  secondary: {upper: car, lower: bogie, stiffness: 4.3e+5, damping: 2.0e+4}
sensors:
  car_a: {kind: acceleration, body: car, noise: 0.004, csv: a}
  car_b: {kind: acceleration, body: car, noise: 0.004, csv: b}
  bogie_a: {kind: acceleration, body: bogie, noise: 0.03, csv: e}
  bogie_b: {kind: acceleration, body: bogie, noise: 0.03, csv: f}
"""
SECONDARY = "lower: bogie, stiffness: 4.3e+5, damping: 2.0e+4"
CASES = (  # what is wrong, after which words of the file above, the law
    ("friction", SECONDARY, "{coulomb_friction: {force: 300, smoothing: 2.0e-3}}"),
    ("weak friction", SECONDARY, "{coulomb_friction: {force: 12, smoothing: 2.0e-3}}"),
    ("cubic spring", SECONDARY, "{cubic_stiffness: {k3: 4.0e+9}}"),
    ("gain", "body: bogie, noise: 0.03, csv: e", "{sensor_gain: {gain: 0.95}}"),
    ("scale", "body: car, noise: 0.004, csv: a", "{sensor_gain: {gain: 2.0}}"),
    ("healthy", SECONDARY, ""),
    ("blow-off", SECONDARY, "{damper_blowoff: {knee: 0.02, ratio: 0.3}}"),
)


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
            state = under(self.state, rules)
        else:
            state = begun(self.system, self.record, replace(self.options, rules=rules), _silent)
        state, usual = with_findings(state, _silent), self.outcome
        same = usual.investigation
        if stage != "noise" and (state.fit is same.fit and state.base is same.base):  # as remembered: the same model
            return Said.of(narrate(replace(usual, investigation=state), self.record))
        return Said.of(narrate(concluded(state, _silent), self.record))


def run(
    budget: Literal["quick", "full"] = "quick", seed: int = 4711, stage: str = "", count: int = 0, seconds: float = 0.0
) -> Iterator[dict[str, Any]]:
    """Yields one line per recording, one per number, and the totals.

    budget: `quick` has 8 recordings of a quarter car of 15 s, `full` 40 of the bundled vehicle of 60 s; count and
    seconds say otherwise.
    stage: of the rules, if only one is asked for.
    """
    count = count or (8 if budget == "quick" else 40)
    lines = {(name, one.name): Line(name, one) for name, one in RULES.constants() if stage in ("", name)}
    began, done = time.process_time(), 0
    for name, system, record in recordings(budget, count, seconds or (15.0 if budget == "quick" else 60.0), seed):
        subject = _known(name, system, record)  # one at a time: remembered fits take a gigabyte
        moved = {".".join(key): found for key, line in lines.items() if (found := line.vary(subject))}
        yield {"recording": name, "verdict": subject.said.verdict, "findings": subject.said.findings, "changed": moved}
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

    def vary(self, subject: Subject) -> list[dict[str, Any]]:
        """Set the number to both ends of its range on a recording; what changes."""
        if (self.stage == "component") != (subject.state is None):
            return []
        before = len(self.changed)
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
        return self.changed[before:]

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


def recordings(budget: str, count: int, seconds: float, seed: int) -> Iterator[tuple[str, System, Falsified]]:
    """Recordings of a vehicle, wrong set-ups among them, then component tests."""
    rigs = max(1, count // 8)
    made = _quarter_cars if budget == "quick" else _vehicles
    for number, (what, system, record) in enumerate(made(count - rigs, seconds, seed)):
        yield f"{number}-{what}", system, record
    for number in range(rigs):
        yield f"rig-{number}", parse_system(RIG), _rig(seconds, np.random.default_rng(seed + 2 + number))


def _vehicles(count: int, seconds: float, seed: int) -> Iterator[tuple[str, System, Falsified]]:
    """The bundled vehicle, laws strong and weak, by the independent generator."""
    system, vehicle = load_system(), read_vehicle(MANCHESTER)
    kinds = ["clean", "coulomb_friction", "bump_stop", "sensor_gain", "sensor_noise", "bouc_wen", "damper_asymmetry"]
    random = np.random.default_rng(seed)
    strong = draw_cases(vehicle, (count + 1) // 2, seed, kinds, 0.3)
    cases = [*strong, *draw_cases(vehicle, count - len(strong), seed + 1, kinds, 1.5)]
    for number, made in enumerate(make_recordings(vehicle, cases, seconds)):
        values = in_order(system, made.values)
        record, what = Falsified("", frozenset(), values), made.case.kind
        if what == "clean" and number < len(strong):  # the others stay healthy
            record = falsified(system, values, SETUPS[number % len(SETUPS)], random)
            what = record.kind
        yield what, system, record


def _quarter_cars(count: int, seconds: float, seed: int) -> Iterator[tuple[str, System, Falsified]]:
    """A quarter car on a road of random phases: healthy, with laws strong and weak, with faults of sensors."""
    system = parse_system(QUARTER_CAR)
    for number in range(count):
        random = np.random.default_rng(seed + number)
        what, place, law = CASES[number % len(CASES)]
        plain = f"{place}}}"
        assert plain in QUARTER_CAR
        faulty = parse_system(QUARTER_CAR.replace(plain, f"{place}, laws: [{law}]}}") if law else QUARTER_CAR)
        time = np.arange(round(seconds * RATE)) / RATE
        f, phase = np.linspace(0.5, 18, 160), random.uniform(0, 2 * np.pi, 160)
        angle = 2 * np.pi * f * time[:, None] + phase
        road = np.column_stack([np.sin(angle) @ (6e-4 / f), np.cos(angle).sum(axis=1) * 6e-4 * 2 * np.pi])
        values = {p.name: p.nominal * float(np.exp(0.08 * random.standard_normal())) for p in system.parameters}
        sensors = simulate_ride(faulty, road, values, noise=random).sensors
        shown = road + np.array([1e-5, 5e-4]) * random.standard_normal(road.shape)
        yield what, system, Falsified("", frozenset(), np.column_stack([shown, sensors]))


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
