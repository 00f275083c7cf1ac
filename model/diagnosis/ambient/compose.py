"""Report of a recording without measured inputs: findings, values, sentences, frequencies over time."""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.ambient.judgement import VARYING, AmbientJudgement, PooledValues
from sprung.model.diagnosis.ambient.windows import WindowResult
from sprung.model.diagnosis.investigation.state import Options, Recorded
from sprung.model.diagnosis.investigation.verdict import kind_of
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.record.channels import Prepared
from sprung.model.diagnosis.report.report import (
    Finding,
    LawParameter,
    RecordingFacts,
    Report,
    ReportedParameter,
    TrackPoint,
    Unexplained,
)
from sprung.model.diagnosis.report.values import figures
from sprung.model.diagnosis.rules import AmbientRules
from sprung.model.laws.basis import UNKNOWN
from sprung.model.laws.sensor_faults import SENSOR_STUCK
from sprung.model.mechanics import Mode
from sprung.model.ratios import mechanics_at
from sprung.model.signals import FloatArray
from sprung.model.system import System


def compose_unforced(
    system: System,
    prepared: Prepared,
    record: Recorded,
    options: Options,
    windows: list[WindowResult],
    pooled: PooledValues,
    judgement: AmbientJudgement,
) -> Report:
    """The report of a recording without measured inputs."""
    names = prepared.signals.sensor_names
    rules = options.rules.ambient
    errors, left = judgement.errors, judgement.left
    where = _where(names, judgement) if np.any(left > 0) else ""
    findings = _findings(system, prepared, windows, pooled, rules)
    if judgement.verdict == "unknown_physics":
        place = names[int(np.argmax(errors.after))]
        sentence = f"a misfit that no law explains: {where}"
        findings.insert(0, Finding(place, UNKNOWN, EffectKind.UNLISTED, (), None, None, sentence=sentence))
    track = tuple(_point(system, window) for window in windows)
    values = _values(system, pooled)
    return Report(
        system=system.name,
        recording=RecordingFacts(
            options.file, len(record.values) / record.sample_rate, len(record.values), int(record.lost)
        ),
        verdict=judgement.verdict,
        baseline=values,
        baseline_validation=figures(names, errors.before),
        findings=tuple(findings),
        augmented=values,
        augmented_validation=figures(names, errors.after),
        noise_floor=figures(names, errors.bounded(options.rules.verdict)),
        localization={},
        explained=judgement.explained,
        unexplained=Unexplained(float(np.mean(left)), dict(zip(names, left.tolist(), strict=True)), where),
        summary=_summary(judgement.verdict, findings, track, where, rules),
        advice=tuple(_advice(system, pooled, judgement, windows, rules)),
        track=track,
        plot_data=_arrays(track),
    )


def _where(names: tuple[str, ...], judgement: AmbientJudgement) -> str:
    """The sensor with most power at other frequencies than the model's, and these frequencies, in words."""
    worst, (low, high) = int(np.argmax(judgement.left)), judgement.band
    share = 100 * judgement.errors.after[worst] ** 2
    return (
        f"{share:.0f} % of the power of {names[worst]} is at other frequencies than the structure has it, "
        f"most at {low:.3g} to {high:.3g} Hz"
    )


def _values(system: System, pooled: PooledValues) -> tuple[ReportedParameter, ...]:
    """Parameters with their means over windows."""
    ratios = zip(np.exp(pooled.log_ratio).tolist(), pooled.deviation.tolist(), strict=True)
    return tuple(
        ReportedParameter(p.name, p.nominal * ratio, p.nominal * ratio * std, p.nominal, p.unit)
        for p, (ratio, std) in zip(system.parameters, ratios, strict=True)
    )


def _findings(
    system: System, prepared: Prepared, windows: list[WindowResult], pooled: PooledValues, rules: AmbientRules
) -> list[Finding]:
    varying = [_varying(system, p, windows, pooled, rules) for p in np.flatnonzero(pooled.varying).tolist()]
    return [_stuck(name, at) for name, at in prepared.stuck] + varying


