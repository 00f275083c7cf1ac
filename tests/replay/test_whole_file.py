"""Files on a disk that fills up, and in places that take no other file."""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from sprung.replay.whole_file import written_whole
from sprung.service.cli import main


@pytest.fixture
def full_disk() -> Iterator[None]:
    """No file grows beyond a few kilobytes."""
    usual, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, usual[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, usual)
    signal.signal(signal.SIGXFSZ, handler)


def test_a_file_stands_in_its_place_once_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "history.csv"
    path.write_text("old")
    path.chmod(0o640)
    with written_whole(path) as part:
        part.write_text("new")
        assert part.name == path.name  # formats and names of models follow it
        assert path.read_text() == "old"
    assert path.read_text() == "new" and path.stat().st_mode & 0o777 == 0o640
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize("before", [None, "good"])
@pytest.mark.usefixtures("full_disk")
def test_what_a_full_disk_cuts_off_leaves_what_was_there(before: str | None, tmp_path: Path) -> None:
    path = tmp_path / "history.csv"
    if before is not None:
        path.write_text(before)
    left = "nothing is left" if before is None else "what was there is as before"
    told = rf"cannot be written whole \(File too large\); {left}"
    with pytest.raises(OSError, match=told) as full, written_whole(path) as part:
        part.write_bytes(b"1,2\n" * 10_000)
    assert full.value.filename == str(path)
    assert (path.read_text() if path.exists() else None) == before
    assert os.listdir(tmp_path) == ([] if before is None else [path.name])


def test_what_is_interrupted_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "ride.csv"
    path.write_text("good")
    with pytest.raises(KeyboardInterrupt), written_whole(path) as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "good" and os.listdir(tmp_path) == [path.name]


def test_links_stay_links_and_pipes_are_written_to(tmp_path: Path) -> None:
    target, link = tmp_path / "target.csv", tmp_path / "link.csv"
    target.write_text("old")
    link.symlink_to(target)
    with written_whole(link) as part:
        part.write_text("new")
    assert link.is_symlink() and target.read_text() == "new"
    with written_whole(Path(os.devnull)) as part:
        assert part == Path(os.devnull)


@pytest.mark.parametrize("suffix", [".yaml", ".mo", ".npz"])
@pytest.mark.usefixtures("full_disk")
def test_an_export_that_cannot_be_written_is_named_and_loses_nothing(
    suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"vehicle{suffix}"
    path.write_text("good")
    assert main(["system", "--export", str(path)]) == 2
    told = capsys.readouterr().err
    assert f"{path}: cannot be written whole (File too large); what was there is as before" in told
    assert path.read_text() == "good"
