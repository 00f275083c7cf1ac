"""A back-up of the data folder in one file, made while the service runs, and its restoration.

The file is a tar: the store as SQLite's own online back-up gives it (a consistent snapshot), uploads and reports, and a
manifest.  The store comes first, so every file that it speaks of is there, unless retention forgot it meanwhile.
A back-up that was cut short is no back-up: its manifest, written last, is missing.

Nobody can say which tokens were revoked after a back-up was made, so none of those in it is good after its restoration,
unless whoever restores it says so.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sqlite3
import tarfile
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any

from sprung import __version__
from sprung.service.access.tokens import Tokens
from sprung.service.durable import sync_file, sync_folder, sync_tree
from sprung.service.errors import UserError
from sprung.service.lock import held
from sprung.service.settings import Settings
from sprung.service.store import audit, open_store
from sprung.service.store.tokens import TokenRow
from sprung.service.times import now_ns, to_iso

MANIFEST = "manifest.json"
STORE = "sprung.db"
FOLDERS = ("uploads", "reports")
FORMAT = 1
PIECE = 1 << 20


@dataclass(frozen=True, slots=True)
class Backup:
    """What is in one."""

    created: str
    version: str
    files: dict[str, str]  # name: SHA-256
    bytes: int


@dataclass(frozen=True, slots=True)
class Restored:
    """What came back."""

    backup: Backup
    tokens: list[TokenRow]  # that were not revoked when it was made, the newest first


def back_up(settings: Settings, target: Path) -> Backup:
    """Write a back-up of the data folder; `target` is whole or not there.

    Raises UserError for a store that is no SQLite file or that is damaged; OSError where nothing can be written.
    """
    source = _store_file(settings)
    if not source.is_file():
        raise UserError(f"{source}: there is no store to back up; give the --data-dir or --store of the service")
    part, copy = target.with_name(f"{target.name}.part"), target.with_name(f"{target.name}.store")
    digests: dict[str, str] = {}
    try:
        copy.unlink(missing_ok=True)  # of an attempt that was killed
        _snapshot(source, copy)
        with tarfile.open(part, "w") as tar:
            digests[STORE] = _add(tar, copy, STORE)
            for name, path in _files(settings):
                with suppress(FileNotFoundError):  # retention forgot it meanwhile
                    digests[name] = _add(tar, path, name)
            manifest = {"format": FORMAT, "version": __version__, "created": to_iso(now_ns()), "files": digests}
            text = json.dumps(manifest, indent=1).encode()
            entry = tarfile.TarInfo(MANIFEST)
            entry.size = len(text)
            tar.addfile(entry, BytesIO(text))
        sync_file(part)
        size = part.stat().st_size
        part.replace(target)
        sync_folder(target.parent)
    finally:
        part.unlink(missing_ok=True)
        copy.unlink(missing_ok=True)
    return Backup(str(manifest["created"]), __version__, digests, size)


def restore(settings: Settings, source: Path, keep_tokens: bool = False) -> Restored:
    """Put a back-up into a data folder that has no store; every file is checked before anything is in its place.

    keep_tokens: leave those good that were so when the back-up was made, also if they were revoked since.
    Raises UserError for an incomplete back-up, and for a folder that is in use or holds a store.
    """
    target = _store_file(settings)
    with held(settings.data_dir):
        if target.exists():
            raise UserError(f"{target}: there is a store already; move it away, or restore into another --data-dir")
        part = settings.data_dir / ".restore.part"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        try:
            found = _extract(source, part)
            _check_store(part / STORE)
            tokens = _tokens(part / STORE, found, keep_tokens)
            sync_tree(part)
            for name in FOLDERS:
                _merge(part / name, settings.data_dir / name)
            target.parent.mkdir(parents=True, exist_ok=True)
            for suffix in ("-wal", "-shm"):  # left by a former store: they would be applied to this one
                target.with_name(target.name + suffix).unlink(missing_ok=True)
            (part / STORE).replace(target)  # last: a restoration that was cut short has no store, and can be begun anew
            sync_folder(target.parent)
            sync_folder(settings.data_dir)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    return Restored(found, tokens)


def _tokens(path: Path, found: Backup, keep: bool) -> list[TokenRow]:
    """Those of a restored store that were not revoked, which they are now unless they are kept."""
    store = open_store(f"sqlite:///{path}")
    try:
        every = Tokens(store)
        good = [r for r in every.rows() if r.revoked_ns is None] if keep else every.revoke_all("restoration")
        with store.write() as connection:
            detail = {"of": found.created, "tokens": "kept" if keep else "revoked"}
            audit.record(connection, "local", "restore", STORE, detail, now_ns())
    finally:
        store.close()
    _one_file(path)
    return good


def _one_file(path: Path) -> None:
    """Leave no log beside a store that nobody else has open."""
    with closing(sqlite3.connect(path)) as store:
        store.execute("PRAGMA journal_mode = DELETE")


def _store_file(settings: Settings) -> Path:
    url = settings.store_url
    if url.startswith("sqlite:///"):
        return Path(url.removeprefix("sqlite:///"))
    if "://" in url:
        raise UserError(f"{url.partition('://')[0]} stores are backed up by their own tools, such as pg_dump")
    return Path(url)


def _snapshot(source: Path, copy: Path) -> None:
    try:
        with closing(sqlite3.connect(source, timeout=60)) as store, closing(sqlite3.connect(copy)) as target:
            store.backup(target, pages=1000)
        _one_file(copy)
    except sqlite3.Error as error:
        raise UserError(f"{source}: cannot be backed up ({error})") from error
    _check_store(copy)


def _check_store(path: Path) -> None:
    try:
        with closing(sqlite3.connect(path)) as store:
            said = str(store.execute("PRAGMA integrity_check").fetchone()[0])
    except sqlite3.Error as error:
        said = str(error)
    if said != "ok":
        raise UserError(f"the store is damaged: {said}")


def _files(settings: Settings) -> Iterator[tuple[str, Path]]:
    for folder, path in zip(FOLDERS, (settings.uploads, settings.reports), strict=True):
        for file in sorted(path.rglob("*")):
            name = PurePosixPath(folder, *file.relative_to(path).parts)
            if file.is_file() and not any(part.endswith(".part") for part in name.parts):
                yield str(name), file


def _add(tar: tarfile.TarFile, path: Path, name: str) -> str:
    """Add a file; its digest."""
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        file.seek(0)
        entry = tarfile.TarInfo(name)
        entry.size = os.fstat(file.fileno()).st_size
        tar.addfile(entry, file)
    return digest


def _extract(source: Path, folder: Path) -> Backup:
    """Into a folder, each file checked against the manifest; nothing but plain files of the known folders."""
    digests: dict[str, str] = {}
    manifest: dict[str, Any] | None = None
    try:
        with tarfile.open(source, "r:") as tar:
            for entry in tar:
                name = PurePosixPath(entry.name)
                if entry.name == MANIFEST:
                    manifest = json.loads(_stream(tar, entry).read(100_000_000))
                    continue
                known = entry.name == STORE or (len(name.parts) > 1 and name.parts[0] in FOLDERS)
                if not entry.isreg() or not known or name.is_absolute() or ".." in name.parts:
                    raise UserError(f"{source}: holds {entry.name[:100]!r}, which is no part of a back-up")
                digests[entry.name] = _write(_stream(tar, entry), folder / name)
    except (tarfile.TarError, EOFError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{source}: is no back-up that can be read ({error})") from error
    if manifest is None or manifest.get("format") != FORMAT or STORE not in digests:
        raise UserError(f"{source}: is no whole back-up of this version; it was cut short, or something else wrote it")
    if manifest.get("files") != digests:
        wrong = sorted(dict(set(manifest.get("files", {}).items()) ^ set(digests.items())))
        raise UserError(f"{source}: {wrong[0]} is not as it was when it was backed up")
    return Backup(str(manifest["created"]), str(manifest["version"]), digests, source.stat().st_size)


def _stream(tar: tarfile.TarFile, entry: tarfile.TarInfo) -> Any:
    stream = tar.extractfile(entry)
    if stream is None:
        raise tarfile.ReadError(f"{entry.name} is no file")
    return stream


def _write(stream: Any, target: Path) -> str:
    target.parent.mkdir(parents=True, exist_ok=True)
    digest = hashlib.sha256()
    with open(target, "xb") as file:
        while piece := stream.read(PIECE):
            digest.update(piece)
            file.write(piece)
    return digest.hexdigest()


def _merge(source: Path, target: Path) -> None:
    """Move the entries of one folder into another; those of an earlier attempt are replaced."""
    if not source.is_dir():
        return
    target.mkdir(parents=True, exist_ok=True)
    for entry in source.iterdir():
        place = target / entry.name
        if place.is_dir():
            shutil.rmtree(place)
        entry.replace(place)
    sync_folder(target)
