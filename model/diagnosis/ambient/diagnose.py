"""The diagnosis of recordings without measured inputs: what a structure is made of, not what excites it.

Nothing can be simulated from its inputs here.  What is compared is the spectrum of the sensors in windows: identified
parameters fitted to the first part of the recording, powers of the rest against the model's.  Errors are square roots
of the share of power that the model puts at other frequencies than measured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from sprung.model.diagnosis.ambient.windows import (
    WindowResult,
    all_windows,
    displaced,
    independent,
    with_known,
)
from sprung.model.diagnosis.fit.memory import FitMemory
from sprung.model.diagnosis.investigation.course import Options, Progress, Recorded
from sprung.model.diagnosis.investigation.verdict import HeldOutErrors, kind_named, verdict_of
from sprung.model.diagnosis.record.channels import Prepared, TooLittleError
from sprung.model.diagnosis.report.report import (
    Finding,
    FitFigures,
    LawParameter,
    RecordingFacts,
    Report,
    ReportedParameter,
    TrackPoint,
    Unexplained,
)
from sprung.model.diagnosis.rules import RULES, AmbientRules
from sprung.model.identifier import PRIOR_STD
from sprung.model.laws.basis import UNKNOWN
from sprung.model.laws.sensor_faults import SENSOR_STUCK
from sprung.model.mechanics import Mode
from sprung.model.signals import BoolArray, FloatArray
from sprung.model.system import System


@dataclass(frozen=True)
class Pooled:
    """What all windows say together."""

    log_ratio: FloatArray  # (P,)
    deviation: FloatArray  # (P,), with the scatter over windows
    varying: BoolArray  # parameters that differ from window to window beyond chance, (P,)
    chance: FloatArray  # of such a scatter, (P,)


def diagnose_unforced(system: System, prepared: Prepared, record: Recorded, options: Options, tell: Progress) -> Report:
    """Diagnose a recording of sensors alone.

    HeldOutErrors: `TooLittleError` where no window tells anything.
    """
    signals = prepared.signals
    rules, memory = options.rules.ambient, options.memory or FitMemory()
    windows, note = all_windows(system, signals, rules, memory, lambda share: tell(0.05 + 0.5 * share, "windows"))
    if not windows:
        seconds = min(system.window, signals.samples) / system.sample_rate
        raise TooLittleError(
            f"no input is measured and no window of {seconds:g} s tells anything: it must hold some ten periods of the "
            "lowest mode, above the sensors' noise; lengthen `window`, or measure what excites the structure"
        )
    tell(0.6, "what all windows say together")
    split = signals.start + options.rules.record.fitted * signals.samples / signals.sample_rate
    first = [w for w in windows if w.end <= split] or windows
    pooled = pool(first if len(first) >= rules.independent else windows, rules)
    held = [w for w in windows if w.begin >= split - 1e-9]
    notes = [note] if note else []
    if not held:
        held = windows[-1:]
        notes.append("the recording is too short to hold a part back: what was fitted was judged on the same window")
    tell(0.8, "the last part under what the first part told")
    shared = with_known(system, signals, held, pooled.log_ratio, memory) or held
    varying = bool(np.any(pooled.varying))
    errors, band = _errors(shared, held if varying else shared, rules)
    tell(0.95, "report")
    report = _report(system, prepared, record, options, windows, pooled, errors, band)
    tell(1.0, "done")
    return replace(report, advice=(*prepared.notes, *notes, *report.advice))


def pool(windows: list[WindowResult], rules: AmbientRules = RULES.ambient) -> Pooled:
    """Weighted means over windows, and which parameters differ between them."""
    theta = np.array([w.log_ratio for w in windows])
    sigma = np.sqrt(np.array([np.diag(w.covariance) for w in windows]))
    P = theta.shape[1]
    mean, deviation = np.zeros(P), np.full(P, PRIOR_STD)
    varying, chance = np.zeros(P, dtype=bool), np.ones(P)
    apart = independent(windows)
    for p in range(P):
        tells = sigma[:, p] < rules.told
        if not tells.any():
            continue
        value, std = theta[tells, p], sigma[tells, p]
        one = apart & tells
        if one.sum() >= rules.independent:
            own, own_std = theta[one, p], sigma[one, p]
            centre = np.sum(own / own_std**2) / np.sum(1 / own_std**2)
            scatter = float(np.sum(((own - centre) / own_std) ** 2))
            chance[p] = float(chi2.sf(scatter, one.sum() - 1))
            wide = np.subtract(*np.quantile(own, [0.85, 0.15]))
            varying[p] = chance[p] < rules.alpha and wide > max(rules.varies, rules.spread * float(np.median(own_std)))
        mean[p] = float(np.median(value)) if varying[p] else float(np.sum(value / std**2) / np.sum(1 / std**2))
        number = max(1, int(one.sum()))
        inside = 1 / np.sqrt(np.sum(1 / std**2) * number / len(std))  # overlapping windows tell the same thing twice
        between = float(np.std(value)) / np.sqrt(number) if number >= rules.independent else 0.0
        deviation[p] = max(inside, between)
    return Pooled(mean, deviation, varying, chance)


def _errors(
    before: list[WindowResult], after: list[WindowResult], rules: AmbientRules
) -> tuple[HeldOutErrors, tuple[float, float]]:
    """Before: one value of every parameter for all windows; after: with what varies."""
    one, chance, _ = displaced([w for w, good in zip(before, independent(before), strict=True) if good], rules.parts)
    own, _, band = displaced([w for w, good in zip(after, independent(after), strict=True) if good], rules.parts)
    return HeldOutErrors(np.sqrt(one), np.sqrt(own), np.sqrt(chance)), band


def _report(
    system: System,
    prepared: Prepared,
    record: Recorded,
    options: Options,
    windows: list[WindowResult],
    pooled: Pooled,
    errors: HeldOutErrors,
    band: tuple[float, float],
) -> Report:
    names = prepared.signals.sensor_names
    rules = options.rules.ambient
    findings = _findings(system, prepared, windows, pooled, rules)
    verdict = verdict_of([kind_named(f.effect) for f in findings], errors, options.rules.verdict)
    left = errors.unexplained(options.rules.verdict)
    adequate = float(np.mean([w.adequate for w in windows]))
    rejected = verdict == "unknown_physics" and float(np.mean(errors.after**2)) > rules.rejected
    where = ""
    if np.any(left > 0):
        worst = int(np.argmax(left))
        where = (
            f"{100 * errors.after[worst] ** 2:.0f} % of the power of {names[worst]} is at other frequencies than the "
            f"structure has it, most at {band[0]:.3g} to {band[1]:.3g} Hz"
        )
    if verdict == "unknown_physics":
        place = names[int(np.argmax(errors.after))]
        findings.insert(0, Finding(place, UNKNOWN, (), None, None, sentence=f"a misfit that no law explains: {where}"))
    track = tuple(_point(system, window) for window in windows)
    share = errors.explained(options.rules.verdict) if any(f.effect != UNKNOWN for f in findings) else None
    values = tuple(
        ReportedParameter(p.name, value, value * float(s), p.nominal, p.unit)
        for p, value, s in zip(
            system.parameters,
            (np.array([p.nominal for p in system.parameters]) * np.exp(pooled.log_ratio)).tolist(),
            pooled.deviation.tolist(),
            strict=True,
        )
    )
    return Report(
        system=system.name,
        recording=RecordingFacts(
            options.file, len(record.values) / record.sample_rate, len(record.values), int(record.lost)
        ),
        verdict=verdict,
        baseline=values,
        baseline_validation=_figures(names, errors.before),
        findings=tuple(findings),
        augmented=values,
        augmented_validation=_figures(names, errors.after),
        noise_floor=_figures(names, errors.bounded(options.rules.verdict)),
        localization={},
        explained=share,
        unexplained=Unexplained(float(np.mean(left)), dict(zip(names, left.tolist(), strict=True)), where),
        summary=_summary(system, verdict, findings, track, where),
        advice=tuple(_advice(system, pooled, errors, adequate, rejected, rules)),
        track=track,
        evidence=_arrays(track),
    )


def _findings(
    system: System, prepared: Prepared, windows: list[WindowResult], pooled: Pooled, rules: AmbientRules
) -> list[Finding]:
    found = [
        Finding(name, SENSOR_STUCK.name, (), None, None, sentence=f"{name}: repeats one value from {at:.2f} s on")
        for name, at in prepared.stuck
    ]
    for p in np.flatnonzero(pooled.varying):
        parameter = system.parameters[int(p)]
        sure = [w for w in windows if w.covariance[p, p] < rules.told**2]
        sure = [w for w in sure if w.adequate and w.covariance[p, p] < rules.sure**2] or sure
        ends = [min(sure, key=lambda w: w.log_ratio[p]), max(sure, key=lambda w: w.log_ratio[p])]
        low, high = (
            LawParameter(
                name,
                parameter.nominal * float(np.exp(w.log_ratio[p])),
                parameter.nominal * float(np.exp(w.log_ratio[p]) * np.sqrt(w.covariance[p, p])),
                parameter.unit,
            )
            for name, w in zip(("lowest", "highest"), ends, strict=True)
        )
        sentence = (
            f"{parameter.element}: its {parameter.quantity} changes during the recording, from {low.value:.5g} "
            f"+- {low.std:.2g} {parameter.unit} at {ends[0].middle:.3g} s to {high.value:.5g} +- {high.std:.2g} "
            f"{parameter.unit} at {ends[1].middle:.3g} s"
        )
        effect = f"time_varying_{parameter.quantity}"
        found.append(Finding(parameter.element, effect, (low, high), float(pooled.chance[p]), None, sentence=sentence))
    return found


def modes_at(system: System, log_ratio: FloatArray) -> list[Mode]:
    """Natural modes with other values, by frequency."""
    values = {p.name: p.nominal * float(np.exp(x)) for p, x in zip(system.parameters, log_ratio, strict=True)}
    mechanics = system.mechanics
    stiffness = [values.get(f"{e}.stiffness", k) for e, k in zip(system.elements, mechanics.stiffness, strict=True)]
    damping = [values.get(f"{e}.damping", c) for e, c in zip(system.elements, mechanics.damping, strict=True)]
    changed = replace(mechanics, stiffness=np.array(stiffness), damping=np.array(damping))
    modes = sorted(changed.modes(system.bodies), key=lambda mode: mode.frequency)
    return [mode for mode in modes if mode.frequency > 1e-6 * modes[-1].frequency]


def _point(system: System, window: WindowResult) -> TrackPoint:
    """Frequencies with deviations by differences along every parameter."""
    frequency = np.array([mode.frequency for mode in modes_at(system, window.log_ratio)])
    slopes = []
    for p in range(len(window.log_ratio)):
        moved = window.log_ratio + 1e-4 * np.eye(len(window.log_ratio))[p]
        slopes.append((np.array([mode.frequency for mode in modes_at(system, moved)]) - frequency) / 1e-4)
    slope = np.array(slopes)
    deviation = np.sqrt(np.maximum(np.einsum("pm,pq,qm->m", slope, window.covariance, slope), 0.0))
    return TrackPoint(window.begin, window.end, tuple(frequency.tolist()), tuple(deviation.tolist()), window.adequate)


def _summary(system: System, verdict: str, findings: list[Finding], track: tuple[TrackPoint, ...], where: str) -> str:
    first = np.array([point.frequency[0] for point in track])
    sure = np.array([point.deviation[0] < 0.1 * point.frequency[0] for point in track])
    seen = first[sure] if sure.any() else first
    lowest = f"lowest natural frequency {np.min(seen):.4g} to {np.max(seen):.4g} Hz over {len(seen)} windows"
    text = "; ".join(f.sentence for f in findings)
    if verdict == "consistent":
        text = "The nominal structure explains the spectra of the sensors; what excites it was not measured"
    elif where and verdict != "unknown_physics":
        text += f"; still unexplained: {where}"
    return f"{text}; {lowest}."


def _advice(
    system: System, pooled: Pooled, errors: HeldOutErrors, adequate: float, rejected: bool, rules: AmbientRules
) -> list[str]:
    words = []
    if rejected:
        words.append(
            "nothing fits: the structure of the system file does not have these spectra. Likeliest: bodies or modes "
            "that the file does not have; masses or stiffnesses far from nominal; an excitation with lines of its own "
            "(a machine)"
        )
    if adequate < 0.5:
        words.append(f"only {100 * adequate:.0f} % of the windows are explained down to chance")
    if float(np.mean(errors.floor**2)) > rules.coarse:
        words.append("so few windows would hardly show a wrong structure: record longer")
    loose = [p.name for p, std in zip(system.parameters, pooled.deviation, strict=True) if std > rules.told]
    if loose:
        words.append(f"undecided without measured inputs: {', '.join(loose)}; longer windows tell more")
    return words


def _figures(names: tuple[str, ...], per_sensor: FloatArray) -> FitFigures:
    return FitFigures(float(np.sqrt(np.mean(per_sensor**2))), dict(zip(names, per_sensor.tolist(), strict=True)))


def _arrays(track: tuple[TrackPoint, ...]) -> dict[str, np.ndarray]:
    return {
        "track.time": np.array([0.5 * (p.begin + p.end) for p in track]),
        "track.frequency": np.array([p.frequency for p in track]),
        "track.std": np.array([p.deviation for p in track]),
    }
