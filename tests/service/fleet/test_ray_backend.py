"""Between the door and Ray: requests of many travel together, each hears of its own, and too many are told so."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.signals import MeasurementFault
from sprung.model.system import System
from sprung.service.core import build_core
from sprung.service.errors import Busy, UserError
from sprung.service.fleet import ray_backend
from sprung.service.fleet.message import IngestResult, SentWindows
from sprung.service.fleet.ray_backend import RayBackend
from sprung.service.fleet.ray_replicas import ComputeReplica
from sprung.service.fleet.serving_sizes import ServingSizes
from sprung.service.monitoring.batching import AskedWindow
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.form import WindowForm
from sprung.service.settings import Settings
from sprung.service.store import open_store
from tests.service_fakes import BelievingExaminer, make_window

pytest.importorskip("ray")
pytestmark = pytest.mark.filterwarnings("ignore")  # Ray's own, when it is imported


FORM = WindowForm("digest", "strut", 100.0, 2, ("a", "b", "c"), ("a",), ("b", "c"), (frozenset("a"),))


class AskedForm:
    """The method of an identifying replica that says what windows look like."""

    asked = 0

    async def remote(self) -> WindowForm:
        self.asked += 1
        return FORM


class Remote:
    """A method of a deployment's handle, here: its answers, and how many each call carried."""

    def __init__(self, answer: Any) -> None:
        self.sizes: list[int] = []
        self._answer = answer

    async def remote(self, first: list[Any], *rest: Any) -> list[Any]:
        self.sizes.append(len(first))
        await asyncio.sleep(0.05)
        return [self._answer(one) for one in first]


def batch(max_batch_size: int, batch_wait_timeout_s: float, **_: Any) -> Any:
    """As `serve.batch`: arguments that come within a while go to one call."""

    def decorate(together: Any) -> Any:
        waiting: list[tuple[Any, asyncio.Future[Any]]] = []

        async def flush() -> None:
            await asyncio.sleep(batch_wait_timeout_s)
            taken_now = [waiting.pop(0) for _ in waiting[:max_batch_size]]
            for (_, told), answer in zip(taken_now, await together([one for one, _ in taken_now]), strict=True):
                told.set_result(answer)

        async def one(argument: Any) -> Any:
            told = asyncio.get_running_loop().create_future()
            waiting.append((argument, told))
            if len(waiting) == 1:
                flushing.append(asyncio.create_task(flush()))
            return await told

        flushing: list[asyncio.Task[None]] = []
        return one

    return decorate


def window(vehicle: str, start: int, count: int = 1) -> SentWindows:
    return SentWindows(vehicle, [start + i for i in range(count)], np.zeros((count, 2, 3)))


def taken(sent: SentWindows) -> IngestResult | UserError:
    return UserError("not this one") if sent.vehicle == "v-3" else IngestResult(sent.vehicle, len(sent.starts), 0, 0)


@dataclass(frozen=True)
class Handle:
    """A deployment's handle, here."""

    take: Remote
    form: AskedForm


def behind(**sizes: Any) -> tuple[RayBackend, Handle]:
    handle = Handle(Remote(taken), AskedForm())
    return RayBackend(handle, ServingSizes(**sizes), batch), handle


def test_windows_of_many_travel_together_and_each_hears_of_its_own() -> None:
    async def asked() -> list[Any]:
        ray, handle = behind(replicas=1, batch_windows=8, batch_wait_seconds=0.05)
        calls = [ray.identify_and_fold(window(f"v-{i}", i)) for i in range(8)]
        found = await asyncio.gather(*calls, return_exceptions=True)
        assert handle.take.sizes == [8]
        return found

    found = asyncio.run(asked())
    assert [one.vehicle for i, one in enumerate(found) if i != 3] == [f"v-{i}" for i in range(8) if i != 3]
    assert isinstance(found[3], UserError)


def test_what_windows_look_like_is_asked_once() -> None:
    async def asked() -> None:
        ray, handle = behind(replicas=1)
        assert await ray.form() == FORM
        await ray.identify_and_fold(window("v-1", 0))
        assert handle.form.asked == 1

    asyncio.run(asked())


def test_too_many_at_once_are_told_so_and_places_come_free() -> None:
    async def asked() -> None:
        ray, _ = behind(replicas=1, queued=2)
        calls = [ray.identify_and_fold(window(f"v-{10 + i}", i)) for i in range(3)]
        found = await asyncio.gather(*calls, return_exceptions=True)
        assert [isinstance(one, Busy) for one in found] == [False, False, True]
        assert (await ray.identify_and_fold(window("v-1", 0))).folded == 1

    asyncio.run(asked())


