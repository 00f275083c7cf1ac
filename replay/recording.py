"""`open_recording`: any supported file as a stream of sample blocks with its account."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

import numpy as np
from cantools.database import Database

from sprung.model.signals import ANY_TIME, Channel, SampleBlock, Tally, TimeColumn
from sprung.model.text import some
from sprung.replay import asc, blf, candump, csvtable, mcaptopics, mf4, parquet, series
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.auxiliary import AuxiliaryMeans
from sprung.replay.bounds import FOR_ITS_SIZE, most_samples
from sprung.replay.candecode import CanDecoder
from sprung.replay.convert import converter
from sprung.replay.frames import FrameBlock
from sprung.replay.plausibility import PlausibilityCheck
from sprung.replay.sampling import at_rate
from sprung.replay.stamps import ABSOLUTE, SECOND
from sprung.replay.tables import column_blocks

FrameReader = Callable[[Path, Account], Iterator[FrameBlock]]

CAN_READERS: dict[str, FrameReader] = {
    ".blf": blf.frames,
    ".asc": asc.frames,
    ".log": candump.frames,
    ".mf4": mf4.frames,
}
TEXT_TABLES = (".csv", ".tsv", ".txt", ".dat")
PARQUET = (".parquet", ".pq")
TABLES = (*TEXT_TABLES, *PARQUET, *series.KINDS)
EXTENSIONS = (".mcap", *CAN_READERS, *TABLES)


class Recording:
    """One file, read once from its beginning to its end by `blocks()`.

    `tally`, `problems`, `vehicle` and `incomplete` are complete when `blocks()` has ended.
    """

    def __init__(
        self,
        path: Path,
        channels: Sequence[Channel],
        source: Iterator[SampleBlock],
        account: Account,
        start: int | None = None,
        beside: int = 0,
    ) -> None:
        """beside: of the channels, the last ones that may be missing, and come at rates of their own."""
        self.path = path
        self.beside = beside
        self.channels = tuple(channels)
        self.account = account
        self.seen = np.zeros(len(channels), dtype=bool)  # channels of which at least one valid value came
        self.start_of_file = False  # the start is only when the file was written
        self._source = source
        self._start = start
        self._plausibility = PlausibilityCheck(channels, account, converter(channels))

    @property
    def relative(self) -> bool:
        """Its times count from 0, as far as it has been read."""
        return self.account.relative

    @property
    def stamped(self) -> bool:
        """Its times are those of sampling; on a bus they are those of arrival."""
        return self.path.suffix.lower() not in CAN_READERS

    def at_rate(
        self, sample_rate: float, apart: Callable[[SampleBlock], SampleBlock] | None = None
    ) -> Iterator[SampleBlock]:
        """`blocks`, channels of much higher rates reduced to that of the grid; raises UnreadableRecording also when all
        are too slow for it.

        apart: takes out of a block what needs no grid, the channels `beside`; left out, they are dropped.
        """
        blocks = self.blocks()
        if self.beside:
            apart = apart or AuxiliaryMeans(len(self.channels) - self.beside, self.beside).keep
            blocks = (left for left in map(apart, blocks) if len(left.time))
        return at_rate(blocks, self.channels[: len(self.channels) - self.beside], sample_rate, self.account, self.path)

    def blocks(self) -> Iterator[SampleBlock]:
        """Blocks in file order; raises UnreadableRecording when none of the channels is in the file, or when it
        gives more samples than its size makes plausible."""
        left = most_samples(self.path)
        shift: int | None = None
        for raw in self._source:
            left -= len(raw.time)
            if left < 0:
                raise UnreadableRecording(f"{self.path}: gives more samples than {FOR_ITS_SIZE}")
            block = self._plausibility.check(raw)
            if len(block.time):
                self.seen[block.channel[~np.isnan(block.value)]] = True
                if shift is None:
                    shift = self._shift(int(block.time.min()))
                yield _begun(block, shift) if shift else block
        self._plausibility.conclude()
        if not self.seen[: len(self.seen) - self.beside].any():
            raise UnreadableRecording(self._nothing())
        if not self.seen.all():
            names = [channel.name for channel, seen in zip(self.channels, self.seen, strict=True) if not seen]
            self.account.problem(f"no values of {some(names, 5)}", incomplete=False)

    def _shift(self, first: int) -> int:
        """What is added to times that count from a start, ns."""
        self.account.relative = self.account.relative or abs(first) < ABSOLUTE * SECOND
        if self._start is None or not self.account.relative:
            return 0
        began = datetime.fromtimestamp(self._start / SECOND, UTC).strftime("%Y-%m-%d %H:%M:%S")
        of_file = ", the file's own time; give a start if it began at another" if self.start_of_file else ""
        self.account.note(f"its times count from 0, which is taken to be {began} UTC{of_file}")
        return self._start - first

    def _nothing(self) -> str:
        if self.account.tally.used and self.account.problems:  # the channels are there
            return f"{self.path}: none of its samples can be used; {self.account.problems[0]}"
        contents = [f"{name} ({count})" if count else name for name, count in self.account.contents.most_common(8)]
        more = " ..." if len(self.account.contents) > 8 else ""
        holds = f"it holds {', '.join(contents)}{more}" if contents else "it holds no messages"
        trouble = f"; {self.account.problems[0]}" if self.account.problems else ""
        return f"{self.path}: none of the system file's channels is in it; {holds}{trouble}"

    @property
    def tally(self) -> Tally:
        """Messages by outcome."""
        return self.account.tally

    @property
    def problems(self) -> list[str]:
        """One line each."""
        return self.account.problems

    @property
    def vehicle(self) -> str | None:
        """The vehicle that the recording names, where its format can."""
        return self.account.vehicle

    @property
    def incomplete(self) -> bool:
        """Some of what was recorded is missing or damaged."""
        return self.account.incomplete


def _begun(block: SampleBlock, shift: int) -> SampleBlock:
    """Times that count from a start moved by `shift` ns; a clock that was set meanwhile is right by itself."""
    counting = np.abs(block.time) < ABSOLUTE * SECOND
    return SampleBlock(np.where(counting, block.time + shift, block.time), block.channel, block.value)


@cache
def added_readers() -> dict[str, EntryPoint]:
    """Readers of other packages by extension: entry points of the group `sprung.readers`, as `xyz = package:blocks`.

    Each is a function (path, channels, account, time) -> Iterator[SampleBlock], like `csvtable.blocks`.
    """
    return {f".{point.name.lower()}": point for point in entry_points(group="sprung.readers")}


def kind_of(path: Path) -> str:
    """The extension of a file that can be read; raises UnreadableRecording when there is no such file or reader."""
    extension = path.suffix.lower()
    if extension not in EXTENSIONS and extension not in added_readers():
        known = " ".join([*EXTENSIONS, *added_readers()])
        raise UnreadableRecording(f"{path}: cannot read files of this kind; known are {known}")
    if not path.is_file():
        raise UnreadableRecording(f"{path}: no such file")
    return extension


def open_recording(
    path: str | Path,
    channels: Sequence[Channel],
    *,
    dbc: str | Path | Database | None = None,
    time_source: str | Mapping[str, str] = "auto",
    time: TimeColumn = ANY_TIME,
    start: int | None = None,
    beside: Sequence[Channel] = (),
) -> Recording:
    """Choose the reader by the file's extension; raises UnreadableRecording with one line.

    `dbc` is the CAN database that CAN recordings need, a file or already loaded.  `time_source` (MCAP): "auto"
    (header stamp where the messages carry one, else publish time), "header", "publish" or "log"; or a table by
    channel name.  `time`: time column of tables.  `start` (ns since 1970) is when a
    recording began whose times count from 0; without it such times stay as they are.
    `beside` are channels that follow the others and may be missing, such as `System.auxiliary`.
    """
    path, channels = Path(path), (*channels, *beside)
    extension = kind_of(path)
    account = Account()
    if extension == ".mcap":
        source = mcaptopics.blocks(path, channels, account, time_source)
    elif extension in TEXT_TABLES:
        source = csvtable.blocks(path, channels, account, time)
    elif extension in PARQUET:
        source = _whatever(path, parquet.blocks(path, channels, account, time), account)
    elif extension in series.KINDS:
        source = _whatever(path, _series(path, channels, account, time), account)
    elif extension in added_readers():
        source = _whatever(path, added_readers()[extension].load()(path, channels, account, time), account)
    else:
        if dbc is None:
            raise UnreadableRecording(f"{path}: a CAN recording needs a CAN database; name it with --dbc")
        source = _decoded(CAN_READERS[extension](path, account), CanDecoder(channels, dbc), account)
    return Recording(path, channels, source, account, start, len(beside))


def _whatever(path: Path, source: Iterator[SampleBlock], account: Account) -> Iterator[SampleBlock]:
    """Blocks of a format that a package of others parses: whatever it raises about a damaged file is one line."""
    rows = 0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # reported by their consequences
            for block in source:
                rows += len(block.time)
                yield block
    except UnreadableRecording:
        raise
    except Exception as error:
        what = str(error) or type(error).__name__
        if not rows:
            raise UnreadableRecording(
                f"{path}: damaged, or not of the kind that its name suggests: {what[:200]}"
            ) from error
        account.problem(f"damaged after {rows} values ({' '.join(what.split())[:200]}); everything before was read")


def _series(path: Path, channels: Sequence[Channel], account: Account, time: TimeColumn) -> Iterator[SampleBlock]:
    with series.opened(path) as columns:
        yield from column_blocks(path, columns, channels, time, account)


def _decoded(frames: Iterator[FrameBlock], decoder: CanDecoder, account: Account) -> Iterator[SampleBlock]:
    decoder.compare_units(account)
    for block in frames:
        yield decoder.decode(block, account)
