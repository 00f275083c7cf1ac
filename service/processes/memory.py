"""Whether there is memory enough.  Imports nothing numerical: libraries that get none end the process."""

from __future__ import annotations

import sys

from sprung.service.errors import NO_THREAD, UserError

SERVICE_BYTES = 1_450_000_000  # of address space until `sprung serve` has started; torch alone takes 0.6 GB of it
NO_ROOM = ("failed to map segment", "cannot allocate memory")  # what the loader says of a library


def check_address_space(needed: int = SERVICE_BYTES) -> None:
    """Raises UserError where a limit leaves less, of which some library would make an abort or a riddle."""
    if sys.platform == "linux":
        import resource

        allowed, _ = resource.getrlimit(resource.RLIMIT_AS)
        if allowed not in (resource.RLIM_INFINITY, -1) and allowed < needed:
            raise UserError(
                f"out of memory: a limit (`ulimit -v`) allows {allowed / 1e6:.0f} MB of address space, and "
                f"{needed / 1e6:.0f} MB are needed; raise it, or use a limit of a cgroup, which counts what is in use"
            )


def is_shortage(error: BaseException) -> bool:
    """Whether it is memory that was missing."""
    told = str(error).lower()
    unloadable = isinstance(error, ImportError | OSError) and any(words in told for words in NO_ROOM)
    return isinstance(error, MemoryError) or told == NO_THREAD or unloadable
