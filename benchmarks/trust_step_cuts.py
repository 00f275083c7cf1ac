"""Power cuts under short steps and under `sprung replay`: traced once, replayed onto a disk that forgets.

At each moment what the disk may hold is put into a folder and judged, as after a kill; then the step is done again
there, undisturbed, and judged once more.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sprung.benchmarks.trust_disk import TRACED, ForgetfulDisk, SystemCall, system_calls
from sprung.benchmarks.trust_kills import KilledStep, content, count, fresh, integrity, started
from sprung.benchmarks.trust_ride import SYSTEM_FILE, RestlessRide
from sprung.benchmarks.trust_zygote import DONE, Zygote
from sprung.service.times import to_iso

TRACE = ("strace", "-f", "-y", "-xx", "-s", "10000000", "--seccomp-bpf", "-e", f"trace={TRACED}")
RIDE_SECONDS = 20.0
TOLD = "told.jsonl"  # what a replay has printed


def cut_step(
    folder: Path, name: str, step: KilledStep, cuts: int, zygote: Zygote, seed: int, warm: bool = True
) -> dict[str, Any]:
    """Figures of one kind of step; warm: with everything imported that commands need."""
    place, log = fresh(folder / "traced", step.prepare), folder / "trace.log"
    disk = ForgetfulDisk(str(place))
    disk.hold(place)
    imports = "from sprung.benchmarks.trust_zygote import warm_up; warm_up()\n" if warm else ""
    code = f"{imports}go = lambda: None\n{step.code}"
    _traced(log, [sys.executable, "-c", code], place)
    wrong: Counter[str] = Counter()

    def look(after: Path, _calls: list[SystemCall]) -> None:
        for path in (path for path in place.rglob("*") if path.is_dir()):
            (after / path.relative_to(place)).mkdir(parents=True, exist_ok=True)
        wrong.update(step.judge(after, False))
        started(step, after, zygote).wait()
        wrong["failed_afterwards"] += not (after / DONE).exists()
        wrong.update({f"{kind}_afterwards": value for kind, value in step.judge(after, True).items()})

    made = _at_moments(log, place, disk, folder / "after", cuts, random.Random(f"{seed}-{name}"), look)
    return {"figure": f"{name}, cut from its power", "cuts": made} | wrong


def replay_cuts(folder: Path, ride: RestlessRide, cuts: int, zygote: Zygote, seed: int) -> dict[str, Any]:
    """Figures of `sprung replay --store`: all that was printed is stored; done again, it ends as if undisturbed."""
    folder.mkdir(parents=True, exist_ok=True)
    file, log, place = folder / "ride.csv", folder / "trace.log", fresh(folder / "traced", lambda _place: None)
    file.write_bytes(ride.csv(0, RIDE_SECONDS))
    options = ["replay", str(file), "--system", str(SYSTEM_FILE), "--json", "--vehicle", "a", "--store"]
    command = [sys.executable, "-m", "sprung", *options, str(place / "chain.db")]
    _traced(log, command, place, place / TOLD)
    alone = content(place / "chain.db")
    disk = ForgetfulDisk(str(place))
    disk.hold(fresh(folder / "empty", lambda _place: None))
    wrong: Counter[str] = Counter({"windows_alone": len(alone["windows"])})

    def look(after: Path, calls: list[SystemCall]) -> None:
        store = after / "chain.db"
        wrong["damaged"] += integrity(store) != "ok"
        there = {to_iso(row[0]) for row in content(store)["windows"]} if count(store, "windows") > 0 else set()
        wrong["windows_lost"] += len(_printed(calls) - there)
        zygote.command(*options, str(store)).wait()
        again = content(store)
        for kind in alone:
            wrong[f"{kind}_differ"] += alone[kind] != again[kind]

    made = _at_moments(log, place, disk, folder / "after", cuts, random.Random(f"{seed}-replay"), look)
    return {"figure": "replay, cut from its power", "cuts": made} | wrong


def _traced(log: Path, command: list[str], place: Path, out: Path | None = None) -> None:
    """Run a command under strace in a folder.  Raises ValueError where it fails."""
    with open(out or os.devnull, "ab") as output:
        ended = subprocess.run(
            [*TRACE, "-o", str(log), *command], cwd=place, stdout=output, stderr=subprocess.PIPE, check=False
        )
    if ended.returncode not in (0, 1):  # 1: a recording that is not whole
        raise ValueError(f"the step fails when nobody disturbs it: {ended.stderr.decode(errors='replace')[-300:]}")


def _at_moments(
    log: Path,
    place: Path,
    disk: ForgetfulDisk,
    after: Path,
    cuts: int,
    rng: random.Random,
    look: Callable[[Path, list[SystemCall]], None],
) -> int:
    """Look at what is left after cuts at random calls; how many there were."""
    with open(log, encoding="ascii", errors="replace") as lines:
        calls = list(system_calls(lines, str(place)))
    moments = Counter(rng.choices(range(len(calls) + 1), k=cuts)) if calls else Counter[int]()
    for number in range(len(calls) + 1):
        for _ in range(moments[number]):
            disk.write(disk.after_a_cut(rng), fresh(after, lambda _place: None))
            look(after, calls[:number])
        if number < len(calls) and calls[number].name != "send":
            disk.take(calls[number])
    shutil.rmtree(after, ignore_errors=True)
    return moments.total()


def _printed(calls: list[SystemCall]) -> set[str]:
    """Windows that had been printed after some calls."""
    text = b"".join(call.data for call in calls if call.name == "write" and call.path.endswith(TOLD))
    return set(_windows(text.decode(errors="replace").splitlines()))


def _windows(lines: list[str]) -> Iterator[str]:
    for line in lines:
        try:
            found = json.loads(line)
        except ValueError:  # the cut came within it
            continue
        if isinstance(found, dict) and "window" in found:
            yield str(found["window"])
