"""Work given to Ray, where it is installed: results stand for each other, errors come as they were raised."""

from __future__ import annotations

import pytest

from sprung.service.fleet.tasks import HereTasks, RayTasks, Tasks
from sprung.service.times import from_iso, to_iso


def _check(tasks: Tasks) -> None:
    """Work of a module that every worker can import."""
    first = tasks.submit(from_iso, "2026-03-01T00:00:00Z")
    assert tasks.result(tasks.submit(to_iso, first)) == "2026-03-01T00:00:00.000Z"
    with pytest.raises(ValueError) as caught:
        tasks.result(tasks.submit(from_iso, "good"))
    assert str(caught.value) == "Invalid isoformat string: 'good'"


def test_work_is_done_here() -> None:
    _check(HereTasks())


@pytest.mark.slow
def test_work_is_done_by_ray() -> None:
    pytest.importorskip("ray")
    tasks = RayTasks(2)
    try:
        _check(tasks)
    finally:
        tasks.close()
