"""Text for terminals: counted things, and names without the invisible and control characters that deceive there, in
logs and on pages."""

from __future__ import annotations

import re
from collections.abc import Sequence

# zero-width ones, marks and changes of direction, separators of lines and paragraphs, the soft hyphen
UNSEEN = r"\u00ad\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"
CONTROL = r"\x00-\x1f\x7f-\x9f"
IN_VEHICLE_IDS = "A-Za-z0-9._:-"
_HIDDEN = re.compile(f"[{CONTROL}{UNSEEN}\U000e0000-\U000e007f]")  # tags, too


def hidden_character(text: str) -> str:
    """The first control or invisible character, as `U+202E`; empty if there is none.

    >>> hidden_character("tram\\u202e 7")
    'U+202E'
    """
    found = _HIDDEN.search(text)
    return f"U+{ord(found[0]):04X}" if found else ""


def escaped(text: str) -> str:
    """With such characters as they would be written in a program, for terminals and logs.

    >>> escaped("tram\u202e 7")
    'tram\\\\u202e 7'
    """
    return _HIDDEN.sub(lambda found: ascii(found[0])[1:-1], text)


def one_line(text: str, longest: int | None = None) -> str:
    """`text` as a line for a terminal: names in a file may hold line breaks, control characters and no end.

    longest: characters that are kept; None: all.

    >>> one_line("no such\\n  topic\\x07", longest=7)
    'no such ...'
    """
    given = text if longest is None else text[: 4 * longest]
    line = " ".join("".join(sign if sign.isprintable() else " " for sign in given).split())
    return line if longest is None or len(line) <= longest else f"{line[:longest]} ..."


def first_line(error: Exception) -> str:
    """What an error says, without what follows in further lines; its kind where it says nothing.

    Of one that wraps a database's (its `orig`), what that says.

    >>> first_line(ValueError("no such topic\\nat line 7")), first_line(KeyError())
    ('no such topic', 'KeyError')
    """
    said = str(getattr(error, "orig", None) or error)
    return said.splitlines()[0] if said else type(error).__name__


def some(names: Sequence[str], most: int, between: str = ", ") -> str:
    """The first of several names, `most` of them, and how many more there are.

    >>> some(["car", "bogie1", "bogie2"], 1), some(["car", "bogie1"], 2)
    ('car and 2 more', 'car, bogie1')
    """
    return between.join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def counted(number: int, one: str, several: str = "") -> str:
    """A number of things; several: their plural, where it is not `one` with an s.

    >>> counted(1, "body", "bodies"), counted(0, "sensor")
    ('1 body', '0 sensors')
    """
    return f"{number} {one if number == 1 else several or one + 's'}"
