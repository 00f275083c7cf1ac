"""100 vehicles, each a window a second, through HTTP, tracked and stored: latencies, losses, memory."""

from __future__ import annotations

import http.client
import json
import sqlite3
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sprung.benchmarks.serve import window_body
from sprung.benchmarks.trust_service import ServiceProcess, children
from sprung.model.system import MANCHESTER, load_system

VEHICLES, MOST_CONNECTIONS = 100, 100
START_SECONDS = 1_790_000_000
TARGET_SECONDS = 1.0
WARM_UP = 0.2  # share of the time after which memory counts


@dataclass
class LoadSent:
    """What the clients saw."""

    seconds: list[float] = field(default_factory=list)  # from when a window was due to its answer
    late: int = 0  # windows that were sent a second or more after they were due
    acknowledged: list[tuple[str, int]] = field(default_factory=list)
    statuses: Counter[int] = field(default_factory=Counter)


def load(folder: Path, minutes: float, vehicles: int = VEHICLES) -> Iterator[dict[str, Any]]:
    """Figures of one run; every vehicle sends a window of one second each second."""
    connections = min(vehicles, MOST_CONNECTIONS)  # a vehicle has one of its own
    yield from watched(folder / "load", minutes, vehicles, connections)


def watched(
    folder: Path,
    minutes: float,
    vehicles: int,
    connections: int,
    beside: Sequence[Callable[[int, float], None]] = (),
    warm_up: float = WARM_UP,
) -> Iterator[dict[str, Any]]:
    """Figures of vehicles that send a window a second over some connections, to a service of their own.

    beside: what else uses the service meanwhile, told its port and the time (`time.monotonic`) at which to end.
    """
    parts = window_body(load_system()).split(b'"bench"')
    sent, memory = LoadSent(), MemorySeen()
    with ServiceProcess(folder, system=MANCHESTER) as served:
        served.ready()
        lasting = {served.process.pid, *children(served.process.pid)}
        begun = time.monotonic() + 1.0
        ends = begun + 60 * minutes
        shares = [range(n, vehicles, connections) for n in range(connections)]
        threads = [
            threading.Thread(target=drive, args=(served.port, parts, share, begun, ends, sent)) for share in shares
        ]
        threads += [threading.Thread(target=use, args=(served.port, ends)) for use in beside]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            memory.look(time.monotonic() - begun, served.process.pid, lasting)
            time.sleep(1.0)
        served.kill()
    yield from figures(folder / "sprung.db", sent, memory, minutes, vehicles, warm_up)


def drive(port: int, parts: list[bytes], vehicles: range, begun: float, ends: float, sent: LoadSent) -> None:
    """Windows of some vehicles, one after the other, each when it is due.

    parts: of a body, before and after the vehicle's name.
    """
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    second = 0
    while (due := begun + second) < ends:
        for vehicle in vehicles:
            moment = due + vehicle % 100 / 100  # spread over the second
            time.sleep(max(0.0, moment - time.monotonic()))
            sent.late += time.monotonic() - moment > 1.0
            name = f"load-{vehicle}"
            start = START_SECONDS + second
            body = parts[0] + json.dumps(name).encode() + parts[1][:-1] + f', "start": "{start}"}}'.encode()
            for _ in range(20):
                status = _post(connection, body)
                sent.statuses[status] += 1
                if status == 200:
                    sent.acknowledged.append((name, start * 1_000_000_000))
                    break
                time.sleep(0.2)
            sent.seconds.append(time.monotonic() - moment)
        second += 1
    connection.close()


def _post(connection: http.client.HTTPConnection, body: bytes) -> int:
    try:
        connection.request("POST", "/identify?track=true", body, {"content-type": "application/json"})
        answer = connection.getresponse()
        answer.read()
        return answer.status
    except (OSError, http.client.HTTPException):
        connection.close()
        return 0


@dataclass
class MemorySeen:
    """Bytes by second: of the service and the processes that it keeps, and of those that it started for a job."""

    lasting: list[tuple[float, int]] = field(default_factory=list)
    jobs: list[int] = field(default_factory=list)

    def look(self, second: float, pid: int, lasting: Collection[int]) -> None:
        """Once more; lasting: the service and what it had started before there was any job."""
        now = {pid, *children(pid)}
        self.lasting.append((second, resident(now & set(lasting))))
        self.jobs.append(resident(now - set(lasting)))


def resident(pids: Iterable[int]) -> int:
    """Bytes of processes; what several share counts once."""
    total = 0
    for one in pids:
        try:
            lines = Path(f"/proc/{one}/smaps_rollup").read_text().splitlines()
        except OSError:
            continue
        total += next((int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:")), 0)
    return total


def figures(
    store: Path,
    sent: LoadSent,
    memory: MemorySeen,
    minutes: float,
    vehicles: int,
    warm_up: float = WARM_UP,
) -> Iterator[dict[str, Any]]:
    """What the clients were told, what the store holds, and the service's memory by second.

    warm_up: share of the time after which memory counts.
    """
    with closing(sqlite3.connect(store)) as opened:
        stored = set(opened.execute("SELECT vehicle_id, start_ns FROM windows").fetchall())
    asked = round(60 * minutes) * vehicles
    yield {"figure": "windows due", "value": asked, "vehicles": vehicles, "minutes": minutes}
    yield {"figure": "windows acknowledged", "value": len(sent.acknowledged), "statuses": dict(sent.statuses)}
    yield {"figure": "acknowledged windows lost", "value": len(set(sent.acknowledged) - stored), "target": "0"}
    low, high, worst = np.percentile(sent.seconds, [50, 99, 100])
    yield {
        "figure": "seconds from due to answered, p99",
        "value": round(float(high), 3),
        "p50": round(float(low), 3),
        "worst": round(float(worst), 3),
        "sent_a_second_late": sent.late,
        "target": f"< {TARGET_SECONDS:g}",
    }
    warm = [size for second, size in memory.lasting if second > warm_up * 60 * minutes and size]
    if len(warm) > 10:
        tenth = max(1, len(warm) // 10)
        first, last = np.median(warm[:tenth]), np.median(warm[-tenth:])
        growth = round(100 * (float(last / first) - 1), 2)
        yield {"figure": "growth of memory after warm-up", "value": growth, "unit": "%", "mb": round(float(last) / 1e6)}
        yield {"figure": "most memory of processes of jobs", "value": round(max(memory.jobs) / 1e6), "unit": "MB"}
