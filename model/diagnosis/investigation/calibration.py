"""Gains, zeros and delays of instruments in order: as data sheets leave them, they are part of the model, no fault.

No rig has gains of one, zeros of nothing and channels that are sampled at the same instant.  A recording of little
noise shows a gain of one per cent or a delay of a hundredth of a sample at once, and names for whatever else fits a
little better beside it: a mass that hangs, an elastic mode.  So once one shows, gains, zeros and delays of all sensors
and gains and zeros of measured forces are fitted beside the structure, expected to be as far off as data sheets leave
them (`gain_std`, `offset_std`, `delay_std` of an address), and findings are sought anew.  Within the tolerance they are
told and decide nothing; the deviations of all other values contain theirs.

Where many channels tell, it is by them that one is judged: one that is off by far more than any other of its kind is a
fault, however small, since the instruments of one rig are of one kind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import stdtr

from sprung.model.diagnosis.fit.baseline import refreshed
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.investigation.setup import misfit
from sprung.model.diagnosis.investigation.state import Investigation
from sprung.model.diagnosis.record.signals import Signals
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import PlausibleRules
from sprung.model.diagnosis.screening.score import Screening
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.diagnosis.selection.plausible import hardly_there
from sprung.model.laws import Law, SensorLaw
from sprung.model.laws.base import DataSheet
from sprung.model.schema import SupportInput
from sprung.model.system import System

_STEPS = 12, 6  # of a fit of the structure beside the calibration, and of one that begins near


def expected(system: System, signals: Signals, law: Law, location: str) -> float:
    """Standard deviation of a fault's parameter at a channel in order; 0: no instrument in order has it."""
    names = [channel.name for channel in system.channels][-len(system.tolerances) :]
    if not isinstance(law, SensorLaw) or law.of_instrument is None or location not in names:
        return 0.0
    sheet = system.tolerances[names.index(location)]
    size, step = _size(signals, location), 1 / signals.sample_rate
    return law.of_instrument(DataSheet(sheet.gain, sheet.zero, sheet.delay, size, step))


def _size(signals: Signals, location: str) -> float:
    """Standard deviation of what a channel shows."""
    if location in signals.sensor_names:
        series = signals.sensors[:, signals.sensor_names.index(location)]
    elif location in signals.force_names:
        series = signals.force[:, signals.force_names.index(location)]
    else:
        return 0.0  # of motions that are measured, nothing but the gain is asked
    return float(np.std(series))


def in_order(state: Investigation, term: Term) -> bool:
    """Whether a fault is no more than the data sheet of its channel leaves, on a rig where that shows."""
    return bool(state.calibrations) and within_sheet(state, term)


def within_sheet(state: Investigation, term: Term, instruments: int = 1) -> bool:
    """Whether a fault is no more than the data sheet of its channel leaves.

    instruments: as bad ones at most; what one sensor shows is told against what drives everything, which is another.
    """
    spread = expected(state.system, state.signals, term.law, term.location)
    off = abs(term.parameters[0] - term.law.absent[0]) if spread > 0 else np.inf
    return bool(off <= instruments * state.options.rules.plausible.calibration * spread)


def stands_alone(terms: Sequence[Term], key: tuple[str, str, str], rules: PlausibleRules) -> bool:
    """Whether a fault is further off than anything else, and than its kind scatters (Student's t).

    In units of what data sheets leave, and from what is usual of its kind: all may share what the file has too large.
    """
    place, effect, _ = key  # a lag's form is told by little
    kinds, away = {term.law.name for term in terms}, dict[tuple[str, str], float]()
    for kind in kinds:
        of_kind = {term.location: _off(term) for term in terms if term.law.name == kind}
        middle = float(np.median(list(of_kind.values())))
        away |= {(location, kind): off - middle for location, off in of_kind.items()}
    own = away.pop((place, effect), None)
    others = np.array([off for (_, kind), off in away.items() if kind == effect])
    if own is None or len(others) < 2 or abs(own) <= rules.alone * max(map(abs, away.values())):
        return False
    spread = float(np.std(others, ddof=1)) * np.sqrt(1 + 1 / len(others))
    distance = abs(own - float(np.mean(others))) / max(spread, 1e-300)
    return bool(2 * stdtr(len(others) - 1, -distance) * (len(others) + 1) < rules.by_chance)


def _off(term: Term) -> float:
    return (term.parameters[0] - term.law.absent[0]) / term.known[0]


def is_gain(term: Term) -> bool:
    """Whether a term is a gain that an instrument in order may have."""
    return isinstance(term.law, SensorLaw) and term.law.of_instrument is not None and term.law.slope().gain != 0


def shared_gain(terms: Sequence[Term]) -> tuple[float, float]:
    """Gain that terms with expected deviations share, least far off together, and its deviation; 1 and 0 of none."""
    gains = [(term.parameters[0], term.known[0]) for term in terms if term.known and is_gain(term)]
    if not gains:
        return 1.0, 0.0
    weights = np.array([1 / spread**2 for _, spread in gains])
    logs = np.log(np.maximum([gain for gain, _ in gains], 1e-3))
    return float(np.exp(weights @ logs / np.sum(weights))), float(np.sum(weights) ** -0.5)


