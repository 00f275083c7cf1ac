"""`sprung bench`."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sprung.benchmarks import BENCHMARKS, load
from sprung.service.cli.targets import check_file, check_folder
from sprung.service.errors import UserError

CONVERT: dict[str, Callable[[str], Any]] = {"int": int, "float": float, "Path": Path, "str": str}
WRITTEN: dict[str, Callable[[Path], None]] = {  # what benchmarks write, by the name of their argument
    "out": check_folder,
    "folder": check_folder,
    "write": check_file,
    "document": check_file,
}


def run(name: str | None, arguments: list[str]) -> int:
    """Run a benchmark and print its figures as they come."""
    if name is None:
        for known, (_, what) in BENCHMARKS.items():
            print(f"{known:18s} {what}")
        return 0
    if name not in BENCHMARKS:
        raise UserError(f"no benchmark {name!r}; known are {', '.join(BENCHMARKS)}")
    function = load(name)
    positional, named = parse(name, function, arguments)
    _check_targets(function, positional, named)
    for figure in function(*positional, **named):
        print(json.dumps({"bench": name} | figure), flush=True)
    return 0


def _check_targets(function: Callable[..., Any], positional: list[Any], named: dict[str, Any]) -> None:
    """Refuse what could not be written when the benchmark has ended; raises UserError."""
    given = inspect.signature(function).bind_partial(*positional, **named)
    given.apply_defaults()
    for name, check in WRITTEN.items():
        if given.arguments.get(name):
            check(Path(given.arguments[name]))


def parse(name: str, function: Callable[..., Any], arguments: list[str]) -> tuple[list[Any], dict[str, Any]]:
    """`TASK --budget full` as arguments of the benchmark's function, by its signature.

    Raises UserError for an option that the function does not have, or a value of the wrong kind.
    """
    known = inspect.signature(function).parameters
    positional: list[Any] = []
    named: dict[str, Any] = {}
    order = [p for p in known.values() if p.kind is p.POSITIONAL_OR_KEYWORD]
    rest = iter(arguments)
    for argument in rest:
        if not argument.startswith("--"):
            if len(positional) >= len(order):
                raise UserError(f"bench {name}: {argument!r} is one argument too many")
            positional.append(_convert(name, order[len(positional)], argument))
            continue
        key, _, value = argument[2:].partition("=")
        parameter = known.get(key.replace("-", "_"))
        if parameter is None:
            options = ", ".join(f"--{p.replace('_', '-')}" for p in known) or "none"
            raise UserError(f"bench {name}: no option --{key}; it has {options}")
        given = value or next(rest, None)
        if given is None:
            raise UserError(f"bench {name}: --{key} needs a value")
        named[parameter.name] = _convert(name, parameter, given)
    return positional, named


def _convert(name: str, parameter: inspect.Parameter, text: str) -> Any:
    annotation = str(parameter.annotation).split("|")[0].strip()
    try:
        return CONVERT.get(annotation, str)(text)
    except ValueError:
        raise UserError(f"bench {name}: {parameter.name} cannot be {text!r}; give {annotation}") from None
