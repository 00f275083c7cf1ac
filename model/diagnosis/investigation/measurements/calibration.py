"""Calibration errors: gains, zeros and delays within the tolerances of data sheets are part of the model, not faults.

No rig has exact gains and zeros and exactly simultaneous samples.  With little noise a gain error of one per cent or a
delay of a hundredth of a sample is significant, and other laws that imitate it, such as a hung mass or an elastic mode,
fit a little better.  Once one is found, gains, zeros and delays of all sensors, gains and zeros of measured forces, and
masses of all bodies, none of which is weighed better than an instrument shows, become parameters of the model with the
tolerances as prior (`gain_std`, `offset_std`, `delay_std` of an address), and the search restarts.  Values within
tolerance are reported and have no effect on the verdict; their uncertainty is part of that of all other values.

With enough channels, one whose error is far larger than all others of its kind is a fault, however small: the
instruments of one rig are comparable.  Where laws are missing, errors make up for them: such a fault is named only if
the model leaves no more than noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr, stdtr

from sprung.model.diagnosis.fit.baseline import refreshed
from sprung.model.diagnosis.fit.misfit import misfit
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.investigation.measurements.floor import leaves_more_than_noise
from sprung.model.diagnosis.investigation.state import AcceptedFinding, Investigation
from sprung.model.diagnosis.record.signals import Signals
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import PlausibleRules
from sprung.model.diagnosis.screening.score import Screening
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.diagnosis.selection.along_measured import disturbed
from sprung.model.diagnosis.selection.plausible import hardly_there, out_of_range
from sprung.model.laws import Law, SensorLaw
from sprung.model.laws.base import DataSheet
from sprung.model.schema import SupportInput
from sprung.model.system import System

_STEPS = 12  # of a fit of the structure with the calibration
_PASSES = 3  # of such fits, with those beyond their tolerance freed after each
_TAILS, _REWEIGHTED = 4.0, 50  # degrees of freedom of Student's t, and iterations


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
    """Whether a fault may be within a data sheet: a sensor is compared with an input, whose error it contains."""
    within = 2 * state.options.rules.plausible.calibration
    return term.law.of_instrument is not None and _in_deviations(state, term) <= within


def _in_deviations(state: Investigation, term: Term) -> float:
    """Size of an error in standard deviations of its data sheet; infinite for other effects."""
    spread = expected(state.system, state.signals, term.law, term.location, state.options.rules.plausible)
    return abs(term.parameters[0] - term.law.absent[0]) / spread if spread > 0 else np.inf


@dataclass(frozen=True)
class _EstimatedError:
    """An error in standard deviations of its data sheet, and the standard deviation of its estimate, likewise."""

    off: float
    std: float

    def visible(self, among: int, by_chance: float) -> float:
        """Its size; 0 where the largest of so many that are none would be as large by chance."""
        return abs(self.off) if 2 * ndtr(-abs(self.off) / max(self.std, 1e-300)) * among < by_chance else 0.0


def is_outlier(fit: Fit, terms: Sequence[Term], key: tuple[str, str, str], rules: PlausibleRules) -> bool:
    """Whether an error is larger than all others, and an outlier of its kind by Student's t-test.

    terms: errors in the fit, perhaps without what they share; taken relative to the median of their kind.  How far the
    others scatter beyond their standard deviations is estimated by moments (DerSimonian and Laird 1986).
    """
    place, effect, _ = key  # the form of a lag is hardly identifiable
    away = _relative_deviations(fit, terms)
    own = away.pop((place, effect), None)
    others = [one for (_, kind), one in away.items() if kind == effect]
    if own is None or len(others) < 2:
        return False
    if abs(own.off) <= rules.alone * max(one.visible(len(away), rules.by_chance) for one in away.values()):
        return False
    middle, spread = _scatter(others)
    distance = abs(own.off - middle) / float(np.hypot(spread, own.std))
    return bool(2 * stdtr(len(others) - 1, -distance) * (len(others) + 1) < rules.by_chance)


def _relative_deviations(fit: Fit, terms: Sequence[Term]) -> dict[tuple[str, str], _EstimatedError]:
    """Errors by place and kind, relative to the median of their kind."""
    at = {term.key: index for index, term in enumerate(fit.point.terms)}
    away: dict[tuple[str, str], _EstimatedError] = {}
    for kind in {term.law.name for term in terms}:
        alike = [term for term in terms if term.law.name == kind]
        sheet = np.array([term.scales[0] for term in alike])
        off = np.array([term.parameters[0] - term.law.absent[0] for term in alike]) / sheet
        places = [fit.place(at[term.key]).start for term in alike]
        apart = np.eye(len(alike)) - 1 / len(alike)  # what all share is less certain than how they differ
        covariance = apart @ (fit.covariance[np.ix_(places, places)] / np.outer(sheet, sheet)) @ apart
        std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        away |= {
            (term.location, kind): _EstimatedError(float(value), float(s))
            for term, value, s in zip(alike, off - np.median(off), std, strict=True)
        }
    return away


def _scatter(errors: Sequence[_EstimatedError]) -> tuple[float, float]:
    """Mean of errors, and the standard deviation of one more of them, exactly known, about it."""
    off, variance = np.array([one.off for one in errors]), np.array([max(one.std, 1e-12) ** 2 for one in errors])
    weight = 1 / variance
    mean = float(weight @ off / np.sum(weight))
    excess = float(weight @ (off - mean) ** 2) - (len(errors) - 1)
    between = max(0.0, excess / float(np.sum(weight) - np.sum(weight**2) / np.sum(weight)))
    weight = 1 / (variance + between)
    return float(weight @ off / np.sum(weight)), float(np.sqrt(between + 1 / np.sum(weight)))


def is_gain(term: Term) -> bool:
    """Whether a term is a gain that may be a calibration error."""
    return term.law.of_instrument is not None and term.law.slope().gain != 0


def shared_gain(terms: Sequence[Term]) -> tuple[float, float]:
    """Most likely common gain of the terms with a tolerance, and its standard deviation; 1 and 0 without any."""
    gains = [(term.parameters[0], term.known[0]) for term in terms if term.known and is_gain(term)]
    if not gains:
        return 1.0, 0.0
    weights = np.array([1 / spread**2 for _, spread in gains])
    logs = np.log(np.maximum([gain for gain, _ in gains], 1e-3))
    return float(np.exp(weights @ logs / np.sum(weights))), float(np.sum(weights) ** -0.5)


def centred(terms: Sequence[Term]) -> tuple[Term, ...]:
    """Terms with their gains divided by the common one, which is not identifiable.

    The same rig at another size, with other values of its laws, gives the same recording.
    """
    shared, _ = shared_gain(terms)
    return tuple(
        replace(term, parameters=(term.parameters[0] / shared,)) if term.known and is_gain(term) else term
        for term in terms
    )


def calibrated(state: Investigation, first: Term) -> Investigation:
    """The investigation with the calibration errors of all channels and bodies in its model, its search begun anew.

    first: the first that was found; if it is an outlier, it is a fault, and the model is not changed.
    Gains of the inputs are kept fixed from now on: their common part is only identifiable from the curvature of a law.
    """
    file, terms = state.fit.point.terms[: state.given], calibration_terms(state)
    keys = {term.key for term in terms}
    beyond = state.fit.point.terms[state.given :]
    laws = tuple(one for one, term in zip(state.found, beyond, strict=True) if term.key not in keys)
    found = tuple(term for term in beyond if term.key not in keys)
    problem = state.problem
    for _ in range(_PASSES):
        fit = try_optimise(problem, replace(state.fit.point, terms=(*file, *terms, *found)), _STEPS)
        if fit is None:
            return replace(state, calibrations=0)
        if problem.process_noise:  # beside a strong unmeasured force, which they make up for, values are rough
            problem, fit = refreshed(problem, fit)
        fitted = _with_heavy_tails(fit, range(len(file), len(file) + len(terms)))
        fitted = fitted if _anchored(state, fitted) else centred(fitted)
        alone = is_outlier(fit, fitted, first.key, state.options.rules.plausible)
        with_them = replace(state, problem=problem, fit=fit, held=replace(state.held, noise=problem.noise))
        if alone and not leaves_more_than_noise(with_them):
            return replace(state, calibrations=0)
        if any(out_of_range(term) for term in fitted):
            return replace(state, calibrations=0)  # no errors, but another structure
        terms = tuple(_freed_beyond_tolerance(state, fitted))
        if [term.known for term in terms] == [term.known for term in fitted]:
            break
    held = tuple(replace(term, fixed=(True,)) for term in terms)  # else they absorb part of the missing law
    problem = replace(state.problem, noise=state.base.noise)
    base = try_optimise(problem, replace(state.base.point, terms=(*state.base.point.terms, *held)), _STEPS)
    if base is None:
        return replace(state, calibrations=0)
    problem, base = refreshed(problem, base)
    screening = screen(problem, base, state.problem.system.catalogue, state.options.project)
    begun = replace(state, problem=problem, base=base, fit=base, found=(), first=screening, last=screening, wider=None)
    begun = replace(begun, held=replace(state.held, noise=problem.noise), calibrations=len(held))
    if found and disturbed(problem.system):
        return _with_laws_kept(begun, with_them, laws)
    if float(np.max(misfit(base))) > state.options.rules.setup.misfit:
        return begun  # fixed until the missing law is found: before, they would diverge
    base = with_free_gains(begun, base)
    return replace(begun, base=base, fit=base)


def _with_laws_kept(begun: Investigation, beside: Investigation, laws: tuple[AcceptedFinding, ...]) -> Investigation:
    """A search begun anew with calibration errors, which goes on beside the laws that were found.

    Along a motion that the sensors saw, unmeasured forces are whatever masses, gains and springs do not explain: beside
    free gains and masses no law shows in them, but those that were found without these are right beside them.
    """
    problem, fit = beside.problem, with_free_gains(begun, beside.fit)
    last = screen(problem, fit, problem.system.catalogue, begun.options.project)
    return replace(begun, problem=problem, fit=fit, held=beside.held, found=laws, last=last)


def _with_heavy_tails(fit: Fit, indices: range) -> tuple[Term, ...]:
    """Errors in a fit, with Student's t in place of their Gaussian priors where nothing but these determines them.

    Factors that masses, gains and springs have in common change nothing that is measured; along them, one large error
    would pull all others.  Iteratively reweighted least squares (Holland and Welsch 1977).
    """
    terms = [fit.point.terms[index] for index in indices]
    places = [fit.place(index).start for index in indices]
    sheet, prior = np.array([(term.scales[0], term.known[0]) for term in terms]).T
    covariance = fit.covariance[np.ix_(places, places)] / np.outer(sheet, sheet)
    measured, directions = np.linalg.eigh(np.linalg.pinv(covariance, hermitian=True) - np.diag((sheet / prior) ** 2))
    free = directions[:, measured < 1]  # less is known than from the data sheets
    fitted = np.array([term.parameters[0] - term.law.absent[0] for term in terms]) / sheet
    found = fitted
    for _ in range(_REWEIGHTED if free.size else 0):
        weighted = free * ((_TAILS + 1) / (_TAILS + found**2))[:, None]
        found = fitted - free @ np.linalg.solve(weighted.T @ free, weighted.T @ fitted)
    values = zip(terms, found * sheet, strict=True)
    return tuple(replace(term, parameters=(float(term.law.absent[0] + value),)) for term, value in values)


def _anchored(state: Investigation, terms: Sequence[Term]) -> bool:
    """Whether a measured force, held exact, determines the gains that others have in common."""
    free = {term.location for term in terms if is_gain(term)}
    return any(name not in free for name in state.signals.force_names)


def _freed_beyond_tolerance(state: Investigation, terms: Sequence[Term]) -> Iterator[Term]:
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


def with_free_gains(state: Investigation, fit: Fit) -> Fit:
    """A fit with masses, and gains, zeros and delays of sensors free; those of the inputs stay fixed."""
    sensors, terms = state.signals.sensor_names, list(fit.point.terms)
    for index in calibration_indices(state):
        if terms[index].location in sensors or terms[index].law.scales:
            terms[index] = replace(terms[index], fixed=())
    return replace(fit, point=replace(fit.point, terms=tuple(terms)))


def calibration_indices(state: Investigation) -> range:
    """Indices of the terms of the investigation's fits that are calibration errors: the last of the given ones."""
    return range(state.given - (state.calibrations or 0), state.given)


