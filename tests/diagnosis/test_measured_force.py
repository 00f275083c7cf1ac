"""A store that hangs in hooks with clearance beside a measured force: no simulation keeps to the recording."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from sprung.model.diagnosis.api import diagnose
from sprung.model.diagnosis.selection.along_measured import disturbed, with_disturbances
from sprung.model.system import parse_system
from tests.diagnosis_cases import MadeRecord

RATE, FINER, SECONDS = 200.0, 80, 12.0  # a damper acts half a step late, which shows as a spring in series
GAP, HARD = 2.0e-4, 1.5e5  # m, N/m, of the hooks
WING = """
name: wing with a store
sample_rate: 200
window: 200
bodies: {wing: {mass: {value: 14, fixed: true}}, store: {mass: {value: 9, fixed: true}}}
inputs: {shaker: {kind: force, body: wing, csv: f, noise: 0.3}}
elements:
  spar: {upper: wing, lower: ground, stiffness: 1.1e5, damping: 40}
  hook: {upper: store, lower: wing, stiffness: 6e4, damping: 30}
sensors:
  a1: {kind: acceleration, body: wing, csv: a1, noise: 0.02}
  a2: {kind: acceleration, body: store, csv: a2, noise: 0.03}
"""


def shaken() -> MadeRecord:
    """Force and accelerations, by semi-implicit steps of a sixteenth of a millisecond."""
    random, count, h = np.random.default_rng(8), int(SECONDS * RATE) * FINER, 1 / (RATE * FINER)
    band = butter(3, [3.0, 40.0], "bandpass", fs=RATE * FINER, output="sos")
    force = sosfiltfilt(band, random.standard_normal(count))
    force *= 60.0 / np.std(force)
    x1 = x2 = v1 = v2 = 0.0
    rows = np.empty((count, 3))
    for i, pushed in enumerate(force.tolist()):
        d = x2 - x1
        hook = 3e4 * d + 20 * (v2 - v1) + HARD * (max(d - GAP, 0.0) + min(d + GAP, 0.0))
        a1, a2 = (pushed - 1.2e5 * x1 - 30 * v1 + hook) / 14, -hook / 9
        rows[i] = pushed, a1, a2
        v1, v2 = v1 + h * a1, v2 + h * a2
        x1, x2 = x1 + h * v1, x2 + h * v2
    low = butter(8, 80.0, fs=RATE * FINER, output="sos")
    shown = sosfiltfilt(low, rows, axis=0)[::FINER]
    return MadeRecord(shown + np.array([0.3, 0.02, 0.03]) * random.standard_normal(shown.shape), RATE)


def test_only_bodies_whose_force_nobody_measured_are_disturbed() -> None:
    pushed = with_disturbances(parse_system(WING))
    assert disturbed(pushed) == {"store"}
    assert [channel.name for channel in pushed.inputs] == ["shaker", "disturbance of store"]


@pytest.mark.slow
def test_a_clearance_beside_a_measured_force_is_named_along_the_motion_that_was_seen() -> None:
    report = diagnose(parse_system(WING), shaken())
    assert report.verdict == "missing_physics", report.summary
    (found,) = report.findings
    assert found.location == "hook" and found.effect in ("bump_stop", "clearance")  # the spring between is a weak one
    values = {one.name: one.value for one in report.augmented}
    assert values["spar.stiffness"] == pytest.approx(1.2e5, rel=0.01)
    assert report.explained is not None and report.explained > 0.9
