"""Findings of component tests: values and sentences."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from sprung.model.diagnosis.component.formula import FormulaPiece
from sprung.model.diagnosis.force.fit import ComponentFit
from sprung.model.diagnosis.force.piece import Values
from sprung.model.diagnosis.force.ranking import Step
from sprung.model.diagnosis.investigation.configuration.effects import SIGN_REVERSED
from sprung.model.diagnosis.investigation.verdict import kind_of
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.report.report import Finding, LawParameter
from sprung.model.diagnosis.selection.evidence import bic
from sprung.model.laws.basis import UNKNOWN
from sprung.model.laws.gas import PRELOAD
from sprung.model.laws.sensor_faults import SENSOR_LAG
from sprung.model.signals import FloatArray

_DATA_SHEET_RATES = (0.05, 0.1, 0.2, 0.3, 0.52, 1.0, 1.5)  # m/s, at which damper makers quote forces
_MIDDLE = 0.3  # of the travel, central part for dynamometer forces
_FEWEST = 5  # samples for a force
_BAND = 0.8  # of the residual's power, in the band that is reported
_NEAR_RATE = 0.05  # relative distance of a sample's rate

_TO_DISTINGUISH = (
    "a test at other amplitudes and other rates, so that the same deflections come at other rates, "
    "would tell them apart"
)


def finding_of(
    element: str,
    fit: ComponentFit,
    base: ComponentFit,
    index: int,
    step: Step,
    sigma: tuple[FloatArray, FloatArray],
    alike: Sequence[str],
) -> Finding:
    """The finding of one law; alike: names of its look-alikes."""
    piece = fit.model.pieces[index]
    values, quoted = _parameters(fit.values(index), sigma[0]), _parameters(fit.quoted(index), sigma[1])
    shown = quoted or values[:2]
    if piece.dissipates:
        quoted += (_loop_area(fit),)
    quoted += _forces_at_rates(fit)
    family = _family(piece.effect, alike)
    rival = step.rivals[0] if step.rivals else None
    formula, memory = (piece.law.formula, piece.law.memory_formula) if isinstance(piece, FormulaPiece) else ("", "")
    what = f"a force {formula}" if formula else piece.title
    sentence = _sentence(f"{element}: {what}", shown[:3], memory, family)
    if base.element.damping > 0 and fit.element.damping * fit.task.rules.no_longer < base.element.damping:
        sentence += f"; {element}.damping is then no longer needed"
    return Finding(
        location=element,
        effect=piece.effect,
        kind=piece.effect_kind,
        parameters=values,
        p_value=step.p_value,
        delta_bic=step.delta_bic,
        runner_up=None if rival is None else (rival.last.effect, step.rival_bic(rival)),
        runner_up_location=None if rival is None else element,
        family=family,
        advice=None if family is None else _TO_DISTINGUISH,
        sentence=sentence,
        quoted=quoted,
        formula=formula,
        memory=memory,
    )


def _sentence(what: str, values: Sequence[LawParameter], memory: str, family: str | None) -> str:
    """A law with its main values, and what fits as well."""
    named = ", ".join(f"{one.name.replace('_', ' ')} {one.words()}" for one in values)
    words = f"{what}, {named}"
    if memory:
        words += f", z' = {memory}"
    return words if family is None else f"{words} ({family.replace('_', ' ')} fit almost equally well)"


def _parameters(values: Values, sigma: FloatArray) -> tuple[LawParameter, ...]:
    return tuple(
        LawParameter(name, float(value), float(s), unit)
        for (name, (value, unit)), s in zip(values.items(), sigma, strict=True)
    )


def _family(effect: str, alike: Sequence[str]) -> str | None:
    """A law and its look-alikes, in words; None without look-alikes."""
    others = [other for other in dict.fromkeys(alike) if other != effect]
    return " or ".join([effect, *others]) if others else None


def _loop_area(fit: ComponentFit) -> LawParameter:
    """Dissipated energy of the largest loops, J: mean and standard deviation over the cycles of most travel."""
    motion = fit.task.motion
    middle = motion.deflection - motion.middle
    starts = np.flatnonzero((middle[1:] > 0) & (middle[:-1] <= 0))
    work = np.concatenate([[0.0], np.cumsum(0.5 * (fit.force[1:] + fit.force[:-1]) * np.diff(motion.deflection))])
    if len(starts) < 2:
        return LawParameter("loop_area", float(abs(work[-1])), float("nan"), "J")
    areas = np.diff(work[starts])
    travel = np.array([np.ptp(middle[a:b]) for a, b in itertools.pairwise(starts)])
    large = areas[travel > 0.9 * travel.max()]
    scatter = float(np.std(large, ddof=1) / np.sqrt(len(large))) if len(large) > 1 else float("nan")
    return LawParameter("loop_area", float(np.mean(large)), scatter, "J")


def _forces_at_rates(fit: ComponentFit) -> tuple[LawParameter, ...]:
    """Modelled force less preload at data-sheet rates within the range of the test, extension then compression.

    Evaluated as on a dynamometer, while the rod passes the middle of its travel.  The standard deviation comprises the
    mean error of the model there and its random error over the passes.
    """
    motion, rows = fit.task.motion, []
    central = np.abs(motion.deflection - motion.middle) < _MIDDLE * fit.task.seen.travel
    for rate in _DATA_SHEET_RATES:
        for side, word in ((1.0, "extension"), (-1.0, "compression")):
            near = np.abs(motion.rate - side * rate) < _NEAR_RATE * rate
            near = near & central if np.sum(near & central) >= _FEWEST else near
            if near.sum() >= _FEWEST:
                value = float(np.mean(fit.force[near]) - fit.preload)
                passes = int(np.sum(np.diff(near.astype(int), prepend=0) > 0))
                left = fit.residual[near]
                deviation = float(np.hypot(np.mean(left), np.std(left) / np.sqrt(passes)))
                rows.append(LawParameter(f"force_{word}_{rate:g}", value, deviation, "N"))
    return tuple(rows)


def preload_finding(element: str, value: float, sigma: float) -> Finding:
    """A static force, of gas, weight or mounting.  Never a fault."""
    parameter = LawParameter("force", value, sigma, "N")
    return Finding(
        element,
        PRELOAD.name,
        kind_of(PRELOAD),
        (parameter,),
        None,
        None,
        sentence=f"{element}: a static preload of {parameter.words()}",
    )


def drift_finding(sensor: str, element: str, fit: ComponentFit, index: int, sigma: FloatArray) -> Finding:
    """A slow drift of a load cell's zero, the piece `index` of a fit.  Never a fault; sigma (2,): of its values."""
    piece, values = fit.model.pieces[index], _parameters(fit.values(index), sigma)
    what = f"{sensor}: its zero, or the static load of {element}, drifts by {values[0].words()}"
    sentence = f"{what} in the course of the record"
    return Finding(sensor, piece.effect, piece.effect_kind, values, None, None, sentence=sentence)