def without_calibrations(state: Investigation) -> Screening:
    """The last screening without calibration errors that are in the model, whose rest is rounding."""
    among = {state.fit.point.terms[index].key[:2] for index in calibration_indices(state)}
    kept = tuple(candidate for candidate in state.last.candidates if candidate.term.key[:2] not in among)
    return replace(state.last, candidates=kept)


def faulty(state: Investigation) -> list[int]:
    """Indices of calibration errors that are significantly beyond their tolerance beside all findings, or outliers."""
    fit, rules = state.fit, state.options.rules.plausible
    beyond = (index for index in calibration_indices(state) if not within_tolerance(state, fit.point.terms[index]))
    return sorted({*(index for index in beyond if not hardly_there(fit, rules, index)), *_outliers(state)})


def _outliers(state: Investigation) -> list[int]:
    """Indices of calibration errors that are outliers of their kind beside all findings."""
    free = [index for index in calibration_indices(state) if not state.fit.point.terms[index].fixed]
    terms, rules = [state.fit.point.terms[index] for index in free], state.options.rules.plausible
    alone = [index for index in free if is_outlier(state.fit, terms, state.fit.point.terms[index].key, rules)]
    return alone if alone and not leaves_more_than_noise(state) else []


def _is_observable(law: SensorLaw, *, rate: bool, support: bool) -> bool:
    """Whether a fault is observable beside others: rates have no offset; of supports only the gain is."""
    slope = law.slope()
    moved = slope.lag or slope.delay
    return bool(slope.gain or (moved and not support) or (slope.offset and not rate and not support))


def calibration_terms(state: Investigation) -> tuple[Term, ...]:
    """Calibration errors of all channels and bodies, with values as found."""
    return (*_of_all_channels(state), *_of_all_bodies(state))


def _of_all_bodies(state: Investigation) -> Iterator[Term]:
    """Masses of bodies that the system file does not estimate, as found."""
    laws = [law for law in state.problem.system.catalogue if law.scales]
    return _freed_beyond_tolerance(state, [term for law in laws for term in _of_bodies(state, law)])


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
