"""Work done here, one piece after the other, or by Ray, wherever there is room: the same calls.

Ray is given functions and what they depend on, and does the rest: which runs when and where, what is tried again when
a worker dies, what is moved to disk when memory is short.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, Protocol

from sprung.service.errors import UserError

OBJECT_STORE_BYTES = 200_000_000  # of a Ray that is started here; more goes to disk
RETRIES = 10  # of a piece of work whose worker died


class WorkLost(RuntimeError):
    """A piece of work ended its process every time that it was tried."""


class Tasks(Protocol):
    """Somebody who does work."""

    name: str
    at_once: bool  # `submit` returns when the work is done

    def submit(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """Have work done; arguments that `submit` returned stand for their results.  What stands for the result."""

    def result(self, pending: Any) -> Any:
        """Wait for a result; raises the error of the work, or WorkLost if its process died."""

    def close(self) -> None:
        """Release what was started for it."""


class HereTasks:
    """Does everything at once, in this process."""

    name = "this process"
    at_once = True

    def submit(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """The result itself."""
        return work(*arguments)

    def result(self, pending: Any) -> Any:
        """The result."""
        return pending

    def close(self) -> None:
        """Nothing."""


class RayTasks:
    """Ray: the cluster that RAY_ADDRESS names, else one on this machine with `workers` cores."""

    at_once = False

    def __init__(self, workers: int | None = None) -> None:
        """Raises UserError where Ray is not installed or cannot be reached."""
        try:
            import ray
        except ModuleNotFoundError as error:
            raise UserError("Ray is not installed: pip install 'sprung[fleet]'") from error
        self._ray: Any = ray
        self._started = not ray.is_initialized()
        if self._started:
            address = os.environ.get("RAY_ADDRESS")
            if address:
                _join_ray(address)
            else:
                start_ray(workers or os.cpu_count())
        self.name = f"Ray, {self._ray.cluster_resources().get('CPU', 0):.0f} cores"
        self._remote: dict[Callable[..., Any], Any] = {}

    def submit(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """A reference to the result."""
        if work not in self._remote:
            self._remote[work] = self._ray.remote(num_cpus=1, max_retries=RETRIES)(work)
        return self._remote[work].remote(*arguments)

    def result(self, pending: Any) -> Any:
        """The result."""
        try:
            return self._ray.get(pending)
        except self._ray.exceptions.RayTaskError as error:
            if not isinstance(error.cause, self._ray.exceptions.RayError):  # else of what the work depended on
                raise error.cause from None  # as it was raised, without the worker's traceback in its text
            raise WorkLost(f"its input was lost ({type(error.cause).__name__})") from None
        except self._ray.exceptions.RayError as error:
            lost = f"its process ended {RETRIES + 1} times ({type(error).__name__}): too little memory?"
            raise WorkLost(lost) from None

    def close(self) -> None:
        """Stop a Ray that was started here."""
        if self._started:
            self._ray.shutdown()


def start_ray(cores: int | None, config: dict[str, Any] | None = None) -> None:
    """A Ray of this process on this machine, that says nothing of itself.

    cores: default all; config: Ray's own settings, by their names in its source.  Raises UserError.
    """
    import ray

    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray reports its use to its makers otherwise
    logging.getLogger("ray").setLevel(logging.ERROR)
    try:
        ray.init(
            num_cpus=cores,
            object_store_memory=OBJECT_STORE_BYTES,
            include_dashboard=False,
            log_to_driver=False,
            configure_logging=False,
            _system_config=config,
        )
    except Exception as error:  # a plain one where its processes are not there within 30 s
        raise UserError(f"Ray did not start: {str(error).splitlines()[0]}") from error


def _join_ray(address: str) -> None:
    import ray

    try:
        ray.init(address=address, log_to_driver=False)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise UserError(f"Ray at {address}: {str(error).splitlines()[0]}") from error


def ray_installed() -> bool:
    """Whether Ray can be imported."""
    return find_spec("ray") is not None


def tasks_for(wanted: str, workers: int | None) -> Tasks:
    """`here`, `ray`, or `auto`: Ray where it is installed and there is more than one core to use."""
    if wanted == "here":
        return HereTasks()
    if wanted == "ray":
        return RayTasks(workers)
    several = (workers or os.cpu_count() or 1) > 1 or "RAY_ADDRESS" in os.environ
    return RayTasks(workers) if several and ray_installed() else HereTasks()