def test_windows_of_one_request_are_identified_and_folded_together() -> None:
    async def asked() -> None:
        ray, handle = behind(replicas=1, batch_windows=32, batch_wait_seconds=0.05)
        found = await asyncio.gather(
            ray.identify_and_fold(window("v-1", 0, 10)), ray.identify_and_fold(window("v-2", 0, 5))
        )
        assert [one.folded for one in found] == [10, 5]
        assert handle.take.sizes == [2]

    asyncio.run(asked())


@dataclass(frozen=True)
class Called:
    """A method of a replica, called here."""

    remote: Callable[..., Any]


async def followed_on_ray(settings: Settings, sent: list[SentWindows]) -> dict[str, object]:
    """A vehicle's tracker after windows that were sent one after the other, by a replica itself."""
    replica = ComputeReplica(settings)
    methods = {name: Called(getattr(replica, name)) for name in ("form", "take")}
    with closing(replica._ingest):
        ray = RayBackend(SimpleNamespace(**methods), ServingSizes(replicas=1), batch)
        for one in sent:
            assert (await ray.identify_and_fold(one)).folded == len(one.starts)
        return replica._ingest._pipeline.state(sent[0].vehicle).to_dict()


def followed_alone(settings: Settings, engine: Engine, sent: list[SentWindows]) -> dict[str, object]:
    """The same in a single process."""
    core = build_core(settings, engine)
    with closing(core):

        async def ask() -> None:
            for one in sent:
                for start, values in zip(one.starts, one.values, strict=True):
                    asked = AskedWindow(values, core.pipeline.engines.shared, one.vehicle, start=start)
                    await core.batcher.ask(lambda asked=asked: asked)  # type: ignore[misc]

        asyncio.run(ask())
        return core.pipeline.state(sent[0].vehicle).to_dict()


def test_what_the_tracker_knows_of_a_vehicles_sensors_counts_as_in_a_single_process(
    engine: Engine, system: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    examiners = [BelievingExaminer(system), BelievingExaminer(system)]
    windows = [make_window(system, number, 0.01) for number in range(12)]
    sent = [SentWindows("v-1", [one.start], one.values[None]) for one in windows]
    folders = [tmp_path / "alone", tmp_path / "ray"]
    alone, behind_ray = (Settings(data_dir=folder, late_seconds=0.0) for folder in folders)
    for settings in (alone, behind_ray):
        open_store(settings.store_url).close()
    engines = [replace(engine, identifier=examiner) for examiner in examiners]
    monkeypatch.setattr("sprung.service.monitoring.engine.load_engine", lambda settings: engines[1])
    expected = followed_alone(alone, engines[0], sent)
    assert asyncio.run(followed_on_ray(behind_ray, sent)) == expected
    assert examiners[1].told == examiners[0].told
    assert examiners[1].told[0] == () and examiners[1].told[-1] == examiners[1].faults


def test_faults_that_are_over_and_those_of_too_many_vehicles_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_backend, "MOST_FAULTY", 2)
    fault: tuple[MeasurementFault, ...] = (MeasurementFault("car_1l", "frozen", 0.0),)
    told: list[tuple[MeasurementFault, ...]] = []
    wrong = {f"v-{number}" for number in range(5)}

    async def take(sent: list[SentWindows], known: list[tuple[MeasurementFault, ...]]) -> list[IngestResult]:
        told.extend(known)
        return [IngestResult(one.vehicle, 1, 0, 0, fault if one.vehicle in wrong else ()) for one in sent]

    async def asked() -> None:
        handle = SimpleNamespace(take=Called(take), form=AskedForm())
        ray = RayBackend(handle, ServingSizes(replicas=1), batch)
        send = partial(_sent_one_by_one, ray)
        await send(["v-1", "v-1"])
        assert told[-1] == fault
        wrong.discard("v-1")
        await send(["v-1", "v-1"])
        assert told[-2:] == [fault, ()]
        await send(["v-2", "v-3", "v-4"])
        await send(["v-2"])
        assert told[-1] == ()  # the one that was not heard from for longest
        await send(["v-4"])
        assert told[-1] == fault

    asyncio.run(asked())


async def _sent_one_by_one(ray: RayBackend, vehicles: list[str]) -> None:
    for number, vehicle in enumerate(vehicles):
        await ray.identify_and_fold(window(vehicle, number))
