"""What a machine can run out of, taken from a running service for real, and given back: disk, files, memory, the store.

The service's data lie on a small disk of its own (a tmpfs in a mount namespace), which is filled; limits of open files
and of memory are lowered under the running process; another process holds the store's write lock.  Meanwhile windows
are sent and the service's health is asked.  What counts: no answer is 500, `/health/live` says 200, `/health/ready`
says what is lacking, and once it is given back the service is ready and everything acknowledged is in its store.
"""

from __future__ import annotations

import http.client
import json
import resource
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

from sprung.benchmarks.trust_clients import ask
from sprung.benchmarks.trust_ride import RestlessRide
from sprung.benchmarks.trust_service import ServiceProcess

DISK_MB = 96
BACK_SECONDS = 120.0  # within which it has to be ready again
PATIENCE = 60.0  # s
TURN = 0.25  # s between two rounds of requests
SPARE_FILES = 4  # descriptors that are left: enough to answer, too few to work
BALLAST, CROWD = 1_500_000, 16  # bytes of bodies that are sent at once when memory is short, and how many of them
CHUNK = 1 << 16


def missing() -> str:
    """Why a disk of its own cannot be had here; empty where it can."""
    if shutil.which("unshare") is None:
        return "there is no `unshare`"
    tried = subprocess.run(
        ["unshare", "-rm", "mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", "/mnt"],
        capture_output=True,
        text=True,
        check=False,
    )
    return tried.stderr.strip()


class ScarceService:
    """A service on a small disk, whose windows and health are asked for in rounds."""

    def __init__(self, folder: Path, ride: RestlessRide) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        mount = f'mount -t tmpfs -o size={DISK_MB}m tmpfs "{folder}" && exec "$@"'
        own_disk = ("unshare", "-rm", "sh", "-c", mount, "sh")
        self.served = ServiceProcess(folder, before=("env", "SPRUNG_MIN_FREE_BYTES=0", *own_disk))
        self.pid = self.served.process.pid
        self._folder = folder
        self._ride = ride
        self.acknowledged: list[int] = []
        self._sent = 0

    @property
    def data(self) -> Path:
        """The data folder as it is seen from outside."""
        return Path(f"/proc/{self.pid}/root{self._folder}")

    def inside(self, program: str) -> list[str]:
        """The command of a Python program on the same disk, told the path of the store."""
        enter = ["nsenter", "--preserve-credentials", "--user", "--mount", "--target", str(self.pid)]
        return [*enter, sys.executable, "-c", program, str(self._folder / "sprung.db")]

    def crowd(self, counts: Counter[str]) -> None:
        """Large windows at once, which are identified and not stored."""
        body = b" " * BALLAST + json.dumps(self._ride.window(0, "windows")).encode()
        with ThreadPoolExecutor(CROWD) as clients:
            answers = list(clients.map(lambda _: self._ask("POST", "/identify", body)[0], range(CROWD)))
        counts.update(f"crowd {answer}" for answer in answers)

    def turn(self, counts: Counter[str], reasons: Counter[str]) -> bool:
        """One window, one look at a page, and the service's health; whether all is well."""
        body = self._ride.window(self._sent, "windows")
        sent, _ = self._ask("POST", "/identify?track=true", json.dumps(body).encode())
        counts[f"window {sent}"] += 1
        if sent == 200:
            self.acknowledged.append(round(float(body["start"]) * 1e9))
            self._sent += 1
        listed, _ = self._ask("GET", "/vehicles")
        counts[f"list {listed}"] += 1
        ready, said = self._ask("GET", "/health/ready")
        counts[f"ready {ready}"] += 1
        if ready == 503:
            reasons[str(said.get("detail", ""))] += 1
        counts[f"live {self._ask('GET', '/health/live')[0]}"] += 1
        return sent == listed == ready == 200

    def _ask(self, method: str, path: str, body: bytes = b"") -> tuple[int | str, dict[str, Any]]:
        try:
            return ask(self.served.port, method, path, body, {"content-type": "application/json"}, PATIENCE)
        except (OSError, http.client.HTTPException):
            return "unanswered", {}


