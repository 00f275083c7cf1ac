"""Recordings and archives behind addresses: of files; of S3 where its stand-in is installed (`moto[server]`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sprung.model.system import System
from sprung.replay.writing import write_recording
from sprung.service.errors import UserError
from sprung.service.fleet import backfill as module
from sprung.service.fleet.backfill import BackfillPlan, FoldedFile, backfill
from sprung.service.fleet.recordings import list_recordings, local_copy
from sprung.service.fleet.tasks import HereTasks
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from sprung.service.store import Store, history
from sprung.service.store.archive import Archive
from sprung.service.store.history import older_windows
from tests.service.store.test_archive import forget
from tests.service.store.test_store import DAY, fill, record

pytest.importorskip("pyarrow")
START = 1_790_000_000_000_000_000


def shown(file: FoldedFile, done: int, of: int) -> None:
    """Nothing."""


def made(system: System, folder: Path) -> Path:
    """Two recordings of one vehicle, in a folder below."""
    (folder / "north").mkdir(parents=True)
    rng = np.random.default_rng(3)
    for part in range(2):
        values = 0.01 * rng.normal(size=(400, len(system.channels)))
        start = START + part * 4_000_000_000
        path = folder / "north" / f"{part}.mcap"
        write_recording(path, system.channels, values, system.sample_rate, start, vehicle="north-1")
    (folder / "notes.txt").write_text("no recording")
    return folder


@pytest.fixture
def s3(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The end of an address of an S3 service of this test's own, with a bucket `fleet`."""
    server = pytest.importorskip("moto.server").ThreadedMotoServer(port=0, verbose=False)
    server.start()
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    _, port = server.get_host_and_port()
    options = f"?scheme=http&region=eu-west-1&endpoint_override=127.0.0.1:{port}"
    from pyarrow import fs

    files, root = fs.FileSystem.from_uri(f"s3://fleet{options}&allow_bucket_creation=true")
    files.create_dir(root)
    yield options
    server.stop()


def test_an_address_of_files_is_listed_and_read(system: System, tmp_path: Path) -> None:
    place = made(system, tmp_path / "recordings")
    found = list_recordings(place.as_uri())
    assert [Path(file.path).name for file in found] == ["0.mcap", "1.mcap"]
    with local_copy(found[0]) as path:
        assert path.read_bytes() == (place / "north" / "0.mcap").read_bytes()
    assert not path.exists()


@pytest.mark.parametrize("place", ["nowhere://bucket/folder", "file:///no/such/folder"])
def test_an_address_that_cannot_be_listed_is_one_line(place: str) -> None:
    with pytest.raises(UserError, match=place) as caught:
        list_recordings(place)
    assert "\n" not in str(caught.value)


def uploaded(place: Path, address: str) -> None:
    """Copy recordings to an address."""
    from pyarrow import fs

    files, root = fs.FileSystem.from_uri(address)
    for path in place.rglob("*.*"):
        with files.open_output_stream(f"{root}/{path.relative_to(place)}") as out:
            out.write(path.read_bytes())


@pytest.mark.slow
def test_a_backfill_from_s3_equals_one_from_files(
    system: System, engine: Engine, store: Store, s3: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = made(system, tmp_path / "recordings")
    address = f"s3://fleet/recordings{s3}"
    uploaded(place, address)
    monkeypatch.setattr(module, "engine_of", lambda settings: engine)
    url = store.engine.url.render_as_string(hide_password=False)
    plan = BackfillPlan(Settings(data_dir=tmp_path, store=url), address, 0, 2**62)
    told = backfill(plan, HereTasks(), 1, shown)
    assert (told.files, told.vehicles, told.problems) == (2, ["north-1"], [])
    other = replace(plan, settings=Settings(data_dir=tmp_path, store=f"sqlite:///{tmp_path}/other.db"))
    alone = backfill(replace(other, place=str(place)), HereTasks(), 1, shown)
    assert told.windows == alone.windows > 0


@pytest.mark.slow
def test_an_archive_on_s3_is_written_read_and_cleaned(store: Store, s3: str) -> None:
    archive = Archive(f"s3://fleet/archive{s3}")
    model = fill(store, [record(i) for i in range(20)])
    assert forget(store, archive, record(0).start + DAY) == 20
    with store.read() as connection:
        older = older_windows(archive, "a", "digest")
        found = history.series(connection, "a", model, 0, 2**62, 0, 100, older)
    assert found.time.tolist() == [record(i).start for i in range(20)]
    assert archive.remove("a") == 1
    assert list(archive.posteriors("a", "digest", 0, 2**62)) == []
