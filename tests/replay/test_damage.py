"""Cut and damaged files: nothing raises but the one clear error, nothing wrong is read, every loss is counted."""

from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType

from sprung.replay import UnreadableRecording, mf4
from sprung.replay.account import Account
from tests.replay_files import (
    ROWS,
    START,
    STEP,
    TIMES,
    VALUES,
    Samples,
    database,
    read,
    write_can,
    write_csv,
    write_json,
)

TOLERANCE = 2_000  # ns; python-can writes float seconds
MESSAGES = ROWS + ROWS // 10  # in the MCAP file


@pytest.fixture(scope="module")
def dbc(tmp_path_factory: pytest.TempPathFactory) -> Path:

    path = tmp_path_factory.mktemp("dbc") / "body.dbc"
    path.write_text(database().as_dbc_string())
    return path


def wrong(samples: Samples, start: int = START) -> int:
    """Samples that the recording never held."""
    count = 0
    for index, (times, values) in samples.items():
        row = np.rint((times - start) / STEP).astype(int)
        known = (row >= 0) & (row < ROWS)
        known[known] &= np.abs(times[known] - start - row[known] * STEP) <= TOLERANCE
        good = known.copy()
        good[known] = np.abs(values[known] - VALUES[row[known], index]) < 1e-9
        count += int((~good & ~np.isnan(values)).sum())
    return count


@pytest.mark.parametrize("name", ["a.mcap", "a.blf", "a.asc", "a.log", "a.csv"])
def test_a_file_cut_anywhere_is_read_up_to_the_cut(name: str, tmp_path: Path, dbc: Path) -> None:
    path = tmp_path / name
    {"a.mcap": write_json, "a.csv": write_csv}.get(name, write_can)(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    recovered = []
    for size in np.sort(rng.integers(1, len(whole) - 1, 40)):
        path.write_bytes(whole[:size])
        try:
            recording, samples = read(path, dbc)
        except UnreadableRecording as error:
            assert "\n" not in str(error)
            continue
        tally = recording.tally
        last_line = name.endswith(("asc", "log", "csv"))  # a cut number is a number: at most the last line differs
        assert wrong(samples, 0 if name.endswith("csv") else START) <= (2 if last_line else 0)
        if name in ("a.mcap", "a.blf"):
            assert recording.incomplete or (name == "a.mcap" and tally.used == ROWS)  # cut in the summary
        recovered.append(tally.used)
    assert recovered == sorted(recovered)
    assert recovered[-1] > 0.8 * ROWS


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4])
@pytest.mark.parametrize("flips", [60, pytest.param(150, marks=pytest.mark.slow)])
def test_flipped_bits_in_an_mcap_file_never_give_a_wrong_number(
    compression: CompressionType, flips: int, tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    write_json(path, compression=compression, chunk=2048)
    whole = path.read_bytes()
    rng = np.random.default_rng(2)
    used, uncounted = [], 0
    for _ in range(flips):
        damaged = bytearray(whole)
        damaged[rng.integers(8, len(whole))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            recording, samples = read(path)
        except UnreadableRecording as error:
            assert "\n" not in str(error)
            continue
        assert wrong(samples) == 0
        counts = recording.tally.as_dict()
        uncounted += sum(counts.values()) != MESSAGES
        used.append(counts["used"])
        if counts["used"] < ROWS:
            assert recording.incomplete or counts["dropped"] or counts["foreign"] > 30
    assert np.mean(used) > 0.85 * ROWS  # a flip costs a chunk, not the recording
    # a flip in the statistics or in an index may take the expected number with it
    assert uncounted <= max(3, flips // 30)


def test_a_damaged_chunk_costs_its_messages_only_and_they_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_json(path, chunk=2048)
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 3] ^= 0x10
    path.write_bytes(damaged)
    recording, samples = read(path)
    counts = recording.tally.as_dict()
    assert 0 < counts["corrupt"] < 60
    assert sum(counts.values()) == MESSAGES
    assert recording.incomplete
    assert wrong(samples) == 0
    assert samples[0][0][-1] == TIMES[-1]
    assert any("CRC" in line or "damaged" in line for line in recording.problems)


def test_an_mcap_file_whose_writer_died_is_read_to_its_last_whole_chunk(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_json(path, chunk=2048, close=False)
    recording, samples = read(path)
    assert recording.vehicle == "tram-7"
    assert recording.incomplete
    assert recording.tally.used > 0.8 * ROWS
    assert np.array_equal(samples[0][0], TIMES[: len(samples[0][0])])
    assert f"{sum(recording.tally.as_dict().values())} messages recovered" in recording.problems[0]


@pytest.mark.parametrize("flips", [60, pytest.param(150, marks=pytest.mark.slow)])
def test_flipped_bits_in_a_blf_file_are_found_and_counted(tmp_path: Path, dbc: Path, flips: int) -> None:
    path = tmp_path / "a.blf"
    write_can(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(3)
    for _ in range(flips):
        damaged = bytearray(whole)
        damaged[rng.integers(144, len(whole))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            recording, samples = read(path, dbc)
        except UnreadableRecording as error:
            assert "\n" not in str(error)
            continue
        assert wrong(samples) == 0
        if recording.tally.used < ROWS:
            assert recording.incomplete


@pytest.mark.parametrize("name", ["a.asc", "a.log", "a.csv"])
def test_damaged_text_is_counted_and_the_rest_is_read(name: str, tmp_path: Path, dbc: Path) -> None:
    path = tmp_path / name
    (write_csv if name == "a.csv" else write_can)(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(4)
    for _ in range(60):
        damaged = bytearray(whole)
        damaged[rng.integers(200, len(whole))] = rng.choice([0x00, 0xFF, 0x80, ord("\n"), ord("g"), ord(" ")])
        path.write_bytes(damaged)
        recording, _ = read(path, dbc)
        assert recording.tally.used >= ROWS - 2


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "it is empty"),
        (b"hello, I am no recording\n", "it does not begin as one"),
        (b"MDF     4.10    " + bytes(range(256)) * 8, "an MDF file of version 4.10 that cannot be read: damaged"),
        (b"MDF     4.1", "an MDF file of version 4.1 that cannot be read: damaged"),
    ],
)
def test_a_file_that_is_no_mdf_is_reported_in_plain_words(content: bytes, told: str, tmp_path: Path) -> None:
    pytest.importorskip("asammdf")
    path = tmp_path / "a.mf4"
    path.write_bytes(content)
    with pytest.raises(UnreadableRecording) as refused:
        list(mf4.frames(path, Account()))
    assert told in str(refused.value) and "mmap" not in str(refused.value) and "magic" not in str(refused.value)


@pytest.mark.parametrize("undone", [1, 4, 5, 60])  # what the logger left: counters, the last length, both, more
def test_an_unfinished_mdf_file_leaves_no_copy_and_prints_nothing(
    undone: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """asammdf completes a copy beside other temporary files, and leaves it there where it fails."""
    pytest.importorskip("asammdf")
    path, folder = tmp_path / "a.mf4", tmp_path / "temporary"
    write_can(path)
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    content = bytearray(path.read_bytes())
    content[:8], content[60:62] = b"UnFinMF ", undone.to_bytes(2, "little")
    path.write_bytes(content)
    try:
        list(mf4.frames(path, Account()))
    except UnreadableRecording as error:
        assert "cannot be read" in str(error)
    assert path.read_bytes() == content
    assert list(folder.iterdir()) == []
    assert capfd.readouterr() == ("", "")