def unknown_finding(element: str, step: Step, laws: tuple[Step, ...], *, mapped: bool) -> Finding:
    """An unexplained force; the closest laws are mentioned in the sentence.

    step: the unnamed force; mapped: whether its map is reported.
    """
    sentence = f"{element}: a force that no law of the catalogue explains{'; its map is reported' if mapped else ''}"
    closest = None
    if laws:
        first, last = laws[0], laws[-1].chosen
        names = " and ".join(dict.fromkeys(s.piece.effect.replace("_", " ") for s in laws))
        left = np.sqrt(last.fit.held_out / max(first.before.fit.held_out, 1e-300))
        sentence += f"; {names} would come closest and leave {100 * left:.0f} % of the error"
        closest = first.piece.effect, first.delta_bic
    return Finding(
        element,
        UNKNOWN,
        EffectKind.UNLISTED,
        (),
        step.p_value,
        step.delta_bic,
        runner_up=closest,
        runner_up_location=None if closest is None else element,
        sentence=sentence,
    )


def reversed_finding(sensor: str, element: str) -> Finding:
    """A force or motion with the wrong sign."""
    return Finding(
        sensor,
        SIGN_REVERSED.name,
        kind_of(SIGN_REVERSED),
        (),
        None,
        None,
        sentence=f"{sensor}: the force has the wrong sign against the motion of {element}, which would feed energy "
        "into the rig; it was turned for the rest of this diagnosis",
    )


def late_finding(
    sensor: str, element: str, time: LawParameter, step: Step, alike: Sequence[str], *, filters: bool
) -> Finding:
    """A lag (or lead) of the force channel relative to the motion: a fault of the measurement.

    time: delay, or time constant of a filter, s.
    """
    size = LawParameter("time", abs(1e3 * time.value), 1e3 * time.std, "ms")
    near, way = _family(SENSOR_LAG.name, alike), "later" if time.value > 0 else "earlier"
    sentence = f"{sensor}: the force comes {size.words()} {way} than the motion of {element}"
    if filters:
        corner = f"{1 / (2 * np.pi * time.value):.3g} Hz"
        sentence = (
            f"{sensor}: the force passes a filter of first order with a time constant of {size.words()} ({corner}), "
            f"against the motion of {element}"
        )
    if near is not None:
        sentence += f" ({near.replace('_', ' ')} fit almost equally well)"
    rival = next(iter(step.rivals), None)
    return Finding(
        sensor,
        SENSOR_LAG.name,
        kind_of(SENSOR_LAG),
        (time,),
        step.p_value,
        step.delta_bic,
        runner_up=None if rival is None else (rival.last.effect, bic(rival.gain, 1, int(rival.count))),
        runner_up_location=None if rival is None else element,
        family=near,
        advice="filters and nodes of a test bench delay their channels: give force and motion the same filter",
        sentence=sentence,
    )


def leftover_words(element: str, fit: ComponentFit, size: float) -> str:
    """Place, size and frequencies of the residual of a force."""
    held = fit.residual[fit.task.split :]
    power = np.abs(np.fft.rfft(held - held.mean())) ** 2
    frequency = np.fft.rfftfreq(len(held), fit.task.motion.step)
    order = np.argsort(power)[::-1]
    count = int(np.searchsorted(np.cumsum(power[order]), _BAND * power.sum())) + 1
    among = frequency[order[:count]]
    rms = float(np.sqrt(np.mean(held**2)))
    return (
        f"{rms:.3g} N rms at {element}, {100 * rms / size:.1f} % of the force, "
        f"most of it at {among.min():.2g} to {among.max():.2g} Hz"
    )
