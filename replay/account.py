"""Account of one input: what became of every message, and the messages to the user."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from sprung.model.signals import Tally
from sprung.model.text import one_line

KEPT_PROBLEMS = 100  # lines; a file can be damaged in a million places
LONGEST_LINE = 1000  # characters; names in a file can have any length


class UnreadableRecording(ValueError):
    """The input cannot be read at all; the message is one line that says what, where and what to do."""

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message, LONGEST_LINE))


@dataclass(slots=True)
class Account:
    """Filled by a reader while it reads.

    `tally` counts messages (MCAP messages, CAN frames, CSV rows): each exactly once, with a reason for each one
    that was not used.  `values` counts single values of used messages that were treated as missing.
    """

    tally: Tally = field(default_factory=Tally)
    values: Counter[str] = field(default_factory=Counter)  # reason -> values treated as missing
    problems: list[str] = field(default_factory=list)  # one line each, for the user; the first ones
    more_problems: int = 0  # that are not kept
    incomplete: bool = False  # something that was recorded could not be read
    vehicle: str | None = None
    relative: bool = False  # its times count from an unknown start
    contents: Counter[str] = field(default_factory=Counter)  # topic or CAN id -> messages in the input

    def drop(self, count: int, reason: str) -> None:
        """Messages that the system file names but that carry nothing usable."""
        if count:
            self.tally.dropped += count
            self.tally.reasons[reason] += count

    def corrupt(self, count: int, reason: str) -> None:
        """Messages that could not be read; the recording is incomplete."""
        if count:
            self.tally.corrupt += count
            self.tally.reasons[reason] += count
            self.incomplete = True

    def foreign(self, count: int, reason: str = "not named by the system file") -> None:
        """Messages that the system file does not name."""
        if count:
            self.tally.foreign += count
            self.tally.reasons[reason] += count

    def problem(self, line: str, *, incomplete: bool = True) -> None:
        """One line for the user; by default it also marks the recording as incomplete."""
        self.incomplete = self.incomplete or incomplete
        if len(self.problems) < KEPT_PROBLEMS:
            self.problems.append(one_line(line, LONGEST_LINE))
            return
        self.more_problems += 1
        if self.more_problems == 1:
            self.problems.append("")
        self.problems[-1] = f"and {self.more_problems} more like these"

    def note(self, line: str) -> None:
        """One line for the user about how the recording was read; once per text; no data are missing because of it."""
        if line not in self.problems:
            self.problem(line, incomplete=False)
