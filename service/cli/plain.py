"""Help in plain words: names of values instead of Python types."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import typer
from typer.core import TyperCommand

TYPE = re.compile(r" <(?:list\[)?\w+\]?>")  # <list[Path]> behind a name that says it already
BRACED = re.compile(r"\{([A-Z]+)(?:\.\.\.)?\}")


class PlainCommand(TyperCommand):
    """A command whose help names no types."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """As the library does, with its types taken out before lines are filled."""
        write = formatter.write_dl

        def write_plain(rows: Any, *given: Any, **options: Any) -> None:
            write([(_plain(name), text) for name, text in rows], *given, **options)

        formatter.write_dl = write_plain
        super().format_help(ctx, formatter)
        formatter.buffer[:] = [_plain(part) for part in formatter.buffer]


def _plain(text: str) -> str:
    return BRACED.sub(r"\1", TYPE.sub("", text))


class PlainTyper(typer.Typer):
    """An application of such commands."""

    def command(self, *args: Any, **options: Any) -> Callable[[Any], Any]:
        """As the library's."""
        return super().command(*args, **{"cls": PlainCommand} | options)
