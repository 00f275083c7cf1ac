"""Tests that start Ray, each in a process of its own: a second Ray in a process may find threads of the first one at
work while it forks, and then does not start."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from typing import Any


def in_own_process(work: Callable[..., Any], *arguments: Any) -> None:
    """Run a function of a module; fails if it does."""
    process = multiprocessing.get_context("spawn").Process(target=work, args=arguments)
    process.start()
    process.join()
    assert process.exitcode == 0, f"{work.__name__} ended with {process.exitcode}; what it raised stands above"
