"""Help in plain words: what a value is called, not the type that it has in Python."""

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
        super().format_help(ctx, formatter)
        formatter.buffer[:] = [BRACED.sub(r"\1", TYPE.sub("", part)) for part in formatter.buffer]


class PlainTyper(typer.Typer):
    """An application of such commands."""

    def command(self, *args: Any, **options: Any) -> Callable[[Any], Any]:
        """As the library's."""
        return super().command(*args, **{"cls": PlainCommand} | options)
