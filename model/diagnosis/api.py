"""The diagnosis as others use it: `diagnose(system, record)` gives a `Report`."""

from __future__ import annotations

from sprung.model.diagnosis.component.diagnose import diagnose_components
from sprung.model.diagnosis.component.measured import is_component_test
from sprung.model.diagnosis.investigation.course import Options, Progress, Recorded
from sprung.model.diagnosis.investigation.diagnose import investigate
from sprung.model.diagnosis.record.channels import DiagnosisError, TooLittleError
from sprung.model.diagnosis.report.narrate import narrate
from sprung.model.diagnosis.report.report import Finding, Report
from sprung.model.system import System

__all__ = ["DiagnosisError", "Finding", "Options", "Recorded", "Report", "TooLittleError", "diagnose"]


def diagnose(
    system: System, record: Recorded, options: Options | None = None, progress: Progress | None = None
) -> Report:
    """Diagnose a recording whose columns are in the order of `system.channels`.

    Errors: `DiagnosisError` when the recording cannot be used at all.
    """
    tell = progress or (lambda share, text: None)
    if is_component_test(system, record.values):
        return diagnose_components(system, record, options or Options(), tell)
    outcome = investigate(system, record, options or Options(), tell)
    tell(0.95, "report")
    report = narrate(outcome, record)
    tell(1.0, "done")
    return report