def _stuck(sensor: str, since: float) -> Finding:
    """since: s of the recording."""
    return Finding(
        location=sensor,
        effect=SENSOR_STUCK.name,
        kind=kind_of(SENSOR_STUCK),
        parameters=(),
        p_value=None,
        delta_bic=None,
        sentence=f"{sensor}: repeats one value from {since:.2f} s on",
    )


def _varying(system: System, p: int, windows: list[WindowResult], pooled: PooledValues, rules: AmbientRules) -> Finding:
    """Change of the p-th parameter, with its lowest and its highest value in windows that are sure of it."""
    parameter = system.parameters[p]
    sure = [w for w in windows if w.covariance[p, p] < rules.undetermined**2]
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
    law, chance = VARYING[parameter.quantity], float(pooled.chance[p])
    return Finding(parameter.element, law.name, kind_of(law), (low, high), chance, None, sentence=sentence)


def modes_at(system: System, log_ratio: FloatArray) -> list[Mode]:
    """Natural modes at log-ratios (P,), by frequency."""
    modes = sorted(mechanics_at(system, log_ratio).modes(system.bodies), key=lambda mode: mode.frequency)
    return [mode for mode in modes if mode.frequency > 1e-6 * modes[-1].frequency]


def _point(system: System, window: WindowResult) -> TrackPoint:
    """Natural frequencies with standard deviations, by finite differences."""
    frequency = np.array([mode.frequency for mode in modes_at(system, window.log_ratio)])
    slopes = []
    for p in range(len(window.log_ratio)):
        moved = window.log_ratio + 1e-4 * np.eye(len(window.log_ratio))[p]
        slopes.append((np.array([mode.frequency for mode in modes_at(system, moved)]) - frequency) / 1e-4)
    slope = np.array(slopes)
    deviation = np.sqrt(np.maximum(np.einsum("pm,pq,qm->m", slope, window.covariance, slope), 0.0))
    return TrackPoint(window.begin, window.end, tuple(frequency.tolist()), tuple(deviation.tolist()), window.adequate)


def _summary(
    verdict: str, findings: list[Finding], track: tuple[TrackPoint, ...], where: str, rules: AmbientRules
) -> str:
    first = np.array([point.frequency[0] for point in track])
    sure = np.array([point.deviation[0] < rules.followed * point.frequency[0] for point in track])
    seen = first[sure] if sure.any() else first
    lowest = f"lowest natural frequency {np.min(seen):.4g} to {np.max(seen):.4g} Hz over {len(seen)} windows"
    text = "; ".join(f.sentence for f in findings)
    if verdict == "consistent":
        text = "The nominal structure explains the spectra of the sensors; its excitation was not measured"
    elif where and verdict != "unknown_physics":
        text += f"; still unexplained: {where}"
    return f"{text}; {lowest}."


def _advice(
    system: System, pooled: PooledValues, judgement: AmbientJudgement, windows: list[WindowResult], rules: AmbientRules
) -> list[str]:
    words = []
    adequate = float(np.mean([w.adequate for w in windows]))
    if judgement.rejected:
        words.append(
            "nothing fits: the structure of the system file does not have these spectra. Likeliest: bodies or modes "
            "that the file does not have; masses or stiffnesses far from nominal; an excitation with lines of its own "
            "(a machine)"
        )
    if adequate < 0.5:
        words.append(f"only {100 * adequate:.0f} % of the windows are explained down to random errors")
    if float(np.mean(judgement.errors.floor**2)) > rules.coarse:
        words.append("too few windows to reveal a wrong structure: record longer")
    pairs = zip(system.parameters, pooled.deviation, strict=True)
    undetermined = [parameter.name for parameter, std in pairs if std > rules.undetermined]
    if undetermined:
        words.append(f"undecided without measured inputs: {', '.join(undetermined)}; longer windows determine more")
    return words


def _arrays(track: tuple[TrackPoint, ...]) -> dict[str, np.ndarray]:
    return {
        "track.time": np.array([0.5 * (p.begin + p.end) for p in track]),
        "track.frequency": np.array([p.frequency for p in track]),
        "track.std": np.array([p.deviation for p in track]),
    }
