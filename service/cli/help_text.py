"""Help in plain words: names of values instead of Python types."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cached_property
from typing import Any

import typer
from typer.core import TyperCommand
from typer.main import get_command

TYPE = re.compile(r" <(?:list\[)?[\w ]+\]?>")  # <list[Path]> behind a name that says it already
WORDS = {"int": "N", "float": "N", "path": "PATH"}  # for values of such types; TEXT for others
BRACED = re.compile(r"\{(\w+)(?:\.\.\.)?\}")


class PlainCommand(TyperCommand):
    """A command whose help names no types."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """As the library does, with its types taken out before lines are filled."""
        write = formatter.write_dl

        def write_plain(rows: Any, *given: Any, **options: Any) -> None:
            write([(_plain(_with_value(name)), text) for name, text in rows], *given, **options)

        formatter.write_dl = write_plain
        super().format_help(ctx, formatter)
        formatter.buffer[:] = [_plain(part) for part in formatter.buffer]


def _with_value(name: str) -> str:
    """An option's name with a word for what it takes: `--days N`; a flag's or an argument's as it is."""
    if not name.startswith("-") or name.endswith("<bool>"):
        return name
    return TYPE.sub(lambda kind: f" {next((w for t, w in WORDS.items() if t in kind[0].lower()), 'TEXT')}", name)


def _plain(text: str) -> str:
    return BRACED.sub(lambda name: name[1].upper(), TYPE.sub("", text))


class PlainTyper(typer.Typer):
    """An application of such commands."""

    @cached_property
    def _built(self) -> Callable[..., Any]:
        return get_command(self)

    def __call__(self, *args: Any, **options: Any) -> Any:
        """As the library's, but commands are built once in a process, and its hook for tracebacks is not set: there
        are none."""
        return self._built(*args, **options)

    def command(self, *args: Any, **options: Any) -> Callable[[Any], Any]:
        """As the library's."""
        return super().command(*args, **{"cls": PlainCommand} | options)
