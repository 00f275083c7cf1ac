"""The steps that are killed: migration, first start, retention, back-up, restoration; and the table of all kills."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable
from pathlib import Path

from alembic import command
from alembic.config import Config
from sqlalchemy import create_engine, insert, text

from sprung.benchmarks.trust_kills import (
    KilledStep,
    Kills,
    ReplayKills,
    ServiceKills,
    StepKills,
    count,
    integrity,
    rows,
)
from sprung.benchmarks.trust_ride import RestlessRide
from sprung.benchmarks.trust_zygote import Zygote
from sprung.service.backup import back_up, restore
from sprung.service.settings import Settings
from sprung.service.store import open_store
from sprung.service.store.schema import models, recordings, vehicles, windows

LIVED_IN_WINDOWS = 4000
OPEN = """
from sprung.service.store import open_store
go()
open_store("sqlite:///sprung.db").close()
"""
FORGET = """
import time
from pathlib import Path
from sprung.service.housekeeping import Housekeeping
from sprung.service.settings import Settings
from sprung.service.store import open_store
settings = Settings(data_dir=Path.cwd())
store = open_store(settings.store_url)
go()
housekeeping = Housekeeping(settings, store)
housekeeping.clear_leftovers()
housekeeping.once(time.time_ns() + 400 * 86_400 * 10**9)
store.close()
"""
BACK_UP = """
from pathlib import Path
from sprung.service.backup import back_up
from sprung.service.settings import Settings
go()
back_up(Settings(data_dir=Path.cwd() / "data"), Path.cwd() / "b.tar")
"""
RESTORE = """
from pathlib import Path
from sprung.service.backup import restore
from sprung.service.settings import Settings
settings = Settings(data_dir=Path.cwd() / "new")
go()
if not (settings.data_dir / "sprung.db").exists():
    restore(settings, Path.cwd() / "b.tar")
"""


def _migration(folder: Path) -> KilledStep:
    def prepare(place: Path) -> None:
        """A store of the first version, with vehicles."""
        engine = create_engine(f"sqlite:///{place}/sprung.db")
        config = Config()
        config.set_main_option("script_location", "sprung.service:migrations")
        config.set_main_option("path_separator", "os")
        with engine.begin() as connection:
            config.attributes["connection"] = connection
            command.upgrade(config, "0001")
            rows = [{"id": f"v{number}", "now": number} for number in range(500)]
            connection.execute(text("INSERT INTO vehicles (id, created_ns) VALUES (:id, :now)"), rows)
        engine.dispose()

    def judge(place: Path, _done: bool) -> dict[str, int]:
        store = place / "sprung.db"
        return {"damaged": integrity(store) != "ok", "vehicles_lost": 500 - count(store, "vehicles")}

    return KilledStep(OPEN, prepare, judge)


def _first_start(folder: Path) -> KilledStep:
    def judge(place: Path, done: bool) -> dict[str, int]:
        store = place / "sprung.db"
        return {"damaged": integrity(store) != "ok", "no_tables": done and count(store, "vehicles") != 0}

    return KilledStep(OPEN, lambda _place: None, judge)


def _retention(folder: Path) -> KilledStep:
    lived_in = _lived_in(folder)

    def judge(place: Path, done: bool) -> dict[str, int]:
        left = count(place / "sprung.db", "windows")
        kept = {row[0] for row in rows(place / "sprung.db", "SELECT file FROM recordings WHERE file IS NOT NULL")}
        present = {path.name for path in (place / "uploads").iterdir()}
        return {
            "damaged": integrity(place / "sprung.db") != "ok",
            "half_forgotten": left not in (0, LIVED_IN_WINDOWS),
            "not_forgotten": done and left != 0,
            "files_of_nobody": done and len(present - kept),
            "files_missing": len(kept - present),
        }

    return KilledStep(FORGET, lambda place: _copy(lived_in, place), judge)


def _back_up(folder: Path) -> KilledStep:
    lived_in = _lived_in(folder)

    def judge(place: Path, done: bool) -> dict[str, int]:
        whole = (place / "b.tar").exists()
        return {
            "source_damaged": integrity(place / "data" / "sprung.db") != "ok",
            "no_back_up": done and not whole,
            "unusable": whole and not _restores(place),
            "leftovers": done and len(list(place.glob("b.tar.*"))),
        }

    return KilledStep(BACK_UP, lambda place: _copy(lived_in, place / "data"), judge)


def _restore(folder: Path) -> KilledStep:
    lived_in = _lived_in(folder)
    source = folder / "b.tar"
    if not source.exists():
        back_up(Settings(data_dir=lived_in), source)

    def judge(place: Path, done: bool) -> dict[str, int]:
        store = place / "new" / "sprung.db"
        uploads = place / "new" / "uploads" / "u.csv"
        whole = store.exists() and count(store, "windows") == LIVED_IN_WINDOWS and uploads.exists()
        return {"half_restored": store.exists() and not whole, "not_restored": done and not whole}

    def prepare(place: Path) -> None:
        shutil.copy(source, place / "b.tar")

    return KilledStep(RESTORE, prepare, judge)


def _lived_in(folder: Path) -> Path:
    """A data folder with a few thousand windows and an upload."""
    place = folder / "lived-in"
    if (place / "done").exists():
        return place
    shutil.rmtree(place, ignore_errors=True)
    (place / "uploads").mkdir(parents=True)
    (place / "uploads" / "u.csv").write_bytes(b"time,x\n" * 100_000)
    store = open_store(f"sqlite:///{place}/sprung.db")
    now = time.time_ns()
    blank = {"stored_ns": now, "outcome": "used", "repaired_samples": 0, "tracked": True, "log_ratio": bytes(96)}
    rows = [blank | {"vehicle_id": "a", "model_id": 1, "start_ns": now + n} for n in range(LIVED_IN_WINDOWS)]
    upload = {"id": "r", "name": "u.csv", "source": "upload", "file": "u.csv", "size_bytes": 700_000}
    with store.write() as connection:
        connection.execute(insert(vehicles).values(id="a", created_ns=now))
        connection.execute(insert(models).values(id=1, digest="d", system="s", description={}, created_ns=now))
        connection.execute(insert(recordings).values(created_ns=now, finished_ns=now, **upload))
        connection.execute(insert(windows), rows)
    store.close()
    (place / "done").touch()
    return place


def _copy(source: Path, target: Path) -> None:
    shutil.copytree(source, target, dirs_exist_ok=True)


def _restores(place: Path) -> bool:
    trial = place / "trial"
    shutil.rmtree(trial, ignore_errors=True)
    with contextlib.suppress(ValueError, OSError):
        restore(Settings(data_dir=trial), place / "b.tar")
        return count(trial / "sprung.db", "windows") == LIVED_IN_WINDOWS
    return False


STEPS: dict[str, Callable[[Path], KilledStep]] = {  # by name: made in a folder for what they need
    "migration": _migration,
    "first start": _first_start,
    "retention": _retention,
    "back-up": _back_up,
    "restoration": _restore,
}


def _kills(name: str) -> Callable[[Path, RestlessRide, Zygote], Kills]:
    def make(folder: Path, _ride: RestlessRide, zygote: Zygote) -> Kills:
        return StepKills(folder, zygote, STEPS[name](folder))

    return make


KILLS: tuple[tuple[str, Callable[[Path, RestlessRide, Zygote], Kills], int], ...] = (  # name, maker, share of all kills
    ("service", ServiceKills, 6),
    ("replay", ReplayKills, 4),
    *((name, _kills(name), 2) for name in STEPS),
)
