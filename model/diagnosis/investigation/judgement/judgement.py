"""Judgement of an investigation: held-out errors, their noise floor, and the verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.investigation.configuration.effects import WRONG_BODY
from sprung.model.diagnosis.investigation.judgement.imitated import imitated
from sprung.model.diagnosis.investigation.measurements.calibration import faulty
from sprung.model.diagnosis.investigation.measurements.data_sheets import within_tolerance
from sprung.model.diagnosis.investigation.measurements.floor import bounded, held_out_errors
from sprung.model.diagnosis.investigation.state import HeldOutRuns, Investigation, Judgement, NoiseFault
from sprung.model.diagnosis.investigation.verdict import HeldOutErrors, Verdict, kind_of, verdict_of
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.record.signals import Noise
from sprung.model.diagnosis.record.spectra import main_band
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.screening.families import ELEMENT, UNNAMED
from sprung.model.diagnosis.selection.holdout import FreeRun
from sprung.model.laws import Law
from sprung.model.laws.sensor_faults import SENSOR_ERROR, SENSOR_NOISE, SENSOR_STUCK
from sprung.model.signals import FloatArray


def held_out_runs(state: Investigation, before: FreeRun, after: FreeRun, noisy: tuple[NoiseFault, ...]) -> HeldOutRuns:
    """The errors of two free runs of an investigation."""
    noise = bounded(state, noisy)
    floor = state.held.noise_rms(state.fit, noise)
    errors = held_out_errors(before, after, floor, state.options.rules.verdict)
    return HeldOutRuns(before, after, noisy, noise, floor, errors)


def judged(state: Investigation, runs: HeldOutRuns, ended: str = "") -> Judgement:
    """Errors and verdict of an investigation.

    ended: the limit that ended the search, or empty.  If laws act along the measured motion and the free run loses its
    phase, its errors are not informative; the verdict is then based on the unmeasured forces relative to the inertia
    forces.
    """
    rules, errors = state.options.rules.verdict, runs.errors
    lost = state.problem.process_noise and runs.after.nrmse > rules.rejected
    deciding = _deciding_errors(state, errors, runs.noise, lost=lost)
    faults, physics = _kinds_of_faults(state, runs.noisy), _kinds_of_physics(state)
    place = imitated(state, deciding)
    other = not place and another_structure(state, deciding)
    verdict = verdict_of(
        faults + physics, deciding, rules, other_structure=other, imitated=bool(place), ended=bool(ended)
    )
    error, unknown = float(np.sqrt(np.mean(deciding.after**2))), verdict == "unknown_physics"
    rejected = bool(other) or (unknown and error > rules.rejected)
    reported, suspect = deciding if lost else errors, place or _place(state)
    return Judgement(
        errors=errors,
        reported=reported,
        verdict=verdict,
        floor=runs.floor,
        error=error,
        rejected=rejected,
        lost_phase=lost,
        nothing_fits=rejected or (unknown and lost and error**2 > rules.gross),
        parts=changed_parts(state) + _modes(state) + _out_of_order(state) if other else 0,
        carried=_carries(verdict, physics) and not place,
        imitated=place,
        ended=ended,
        place=suspect,
        where=_words(state, reported, None if lost else runs.after, suspect),
    )


def _deciding_errors(state: Investigation, errors: HeldOutErrors, noise: Noise, *, lost: bool) -> HeldOutErrors:
    """The errors on which the verdict is based; lost: the free run loses its phase."""
    if lost:
        shares = [unmeasured_share(fit, level.force) for fit, level in _compared(state, noise)]
        return HeldOutErrors(*(np.array([share]) for share in shares))
    if state.setup_faults:  # corrected before the first fit, from which the errors count
        worst = np.sqrt(state.setup_faults[0].before / len(errors.before))
        return replace(errors, before=np.maximum(errors.before, worst))
    return errors


def _kinds_of_faults(state: Investigation, noisy: tuple[NoiseFault, ...]) -> list[EffectKind]:
    """Kinds of all faults beside the findings of the search."""
    kinds = [kind_of(fault.effect) for fault in state.setup_faults]
    kinds += [_kind(state, fault.term, fault.term.law) for fault in state.input_faults]
    kinds += [kind_of(state.fit.point.terms[index].law) for index in faulty(state)]
    kinds += [EffectKind.FAULT for drift in state.clock_drifts if drift.beyond(state.options.rules)]
    counts = ((SENSOR_STUCK, state.prepared.stuck), (SENSOR_ERROR, state.contradictions), (SENSOR_NOISE, noisy))
    return kinds + [kind_of(law) for law, faults in counts for _ in faults]


def _kinds_of_physics(state: Investigation) -> list[EffectKind]:
    """Kinds of the findings of the search, best first."""
    terms = state.fit.point.terms[state.given :]
    return [_kind(state, term, found.trial.term.law) for found, term in zip(state.found, terms, strict=True)]


def _carries(verdict: Verdict, physics: list[EffectKind]) -> bool:
    """Whether the findings carry the verdict: they explain more than they leave."""
    kinds = [kind for kind in physics if kind is not EffectKind.NUISANCE]
    return verdict != "unknown_physics" or not kinds or kinds[0] is EffectKind.UNLISTED


def _kind(state: Investigation, term: Term, law: Law) -> EffectKind:
    """The kind of a finding; calibration errors within tolerance are nuisances."""
    return EffectKind.NUISANCE if within_tolerance(state, term) else kind_of(law)


def changed_parts(state: Investigation) -> int:
    """Number of structural changes among the findings: moved elements and linear parts."""
    moved = sum(fault.effect is WRONG_BODY for fault in state.setup_faults)
    return moved + sum(found.trial.term.law.part for found in state.found)


def _modes(state: Investigation) -> int:
    """Number of elastic modes of bodies among the findings, of which a body may have several."""
    laws = [found.trial.term.law for found in state.found]
    return sum(law.adds_motion and not law.part for law in laws)


def _out_of_order(state: Investigation) -> int:
    """Number of masses and instruments that are off beyond their tolerances."""
    if state.calibrations:
        return len(faulty(state))
    laws = [found.trial.term.law for found in state.found]
    return sum(law.error_of_value or law.fault for law in laws)


def another_structure(state: Investigation, errors: HeldOutErrors | None = None) -> bool:
    """Whether so many changes were found that they imitate another structure than the file's.

    More structural ones than a few in any case, more than one, elastic modes among them, if they leave a significant
    error (`errors`): together linear parts approximate any linear structure, and true ones would leave noise.  Masses
    and instruments off beyond their tolerances count, too, where they are most of all, are beside more than one
    structural change, or leave much: they then take up what a law beside them lacks, which counts with them.
    """
    rules, parts = state.options.rules.verdict, changed_parts(state)
    if errors is None or parts > rules.parts:
        return parts > rules.parts
    off = _out_of_order(state)
    share = errors.explained(rules)
    left = bool(np.any(errors.unexplained(rules) > 0))
    if (state.calibrations and 2 * off > state.calibrations) or (parts > 1 and off > 0):
        return True
    if left and parts + _modes(state) > 1:
        return True
    much = left and share is not None and share < 1 - rules.parts_leave
    beside = sum(found.trial.term.law.in_time for found in state.found) if off else 0
    return much and parts + off + beside > rules.parts


def _compared(state: Investigation, noise: Noise) -> tuple[tuple[Fit, Noise], ...]:
    """Fits and force noise before, after, and as far as bounded."""
    return (state.base, state.base.noise), (state.fit, state.fit.noise), (state.fit, noise)


def unmeasured_share(fit: Fit, force: FloatArray) -> float:
    """Unmeasured forces, noise (I,), N, of the measured ones, relative to the inertia forces, rms over rms."""
    structure = fit.forward.plant.structure
    inertia = structure.mass * fit.forward.part.grid.inverse(fit.motions.acceleration)
    return float(np.sqrt(np.sum(structure.F**2 @ force**2) / np.sum(np.mean(inertia**2, axis=0))))


def _place(state: Investigation) -> str:
    """Location of the highest score of the remaining misfit."""
    here = [candidate for candidate in state.last.candidates if candidate.family in (ELEMENT, UNNAMED)] or list(
        state.last.candidates
    )
    return max(here, key=lambda candidate: candidate.score).location if here else next(iter(state.system.elements), "")


def _words(state: Investigation, errors: HeldOutErrors, after: FreeRun | None, place: str) -> str:
    """Place, size and frequencies of the misfit, in words; empty without misfit.

    after: the free run of the errors; None: they are unmeasured forces over the inertia forces.
    """
    left = errors.unexplained(state.options.rules.verdict)
    if not np.any(left > 0):
        return ""
    worst = int(np.argmax(left))
    size, noise = 100 * errors.after[worst], f"({100 * errors.floor[worst]:.1f} % is noise)"
    suspect = f"most suspicious is {place.replace('|', ' and ')}"
    if after is None:
        return f"unmeasured forces of {size:.0f} % of the inertia forces {noise}; {suspect}"
    low, high = main_band(after.measured[:, worst] - after.simulated[:, worst], state.signals.sample_rate)
    sensor = state.signals.sensor_names[worst]
    return f"{size:.0f} % of {sensor} {noise}, most of it at {low:.2g} to {high:.2g} Hz; {suspect}"
