"""`python -m tests.fuzz.guided --seconds 60`: fuzzing that is guided by coverage; one JSON line per kind of file.

libFuzzer, through atheris (`make fuzz`), keeps the inputs that reach new branches of the readers, and changes those.
It starts from the seeds that mutants are made of and from what earlier runs kept (`tests/data/guided`).  Every kind
runs in a process of its own; an exception that is none of ours, a hang or too much memory is a fault.  System files
and CAN databases, which are trusted, are held to the same: one line, no traceback.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

KEPT = Path(__file__).parents[1] / "data" / "guided"
OURS = ["sprung.replay", "sprung.model.system", "sprung.model.systemfile", "sprung.model.schema"]
THEIRS = {
    "mf4": ["asammdf.blocks.v4_blocks"],
    "tdms": ["nptdms"],
    "dbc": ["cantools"],
}  # parsers in Python, which show their branches
LONGEST = 40_000  # bytes of an input
MEMORY = 1_500  # MB that a process may hold
PATIENCE = 900  # s by the clock: what an input may take is counted in processor time (`harness.SECONDS`)
INSIDE_SHARE = 0.3  # of the changes are made behind the checksums, where a format has them
FAULT = "FAULT "


def _system() -> bytes:
    from tests.strut import TEXT

    return TEXT.format(law="friction", sensor="").encode()


def _database() -> bytes:
    from tests.replay_files import database

    return database().as_dbc_string().encode()


TEXTS: dict[str, Callable[[], bytes]] = {"yaml": _system, "dbc": _database}


def main() -> int:
    """0 when nothing was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=60, help="per kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder for inputs that reach new branches, and for faults")
    parser.add_argument("--here", action="store_true", help="in this process (one kind)")
    parser.add_argument("kinds", nargs="*")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="guided-") as folder:
        keep = options.keep or Path(folder)
        keep.mkdir(parents=True, exist_ok=True)
        if options.here:
            _here(options.kinds[0], options.seconds, options.seed, keep)
        return max(_apart(kind, options.seconds, options.seed, keep) for kind in options.kinds or _kinds())


def _kinds() -> list[str]:
    from tests.fuzz.seeds import SEEDS

    return [*SEEDS, *TEXTS]


def _apart(kind: str, seconds: int, seed: int, keep: Path) -> int:
    """Run one kind in a process of its own and print its line; 1 where it found a fault."""
    command = [sys.executable, "-m", "tests.fuzz.guided", "--here", f"--seconds={seconds}", f"--seed={seed}"]
    done = subprocess.run(
        [*command, f"--keep={keep}", kind], capture_output=True, text=True, errors="replace", check=False
    )
    faults = [line.removeprefix(FAULT) for line in done.stdout.splitlines() if line.startswith(FAULT)]
    if done.returncode and not faults:
        faults = [done.stderr.strip()[-600:] or f"ended with {done.returncode}"]
    reached = re.findall(r"cov: (\d+)", done.stderr)
    inputs = re.findall(r"number_of_executed_units: (\d+)", done.stderr)
    line = {"guided": kind, "inputs": int(inputs[-1]) if inputs else 0, "edges": int(reached[-1]) if reached else 0}
    print(json.dumps(line | {"first_edges": int(reached[0]) if reached else 0, "faults": faults}), flush=True)
    return int(bool(faults))


def _here(kind: str, seconds: int, seed: int, keep: Path) -> None:
    """Fuzz one kind until the time is over; does not return."""
    import atheris

    with atheris.instrument_imports(include=OURS + THEIRS.get(kind, [])):
        from tests.fuzz.mutate import INSIDE
        from tests.fuzz.seeds import SEEDS

        one = _text(kind, keep) if kind in TEXTS else _recording(kind, keep)
    corpus = keep / kind
    corpus.mkdir(exist_ok=True)
    if kind in SEEDS:
        name, write = SEEDS[kind]
        write(corpus / name)
        (corpus / name).rename(corpus / "seed")
    else:
        (corpus / "seed").write_bytes(TEXTS[kind]())
    import numpy as np

    def change(data: bytes, most: int, number: int) -> bytes:
        if kind in INSIDE and random.Random(number).random() < INSIDE_SHARE:
            try:
                return INSIDE[kind](data, np.random.default_rng(number))[:most]
            except Exception:  # what was changed before has no inside any more
                return atheris.Mutate(data, len(data) + 1)[:most]
        return atheris.Mutate(data, most)

    options = [f"-max_total_time={seconds}", f"-max_len={LONGEST}", f"-seed={seed}", f"-rss_limit_mb={MEMORY}"]
    options += [f"-timeout={PATIENCE}", "-print_final_stats=1", f"-artifact_prefix={keep}/{kind}-", "-verbosity=1"]
    kept = [str(folder) for folder in [KEPT / kind] if folder.is_dir()]
    atheris.Setup([sys.argv[0], *options, str(corpus), *kept], one, custom_mutator=change)
    atheris.Fuzz()


def _report(kind: str, keep: Path, seen: set[str], what: str, data: bytes) -> None:
    """Print a fault the first time that it is seen, and keep the input."""
    place = what.split(": ", maxsplit=1)[0]
    if place not in seen:
        seen.add(place)
        (keep / f"fault-{kind}-{len(seen)}").write_bytes(data)
        print(f"{FAULT}{what}", flush=True)


def _recording(kind: str, keep: Path) -> Callable[[bytes], None]:
    """Reads an input as the product reads such a file."""
    from tests.fuzz.harness import MutantOutcome, read_one
    from tests.fuzz.seeds import SEEDS
    from tests.replay_files import database

    folder = Path(tempfile.mkdtemp(prefix="guided-"))
    path, dbc, seen = folder / SEEDS[kind][0], database(), set[str]()

    def one(data: bytes) -> None:
        path.write_bytes(data)
        outcome = MutantOutcome(kind)
        read_one(path, dbc, False, outcome)
        for fault in outcome.faults:
            _report(kind, keep, seen, fault, data)

    return one


def _text(kind: str, keep: Path) -> Callable[[bytes], None]:
    """Loads a system file or a CAN database."""
    from sprung.model.schema import SystemFileError
    from sprung.model.system import load_system
    from sprung.replay import UnreadableRecording
    from sprung.replay.candatabase import load_database
    from sprung.replay.candecode import CanDecoder
    from tests.fuzz.seeds import TABLE

    folder = Path(tempfile.mkdtemp(prefix="guided-"))
    path, seen = folder / f"a.{kind}", set[str]()
    load: Callable[[Path], Any] = load_system if kind == "yaml" else lambda path: CanDecoder(TABLE, load_database(path))

    def one(data: bytes) -> None:
        path.write_bytes(data)
        try:
            load(path)
        except (SystemFileError, UnreadableRecording):
            pass
        except Exception as error:
            import traceback

            where = traceback.extract_tb(error.__traceback__)[-1]
            _report(
                kind, keep, seen, f"{type(error).__name__} at {Path(where.filename).name}:{where.lineno}: {error}", data
            )

    return one


if __name__ == "__main__":
    sys.exit(main())
