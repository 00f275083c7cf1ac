"""Work given to Ray, where it is installed: results stand for each other, errors come as they were raised."""

from __future__ import annotations

import pytest

from sprung.service.errors import UserError
from sprung.service.fleet.tasks import HereTasks, RayTasks, Tasks
from sprung.service.times import from_iso, to_iso
from tests.ray_apart import in_own_process


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
    in_own_process(_check_ray)


def _check_ray() -> None:
    tasks = RayTasks(2)
    try:
        _check(tasks)
    finally:
        tasks.close()


@pytest.mark.slow
def test_a_ray_that_does_not_start_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray")

    def init(**_given: object) -> None:
        raise Exception("The current node timed out during startup.\nThis could happen")

    monkeypatch.setattr(ray, "init", init)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with pytest.raises(UserError) as caught:
        RayTasks(1)
    assert str(caught.value) == "Ray did not start: The current node timed out during startup."
