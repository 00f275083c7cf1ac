"""`sprung bench trust`: killed at random moments, cut from its power, loaded: what was acknowledged counts.

`--kills N` sends SIGKILL to real processes: to a service that takes windows, recordings and diagnoses, and to commands
that replay, migrate, forget, back up and restore.  `--cuts N` replays the system calls of a traced service onto a disk
that loses what was not synced, and looks at what is left at N moments; `--step-cuts N` does so with replay, migration,
first start, retention, back-up and restoration, N moments each.  `--load-minutes N` sends the windows of 100
vehicles (`--vehicles`), one a second each; `--soak-minutes N` sends few, uploads and looks at pages meanwhile.
`--scarce-seconds N` takes disk, files, memory and the store's lock from a running service, for N seconds each; as 20
kills are, it is done unless told otherwise (`sprung bench trust 0 --scarce-seconds 0`).
With `--folder` what was done is kept: the same call goes on where the last one was ended.
"""

from __future__ import annotations

import json
import random
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sprung.benchmarks.trust_load import VEHICLES, load
from sprung.benchmarks.trust_power import power_cuts
from sprung.benchmarks.trust_ride import RestlessRide
from sprung.benchmarks.trust_scarcity import scarcity
from sprung.benchmarks.trust_soak import soak
from sprung.benchmarks.trust_step_cuts import cut_step, replay_cuts
from sprung.benchmarks.trust_steps import KILLS, STEPS
from sprung.benchmarks.trust_zygote import Zygote


def run(
    kills: int = 20,
    *,
    cuts: int = 0,
    step_cuts: int = 0,
    load_minutes: float = 0.0,
    vehicles: int = VEHICLES,
    soak_minutes: float = 0.0,
    scarce_seconds: float = 4.0,
    folder: str = "",
    minutes: float = 0.0,
    seed: int = 1,
) -> Iterator[dict[str, Any]]:
    """Figures of each part that is asked for.

    minutes: no further kill is begun after these; 0: all are.
    """
    with tempfile.TemporaryDirectory(prefix="sprung-trust-") as temporary:
        place = Path(folder or temporary)
        place.mkdir(parents=True, exist_ok=True)
        if kills:
            yield from _kills(place, kills, seed, minutes * 60)
        if cuts:
            yield from power_cuts(place / "power", cuts, seed)
        if step_cuts:
            yield from _step_cuts(place / "power", step_cuts, seed)
        if load_minutes:
            yield from load(Path(temporary), load_minutes, vehicles)
        if soak_minutes:
            yield from soak(Path(temporary), soak_minutes)
        if scarce_seconds:
            yield from scarcity(Path(temporary), scarce_seconds)


def _step_cuts(place: Path, cuts: int, seed: int) -> Iterator[dict[str, Any]]:
    """Each kind of step, and replay."""
    if shutil.which("strace") is None:
        yield {"figure": "power cuts of steps", "value": None, "skipped": "strace is not installed"}
        return
    zygote = Zygote()
    for name, make in STEPS.items():
        folder = place / name.replace(" ", "-")
        folder.mkdir(parents=True, exist_ok=True)
        yield cut_step(folder, name, make(folder), cuts, zygote, seed)
    yield replay_cuts(place / "replay", RestlessRide(), cuts, zygote, seed)
    zygote.close()


def _kills(place: Path, kills: int, seed: int, seconds: float) -> Iterator[dict[str, Any]]:
    """Each kind of kill its share, in turn; then what each came to."""
    begun = time.monotonic()
    log = place / "kills.jsonl"
    begun_before = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    numbers = Counter(line["kind"] for line in begun_before)
    done = Counter(line["kind"] for line in begun_before if not line.get("too_late"))  # what had ended was not killed
    ride = RestlessRide()
    zygote = Zygote()
    tried = {kind: make(place / kind.replace(" ", "-"), ride, zygote) for kind, make, _ in KILLS}
    total = sum(share for _, _, share in KILLS)
    goals = {kind: -(-kills * share // total) for kind, _, share in KILLS}
    while any(done[kind] < goal for kind, goal in goals.items()):
        kind = min((k for k in goals if done[k] < goals[k]), key=lambda k: done[k] / goals[k])
        outcome = tried[kind].kill(random.Random(f"{seed}-{kind}-{numbers[kind]}"))
        numbers[kind] += 1
        done[kind] += not outcome.get("too_late", False)
        with open(log, "a") as file:
            file.write(json.dumps({"kind": kind, "number": numbers[kind]} | outcome) + "\n")
        if seconds and time.monotonic() - begun > seconds:
            break
    yield {"figure": "kills", "value": sum(done.values()), "asked": kills, "too_late": sum((numbers - done).values())}
    for kind, one in tried.items():
        if numbers[kind]:
            yield {"figure": kind, "kills": done[kind]} | one.outcome()
    zygote.close()
