"""One recording, written by other people's writers in every format, reads the same through every reader."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from cantools.database.can import Database, Message, Signal
from mcap.writer import CompressionType, Writer

from sprung.model.signals import Channel
from sprung.replay import UnreadableRecording, open_recording
from sprung.replay.windowing import Windower
from tests.replay_files import (
    CHANNELS,
    LEFT,
    NUMBERS,
    ROWS,
    START,
    STEP,
    TIMES,
    VALUES,
    database,
    read,
    write_can,
    write_csv,
    write_json,
    write_protobuf,
    write_ros2,
)


@pytest.fixture
def dbc(tmp_path: Path) -> Path:
    path = tmp_path / "body.dbc"
    path.write_text(database().as_dbc_string())
    return path


WRITERS = {
    "json.mcap": write_json,
    "protobuf.mcap": write_protobuf,
    "ros2.mcap": write_ros2,
    "can.blf": write_can,
    "can.asc": write_can,
    "can.log": write_can,
    "can.mf4": write_can,
    "table.csv": write_csv,
}
FOREIGN = {"json.mcap": 30, "can.blf": 90, "can.asc": 90, "can.log": 90, "can.mf4": 60}  # MF4 holds no remote frames


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_every_reader_gives_every_sample_and_counts_every_message(name: str, tmp_path: Path, dbc: Path) -> None:
    if name.endswith("mf4"):
        pytest.importorskip("asammdf")
    path = tmp_path / name
    WRITERS[name](path)
    recording, samples = read(path, dbc)
    start = 0 if name.endswith("csv") else START
    for index in range(2):
        times, values = samples[index]
        tolerance = 2_000 if "can" in name else 0  # python-can writes float seconds
        assert np.abs(times - (start + NUMBERS * STEP)).max() <= tolerance
        assert np.abs(values - VALUES[:, index]).max() < (1e-6 if name == "ros2.mcap" else 1e-12)
    tally = recording.tally
    assert tally.as_dict() == {
        "used": ROWS,
        "repaired": 0,
        "dropped": 0,
        "corrupt": 0,
        "foreign": FOREIGN.get(name, 0),
    }
    assert sum(tally.reasons.values()) == tally.foreign
    assert recording.problems == []
    assert not recording.incomplete
    assert recording.vehicle == ("tram-7" if name == "json.mcap" else None)


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
@pytest.mark.parametrize("chunked", [True, False])
def test_mcap_of_every_compression_reads_the_same(compression: CompressionType, chunked: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_json(path, compression=compression, chunked=chunked)
    recording, samples = read(path)
    assert np.array_equal(samples[0][1], LEFT)
    assert (recording.tally.used, recording.tally.foreign) == (ROWS, 30)


def test_the_time_of_mcap_messages_can_be_chosen_by_channel(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_ros2(path)
    assert np.array_equal(read(path)[1][0][0], TIMES)
    assert np.array_equal(read(path, time_source="log")[1][0][0], TIMES + 7_000_000)
    _, samples = read(path, time_source={"right": "publish"})
    assert np.array_equal(samples[0][0], TIMES)
    assert np.array_equal(samples[1][0], TIMES + 7_000_000)
    write_json(path)
    assert np.array_equal(read(path)[1][0][0], TIMES)
    assert np.array_equal(read(path, time_source="log")[1][0][0], TIMES + 3_000_000)
    with pytest.raises(UnreadableRecording, match="time source 'clock' is not known"):
        read(path, time_source="clock")


def test_a_ros2_definition_that_cannot_be_read_is_one_line_of_ours(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("test_msgs/msg/Body", "ros2msg", b"float64 left\nflo@t64 ri-ght what\n")
        channel = writer.register_channel("/body/acceleration", "cdr", schema)
        for time in TIMES.tolist():
            writer.add_message(channel, time, bytes(20), time)
        writer.finish()
    with pytest.raises(UnreadableRecording, match="schema of topic /body/acceleration cannot be read: 'flo@t64' is"):
        read(path)
    assert capfd.readouterr() == ("", "")


def test_an_empty_header_stamp_gives_way_to_the_publish_time(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_ros2(path, stamped=False)
    assert np.array_equal(read(path)[1][0][0], TIMES)


def test_header_stamps_are_even_where_messages_were_logged_in_bursts(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_ros2(path, bursts=30)
    outcomes = {}
    for source in ("auto", "log"):
        recording = open_recording(path, CHANNELS, time_source=source)
        windower = Windower(CHANNELS, 100.0, 100, 50)
        outcomes[source] = {w.outcome for b in recording.blocks() for w in windower.push(b)}
    assert outcomes["auto"] == {"used"}
    assert "used" not in outcomes["log"]


def test_json_values_that_are_no_numbers_are_missing(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    odd = [
        '{"left": null}',
        '{"left": "1.5"}',
        '{"left": true}',
        "{}",
        '{"left": NaN}',
        "[1]",
        '{"left": 2}',
        "{broken",
    ]
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        body = writer.register_channel("/body/acceleration", "json", 0)
        for row, text in enumerate(odd):
            writer.add_message(body, int(TIMES[row]), text.encode(), int(TIMES[row]), row)
        writer.finish()
    recording, samples = read(path, channels=CHANNELS[:1])
    assert np.isnan(samples[0][1]).tolist() == [True] * 6 + [False]
    assert recording.tally.as_dict() == {"used": 1, "repaired": 0, "dropped": 6, "corrupt": 1, "foreign": 0}
    assert recording.incomplete


def test_csv_cells_that_are_empty_are_missing_and_rows_that_are_broken_are_corrupt(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time;left;right\n0.00;1;\n0.01;;\n0.02;NaN;4\nx;1;2\n0.03;1\n0.04;5;6\n;7;8\n")
    recording, samples = read(path)
    assert samples[0][0].tolist() == [0, 10_000_000, 20_000_000, 40_000_000]
    assert np.array_equal(samples[0][1], [1, np.nan, np.nan, 5], equal_nan=True)
    assert recording.tally.as_dict() == {"used": 3, "repaired": 0, "dropped": 1, "corrupt": 3, "foreign": 0}


def test_asc_in_decimal_with_relative_stamps_and_fd_frames(tmp_path: Path) -> None:
    path = tmp_path / "a.asc"
    message = Message(784, "Body", 16, [Signal("Left", 64, 8, minimum=0, maximum=255)], is_fd=True)
    dbc = tmp_path / "fd.dbc"
    dbc.write_text(Database([message]).as_dbc_string())
    data = " ".join(str(i) for i in range(16))
    path.write_text(
        "date Mon Sep 21 02:13:20.500 pm 2026\nbase dec  timestamps relative\ninternal events logged\n"
        f"   0.100000 CANFD   1 Rx        784  Body   1 0 10 16 {data} 0 0\n"
        f"   0.100000 CANFD   1 Rx        784   1 0 10 16 {data} 0 0\n"
        "   0.050000 1  784             Rx   d 2 1 2\n"
        "   0.050000 1  Statistic: D 0 R 0\n"
        "   0.050000 1  ErrorFrame\n"
    )
    recording, samples = read(path, dbc, CHANNELS[:1])
    times, values = samples[0]
    assert values.tolist() == [8.0, 8.0]
    assert np.diff(times).tolist() == [100_000_000]
    assert recording.tally.as_dict() == {"used": 2, "repaired": 0, "dropped": 0, "corrupt": 1, "foreign": 1}


def test_candump_fd_and_extended_frames(tmp_path: Path, dbc: Path) -> None:
    path = tmp_path / "a.log"
    path.write_text(
        "(1790000000.000001) vcan0 310#0100000200000000\n(1790000000.010001) vcan0 00000310#0100000200000000 R\n"
        "(1790000000.020001) vcan0 310##1" + "01" * 12 + "\n(1790000000.030001) vcan0 310#R8\n"
        "(1790000000.040001) vcan0 20000004#0000\n"
    )
    recording, samples = read(path, dbc)
    assert samples[0][0].tolist() == [START + 1_000, START + 20_001_000]
    assert samples[0][1].tolist() == [0.001, 0.257]
    assert recording.tally.as_dict() == {"used": 2, "repaired": 0, "dropped": 0, "corrupt": 0, "foreign": 3}


def test_wrong_use_is_one_clear_line(tmp_path: Path, dbc: Path) -> None:
    def complaint(path: Path, database: Path | None = None, channels: Sequence[Channel] = CHANNELS) -> str:
        with pytest.raises(UnreadableRecording) as error:
            read(path, database, channels)
        assert "\n" not in str(error.value)
        return str(error.value)

    assert "no such file" in complaint(tmp_path / "none.mcap")
    (tmp_path / "a.xyz").write_bytes(b"1")
    assert "known are .mcap .blf .asc .log .mf4 .csv .tsv .txt .dat .parquet" in complaint(tmp_path / "a.xyz")
    for name in ("a.mcap", "a.blf", "a.asc", "a.log", "a.csv"):
        (tmp_path / name).write_bytes(b"\x00\xff\x13 some other file \x80\n" * 50)
        assert complaint(tmp_path / name, dbc).startswith(str(tmp_path / name))
        (tmp_path / name).write_bytes(b"")
        assert complaint(tmp_path / name, dbc).startswith(str(tmp_path / name))
    write_can(tmp_path / "b.blf")
    assert "needs a CAN database" in complaint(tmp_path / "b.blf")
    write_csv(tmp_path / "b.csv")
    typo = [Channel("left", "m", 1.0, csv="lefd")]
    assert "'lefd' (did you mean 'left'?)" in complaint(tmp_path / "b.csv", channels=typo)
    (tmp_path / "c.csv").write_text("when,left\n0,1\n1,2\n")
    assert "no column of times is recognised" in complaint(tmp_path / "c.csv")
    for path in (tmp_path / "b.csv", tmp_path / "b.blf"):
        assert "names no" in complaint(path, dbc, [Channel("x", "m", 1.0, mcap="/a.b")])


def test_a_recording_without_any_of_the_channels_says_what_it_holds(tmp_path: Path) -> None:
    write_json(tmp_path / "a.mcap")
    with pytest.raises(UnreadableRecording, match=r"it holds /body/acceleration \(300\), /door/state \(30\)"):
        read(tmp_path / "a.mcap", channels=[Channel("x", "m", 1.0, mcap="/car/acceleration.left")])
    other = tmp_path / "other.dbc"
    other.write_text(Database([Message(0x99, "Other", 8, [Signal("s", 0, 8)])]).as_dbc_string())
    write_can(tmp_path / "a.blf")
    with pytest.raises(UnreadableRecording, match=r"it holds 0x310 \(300\), 0x311 \(30\), 0x00000310 \(30\)"):
        read(tmp_path / "a.blf", other, [Channel("x", "m", 1.0, can="Other.s")])


def test_channels_that_never_come_are_named(tmp_path: Path) -> None:
    write_json(tmp_path / "a.mcap")
    lacking = Channel("roof", "m", 1.0, mcap="/body/acceleration.leftt")
    recording, _ = read(tmp_path / "a.mcap", channels=[CHANNELS[0], lacking])
    assert recording.seen.tolist() == [True, False]
    assert any("no field 'leftt'; nearest: left" in line for line in recording.problems)
    assert any(line == "no values of roof" for line in recording.problems)
    assert not recording.incomplete


@pytest.mark.parametrize("chunk", [2048, 1 << 20])
def test_an_mcap_file_written_topic_by_topic_is_put_in_time_order(chunk: int, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk)
        writer.start()
        for side in ("left", "right"):
            topic = writer.register_channel(f"/{side}", "json", 0)
            for row in range(ROWS):
                writer.add_message(topic, int(TIMES[row]), f'{{"x": {row}}}'.encode(), int(TIMES[row]), row)
        writer.finish()
    channels = [Channel(side, "m", 1.0, mcap=f"/{side}.x") for side in ("left", "right")]
    times = np.concatenate([block.time for block in open_recording(path, channels).blocks()])
    assert np.array_equal(times, np.repeat(TIMES, 2))
