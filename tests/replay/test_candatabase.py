"""CAN databases that describe more than a bus holds, or are too large to be read."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from cantools.database import Message

from sprung.replay import candatabase
from sprung.replay.account import UnreadableRecording
from sprung.replay.candatabase import MOST_MESSAGE_BYTES, load_database

DBC = 'VERSION ""\n\nBO_ 1 M: {length} A\n SG_ X{between}: 0|{bits}@1+ (1,0) [0|1] "" A\n'
KCD = (
    '<NetworkDefinition xmlns="http://kayak.2codeornot2code.org/1.0"><Document name="a"/><Bus name="b">'
    '<Message id="0x1" length="8" name="M"><Signal name="X" offset="0" length="{bits}"/></Message></Bus>'
    "</NetworkDefinition>"
)


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("between", [" ", "\n  ", " \t"], ids=["space", "line", "tab"])
def test_a_signal_of_a_billion_bits_is_refused_undrawn(tmp_path: Path, between: str) -> None:
    text = DBC.format(length=8, between=between, bits=10**9)
    with pytest.raises(UnreadableRecording, match="signal X: 1000000000 bits from bit 0 on, which no frame holds"):
        load_database(written(tmp_path, "a.dbc", text))


def test_so_is_that_of_another_format(tmp_path: Path) -> None:
    with pytest.raises(UnreadableRecording, match="signal X: 1000000000 bits"):
        load_database(written(tmp_path, "a.kcd", KCD.format(bits=10**9)))


def test_a_message_of_gigabytes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnreadableRecording, match="message M of 4000000000 bytes"):
        load_database(written(tmp_path, "a.dbc", DBC.format(length=4 * 10**9, between=" ", bits=8)))


def test_others_who_use_the_reader_of_databases_are_not_bounded() -> None:
    """A process that imports Sprung still makes what messages it wants."""
    assert Message(1, "M", MOST_MESSAGE_BYTES + 1, []).length == MOST_MESSAGE_BYTES + 1


@pytest.mark.parametrize("length", [8, 1785, 4095], ids=["a frame", "SAE J1939", "ISO 15765"])
def test_messages_in_several_frames_are_read(tmp_path: Path, length: int) -> None:
    found = load_database(written(tmp_path, "a.dbc", DBC.format(length=length, between=" ", bits=8)))
    assert [message.length for message in found.messages] == [length]


@pytest.mark.parametrize("name", ["a.dbc", "a.sym", "a.kcd", "a.ARXML", "a"])
def test_what_is_larger_than_any_database_is_refused_unread(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(candatabase, "MOST_TEXT_BYTES", 100)
    monkeypatch.setattr(candatabase, "MOST_XML_BYTES", 200)
    monkeypatch.setattr("cantools.database.load_file", None)
    with pytest.raises(UnreadableRecording, match="are read as a CAN database"):
        load_database(written(tmp_path, name, "x" * 201))


def test_what_is_no_file_is_refused_rather_than_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.dbc")
    for path in (tmp_path / "pipe.dbc", tmp_path):
        with pytest.raises(UnreadableRecording, match="no file"):
            load_database(path)
