"""Back-up and restoration: what comes back is what was there, and half of one is told as such."""

from __future__ import annotations

import io
import sqlite3
import tarfile
from contextlib import closing
from pathlib import Path

import pytest

from sprung.model.system import System
from sprung.service.access.tokens import Refused, Tokens
from sprung.service.backup import back_up, restore
from sprung.service.cli import main
from sprung.service.errors import UserError
from sprung.service.lock import held
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.settings import Settings
from sprung.service.store import open_store
from tests.service_fakes import make_window


def rows(path: Path) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(path)) as store:
        return store.execute("SELECT vehicle_id, start_ns, outcome FROM windows ORDER BY start_ns").fetchall()


@pytest.fixture
def lived_in(tmp_path: Path, engine: Engine, system: System, compute: Compute) -> Settings:
    """A data folder with windows, an upload, a report, and things half written."""
    settings = Settings(data_dir=tmp_path / "data")
    store = open_store(settings.store_url)
    Pipeline(engine, store, compute).process("car-17", [make_window(system, number) for number in range(30)])
    settings.uploads.mkdir()
    (settings.uploads / "a.csv").write_text("time,x\n")
    (settings.uploads / "b.csv.part").write_text("half")
    (settings.reports / "r1").mkdir(parents=True)
    (settings.reports / "r1" / "report.html").write_text("<p>page</p>")
    (settings.reports / "r2.77.part").mkdir()
    (settings.reports / "r2.77.part" / "report.html").write_text("half")
    return settings  # the store stays open, as that of a running service


def test_what_was_backed_up_comes_back(lived_in: Settings, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "b.tar"
    with held(lived_in.data_dir):  # a service runs
        assert main(["backup", str(target), "--data-dir", str(lived_in.data_dir)]) == 0
    assert main(["restore", str(target), "--data-dir", str(tmp_path / "new")]) == 0
    assert "3 files" in capsys.readouterr().out
    new = Settings(data_dir=tmp_path / "new")
    assert rows(new.data_dir / "sprung.db") == rows(lived_in.data_dir / "sprung.db") and rows(
        new.data_dir / "sprung.db"
    )
    found = sorted(str(p.relative_to(new.data_dir)) for p in new.data_dir.rglob("*") if p.is_file())
    assert found == ["reports/r1/report.html", "sprung.db", "sprung.lock", "uploads/a.csv"]
    open_store(new.store_url).close()  # and the service can go on with it


def good_tokens(settings: Settings, *secrets: str) -> list[bool]:
    store = open_store(settings.store_url)
    try:
        return [_is_good(Tokens(store), secret) for secret in secrets]
    finally:
        store.close()


def _is_good(tokens: Tokens, secret: str) -> bool:
    try:
        tokens.actor(secret)
    except Refused:
        return False
    return True


@pytest.mark.parametrize("keep", [False, True])
def test_a_token_that_was_revoked_since_does_not_come_back_unnoticed(
    lived_in: Settings, tmp_path: Path, capsys: pytest.CaptureFixture[str], keep: bool
) -> None:
    store = open_store(lived_in.store_url)
    tokens = Tokens(store)
    (stolen, row), (gone, before) = tokens.create("stolen laptop", ["admin"]), tokens.create("long gone", ["read"])
    tokens.revoke(before.id)
    back_up(lived_in, tmp_path / "b.tar")
    tokens.revoke(row.id)
    store.close()
    new = Settings(data_dir=tmp_path / "new")
    options = ["--keep-tokens"] if keep else []
    assert main(["restore", str(tmp_path / "b.tar"), "--data-dir", str(new.data_dir), *options]) == 0
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and f"{row.id} (stolen laptop)" in told and before.id not in told
    assert ("are good again" if keep else "are revoked") in told
    assert good_tokens(new, stolen, gone) == [keep, False]
    with closing(sqlite3.connect(new.data_dir / "sprung.db")) as restored:
        noted = restored.execute("SELECT action, target FROM audit ORDER BY id").fetchall()
    assert noted[-1] == ("restore", "sprung.db") and (("revoke token", row.id) in noted) is not keep


def test_a_folder_in_use_is_not_restored_into(lived_in: Settings, tmp_path: Path) -> None:
    back_up(lived_in, tmp_path / "b.tar")
    with pytest.raises(UserError, match="there is a store already"):
        restore(lived_in, tmp_path / "b.tar")
    new = Settings(data_dir=tmp_path / "new")
    with held(new.data_dir), pytest.raises(UserError, match="another sprung serve"):
        restore(new, tmp_path / "b.tar")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.97])
def test_a_back_up_that_was_cut_short_is_refused_and_leaves_nothing(
    lived_in: Settings, tmp_path: Path, share: float
) -> None:
    whole = tmp_path / "b.tar"
    back_up(lived_in, whole)
    cut = tmp_path / "cut.tar"
    content = whole.read_bytes().rstrip(b"\0")  # without the blocks of zeros that fill an archive up
    cut.write_bytes(content[: round(share * len(content))])
    new = Settings(data_dir=tmp_path / "new")
    with pytest.raises(UserError, match="back-up"):
        restore(new, cut)
    assert [p.name for p in new.data_dir.iterdir()] == ["sprung.lock"]
    restore(new, whole)  # and the next attempt goes through


def test_a_changed_byte_is_found(lived_in: Settings, tmp_path: Path) -> None:
    target = tmp_path / "b.tar"
    back_up(lived_in, target)
    data = bytearray(target.read_bytes())
    data[data.index(b"<p>page</p>") + 4] ^= 1
    target.write_bytes(data)
    with pytest.raises(UserError, match=r"reports/r1/report\.html is not as it was"):
        restore(Settings(data_dir=tmp_path / "new"), target)


@pytest.mark.parametrize("name", ["../evil", "/etc/evil", "uploads/../../evil", "sprung.db/../x", "elsewhere/x"])
def test_paths_that_lead_out_are_refused(tmp_path: Path, name: str) -> None:
    target = tmp_path / "b.tar"
    with tarfile.open(target, "w") as tar:
        entry = tarfile.TarInfo(name)
        entry.size = 4
        tar.addfile(entry, io.BytesIO(b"evil"))
    with pytest.raises(UserError, match="no part of a back-up"):
        restore(Settings(data_dir=tmp_path / "new"), target)
    assert not list(tmp_path.rglob("evil"))


def test_what_cannot_be_backed_up_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["backup", str(tmp_path / "b.tar"), "--data-dir", str(tmp_path / "none")]) == 2
    assert "no store to back up" in capsys.readouterr().err
    assert main(["backup", str(tmp_path / "b.tar"), "--store", "postgresql://x/y"]) == 2
    assert "pg_dump" in capsys.readouterr().err
    (tmp_path / "sprung.db").write_bytes(b"no database" * 500)
    assert main(["backup", str(tmp_path / "b.tar"), "--data-dir", str(tmp_path)]) == 2
    assert not (tmp_path / "b.tar").exists() and not (tmp_path / "b.tar.part").exists()
