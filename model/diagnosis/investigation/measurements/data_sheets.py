"""Tolerances of data sheets: errors of channels and masses as terms of the model, and which of them are in order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.investigation.state import Investigation
from sprung.model.diagnosis.record.signals import Signals
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import PlausibleRules
from sprung.model.diagnosis.selection.along_measured import disturbed
from sprung.model.laws import Law, SensorLaw
from sprung.model.laws.base import DataSheet
from sprung.model.schema import SupportInput
from sprung.model.system import System


def expected(system: System, signals: Signals, law: Law, location: str, rules: PlausibleRules) -> float:
    """Standard deviation of a parameter by the data sheet of its channel or body; 0: not a calibration error."""
    if law.scales:
        stated = getattr(system.file.bodies[location], law.scales)
        return rules.weighed if stated.std is None else float(stated.std / stated.value)
    names = [channel.name for channel in system.channels][-len(system.tolerances) :]
    if not isinstance(law, SensorLaw) or law.of_instrument is None or location not in names:
        return 0.0
    sheet = system.tolerances[names.index(location)]
    size, step = _size(signals, location), 1 / signals.sample_rate
    return law.of_instrument(DataSheet(sheet.gain, sheet.zero, sheet.delay, size, step))


def _size(signals: Signals, location: str) -> float:
    """Standard deviation of a channel's samples."""
    if location in signals.sensor_names:
        series = signals.sensors[:, signals.sensor_names.index(location)]
    elif location in signals.force_names:
        series = signals.force[:, signals.force_names.index(location)]
    else:
        support, _, quantity = location.rpartition(".")
        if quantity != "velocity":
            return 0.0  # only an offset needs it, and only velocities have one that shows
        series = signals.velocity[:, signals.support_names.index(support)]
        if not np.isfinite(series).all():
            return 0.0
    return float(np.std(series))


def within_tolerance(state: Investigation, term: Term) -> bool:
    """Whether an error is one of calibration, where such errors are part of the model."""
    return bool(state.calibrations) and within_data_sheet(state, term)


def within_data_sheet(state: Investigation, term: Term) -> bool:
    """Whether a fault is within the data sheet of its channel, or a mass within what the system file knows of it."""
    return _in_deviations(state, term) <= state.options.rules.plausible.calibration


def may_be_calibration(state: Investigation, term: Term) -> bool:
    """Whether a fault may be within a data sheet: a sensor is compared with an input, whose error it contains.

    So may a mass that a measured force weighs; without one it is compared with others, and stands for their errors.
    """
    compared = term.law.of_instrument is not None or (term.law.scales and _measures_force(state.system))
    return bool(compared) and _in_deviations(state, term) <= 2 * state.options.rules.plausible.calibration


def _in_deviations(state: Investigation, term: Term) -> float:
    """Size of an error in standard deviations of its data sheet; infinite for other effects."""
    spread = expected(state.system, state.signals, term.law, term.location, state.options.rules.plausible)
    return abs(term.parameters[0] - term.law.absent[0]) / spread if spread > 0 else np.inf


def calibration_terms(state: Investigation) -> tuple[Term, ...]:
    """Calibration errors of all channels and bodies, with values as found."""
    return (*_of_all_channels(state), *_of_all_bodies(state))


def freed_beyond_tolerance(state: Investigation, terms: Sequence[Term]) -> Iterator[Term]:
    """Terms with their tolerance as a prior, sensors and masses beyond it with a wide one.

    Without any, a sensor that is off would be held exact, and all others would follow it.  Inputs beyond are left out,
    to be found as faults: their values are kept from now on, and may make up for a law that is still missing.
    """
    rules, sensors = state.options.rules.plausible, state.signals.sensor_names
    for term in terms:
        if within_data_sheet(state, term):
            yield term
        elif term.law.scales:
            yield replace(term, known=(rules.masses,))
        elif term.location in sensors:
            yield replace(term, known=(rules.faulty * term.scales[0],))


def _of_all_bodies(state: Investigation) -> Iterator[Term]:
    """Masses of bodies that the system file does not estimate, as found."""
    laws = [law for law in state.problem.system.catalogue if law.scales]
    return freed_beyond_tolerance(state, [term for law in laws for term in _of_bodies(state, law)])


def _of_bodies(state: Investigation, law: Law) -> Iterator[Term]:
    """Changes of the quantity of bodies that a law scales, where the system file does not estimate it.

    Without a measured force, the heaviest body's is kept: masses are then known up to a common factor only.  Beside an
    unmeasured force no mass is known better than before: that force makes up for it.
    """
    system, rules = state.problem.system, state.options.rules.plausible
    known = {p.name.removesuffix(f".{law.scales}") for p in system.parameters}
    known |= {term.location for term in state.fit.point.terms[: state.given] if term.law == law} | disturbed(system)
    if not _measures_force(system):
        known.add(max(system.bodies, key=lambda name: getattr(system.file.bodies[name], law.scales).value))
    for name in system.bodies:
        if name not in known:
            yield _as_found(state, law, name, expected(system, state.signals, law, name, rules))


def _as_found(state: Investigation, law: Law, location: str, spread: float) -> Term:
    """A calibration error of a standard deviation by the data sheet, with its value if it was found before."""
    nothing = Term(law, location, law.absent, scales=(spread,), known=(spread,))
    values = {term.key: term.parameters for term in state.fit.point.terms[state.given :]}
    return replace(nothing, parameters=values.get(nothing.key, law.absent))


def _measures_force(system: System) -> bool:
    """Whether a force is measured, as an input or by a sensor, so that masses are known absolutely."""
    measured = (*system.file.inputs.values(), *system.file.sensors.values())
    return any(one.kind == "force" for one in measured)


def _of_all_channels(state: Investigation) -> tuple[Term, ...]:
    """Gain, zero and delay of every sensor, the first two of measured forces, gains of supports; values as found."""
    signals, part = state.signals, state.problem.part
    laws = [law for law in state.problem.system.catalogue if isinstance(law, SensorLaw)]
    rates = {name for name, rate in zip(signals.sensor_names, part.differentiated, strict=True) if rate}
    given = {term.key[:2] for term in state.fit.point.terms[: state.given]}
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
                spread = expected(state.system, signals, law, name, state.options.rules.plausible)
                if not spread or channel not in law.at or (name, law.name) in given:
                    continue
                if _is_observable(law, rate=name in rates, support=channel == "support"):
                    found.append(_as_found(state, law, str(name), spread))
    return tuple(found)


def _is_observable(law: SensorLaw, *, rate: bool, support: bool) -> bool:
    """Whether a fault is observable beside others: rates have no offset; of supports only the gain is."""
    slope = law.slope()
    moved = slope.lag or slope.delay
    return bool(slope.gain or (moved and not support) or (slope.offset and not rate and not support))