def centred(terms: Sequence[Term]) -> tuple[Term, ...]:
    """Terms with gains around one: what all channels show too large is the same rig at another size.

    Other values of its laws explain it as well, so that no fit knows it better than data sheets do.
    """
    shared, _ = shared_gain(terms)
    return tuple(
        replace(term, parameters=(term.parameters[0] / shared,)) if term.known and is_gain(term) else term
        for term in terms
    )


def calibrated(state: Investigation, shown: Term) -> Investigation:
    """The investigation with the gains and zeros of all channels in its model, at the beginning of its search.

    shown: the first that was found; where it stands alone it is a fault, and nothing of this is done.
    What is beyond the tolerance beside the findings so far stays out, to be found as the fault that it is.  Gains of
    what drives everything are kept as they are from now on: their common part shows in a law's curvature alone.
    """
    file, terms = state.fit.point.terms[: state.given], _of_all_channels(state)
    keys = {term.key for term in terms}
    found = tuple(term for term in state.fit.point.terms[state.given :] if term.key not in keys)
    for _ in range(2):
        fit = try_optimise(state.problem, replace(state.fit.point, terms=(*file, *terms, *found)), _STEPS[1])
        if fit is None:
            return replace(state, calibrations=0)
        fitted = centred(fit.point.terms[len(file) : len(file) + len(terms)])
        if stands_alone(fitted, shown.key, state.options.rules.plausible):
            return replace(state, calibrations=0)
        terms = tuple(term for term in fitted if within_sheet(state, term))
        if len(terms) == len(fitted):
            break
    held = tuple(replace(term, fixed=(True,)) for term in terms)  # else they take up part of what a law leaves out
    problem = replace(state.problem, noise=state.base.noise)
    base = try_optimise(problem, replace(state.base.point, terms=(*state.base.point.terms, *held)), _STEPS[0])
    if base is None:
        return replace(state, calibrations=0)
    problem, base = refreshed(problem, base)
    screening = screen(problem, base, state.problem.system.catalogue, state.options.project)
    begun = replace(state, problem=problem, base=base, fit=base, found=(), first=screening, last=screening, wider=None)
    begun = replace(begun, held=replace(state.held, noise=problem.noise), calibrations=len(held))
    if float(np.max(misfit(base))) > state.options.rules.setup.misfit:
        return begun  # kept until the law stands that is left out: beside it they would run away from any start
    base = freed(begun, base)
    return replace(begun, base=base, fit=base)


def freed(state: Investigation, fit: Fit) -> Fit:
    """A fit whose next steps move gains, zeros and delays of sensors; those of what drives everything are kept."""
    sensors, terms = state.signals.sensor_names, list(fit.point.terms)
    for index in channels(state):
        if terms[index].location in sensors:
            terms[index] = replace(terms[index], fixed=())
    return replace(fit, point=replace(fit.point, terms=tuple(terms)))


def channels(state: Investigation) -> range:
    """Which terms of the investigation's fits are gains and zeros: the last that are given."""
    return range(state.given - (state.calibrations or 0), state.given)


def of_others(state: Investigation) -> Screening:
    """What was screened last, without gains and zeros that are in the model: of these no more than rounding is left."""
    among = {state.fit.point.terms[index].key[:2] for index in channels(state)}
    kept = tuple(candidate for candidate in state.last.candidates if candidate.term.key[:2] not in among)
    return replace(state.last, candidates=kept)


def faulty(state: Investigation) -> list[int]:
    """Those of them that are beyond the tolerance beside everything that was found, by more than they are uncertain."""
    fit, rules = state.fit, state.options.rules.plausible
    beyond = (index for index in channels(state) if not in_order(state, fit.point.terms[index]))
    return [index for index in beyond if not hardly_there(fit, rules, index)]


def _shows(law: SensorLaw, *, rate: bool, support: bool) -> bool:
    """Whether a fault shows: a rate has no offset, and supports are taken to be sampled at their time."""
    slope = law.slope()
    moved = slope.lag or slope.delay
    return bool(slope.gain or (moved and not support) or (slope.offset and not rate))


def _of_all_channels(state: Investigation) -> tuple[Term, ...]:
    """Gain, zero and delay of every sensor, the first two of measured forces, gains of supports; off as found."""
    signals, part = state.signals, state.problem.part
    laws = [law for law in state.problem.system.catalogue if isinstance(law, SensorLaw)]
    rates = {name for name, rate in zip(signals.sensor_names, part.differentiated, strict=True) if rate}
    given = {term.key[:2] for term in state.fit.point.terms[: state.given]}
    values = {term.key: term.parameters for term in state.fit.point.terms[state.given :]}
    found = []
    measured = tuple(
        f"{name}.{next(iter(source.measured))}"
        for name, source in state.system.file.inputs.items()
        if isinstance(source, SupportInput)
    )
    groups = (("sensor", signals.sensor_names), ("force", signals.force_names), ("support", measured))
    for channel, names in groups:
        for name in names:
            for law in laws:
                spread = expected(state.system, signals, law, name)
                if not spread or channel not in law.at or (name, law.name) in given:
                    continue
                if _shows(law, rate=name in rates, support=channel == "support"):
                    nothing = Term(law, str(name), law.absent, scales=(spread,), known=(spread,))
                    found.append(replace(nothing, parameters=values.get(nothing.key, law.absent)))
    return tuple(found)
