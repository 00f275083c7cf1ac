"""`sprung bench sensitivity`: what a diagnosis says when one of its deciding numbers is another.

Every number of `model.diagnosis.rules` is set to both ends of its range, one at a time, and recordings are diagnosed
again: healthy vehicles, laws strong and weak, faults of sensors, wrong set-ups, component tests.  They are those of the
independent generator, with the budgets `quick` and `cases` those of a simulated quarter car.  Work that a number
cannot change is not done again: a number of the verdict or the report is varied on finished investigations, one of
the evidence or the selection on begun ones, and fits, screenings and starts that are known are remembered.

One line per recording, with the numbers that change what is said of it; then one line per number: on how many
recordings it was varied, where verdict, place or name changed and to what, and by how many decades p-values moved
elsewhere.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import Field, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sprung.benchmarks.concealed import engine_digest
from sprung.benchmarks.keeping import keep, kept
from sprung.benchmarks.sensitivity_cases import Made, recordings
from sprung.benchmarks.setups import FalsifiedRecording
from sprung.model.diagnosis.api import DiagnosisError, Options, Report, diagnose
from sprung.model.diagnosis.component.measured import is_component_test
from sprung.model.diagnosis.fit.memory import FitMemory
from sprung.model.diagnosis.investigation.diagnose import begun, concluded, under, with_findings
from sprung.model.diagnosis.investigation.judgement.judgement import held_out_runs, judged
from sprung.model.diagnosis.investigation.state import Investigation, Outcome
from sprung.model.diagnosis.report.compose import compose
from sprung.model.diagnosis.rules import RULES, Rules, reason
from sprung.model.rule import RuleTable
from sprung.model.system import System

ALONE = {  # stages of recordings of their own, with what decides there
    "component": ("white_noise", "component", "verdict"),
    "ambient": ("white_noise", "ambient", "ambient_window", "verdict"),
}
LAST = ("verdict", "report")  # stages that read finished investigations
LATE = ("evidence", "selection", "plausible", "acceptance", "formula", "noise")  # stages that go on from begun ones
_NAMED = 4  # recordings at most whose names are kept with a number
FIRST = ("input_faults", "input_rounds", "input_rival", "input_rivals", "input_done")  # of acceptance, but decide early


@dataclass(frozen=True)
class ReportedResult:
    """What a report decides."""

    verdict: str
    findings: tuple[tuple[str, str], ...]  # location and effect, or its look-alikes
    p_values: tuple[float | None, ...]

    @classmethod
    def of(cls, report: Report) -> ReportedResult:
        """From a report."""
        names = tuple((f.location, f.family or f.effect) for f in report.findings)
        return cls(report.verdict, names, tuple(f.p_value for f in report.findings))

    def decades(self, other: ReportedResult) -> float:
        """Largest move of a p-value, in powers of ten; those below 1e-30 count as that."""
        pairs = zip(self.p_values, other.p_values, strict=False)
        moves = [abs(np.log10(max(a, 1e-30) / max(b, 1e-30))) for a, b in pairs if a is not None and b is not None]
        return float(max(moves, default=0.0))


@dataclass(frozen=True)
class Subject:
    """A recording with everything that is known of it under the usual rules."""

    name: str
    system: System
    record: FalsifiedRecording
    options: Options
    said: ReportedResult
    reads: tuple[str, ...] = ()  # stages that alone decide: of component tests, of structures without inputs
    state: Investigation | None = None  # begun; None for those
    outcome: Outcome | None = None

    def again(self, stage: str, name: str, rules: Rules) -> ReportedResult:
        """What is said under other rules, doing again what they can change."""
        if self.state is None or self.outcome is None:
            return ReportedResult.of(diagnose(self.system, self.record, replace(self.options, rules=rules)))
        if stage in LAST:
            done = self.outcome
            state = under(done.investigation, rules)
            runs = held_out_runs(state, done.runs.before, done.runs.after, done.runs.noisy)
            judgement = judged(state, runs, done.judgement.ended)
            return ReportedResult.of(compose(replace(done, investigation=state, judgement=judgement), self.record))
        if stage in LATE and name not in FIRST:
            state = under(self.state, rules)
        else:
            state = begun(self.system, self.record, replace(self.options, rules=rules), _silent)
        state, usual = with_findings(state, _silent), self.outcome
        same = usual.investigation
        if stage != "noise" and (state.fit is same.fit and state.base is same.base):  # as remembered: the same model
            return ReportedResult.of(compose(replace(usual, investigation=state), self.record))
        return ReportedResult.of(compose(concluded(state, _silent), self.record))


def run(
    budget: Literal["quick", "cases", "full"] = "quick",
    seed: int = 4711,
    stage: str = "",
    cases: str = "",
    count: int = 0,
    seconds: float = 0.0,
    folder: Path | None = None,
    part: str = "1/1",
    write: Path | None = None,
) -> Iterator[dict[str, Any]]:
    """Yields one line per recording, one per number, and the totals.

    budget: `quick` has 8 recordings of a quarter car and a rig of 15 s, `cases` 28, with weak effects and more kinds of
    faults, `full` 40 of the bundled vehicle of 60 s; count and seconds say otherwise.  All have structures and rigs
    besides, each with something of its own (`sensitivity_cases.PARTICULAR` and on).
    stage: of the rules, or numbers as `stage.name`, separated by commas, if not all are asked for.
    cases: parts of the names of recordings, separated by commas, if not all are asked for.
    folder: where numbers that are done are kept; on the same recording and engine they are not varied again.
    part: "2/3": only every third recording, the second first, for processes beside each other with one folder.
    write: file for what was found, which the reasons of the rules quote; what it knows of more recordings stays.
    """
    count = count or {"quick": 8, "cases": 28, "full": 40}[budget]
    seconds = seconds or (60.0 if budget == "full" else 15.0)
    asked, names = ([one for one in text.split(",") if one] for text in (stage, cases))
    keys = [(n, one) for n, one in RULES.constants() if not asked or n in asked or f"{n}.{one.name}" in asked]
    settings = [budget, seed, count, seconds, engine_digest()]
    own, parts = (int(x) for x in part.split("/"))
    began, done = time.process_time(), []
    for number, (name, make) in enumerate(recordings(budget, count, seconds, seed)):
        if number % parts != own - 1 or (names and not any(one in name for one in names)):
            continue
        file = None if folder is None else folder / f"{name.replace(' ', '-')}.json"
        known = _varied_on(name, make, keys, file, settings)
        done.append(known)
        changed = {key: one["changed"] for key, one in known["varied"].items() if one and one["changed"]}
        yield {key: known[key] for key in ("recording", "verdict", "findings")} | {"changed": changed}
    lines = [figure(key, one, done) for key, one in keys]
    yield from lines
    if write is not None:
        before = json.loads(write.read_text(encoding="utf-8")) if write.exists() else {}
        write.write_text(quoted(lines, done, f"recordings ({budget})", before, code=engine_digest()), encoding="utf-8")
    yield {
        "numbers": len(lines),
        "that_change_something": sum(bool(line["changed"]) for line in lines),
        "recordings": len(done),
        "cpu_seconds": round(time.process_time() - began, 1),
    }


def _varied_on(
    name: str,
    make: Callable[[], Made],
    keys: list[tuple[str, Field[Any]]],
    file: Path | None,
    settings: list[Any],
) -> dict[str, Any]:
    """What a recording says of all numbers; None of those that it does not read.  Varied are those not yet known."""
    result = kept(file, settings) or {}
    known = result.get("varied", {})
    wanted = {f"{stage}.{one.name}": (stage, one) for stage, one in keys}
    open_keys = [key for key, (_, one) in wanted.items() if known.get(key, {}).get("varied") != _numbers(one)]
    if not result or open_keys:
        subject = _known(name, *make())  # one at a time: remembered fits take a gigabyte
        result = {"recording": name, "verdict": subject.said.verdict, "findings": subject.said.findings}
        for key in open_keys:
            stage, one = wanted[key]
            known[key] = {"varied": _numbers(one), "found": vary(subject, stage, one)}
            keep(file, settings, result | {"varied": known})
    return result | {"varied": {key: known[key]["found"] for key in wanted}}


def _numbers(number: Field[Any]) -> list[Any]:
    return [number.default, *number.metadata["range"]]


def vary(subject: Subject, stage: str, number: Field[Any]) -> dict[str, Any] | None:
    """Set a number to both ends of its range on a recording; what changes.  None: its stage does not read it."""
    if stage not in subject.reads if subject.reads else stage in ("component", "ambient", "ambient_window"):
        return None
    changed, decades = [], 0.0
    for end in number.metadata["range"]:
        if end == number.default:
            continue
        try:
            said = subject.again(stage, number.name, RULES.varied(stage, number.name, end))
        except DiagnosisError as error:
            changed.append({"recording": subject.name, "at": end, "error": str(error)})
            continue
        if (said.verdict, said.findings) == (subject.said.verdict, subject.said.findings):
            decades = max(decades, said.decades(subject.said))
        else:
            changed.append({"recording": subject.name, "at": end, **_difference(subject.said, said)})
    return {"changed": changed, "decades": decades}


def figure(stage: str, number: Field[Any], done: list[dict[str, Any]]) -> dict[str, Any]:
    """The line of a number, over all recordings that its stage reads."""
    key = f"{stage}.{number.name}"
    read = {of["recording"]: one for of in done if (one := of["varied"].get(key))}
    found = list(read.values())
    return {
        "stage": stage,
        "number": number.name,
        "value": number.default,
        "range": list(number.metadata["range"]),
        "recordings": len(found),
        "on": list(read),
        "changed": [change for one in found for change in one["changed"]],
        "p_value_decades": round(max((one["decades"] for one in found), default=0.0), 2),
        "reason": reason(stage, number),
    }


def quoted(
    lines: list[dict[str, Any]],
    done: list[dict[str, Any]],
    subjects: str,
    before: dict[str, Any] | None = None,
    rules: RuleTable = RULES,
    code: str = "",
) -> str:
    """What the reasons of the rules say of a run, as JSON of a line per number: what is said otherwise at which end.

    subjects: what they are, in words; before: what was known.  A number that is what it was, and was varied on more
    recordings then, keeps that, and so do numbers that this run did not vary.  The set that is named is the larger one.
    code: digest of the code by which these numbers were varied, kept with each.
    """
    before = before or {"recordings": [], "numbers": {}}
    known_of, smaller = before["numbers"], len(done) < len(before["recordings"])
    others = {f"{n}.{one.name}" for n, one in rules.constants()} - {
        f"{line['stage']}.{line['number']}" for line in lines
    }
    numbers = {name: found for name, found in known_of.items() if name in others} | {
        f"{line['stage']}.{line['number']}": {
            "varied": [line["value"], *line["range"]],
            "recordings": line["recordings"],
            **({"on": line["on"]} if smaller or line["recordings"] <= _NAMED else {}),
            "changes": [_words(change) for change in line["changed"]],
            **({"code": code} if code else {}),
        }
        for line in lines
        if line["recordings"]
    }
    for line in lines:
        name = f"{line['stage']}.{line['number']}"
        known = known_of.get(name)
        if known is None or known["recordings"] <= line["recordings"]:
            continue
        if known["varied"] == [line["value"], *line["range"]]:
            numbers[name] = known
    head = {"set": f"{len(done)} {subjects}", "recordings": [one["recording"] for one in done]}
    if smaller:
        head = {key: before[key] for key in head}
    elif before.get("set") and before["set"] != head["set"]:  # numbers of before were varied on that
        for name, found in numbers.items():
            if "on" not in found and found is known_of.get(name):
                numbers[name] = {"of": before["set"], **found}
    rows = ",\n".join(f"  {json.dumps(name)}: {json.dumps(found)}" for name, found in numbers.items())
    return f'{json.dumps(head)[:-1]},\n "numbers": {{\n{rows}\n}}}}\n'


def _words(change: dict[str, Any]) -> str:
    """ "at 9.2 the name in 1-weak friction: a or b -> a"."""
    where = f"in {change['recording']}"
    if "error" in change:
        return f"at {change['at']:g} {where}: {change['error']}"
    what = "verdict" if "verdict" in change else "findings"
    before, after = (_named(side) if what == "findings" else side for side in change[what])
    return f"at {change['at']:g} the {what} {where}: {before} -> {after}"


def _named(findings: list[tuple[str, str]]) -> str:
    return " + ".join(f"{place} {effect}" for place, effect in findings) or "none"


def _difference(before: ReportedResult, after: ReportedResult) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if before.verdict != after.verdict:
        found["verdict"] = [before.verdict, after.verdict]
    if before.findings != after.findings:
        found["findings"] = [before.findings, after.findings]
    return found


def _known(name: str, system: System, record: FalsifiedRecording) -> Subject:
    """A recording diagnosed under the usual rules, with the steps on the way."""
    options = Options(file=name, memory=FitMemory())
    unmeasured = system.on_track or not system.file.inputs
    if unmeasured or is_component_test(system, record.values):
        reads = ALONE["ambient" if unmeasured else "component"]
        return Subject(name, system, record, options, ReportedResult.of(diagnose(system, record, options)), reads)
    state = begun(system, record, options, _silent)
    outcome = concluded(with_findings(state, _silent), _silent)
    return Subject(name, system, record, options, ReportedResult.of(compose(outcome, record)), (), state, outcome)


def _silent(share: float, text: str) -> None:
    """Nobody watches."""
