"""Reads mutants as the product does and says what became of each: read, refused with one line, or a fault of ours.

`python -m tests.fuzz --mutants 1000` prints one JSON line per format; every format runs in a process of its own with
bounded memory, so that a hang or a crash costs that format and is told.
"""

from __future__ import annotations

import json
import resource
import signal
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sprung.model.signals import SampleBlock
from sprung.replay import Recording, UnreadableRecording, open_recording
from sprung.replay.clock_messages import remarks
from sprung.replay.record import load_record
from sprung.replay.windowing import Windower
from tests.fuzz.mutate import INSIDE, mutant
from tests.fuzz.seeds import CHECKED, GROUPED, RECORDS, SEEDS, START, TABLE, TIMES, UNIVERSAL, VALUES
from tests.replay_files import database

SECONDS = 20.0  # of processor time that one mutant may take
MEMORY = 512 << 20  # bytes beside twice the file, of what the process had before
NEAR = 2_000  # ns; CAN files hold float seconds


@dataclass
class MutantOutcome:
    """What became of the mutants of one format."""

    name: str
    mutants: int = 0
    read: int = 0
    refused: int = 0
    told: int = 0  # read, with something missing and said
    silent: int = 0  # values that the file never held, and nothing said (of the formats with checksums)
    slowest: float = 0.0  # s
    grown: int = 0  # bytes by which the process grew at most
    faults: Counter[str] = field(default_factory=Counter)  # exceptions that are none of ours, hangs

    def line(self) -> dict[str, Any]:
        """As JSON."""
        said = {"fuzz": self.name, "mutants": self.mutants, "read": self.read, "refused": self.refused}
        said |= {"told": self.told, "silent": self.silent, "slowest_seconds": round(self.slowest, 2)}
        return said | {"grown_megabytes": self.grown >> 20, "faults": dict(self.faults)}


class _Hang(BaseException):
    pass


def mutants(name: str, count: int, seed: int, folder: Path) -> Iterator[tuple[Path, bool]]:
    """Files, one after the other at the same path, and whether their checksums still hold what was written."""
    file_name, write = SEEDS[name]
    path = folder / file_name
    write(path)
    whole = path.read_bytes()
    rng = np.random.default_rng([seed, *name.encode()])
    for number in range(count):
        inside = name in INSIDE and number % 3 == 2
        path.write_bytes(INSIDE[name](whole, rng) if inside else mutant(whole, rng))
        yield path, name in CHECKED and not inside


def run(name: str, count: int, seed: int = 1, keep: Path | None = None) -> MutantOutcome:
    """Read the mutants of one format here; those that show a fault are kept in the folder `keep`."""
    outcome = MutantOutcome(name)
    found = 0
    dbc = database()
    before = _peak()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        for path, honest in mutants(name, count, seed, Path(folder)):
            outcome.mutants += 1
            started = time.process_time()
            read_one(path, dbc, honest, outcome)
            outcome.slowest = max(outcome.slowest, time.process_time() - started)
            if keep is not None and sum(outcome.faults.values()) + outcome.silent > found:
                keep.mkdir(parents=True, exist_ok=True)
                (keep / f"{name}-{outcome.mutants}{path.suffix}").write_bytes(path.read_bytes())
                found = sum(outcome.faults.values()) + outcome.silent
    outcome.grown = _peak() - before
    return outcome


def read_one(path: Path, dbc: Any, honest: bool, outcome: MutantOutcome) -> None:
    """Read one file as the product does and note in `outcome` what became of it; honest: its checksums are right."""
    previous = signal.signal(signal.SIGPROF, _hang)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        channels = {".tdms": GROUPED, ".uff": UNIVERSAL, ".npy": RECORDS}.get(path.suffix, TABLE)
        recording = open_recording(path, channels, dbc=dbc)
        blocks = list(recording.blocks())
        _windows(blocks)
        load_record(path, channels, 100.0, dbc=dbc)
        outcome.read += 1
        outcome.told += bool(recording.incomplete or recording.problems)
        outcome.silent += honest and _wrong(blocks, recording)
    except UnreadableRecording as error:
        outcome.refused += 1
        if "\n" in str(error) or not str(error):
            outcome.faults["a refusal of more than one line"] += 1
    except _Hang:
        outcome.faults[f"longer than {SECONDS:.0f} s"] += 1
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        ours = [f for f in traceback.extract_tb(error.__traceback__) if "replay" in f.filename]
        place = ours[-1] if ours else where
        outcome.faults[f"{type(error).__name__} at {Path(place.filename).name}:{place.lineno}: {error}"[:200]] += 1
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, previous)


def _windows(blocks: list[SampleBlock]) -> None:
    windower = Windower(TABLE, 100.0, 100)
    windows = [window for block in blocks for window in windower.push(block)] + windower.flush()
    remarks(windower, len(windows))


def _wrong(blocks: list[SampleBlock], recording: Recording) -> bool:
    """Whether there is a sample that was never recorded and nothing is said of the file."""
    if recording.incomplete or recording.problems:
        return False
    for block in blocks:
        row = np.rint((block.time - START) / (TIMES[1] - TIMES[0])).astype(np.int64)
        known = (row >= 0) & (row < len(TIMES))
        row = np.clip(row, 0, len(TIMES) - 1)
        known &= np.abs(block.time - TIMES[row]) <= NEAR
        known &= np.abs(block.value - VALUES[row, block.channel]) < 1e-9
        if not (known | np.isnan(block.value)).all():
            return True
    return False


def _hang(_number: int, _frame: Any) -> None:
    raise _Hang


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def bounded(name: str, count: int, seed: int, keep: Path | None) -> None:
    """The same for a process of its own: prints the line."""
    run(name, 1, seed)  # what is loaded at first use is not the file's
    used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    size = 2 * 200_000  # the seeds and what mutations add to them
    resource.setrlimit(resource.RLIMIT_DATA, (used + size + MEMORY, used + size + MEMORY))
    print(json.dumps(run(name, count, seed, keep).line()), flush=True)
