"""CAN decoding in blocks gives what cantools gives frame by frame, and counts every frame."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from cantools.database.can import Database, Message, Signal
from cantools.database.conversion import BaseConversion
from numpy.typing import ArrayLike

from sprung.model.signals import Channel
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.candatabase import load_database
from sprung.replay.candecode import CanDecoder
from sprung.replay.frames import EXTENDED, FrameBlock, id_text, raw_bits

START = 1_790_000_000_000_000_000


def conversion(scale: float = 1, offset: float = 0, is_float: bool = False, choices: Any = None) -> BaseConversion:
    return BaseConversion.factory(scale=scale, offset=offset, is_float=is_float, choices=choices)


def block(payloads: Sequence[bytes], frame_id: ArrayLike, width: int = 8) -> FrameBlock:
    """Frames 1 ms apart."""
    n = len(payloads)
    data = np.zeros((n, width), dtype=np.uint8)
    for row, payload in enumerate(payloads):
        data[row, : len(payload)] = list(payload)
    ids = np.broadcast_to(np.asarray(frame_id, dtype=np.uint32), n).copy()
    length = np.array([len(payload) for payload in payloads], dtype=np.uint8)
    return FrameBlock(START + np.arange(n) * 1_000_000, ids, length, data)


def channels_of(*messages: Message) -> list[Channel]:
    return [Channel(f"{m.name}.{s.name}", "1", 1.0, can=f"{m.name}.{s.name}") for m in messages for s in m.signals]


def random_signal(rng: np.random.Generator, name: str, size: int) -> Signal:
    """A signal anywhere in `size` bytes: either byte order, signed, unsigned or float, scaled."""
    is_float = rng.random() < 0.2
    length = int(rng.choice([16, 32, 64])) if is_float else int(rng.integers(1, 65))
    big = bool(rng.random() < 0.5)
    first = int(rng.integers(0, 8 * size - length + 1))  # distance from the first bit on the wire
    start = 8 * (first // 8) + 7 - first % 8 if big else first
    scale, offset = (1, 0) if rng.random() < 0.3 else (float(rng.choice([0.5, 0.01, 3e-4, -2.0])), float(rng.normal()))
    return Signal(
        name,
        start,
        length,
        byte_order="big_endian" if big else "little_endian",
        is_signed=bool(rng.random() < 0.5) and not is_float,
        conversion=conversion(scale, offset, is_float),
        minimum=-1e300,
        maximum=1e300,
    )


@pytest.mark.parametrize("seed", range(12))
def test_random_layouts_decode_as_cantools_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = int(rng.choice([8, 8, 3, 12, 24, 64]))
    extended = bool(rng.random() < 0.5)
    signals: list[Signal] = []
    taken: set[tuple[int, int]] = set()
    for index in range(200):
        signal = random_signal(rng, f"S{index}", max(size, 8))
        if last_bit(signal) < 8 * size and not taken & bits_of(signal):
            signals.append(signal)
            taken |= bits_of(signal)
    message = Message(0x123, "M", size, signals, is_extended_frame=extended, is_fd=size > 8)
    payloads = [rng.bytes(size) for _ in range(50)]
    width = 8 if size <= 8 else 64
    account = Account()
    samples = CanDecoder(channels_of(message), Database([message])).decode(
        block(payloads, 0x123 | (EXTENDED if extended else 0), width), account
    )
    assert account.tally.used == 50
    values = samples.value.reshape(50, len(signals))
    for row, payload in enumerate(payloads):
        expected = message.decode(payload, decode_choices=False)
        for column, name in enumerate(s.name for s in message.signals):
            truth = float(expected[name])  # type: ignore[call-overload,arg-type]
            if not np.isfinite(truth) or abs(truth) > 1e300:
                assert np.isnan(values[row, column])
            else:
                assert values[row, column] == pytest.approx(truth, rel=1e-12, abs=1e-12), (name, payload)


def last_bit(signal: Signal) -> int:
    if signal.byte_order == "big_endian":
        return 8 * (signal.start // 8) + 7 - signal.start % 8 + signal.length - 1
    return signal.start + signal.length - 1


def bits_of(signal: Signal) -> set[tuple[int, int]]:
    """(byte, bit) of every bit of the signal."""
    if signal.byte_order == "big_endian":
        return {
            (place // 8, 7 - place % 8) for place in range(last_bit(signal) + 1 - signal.length, last_bit(signal) + 1)
        }
    return {(place // 8, place % 8) for place in range(signal.start, signal.start + signal.length)}


def test_every_single_bit_of_a_long_frame_is_found_in_both_byte_orders() -> None:
    for bit in range(512):
        data = np.zeros((1, 64), dtype=np.uint8)
        data[0, bit // 8] = 1 << (bit % 8)
        assert raw_bits(data, bit, 1, big_endian=False)[0] == 1
        assert raw_bits(data, bit, 1, big_endian=True)[0] == 1
        assert raw_bits(data ^ np.uint8(0xFF), bit, 1, big_endian=True)[0] == 0


def multiplexed() -> Message:
    """Two values that share their bits, chosen by `mode`, whose second case is itself multiplexed."""
    return Message(
        0x200,
        "Mux",
        8,
        [
            Signal("mode", 0, 4, is_multiplexer=True),
            Signal("a", 8, 16, multiplexer_ids=[0], multiplexer_signal="mode", minimum=0, maximum=70000),
            Signal("page", 8, 8, multiplexer_ids=[1, 2], multiplexer_signal="mode", is_multiplexer=True),
            Signal("b", 16, 8, multiplexer_ids=[3], multiplexer_signal="page", minimum=0, maximum=255),
        ],
    )


def test_multiplexed_signals_are_taken_only_from_frames_that_select_them() -> None:
    message = multiplexed()
    channels = [Channel("a", "1", 1.0, can="Mux.a"), Channel("b", "1", 1.0, can="Mux.b")]
    payloads = [bytes([0, 7, 1, 0, 0, 0, 0, 0]), bytes([1, 3, 9, 0, 0, 0, 0, 0]), bytes([2, 4, 9, 0, 0, 0, 0, 0])]
    account = Account()
    samples = CanDecoder(channels, Database([message])).decode(block(payloads, 0x200), account)
    assert samples.channel.tolist() == [0, 1]
    assert samples.value.tolist() == [263.0, 9.0]
    assert account.tally.as_dict() == {"used": 2, "repaired": 0, "dropped": 0, "corrupt": 0, "foreign": 1}
    assert account.tally.reasons["other multiplexer value"] == 1


def test_other_ids_are_foreign_also_when_only_the_frame_format_differs() -> None:
    message = Message(0x123, "M", 8, [Signal("s", 0, 16, minimum=0, maximum=65535)])
    frames = block([bytes(8)] * 4, [0x123, 0x124, 0x123 | EXTENDED, 0x123])
    account = Account()
    samples = CanDecoder(channels_of(message), Database([message])).decode(frames, account)
    assert len(samples.value) == 2
    assert (account.tally.used, account.tally.foreign) == (2, 2)
    assert account.contents == {"0x123": 2, "0x124": 1, id_text(0x123 | EXTENDED): 1}


def test_frames_too_short_for_their_signals_are_corrupt() -> None:
    message = Message(0x123, "M", 8, [Signal("s", 16, 16, minimum=0, maximum=65535)])
    account = Account()
    samples = CanDecoder(channels_of(message), Database([message])).decode(
        block([bytes(8), bytes(3), bytes(4), b""], 0x123), account
    )
    assert len(samples.value) == 2
    assert account.tally.corrupt == 2
    assert account.incomplete


@pytest.mark.parametrize(
    ("signal", "raw", "valid"),
    [
        (Signal("s", 0, 16, conversion=conversion(0.1), minimum=0, maximum=6000), 60001, False),
        (Signal("s", 0, 16, conversion=conversion(0.1), minimum=0, maximum=6000), 60000, True),
        (Signal("s", 0, 16, conversion=conversion(0.1), minimum=0, maximum=6553.5), 65535, True),
        (Signal("s", 0, 16, conversion=conversion(choices={65533: "Unknown"}), minimum=0, maximum=65533), 65533, False),
        (Signal("s", 0, 16, conversion=conversion(choices={7: "Sensor_Fault"})), 7, False),
        (Signal("s", 0, 16, conversion=conversion(choices={7: "No_Fault"})), 7, True),
        (Signal("s", 0, 16, conversion=conversion(choices={7: "Default"})), 7, True),
        (Signal("s", 0, 16, conversion=conversion(choices={7: "SNA"})), 7, False),
        (Signal("s", 0, 16, is_signed=True, conversion=conversion(choices={-1: "Not available"})), 0xFFFF, False),
        (Signal("s", 0, 16), 0xFFFF, False),  # no range: all ones mean "not available"
        (Signal("s", 0, 4), 0xF, True),  # too narrow to tell
        (Signal("s", 0, 16, is_signed=True), 0xFFFF, True),  # -1
        (Signal("s", 0, 16, minimum=0, maximum=0), 0xFFFE, True),  # 0|0 is no range
    ],
)
def test_sentinels_and_values_out_of_range_are_missing(signal: Signal, raw: int, valid: bool) -> None:
    message = Message(0x123, "M", 8, [signal])
    account = Account()
    samples = CanDecoder(channels_of(message), Database([message])).decode(
        block([raw.to_bytes(8, "little")], 0x123), account
    )
    assert np.isfinite(samples.value[0]) == valid
    assert account.tally.as_dict()["used" if valid else "dropped"] == 1
    assert sum(account.values.values()) == (0 if valid else 1)


def test_samples_keep_the_order_of_the_frames() -> None:
    first = Message(
        0x10, "A", 8, [Signal("x", 0, 8, minimum=0, maximum=255), Signal("y", 8, 8, minimum=0, maximum=255)]
    )
    second = Message(0x20, "B", 8, [Signal("z", 0, 8, minimum=0, maximum=255)])
    frames = block([bytes([i, i, 0, 0, 0, 0, 0, 0]) for i in range(6)], [0x20, 0x10, 0x10, 0x20, 0x10, 0x20])
    samples = CanDecoder(channels_of(first, second), Database([first, second])).decode(frames, Account())
    assert samples.value.tolist() == [0, 1, 1, 2, 2, 3, 4, 4, 5]
    assert np.all(np.diff(samples.time) >= 0)


def test_wrong_names_and_databases_are_one_clear_line(tmp_path: Path) -> None:
    message = Message(0x10, "CarAcceleration", 8, [Signal("FrontLeft", 0, 8)])
    database = Database([message])
    with pytest.raises(UnreadableRecording, match=r"no message 'CarAccel'; its nearest messages: CarAcceleration"):
        CanDecoder([Channel("a", "1", 1.0, can="CarAccel.FrontLeft")], database)
    with pytest.raises(UnreadableRecording, match=r"no signal 'FrontLef'; its nearest signals: FrontLeft"):
        CanDecoder([Channel("a", "1", 1.0, can="CarAcceleration.FrontLef")], database)
    with pytest.raises(UnreadableRecording, match="names no CAN signal"):
        CanDecoder([Channel("a", "1", 1.0)], database)
    with pytest.raises(UnreadableRecording, match="no such CAN database"):
        load_database(tmp_path / "none.dbc")
    broken = tmp_path / "broken.dbc"
    broken.write_text("BO_ nonsense")
    with pytest.raises(UnreadableRecording, match="not a CAN database") as error:
        load_database(broken)
    assert "\n" not in str(error.value)


def test_a_database_file_gives_the_same_as_its_objects(tmp_path: Path) -> None:
    message = Message(0x18FF1234, "Ext", 8, [Signal("s", 7, 16, "big_endian", is_signed=True)], is_extended_frame=True)
    path = tmp_path / "ext.dbc"
    path.write_text(Database([message]).as_dbc_string())
    loaded = cantools.database.load_file(path)
    assert isinstance(loaded, Database) and loaded.messages[0].is_extended_frame
    account = Account()
    frames = block([b"\xff\xfe\0\0\0\0\0\0"], 0x18FF1234 | EXTENDED)
    samples = CanDecoder(channels_of(message), path).decode(frames, account)
    assert samples.value.tolist() == [-2.0]


LINE = ' SG_ Speed : 0|16@1+ (1,0) [0|65000] "" Vector__XXX'


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (LINE.replace("0|16@", "0|65@"), "65 bits from bit 0 on"),
        (LINE.replace("0|16@", "0|99999@"), "99999 bits from bit 0 on"),
        (LINE.replace("0|16@", "999999999|8@"), "8 bits from bit 999999999 on"),
        (LINE.replace("(1,0)", "(0,0)"), "a scale of 0"),
        (LINE.replace("(1,0)", "(1e999,0)"), "a scale of inf"),
        (LINE.replace("(1,0)", "(1,1e999)"), "an offset of inf"),
        (LINE.replace("(1,0)", f"({'9' * 400},0)"), "a scale of inf"),
    ],
)
def test_signals_that_no_frame_can_hold_are_refused_in_one_line(line: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "a.dbc"
    path.write_text(f'VERSION ""\n\nBU_:\n\nBO_ 291 Train: 8 Vector__XXX\n{line}\n')
    with pytest.raises(UnreadableRecording) as refused:
        CanDecoder([Channel("speed", "m/s", 0.1, can="Train.Speed")], path)
    assert told in str(refused.value) and "\n" not in str(refused.value)


def test_multiplexers_in_a_circle_are_refused(tmp_path: Path) -> None:
    first, second = (
        Signal(name, 8 * place, 8, is_multiplexer=True, multiplexer_ids=[1], multiplexer_signal=other)
        for place, (name, other) in enumerate((("A", "B"), ("B", "A")))
    )
    database = Database([Message(0x123, "Train", 8, [Signal("C", 16, 8), first, second], strict=False)], strict=False)
    with pytest.raises(UnreadableRecording, match="is multiplexed by itself"):
        CanDecoder([Channel("speed", "m/s", 0.1, can="Train.A")], database)
