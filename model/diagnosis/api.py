"""The diagnosis as others use it: `diagnose(system, record)` gives a `Report`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.ambient.decay import decay_stretch
from sprung.model.diagnosis.ambient.diagnose import diagnose_unforced
from sprung.model.diagnosis.component.diagnose import diagnose_components
from sprung.model.diagnosis.component.measured import covariates, is_component_test
from sprung.model.diagnosis.investigation.diagnose import investigate
from sprung.model.diagnosis.investigation.state import Options, Outcome, Progress, Recorded
from sprung.model.diagnosis.record.channels import DiagnosisError, TooLittleError, prepare
from sprung.model.diagnosis.report.compose import compose
from sprung.model.diagnosis.report.report import Finding, Report
from sprung.model.diagnosis.selection.along_measured import unpushed, with_disturbances
from sprung.model.laws import ElementLaw
from sprung.model.laws.following import Covariate, following_law
from sprung.model.signals import FloatArray
from sprung.model.system import System

__all__ = ["DiagnosisError", "Finding", "Options", "Recorded", "Report", "TooLittleError", "diagnose"]


@dataclass(frozen=True)
class RecordedPart:
    """A part of a recording: some of its channels, from some sample on."""

    sample_rate: float  # Hz
    values: FloatArray  # (T, C)
    lost: int


def following_laws(system: System, record: Recorded) -> list[ElementLaw]:
    """What elements may do that follow a measured signal of the recording."""
    signals: dict[str, Covariate] = {}
    places: dict[str, tuple[str, ...]] = {}
    for name in system.elements:
        for signal in covariates(system, record.values, record.sample_rate, name, []):
            signals[signal.name] = signal
            places[signal.name] = (*places.get(signal.name, ()), name)
    return [
        following_law(quantity, signal, places[name])
        for name, signal in signals.items()
        for quantity in ("stiffness", "damping")
    ]


def diagnose(
    system: System, record: Recorded, options: Options | None = None, progress: Progress | None = None
) -> Report:
    """Diagnose a recording whose columns are in the order of `system.channels`, then of `system.signals`.

    Errors: `DiagnosisError` when the recording cannot be used at all.

    >>> import sprung
    >>> rig = sprung.load_system("rig.yaml")
    >>> report = sprung.diagnose(rig, sprung.load_record("rig.csv", rig))
    >>> report.verdict, report.findings[0].location, report.findings[0].effect
    ('missing_physics', 'damper', 'coulomb_friction')
    """
    progress, options = progress or (lambda share, text: None), options or Options()
    channels = record.values[:, : len(system.channels)]
    if is_component_test(system, channels, options.rules):
        return diagnose_components(system, record, options, progress)
    if system.signals:
        system = replace(system, catalogue=(*system.catalogue, *following_laws(system, record)))
        record = RecordedPart(record.sample_rate, channels, record.lost)
    if system.on_track or not system.file.inputs:
        whole = replace(options.rules.record, longest=len(record.values), enough=len(record.values))
        prepared = prepare(system, system.undistorted(record.values), record.sample_rate, whole)
        decay = None if system.on_track else decay_stretch(prepared.signals, system.sensor_noise, options.rules)
        if decay is None:
            return diagnose_unforced(system, prepared, record, options, progress)
        record = RecordedPart(record.sample_rate, record.values[decay], record.lost)
    outcome = investigate(system, record, options, progress)
    if _may_be_followed(outcome):
        outcome = _along_what_was_seen(system, record, options, progress, outcome)
    progress(0.95, "report")
    report = compose(outcome, record)
    progress(1.0, "done")
    return report


def _may_be_followed(outcome: Outcome) -> bool:
    """Whether no simulation keeps to a motion that the sensors saw of bodies on which no force was measured.

    That is the motion of a free decay that rejects the model, or one beside a measured force that nothing explains.
    """
    system = outcome.investigation.system
    if not system.file.inputs:
        return outcome.judgement.rejected
    unknown = outcome.judgement.verdict == "unknown_physics" and not outcome.investigation.setup_faults
    return unknown and outcome.investigation.problem.process_noise and bool(unpushed(system))


def _along_what_was_seen(
    system: System, record: Recorded, options: Options, progress: Progress, simulated: Outcome
) -> Outcome:
    """The outcome with laws acting along the motion that the sensors saw; the simulated one where that is no better.

    A law that shifts the frequency makes a linear start diverge within a few periods, and hard stops between bodies
    make a simulation under a measured force leave the recording.  With an unmeasured force on every other body, as
    strong as it has to be, forces are fitted along the measured motion.
    """
    pushed, inputs = with_disturbances(system), len(system.inputs)
    nothing = np.zeros((len(record.values), len(pushed.inputs) - inputs))
    values = np.column_stack([record.values[:, :inputs], nothing, record.values[:, inputs:]])
    outcome = investigate(pushed, RecordedPart(record.sample_rate, values, record.lost), options, progress)
    if not inputs:
        return simulated if outcome.judgement.rejected else outcome
    named = outcome.judgement.verdict == "missing_physics" and outcome.runs.after.nrmse < simulated.runs.after.nrmse
    return outcome if named else simulated
