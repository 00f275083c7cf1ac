"""`sprung bench`."""

from __future__ import annotations

import inspect
import json
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sprung.benchmarks import BENCHMARKS, load
from sprung.service.cli.targets import check_file, check_folder
from sprung.service.errors import UserError


def _finite(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise ValueError
    return number


CONVERT: dict[str, Callable[[str], Any]] = {"int": int, "float": _finite, "Path": Path, "str": str}
CHOICE = re.compile(r"Literal\[(.*)\]")
HELP = ("--help", "-h")
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
    if any(argument in HELP for argument in arguments):
        print(described(name, function))
        return 0
    positional, named = parse(name, function, arguments)
    _check_targets(function, positional, named)
    figures = 0
    for figure in function(*positional, **named):
        figures += 1
        print(json.dumps({"bench": name} | figure), flush=True)
    if not figures:
        raise UserError(f"bench {name}: nothing is measured with these arguments; see sprung bench {name} --help")
    return 0


def described(name: str, function: Callable[..., Any]) -> str:
    """The help of one benchmark: how it is called, what its module and its function say, its options and defaults."""
    known = inspect.signature(function).parameters.values()
    options = [(f"--{p.name.replace('_', '-')} {_kind(p)}", p) for p in known]
    usage = [option if p.default is p.empty else f"[{option}]" for option, p in options]
    said = [inspect.getdoc(sys.modules[function.__module__]), inspect.getdoc(function)]
    width = max((len(option) for option, _ in options), default=0)
    rows = [f"  {option:{width}s}  {_default(p)}".rstrip() for option, p in options]
    return "\n\n".join(
        [
            " ".join(["Usage: sprung bench", name, *usage]),
            *(text for text in said if text),
            "\n".join(["Options:", *rows]),
        ]
    )


def _kind(parameter: inspect.Parameter) -> str:
    """What an option takes, in the words of the other commands' help."""
    annotation = _annotation(parameter)
    if choices := _choices(annotation):
        return "|".join(choices)
    return {"int": "N", "float": "N", "Path": "PATH"}.get(annotation, "TEXT")


def _default(parameter: inspect.Parameter) -> str:
    if parameter.default is parameter.empty:
        return "required"
    return f"default: {parameter.default}" if parameter.default not in (None, "") else ""


def _check_targets(function: Callable[..., Any], positional: list[Any], named: dict[str, Any]) -> None:
    """Refuse what could not be written when the benchmark has ended; raises UserError."""
    given = inspect.signature(function).bind_partial(*positional, **named)
    given.apply_defaults()
    for name, check in WRITTEN.items():
        if given.arguments.get(name):
            check(Path(given.arguments[name]))


def parse(name: str, function: Callable[..., Any], arguments: list[str]) -> tuple[list[Any], dict[str, Any]]:
    """`TASK --budget full` as arguments of the benchmark's function, by its signature.

    Raises UserError for an option that the function does not have, a value of the wrong kind, or one that is missing.
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
        key, assigned, value = argument[2:].partition("=")
        parameter = known.get(key.replace("-", "_"))
        if parameter is None:
            options = ", ".join(f"--{p.replace('_', '-')}" for p in known) or "none"
            raise UserError(f"bench {name}: no option --{key}; it has {options}")
        given = value if assigned else next(rest, "--")
        if not assigned and given.startswith("--"):
            raise UserError(f"bench {name}: --{key} needs a value")
        if parameter.name in named:
            raise UserError(f"bench {name}: --{key} is given twice")
        named[parameter.name] = _convert(name, parameter, given)
    for parameter in order[: len(positional)]:
        if parameter.name in named:
            raise UserError(f"bench {name}: {parameter.name} is given twice, by its place and as an option")
    missing = [p for p in known.values() if p.default is p.empty and p not in order[: len(positional)]]
    lacking = [f"--{p.name.replace('_', '-')} {_kind(p)}" for p in missing if p.name not in named]
    if lacking:
        raise UserError(f"bench {name} needs {' and '.join(lacking)}; see sprung bench {name} --help")
    return positional, named


def _annotation(parameter: inspect.Parameter) -> str:
    """The name of a parameter's type, without `| None`."""
    return str(parameter.annotation).split("|")[0].strip()


def _choices(annotation: str) -> list[str]:
    """The words that a `Literal[...]` allows."""
    literal = CHOICE.match(annotation)
    return re.findall(r"'([^']*)'", literal[1]) if literal else []


def _convert(name: str, parameter: inspect.Parameter, text: str) -> Any:
    annotation = _annotation(parameter)
    choices = _choices(annotation)
    if choices and text not in choices:
        raise UserError(f"bench {name}: {parameter.name} cannot be {text!r}; give {' or '.join(choices)}")
    try:
        return CONVERT.get(annotation, str)(text)
    except ValueError:
        raise UserError(f"bench {name}: {parameter.name} cannot be {text!r}; give {annotation}") from None
