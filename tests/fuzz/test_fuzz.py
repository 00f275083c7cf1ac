"""Mutants and hostile files: read, or refused with one line; never a hang, a traceback, much memory or a silent lie."""

import importlib.util
import json
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import pytest

from sprung.replay import UnreadableRecording, open_recording
from sprung.replay.remarks import remarks
from sprung.replay.windowing import Windower
from tests.fuzz.harness import run
from tests.fuzz.hostile import ROWS
from tests.fuzz.seeds import NEEDS, SEEDS, TABLE
from tests.replay_files import database

HOSTILE = sorted((Path(__file__).parents[1] / "data" / "hostile").iterdir())
NOTHING = {"bomb-zstd.mcap", "bomb-lz4.mcap", "bomb-stated.mcap", "bomb-many.mcap", "bomb.blf", "signatures.blf"}
NOTHING |= {"short-objects.blf", "no-clock.mcap", "columns.csv"}
NO_WINDOW = {"same-time.mcap", "apart.mcap"}


@pytest.mark.parametrize("name", SEEDS)
def test_mutants_are_read_or_refused(name: str) -> None:
    if name in NEEDS and importlib.util.find_spec(NEEDS[name]) is None:
        pytest.skip(f"{NEEDS[name]} is not installed")
    count = 15 if name == "mf4" else 60  # asammdf takes a tenth of a second for each
    outcome = run(name, count, seed=2026)
    assert not outcome.faults, outcome.faults
    assert outcome.silent == 0
    assert outcome.read + outcome.refused == outcome.mutants == count


@pytest.mark.slow
def test_a_thousand_mutants_of_every_format_in_bounded_memory() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.fuzz", "--mutants=1000", "--seed=5"],
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line for line in lines if line["faults"] or line["silent"]] == []
    assert len(lines) == len(SEEDS)


@pytest.mark.parametrize("path", HOSTILE, ids=lambda path: path.name)
def test_a_hostile_file_costs_little_and_its_good_samples_are_kept(path: Path) -> None:
    tracemalloc.start()
    started = time.process_time()
    try:
        recording = open_recording(path, TABLE, dbc=database())
        blocks = list(recording.blocks())
        windower = Windower(TABLE, 100.0, 100)
        windows = [w for block in blocks for w in windower.push(block)] + windower.flush()
        assert path.name not in NOTHING
        told = recording.problems or recording.tally.corrupt or sum(recording.account.values.values())
        assert told or remarks(windower, len(windows))
        assert recording.tally.used >= ROWS - 1
        assert bool(windows) == (path.name not in NO_WINDOW)
    except UnreadableRecording as error:
        assert path.name in NOTHING, error
        assert "\n" not in str(error)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert time.process_time() - started < 3
    assert peak < 2 * path.stat().st_size + (40 << 20)


def test_the_corpus_is_small() -> None:
    assert sum(path.stat().st_size for path in HOSTILE) < 600_000
