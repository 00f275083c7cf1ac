"""Estimates from elsewhere whose numbers cannot be: each costs itself and is counted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sprung.model.signals import Estimate, MeasurementFault
from sprung.model.system import System
from sprung.service.fleet.ingest import Ingest
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.store.windows import known_windows
from tests.service.fleet.test_ingest import Clock, messages


def _of_one_parameter(value: float) -> Callable[[Estimate], Estimate]:
    def changed(e: Estimate) -> Estimate:
        covariance = e.covariance.copy()
        covariance[0, 0] = value
        return replace(e, covariance=covariance)

    return changed


CHANGES: list[Callable[[Estimate], Estimate]] = [
    lambda e: replace(e, log_ratio=np.full_like(e.log_ratio, np.nan)),
    lambda e: replace(e, log_ratio=e.log_ratio + 700),
    _of_one_parameter(-1.0),
    _of_one_parameter(0.0),
    _of_one_parameter(np.inf),
    _of_one_parameter(1e300),
    lambda e: replace(e, covariance=e.covariance + np.triu(np.full_like(e.covariance, 0.5 * e.covariance[0, 0]), 1)),
    lambda e: replace(e, covariance=e.covariance - 0.9 * e.covariance[0, 0] * (1 - np.eye(len(e.covariance)))),
    lambda e: replace(e, chi_square=-1.0),
    lambda e: replace(e, chi_square=np.nan),
    lambda e: replace(e, noise=np.nan),
    lambda e: replace(e, noise=np.inf),
    lambda e: replace(e, nrmse=-0.1),
    lambda e: replace(e, per_sensor=-e.per_sensor),
    lambda e: replace(e, faults=(MeasurementFault("car_1l", "mood", 1.0, 0.1),)),  # type: ignore[arg-type]
    lambda e: replace(e, faults=(MeasurementFault("nothing", "gain", 1.0, 0.1),)),
    lambda e: replace(e, faults=(MeasurementFault("car_1l", "gain", np.nan, 0.1),)),
]


@pytest.mark.parametrize("change", CHANGES)
def test_an_estimate_of_impossible_numbers_costs_itself(
    engine: Engine, system: System, pipeline: Pipeline, change: Callable[[Estimate], Estimate]
) -> None:
    """Any of these would have stayed in the vehicle's tracker, some as NaN for good."""
    good = messages(engine, system, 6, 6)[0]
    windows = list(good.windows)
    assert windows[2].estimate is not None
    windows[2] = replace(windows[2], estimate=change(windows[2].estimate))
    taken = Ingest(pipeline, 0.0, Clock()).take([replace(good, windows=tuple(windows))])
    assert taken[0].folded == 6
    with pipeline.store.read() as connection:
        stored = known_windows(connection, "north-1", pipeline.model_id, [w.start for w in good.windows])
    outcomes = [stored[w.start].outcome for w in good.windows]
    assert outcomes == ["used", "used", "dropped", "used", "used", "used"]
    assert (stored[good.windows[2].start].reason or "").startswith("its estimate came with ")
    assert np.isfinite(pipeline.state("north-1").belief.mean).all()
