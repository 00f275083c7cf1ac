"""Work given to Ray, where it is installed: results stand for each other, errors come as they were raised."""

from __future__ import annotations

import pytest

from sprung.service.fleet.tasks import HereTasks, RayTasks, Tasks


def _sum(one: int, other: int) -> int:
    return one + other


def _wrong(text: str) -> None:
    raise ValueError(f"no {text}")


def _check(tasks: Tasks) -> None:
    first = tasks.submit(_sum, 1, 2)
    assert tasks.result(tasks.submit(_sum, first, 4)) == 7
    with pytest.raises(ValueError) as caught:
        tasks.result(tasks.submit(_wrong, "good"))
    assert str(caught.value) == "no good"


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
