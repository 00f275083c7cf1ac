"""Noise levels of unmeasured forces, renewed until they no longer matter."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.fit import baseline as renewing
from sprung.model.diagnosis.fit.baseline import baseline, refreshed
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import Noise, declared_noise
from sprung.model.diagnosis.selection.along_measured import MeasuredMotion
from tests.diagnosis_cases import quarter_car, simulate


def test_a_level_that_vanishes_is_not_renewed_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its estimate falls by a constant factor with every renewal, soon without any effect on the fit."""
    system = quarter_car()
    record = simulate(lambda d, v: 300 * np.tanh(v / 2e-3), seconds=12, seed=3)
    signals = prepare(system, record.values, 100.0).signals
    measured = MeasuredMotion.of(*baseline(system, signals, declared_noise(system, signals), 800))
    assert measured is not None
    level, fits, fitted = measured.problem.noise.force[0], list[Fit | None](), try_optimise

    def vanishing(forward: Any, spectrum: Any, noise: Noise, rules: Any) -> Noise:
        return replace(noise, force=np.array([level, 1e-4 * noise.force[1]]))

    def counted(*args: Any, **kwargs: Any) -> Fit | None:
        fits.append(fitted(*args, **kwargs))
        return fits[-1]

    monkeypatch.setattr(renewing, "force_noise", vanishing)
    monkeypatch.setattr(renewing, "try_optimise", counted)
    problem, fit = refreshed(measured.problem, measured.fit)
    assert len(fits) <= 6
    assert fit.converged and problem.noise.force[1] < 1e-6 * level
