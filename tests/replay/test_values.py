"""One bad value, message, line or time stamp costs itself, never the recording."""

import json
import struct
import time
from collections.abc import Sequence
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from numpy.typing import ArrayLike

from sprung.model.signals import Channel, SampleBlock
from sprung.replay.account import KEPT_PROBLEMS, Account, UnreadableRecording
from sprung.replay.blf import frames as blf_frames
from sprung.replay.convert import converter
from sprung.replay.plausibility import EARLIEST, LATEST, OUT_OF_RANGE, OUT_OF_TIME, PlausibilityCheck, nanoseconds
from sprung.replay.textframes import decimal_ns, frame_id
from tests.replay_files import LEFT, RIGHT, ROWS, TIMES, VALUES, database, frame, read, write_can

BAD_ROW = 100
GOOD = np.arange(ROWS) != BAD_ROW


@pytest.fixture(scope="module")
def dbc(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dbc") / "body.dbc"
    path.write_text(database().as_dbc_string())
    return path


def write_mcap(path: Path, bad: bytes | Sequence[bytes], publish: int | None = None) -> None:
    """The usual recording with one message of its own in row BAD_ROW, or several from there on."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4096)
        writer.start()
        schema = writer.register_schema("Body", "jsonschema", b'{"type": "object"}')
        body = writer.register_channel("/body/acceleration", "json", schema)
        for row in range(ROWS):
            data = json.dumps({"left": LEFT[row], "axes": [{}, {"right": RIGHT[row]}]}).encode()
            damaged = (bad,) if isinstance(bad, bytes) else bad
            here = BAD_ROW <= row < BAD_ROW + len(damaged)
            data, time = (damaged[row - BAD_ROW], publish or int(TIMES[row])) if here else (data, int(TIMES[row]))
            writer.add_message(body, int(TIMES[row]), data, time, row)
        writer.finish()


NUMBERS = ["1e30", "1e300", "1e999", "-1e999", "Infinity", "NaN", "1" * 400, "1" * 5000, "-9999", "32767", "-1e4"]


@pytest.mark.parametrize("number", NUMBERS)
def test_a_number_that_no_sensor_gives_is_missing(number: str, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_mcap(path, f'{{"left": {number}, "axes": [{{}}, {{"right": 0.5}}]}}'.encode())
    recording, samples = read(path)
    assert np.array_equal(
        samples[0][1][GOOD[: len(samples[0][1])]] if len(samples[0][1]) == ROWS else samples[0][1], VALUES[GOOD, 0]
    )
    missing = sum(recording.account.values.values()) + recording.tally.corrupt
    assert missing == 1
    if number != "NaN":
        assert "left: 1 of its values taken as missing" in recording.problems[-1]


@pytest.mark.parametrize(
    "message",
    [
        b"[" * 100_000,
        b'{"left":' * 2_000 + b"1" + b"}" * 2_000,
        b"",
        b"null",
        b"[]",
        b'"left"',
        b'{"left": {"left": 1}}',
        b'{"left": "1"}',
        b'{"left": true}',
        b"\xff\xfe",
        b'{"left": 1',
        b'{"left": 1}, {"left": 2}',
        b'{"left": 1, "left": 2}',
        b'{"left": 1, "axes": [{}, {"right": 1, "right": 2}]}',
        b'{"left" : 1, "note": ":", "left": 2}',
        b'{"left"\n:1,"left":2}',
    ],
)
def test_a_message_that_is_none_costs_itself(message: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_mcap(path, message)
    recording, samples = read(path)
    for index in (0, 1):
        time, value = samples[index]
        kept = ~np.isnan(value)
        assert np.array_equal(time[kept], TIMES[GOOD])
        assert np.array_equal(value[kept], VALUES[GOOD, index])
    assert recording.tally.used == ROWS - 1
    assert recording.tally.corrupt + recording.tally.dropped == 1
    assert not any("Error" in line for line in recording.problems)


@pytest.mark.parametrize(
    "damaged",
    [
        (b'{"left": 1', b'"axes": []}', b'{"left": 5}, {"left": 6}'),
        (b'{"left": 5}, {"left": 6}', b'{"left": 1', b'"axes": []}'),
        (b'{"left": 1, "axes": [{}', b'{"right": 7}]}', b'{"left": 5}, {"left": 6}'),
    ],
)
def test_parts_of_damaged_messages_never_make_up_one(damaged: tuple[bytes, ...], tmp_path: Path) -> None:
    """As many as there are messages, and in the place of others."""
    write_mcap(tmp_path / "a.mcap", damaged)
    recording, samples = read(tmp_path / "a.mcap")
    whole = (np.arange(ROWS) < BAD_ROW) | (np.arange(ROWS) >= BAD_ROW + 3)
    assert np.array_equal(samples[0][0], TIMES[whole]) and np.array_equal(samples[0][1], VALUES[whole, 0])
    assert recording.tally.corrupt == 3


def test_a_definition_without_end_is_refused_before_it_is_parsed(tmp_path: Path) -> None:
    """It took the square of its fields: two minutes for a file of 100 kB."""
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        text = "\n".join(f"float64 f{i}" for i in range(100_000))
        schema = writer.register_schema("pkg/msg/Body", "ros2msg", text.encode())
        body = writer.register_channel("/body/acceleration", "cdr", schema)
        for row in range(20):
            writer.add_message(body, int(TIMES[row]), bytes(64), int(TIMES[row]), row)
        writer.finish()
    begun = time.process_time()
    with pytest.raises(UnreadableRecording, match="has more than 10000 lines"):
        read(tmp_path / "a.mcap")
    assert time.process_time() - begun < 5.0


def test_a_message_of_another_era_is_left_out_and_reported(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_mcap(path, b'{"left": 0.5}', publish=(1 << 64) - 1)
    recording, samples = read(path)
    assert np.array_equal(samples[0][0], TIMES[GOOD])
    assert recording.account.values[OUT_OF_TIME] == 2
    assert recording.incomplete
    assert "time stamps" in recording.problems[-1]


LINES = [
    b"(99999999999999.000000) can0 310#0000000000000000",
    b"(9300000000.000000) can0 310#0000000000000000",
    b"(1e9) can0 310#0000000000000000",
    b"(1_790_000_000.0) can0 310#0000000000000000",
    "(\u0661\u0662.0) can0 310#0000000000000000".encode(),
    b"(1790000000.000000) can0 123456789ABCDEF#00",
    b"(1790000000.000000) can0 3_0#00",
    b"(1790000000.000000) can0 -10#00",
    b"(1790000000.000000) can0 310#0",
    b"(1790000000.000000) can0 310#" + b"00" * 100,
    b"(1790000000.000000) can0 310#0g",
    b"(" + b"1" * 100_000 + b") can0 310#00",
    b"x" * 3_000_000,
    b"\0" * 5_000,
    b"( ) ( ) ( )",
]


@pytest.mark.parametrize("line", LINES, ids=range(len(LINES)))
def test_a_line_of_a_candump_log_costs_itself(line: bytes, tmp_path: Path, dbc: Path) -> None:
    path = tmp_path / "a.log"
    write_can(path)
    lines = path.read_bytes().splitlines()
    path.write_bytes(b"\n".join([*lines[:50], line, *lines[50:]]) + b"\n")
    recording, samples = read(path, dbc)
    assert recording.tally.used == ROWS
    assert recording.tally.corrupt >= 1
    assert np.allclose(samples[0][1], VALUES[:, 0], atol=1e-9)


ASC = [
    b"   9999999999999.5 1  310             Rx   d 8 00 00 00 00 00 00 00 00",
    b"   9300000000.5 1  310             Rx   d 8 00 00 00 00 00 00 00 00",
    b"   -99999999.5 1  310             Rx   d 8 00 00 00 00 00 00 00 00",
    b"   1.5 1  123456789ABCDEF             Rx   d 8 00 00 00 00 00 00 00 00",
    b"   1.5 1  310             Rx   d 8 00 00",
    b"   1.5 1  310             Rx   d 99999999999999999999999999999 00",
    b"   1.5 1  310             Rx   d 8 00 00 00 00 00 00 00 0g",
    b"   1.5 CANFD   1 Rx        310                                   1 0 8 99 00 00",
    b"   1.5 CANFD",
    b"   1.5",
]


@pytest.mark.parametrize("line", ASC, ids=range(len(ASC)))
def test_a_line_of_an_asc_log_costs_itself(line: bytes, tmp_path: Path, dbc: Path) -> None:
    path = tmp_path / "a.asc"
    write_can(path)
    lines = path.read_bytes().splitlines()
    path.write_bytes(b"\n".join([*lines[:50], line, *lines[50:]]) + b"\n")
    recording, samples = read(path, dbc)
    assert recording.tally.used == ROWS
    assert np.allclose(samples[0][1], VALUES[:, 0], atol=1e-9)


def test_a_blf_file_of_remote_frames_only_holds_no_messages(tmp_path: Path) -> None:
    path = tmp_path / "a.blf"
    with can.BLFWriter(str(path)) as writer:
        for row in range(10):
            stamp = int(TIMES[row]) / 1e9
            writer.on_message_received(can.Message(timestamp=stamp, arbitration_id=1, is_remote_frame=True, dlc=8))
    account = Account()
    assert list(blf_frames(path, account)) == []
    assert account.tally.foreign == 10


def test_blf_objects_that_are_too_short_or_beyond_time_are_counted_and_the_others_read(tmp_path: Path) -> None:
    path = tmp_path / "a.blf"
    with can.BLFWriter(str(path), compression_level=0) as writer:
        for row in range(40):
            writer.on_message_received(frame(row, channel=0))
    data = bytearray(path.read_bytes())
    at = [i for i in range(200, len(data)) if data[i : i + 4] == b"LOBJ"]
    size = struct.unpack_from("<L", data, at[5] + 8)[0]
    struct.pack_into("<L", data, at[5] + 8, 20)  # shorter than its header
    struct.pack_into("<Q", data, at[9] + 24, (1 << 64) - 1)  # time
    account = Account()
    path.write_bytes(data)
    blocks = list(blf_frames(path, account))
    assert size == at[6] - at[5]
    assert sum(len(block.time) for block in blocks) == 38
    assert account.tally.corrupt == 2
    assert account.incomplete


def screened(
    channels: Sequence[Channel], time: ArrayLike, channel: ArrayLike, value: ArrayLike
) -> tuple[SampleBlock, Account]:
    account = Account()
    screen = PlausibilityCheck(channels, account, converter(channels))
    block = screen.check(SampleBlock(np.array(time), np.array(channel, dtype=np.int32), np.array(value)))
    screen.conclude()
    return block, account


def test_a_channel_may_say_what_it_can_measure() -> None:
    channels = [Channel("near", "m/s^2", 0.01, range=(-20.0, 20.0)), Channel("far", "m/s^2", 0.01)]
    block, account = screened(channels, [0, 0, 1, 1], [0, 1, 0, 1], [30.0, 30.0, -20.0, 6e3])
    assert np.array_equal(np.isnan(block.value), [True, False, False, True])
    assert account.values[OUT_OF_RANGE] == 2
    assert "near: 1 of its values" in account.problems[0]


def test_a_range_is_one_of_si_values_and_a_marker_one_of_recorded_numbers() -> None:
    channel = Channel("a", "m/s^2", 0.01, gain=1e-3, range=(-20.0, 20.0))
    ordinary = 1000.0 * np.sin(np.arange(100))
    block, _ = screened([channel], np.arange(102), np.zeros(102), [*ordinary, -9999.0, 25_000.0])
    assert np.isnan(block.value).sum() == 2


def test_a_force_may_have_the_value_of_a_marker() -> None:
    rng = np.random.default_rng(3)
    values = np.rint(9_000 * rng.standard_normal(1000))
    values[500] = 9_999.0
    block, _ = screened([Channel("f", "N", 1.0)], np.arange(1000), np.zeros(1000), values)
    assert not np.isnan(block.value).any()
    calm = np.r_[np.rint(10 * rng.standard_normal(999)), -9_999.0]
    block, account = screened([Channel("f", "N", 1.0)], np.arange(1000), np.zeros(1000), calm)
    assert np.isnan(block.value).sum() == 1
    assert account.values[OUT_OF_RANGE] == 1


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.integers(-(2**63), 2**63 - 1), st.integers(0, 1), st.floats()), max_size=30))
def test_nothing_passes_the_screen_but_plausible_values_at_possible_times(
    samples: list[tuple[int, int, float]],
) -> None:
    channels = [Channel("a", "m/s^2", 0.01), Channel("f", "N", 1.0, gain=-1e3, offset=2.0)]
    time, channel, value = zip(*samples, strict=True) if samples else ((), (), ())
    block, account = screened(channels, np.array(time, dtype=np.int64), channel, np.array(value, dtype=np.float64))
    assert ((block.time >= EARLIEST) & (block.time <= LATEST)).all()
    kept = block.value[~np.isnan(block.value)]
    assert (np.abs(kept) <= 1e8).all()
    assert len(block.time) + account.values[OUT_OF_TIME] == len(samples)
    nan_before = sum(np.isnan(v) for v, t in zip(value, time, strict=True) if EARLIEST <= t <= LATEST)
    assert np.isnan(block.value).sum() == nan_before + account.values[OUT_OF_RANGE]


@settings(max_examples=150, deadline=None)
@given(st.lists(st.floats(), max_size=20))
def test_seconds_become_times_or_none(seconds: list[float]) -> None:
    time, good = nanoseconds(np.array(seconds, dtype=np.float64))
    assert ((time >= EARLIEST) & (time <= LATEST)).all()
    for second, at, fine in zip(seconds, time, good, strict=True):
        assert fine == (-86_400 <= second <= LATEST / 1e9)
        assert not fine or abs(int(at) - second * 1e9) <= 1.0 + abs(second) * 1e9 * 2e-16


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.one_of(st.binary(max_size=25), st.from_regex(rb"\A-?[0-9]{1,14}(\.[0-9]{0,12})?\Z")))
def test_text_is_a_time_or_refused(text: bytes) -> None:
    try:
        time = decimal_ns(text)
    except ValueError:
        return
    assert EARLIEST <= time <= LATEST
    whole, _, fraction = text.decode("ascii").lstrip("-").partition(".")
    assert abs(time) == int(whole) * 10**9 + int(fraction[:9].ljust(9, "0"))


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=12), st.sampled_from([10, 16]), st.booleans())
def test_text_is_an_identifier_or_refused(text: bytes, base: int, extended: bool) -> None:
    try:
        number = frame_id(text, base, extended=extended)
    except ValueError:
        return
    assert number & 0x1FFFFFFF == int(text.decode("ascii"), base)
    assert number >> 31 == extended


def test_countless_problems_are_a_hundred_lines() -> None:
    account = Account()
    for number in range(100_000):
        account.problem(f"chunk {number} is damaged")
    assert len(account.problems) == KEPT_PROBLEMS + 1
    assert account.problems[-1] == f"and {100_000 - KEPT_PROBLEMS} more like these"


def test_names_in_a_file_can_do_nothing_to_a_terminal(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Body", "jsonschema", b"{}")
        channel = writer.register_channel("/evil\n\x1b[31mred" + "x" * 100_000, "json", schema)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(UnreadableRecording) as found:
        read(path)
    assert str(found.value).isprintable()
    assert len(str(found.value)) < 1100
    account = Account()
    account.problem("topic a\r\n\tb\x07 cannot be read")
    assert account.problems == ["topic a b cannot be read"]
