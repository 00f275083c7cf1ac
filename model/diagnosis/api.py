"""The diagnosis as others use it: `diagnose(system, record)` gives a `Report`."""

from __future__ import annotations

from dataclasses import dataclass

from sprung.model.diagnosis.ambient.decay import decay_begin
from sprung.model.diagnosis.ambient.diagnose import diagnose_unforced
from sprung.model.diagnosis.component.diagnose import diagnose_components
from sprung.model.diagnosis.component.measured import is_component_test
from sprung.model.diagnosis.investigation.course import Options, Progress, Recorded
from sprung.model.diagnosis.investigation.diagnose import investigate
from sprung.model.diagnosis.record.channels import DiagnosisError, TooLittleError, prepare
from sprung.model.diagnosis.report.narrate import narrate
from sprung.model.diagnosis.report.report import Finding, Report
from sprung.model.signals import FloatArray
from sprung.model.system import System

__all__ = ["DiagnosisError", "Finding", "Options", "Recorded", "Report", "TooLittleError", "diagnose"]


@dataclass(frozen=True)
class Trimmed:
    """A recording from some sample on."""

    sample_rate: float
    values: FloatArray
    lost: int


def diagnose(
    system: System, record: Recorded, options: Options | None = None, progress: Progress | None = None
) -> Report:
    """Diagnose a recording whose columns are in the order of `system.channels`.

    Errors: `DiagnosisError` when the recording cannot be used at all.
    """
    tell, options = progress or (lambda share, text: None), options or Options()
    if is_component_test(system, record.values):
        return diagnose_components(system, record, options, tell)
    if system.on_track or not system.file.inputs:
        prepared = prepare(system, system.undistorted(record.values), record.sample_rate)
        begin = None if system.on_track else decay_begin(prepared.signals, system.sensor_noise)
        if begin is None:
            return diagnose_unforced(system, prepared, record, options, tell)
        record = Trimmed(record.sample_rate, record.values[begin:], record.lost)
    outcome = investigate(system, record, options, tell)
    tell(0.95, "report")
    report = narrate(outcome, record)
    tell(1.0, "done")
    return report
