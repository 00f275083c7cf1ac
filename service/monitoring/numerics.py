"""Identifying, with vehicles' own models apart, and tracking, each in a process beside what answers and stores."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial

from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.following import Following, FollowingApart, follow
from sprung.service.monitoring.identifier_processes import IdentifierApart, identifying_processes, placed_in
from sprung.service.processes.forked import ForkedFunctions, Watch, forks
from sprung.service.settings import Settings


@dataclass(frozen=True, slots=True)
class Numerics:
    """What identifies and tracks."""

    engine: Engine
    following: Following = follow  # feeds windows to its tracker
    processes: Sequence[ForkedFunctions] = ()  # in which they work; none: in this one


@contextmanager
def numerics(engine: Engine, settings: Settings) -> Iterator[Numerics]:
    """The engine, and what feeds windows to its tracker, as the settings and the machine have them.

    Enter it before the first thread is started.  In one interpreter the two and the API would take turns: measured with
    100 vehicles and a window a second on two cores, each took twice the processor time that it takes alone, and
    windows came to wait 26 s.  Windows of a vehicle with a model of its own may take seconds of it each.
    """
    if not (settings.apart and forks()):
        yield Numerics(engine)
        return
    with ExitStack() as last, ExitStack() as stack:
        following = FollowingApart(engine, settings.vehicles_in_memory)
        stack.callback(following.forked.close)
        shared, own = identifying_processes(engine.identifier, engine.system)
        stack.callback(shared.close)
        stack.callback(own.close)
        identifier = IdentifierApart(engine.identifier, partial(shared.call, "ask"))
        processes = (following.forked, shared, own)
        last.callback(Watch(processes).close)
        yield Numerics(replace(engine, identifier=identifier, place=placed_in(own)), following, processes)
