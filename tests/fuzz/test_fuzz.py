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
from sprung.replay.clock_messages import remarks
from sprung.replay.windowing import Windower
from sprung.service.cli import main
from tests.fuzz.guided import KEPT
from tests.fuzz.harness import MutantOutcome, read_one, run
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


@pytest.mark.parametrize("kind", sorted(folder.name for folder in KEPT.iterdir() if folder.name in SEEDS))
def test_what_guided_fuzzing_kept_is_read_or_refused(kind: str, tmp_path: Path) -> None:
    if kind in NEEDS and importlib.util.find_spec(NEEDS[kind]) is None:
        pytest.skip(f"{NEEDS[kind]} is not installed")
    outcome, path = MutantOutcome(kind), tmp_path / SEEDS[kind][0]
    for kept in sorted((KEPT / kind).iterdir()):
        path.write_bytes(kept.read_bytes())
        read_one(path, database(), False, outcome)
    assert not outcome.faults and outcome.read + outcome.refused >= 1


@pytest.mark.slow
def test_a_file_that_crashes_the_library_that_reads_it_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Found by guided fuzzing: libhdf5 ends by SIGSEGV, in a process of its own."""
    monkeypatch.setenv("SPRUNG_ISOLATE_READING", "true")
    pytest.importorskip("h5py")
    assert main(["inspect", str(KEPT.parent / "crashes" / "libhdf5-segv.h5")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_damaged_statistics_of_a_parquet_file_do_not_end_the_process() -> None:
    """Found by mutants: pyarrow aborts where the metadata of a damaged column are asked for."""
    pytest.importorskip("pyarrow")
    outcome = MutantOutcome("parquet")
    read_one(KEPT.parent / "crashes" / "pyarrow-abort.parquet", None, False, outcome)
    assert outcome.refused == 1 and not outcome.faults
