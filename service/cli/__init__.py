"""The command `sprung`.  Errors are one line on stderr; exit status 0, 1 or 2, and 130 after Ctrl-C."""

from __future__ import annotations

import io
import logging
import os
import sys
from collections.abc import Sequence

import typer

from sprung.model.text import one_line
from sprung.service.processes.imports import python_can_alone
from sprung.service.processes.memory import is_shortage

USAGE = 2
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status; never a traceback, unless SPRUNG_DEBUG is set."""
    _usable_streams()
    python_can_alone()
    logging.basicConfig(format="sprung: %(message)s")  # warnings; a service sets up logs of its own
    from sprung.service.cli.app import app

    try:
        status = app(arguments, prog_name="sprung", standalone_mode=False)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of a pipe, such as head, has seen enough
        return _closed_pipe()
    except SystemExit as ended:  # the library of the command line makes 1 of it, which would say "alarms"
        if isinstance(ended.__context__, BrokenPipeError):
            return _closed_pipe()
        raise
    except (KeyboardInterrupt, typer.Abort):
        status = INTERRUPTED  # older versions of typer raise, newer ones return it
    except Exception as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            print(error.format_message())  # type: ignore[attr-defined]  # of click, or of the copy of it inside typer
            return USAGE
        if os.environ.get("SPRUNG_DEBUG"):
            raise
        print(f"sprung: {describe(error)}", file=sys.stderr)
        return USAGE
    if status == INTERRUPTED:
        print("sprung: interrupted", file=sys.stderr)
    return status if isinstance(status, int) else 0


def _usable_streams() -> None:
    """Streams that take every character, and that are there at all: `>&-` closes them, `LC_ALL=C` makes them ASCII."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 (for as long as the process)
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _closed_pipe() -> int:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def describe(error: Exception) -> str:
    """One line: what, where, what to do."""
    usage = getattr(error, "format_message", None)  # typer's and click's errors of usage have it
    if callable(usage):
        context = getattr(error, "ctx", None)
        command = getattr(context, "command_path", None) or "sprung"
        return f"{one_line(usage()).rstrip('.')}; see {command} --help"
    if is_shortage(error):
        return one_line(f"out of memory{f': {error}' if str(error) else ''}")
    if isinstance(error, OSError) and error.strerror:
        return one_line(f"{error.filename}: {error.strerror}" if error.filename else error.strerror)
    if isinstance(error, ValueError):  # what every folder raises for input that cannot be used
        return one_line(str(error))
    if type(error).__name__ == "OperationalError":  # of SQLAlchemy: read-only, full, locked for long, out of reach
        return one_line(": ".join([*getattr(error, "__notes__", []), str(getattr(error, "orig", error))]))
    return f"unexpected {type(error).__name__}: {one_line(str(error))}; SPRUNG_DEBUG=1 shows where"