@contextmanager
def disk_full(watched: ScarceService) -> Iterator[None]:
    """Every byte of its disk taken."""
    filler = watched.data / "filler"
    with suppress(OSError), open(filler, "wb", buffering=0) as file:
        while True:
            file.write(bytes(CHUNK))
    with suppress(OSError), open(filler, "ab", buffering=0) as file:
        while True:
            file.write(b"x")
    yield
    filler.unlink()


@contextmanager
def locked(watched: ScarceService) -> Iterator[None]:
    """Another process writes to the store and does not end."""
    command = watched.inside(LOCK)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        other.stdout.readline()
        yield
        other.communicate("enough\n")


@contextmanager
def _limited(watched: ScarceService, kind: int, value: int) -> Iterator[None]:
    before = resource.prlimit(watched.pid, kind)
    resource.prlimit(watched.pid, kind, (value, before[1]))
    yield
    resource.prlimit(watched.pid, kind, before)


def few_files(watched: ScarceService) -> AbstractContextManager[None]:
    """A few more files may be opened."""
    highest = max(int(path.name) for path in Path(f"/proc/{watched.pid}/fd").iterdir())
    return _limited(watched, resource.RLIMIT_NOFILE, highest + 1 + SPARE_FILES)


def no_files(watched: ScarceService) -> AbstractContextManager[None]:
    """No file can be opened: not even a connection accepted."""
    return _limited(watched, resource.RLIMIT_NOFILE, 3)


def little_memory(watched: ScarceService) -> AbstractContextManager[None]:
    """The process may not grow any more."""
    lines = Path(f"/proc/{watched.pid}/status").read_text().splitlines()
    (kilobytes,) = (int(line.split()[1]) for line in lines if line.startswith("VmData"))
    return _limited(watched, resource.RLIMIT_DATA, 1024 * kilobytes)


LOCK = """
import sqlite3, sys
store = sqlite3.connect(sys.argv[1], isolation_level=None, timeout=30)
store.execute("BEGIN IMMEDIATE")
print("held", flush=True)
sys.stdin.readline()
store.execute("ROLLBACK")
"""
LOOK = """
import json, sqlite3, sys
store = sqlite3.connect(sys.argv[1])
starts = [row[0] for row in store.execute("SELECT start_ns FROM windows")]
print(json.dumps({"starts": starts, "integrity": store.execute("PRAGMA integrity_check").fetchone()[0]}))
"""
Scarcity = Callable[[ScarceService], AbstractContextManager[None]]
SCARCITIES: dict[str, Scarcity] = {
    "disk full": disk_full,
    "store locked": locked,
    "few files": few_files,
    "no files": no_files,
    "little memory": little_memory,
}


def scarcity(folder: Path, seconds: float) -> Iterator[dict[str, Any]]:
    """Figures of everything that can be lacking, each for `seconds`."""
    if reason := missing():
        yield {"figure": "scarcity", "value": None, "skipped": f"no disk of its own: {reason}"}
        return
    watched = ScarceService(folder / "scarce", RestlessRide())
    with watched.served as served:
        served.ready()
        for name, taken in SCARCITIES.items():
            counts, reasons = Counter[str](), Counter[str]()
            with taken(watched):
                until = time.monotonic() + seconds
                while time.monotonic() < until:
                    if taken is little_memory:
                        watched.crowd(counts)
                    watched.turn(counts, reasons)
                    time.sleep(TURN)
            back = _back(watched)
            yield {
                "figure": name,
                "value": back,
                "unit": "s until ready",
                "answers": dict(sorted(counts.items())),
                "not_ready": [line for line, _ in reasons.most_common(2)],
            }
        seen = json.loads(subprocess.run(watched.inside(LOOK), capture_output=True, check=True).stdout)
        kept, whole = Counter(seen["starts"]), seen["integrity"]
        yield {
            "figure": "acknowledged windows lost",
            "value": sum(kept[start] == 0 for start in watched.acknowledged),
            "doubled": sum(count - 1 for count in kept.values()),
            "acknowledged": len(watched.acknowledged),
            "integrity": whole,
        }


def _back(watched: ScarceService) -> float | None:
    """Seconds until all is well again; None: it is not."""
    begun = time.monotonic()
    while time.monotonic() - begun < BACK_SECONDS and watched.served.process.alive:
        if watched.turn(Counter(), Counter()):
            return round(time.monotonic() - begun, 1)
        time.sleep(TURN)
    return None
