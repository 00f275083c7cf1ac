"""What code a row of the paper's benchmark was made by: a digest of the definitions that making it can reach.

Read from the source alone: from the function that makes a task's rows, every function, class and constant of this
project that a definition names, and what these name in turn.  A class counts as a whole, and so does a module that is
passed on without saying what of it.  Comments and docstrings do not count, nor do pictures, nor the systems of other
visual tasks, nor the catalogue of laws, of which the train's vehicle has none.  What code asks for by a string is not
seen.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parent.parent
WHOLE = "*"  # in the place of a name: all of a module
LOOSE = ""  # what a module does beside defining names
_ALPS = "sprung.model.alps"
_VISUAL = ("pendulum", "mass_spring_damper", "two_body")
_BENCH = "sprung.benchmarks"
MADE_BY: dict[str, tuple[str, str]] = {  # task: module and function of its rows
    "systems": (f"{_BENCH}.paper_visual", "system_rows"),
    **{task: (f"{_BENCH}.paper_visual", "rows") for task in _VISUAL},
    "poor_opening": (f"{_BENCH}.poor_opening", "rows"),
    "tuning": (f"{_BENCH}.tuning", "rows"),
    "train": (f"{_BENCH}.paper_train", "constant_rows"),
    "train_changing": (f"{_BENCH}.paper_train", "changing_rows"),
    "train_drifting": (f"{_BENCH}.drifting", "rows"),
    "kernels": (f"{_BENCH}.paper_analysis", "kernel_rows"),
    "phase": (f"{_BENCH}.paper_analysis", "phase_rows"),
    "phase_information": (f"{_BENCH}.phase_information", "rows"),
    "features": (f"{_BENCH}.paper_analysis", "feature_rows"),
    "window_information": (f"{_BENCH}.window_information", "rows"),
}

_VEHICLE = "model/systems/manchester.yaml"
FILES = {  # that are read on the way
    "train": (_VEHICLE,),
    "train_changing": (_VEHICLE, "model/weights/manchester/weights.safetensors"),
    "train_drifting": (_VEHICLE,),
}


@dataclass(frozen=True)
class SameRows:
    """Code that differs and yet makes the same rows, to the bit, with one budget."""

    task: str
    budget: str
    old: str
    new: str  # the present code: with a further change the old rows are stale
    why: str


_IDENTIFICATION = "sprung.model.identification"
MOVED = {  # modules by their present names, and the names under which rows were made: where code is does not count
    f"{_IDENTIFICATION}.{package}.{module}": f"{_IDENTIFICATION}.{module}"
    for package, modules in {
        "likelihood": ("compression", "frequency", "gauss_newton", "linearise", "noise_share"),
        "measurements": ("calibration", "deviations", "redundancy"),
        "refinement": ("refine",),
        "amortised": ("estimator", "features", "training"),
    }.items()
    for module in modules
} | dict.fromkeys(("sprung.model.laws.motion", "sprung.model.laws.kinds"), "sprung.model.laws.base")

_FULL_ALONE = "since 632f9976 what `full` draws is held against the first embeddings; `quick` holds it against no other"
_DIVERGED = "a training that has diverged ends with an error, where drawing an angle went on for ever"
_SHARED = "data and embeddings of a seed are made in a module that two experiments share"
_FORECAST = "output error forecasts what follows a window, beside figures that are the same"
_SEARCHED = "ALPS is searched as well, each method by itself"
SAME = (
    SameRows("pendulum", "quick", "9e2624087112", "fe6d7dbf50b1", f"{_FULL_ALONE}; {_DIVERGED}; {_FORECAST}"),
    SameRows("pendulum", "quick", "a2951359b567", "fe6d7dbf50b1", f"{_DIVERGED}; {_FORECAST}"),
    SameRows("mass_spring_damper", "quick", "b7dff46cd836", "2677fd6eeab0", f"{_FULL_ALONE}; {_DIVERGED}; {_FORECAST}"),
    SameRows("mass_spring_damper", "quick", "50f03443cbf3", "2677fd6eeab0", f"{_DIVERGED}; {_FORECAST}"),
    SameRows("two_body", "quick", "8c92e59ff7de", "7034c4fab285", f"{_FULL_ALONE}; {_DIVERGED}; {_FORECAST}"),
    SameRows("two_body", "quick", "0f743c0a968c", "7034c4fab285", f"{_DIVERGED}; {_FORECAST}"),
    SameRows("poor_opening", "quick", "6108af9b6228", "effa48c92f7b", f"{_SHARED}; {_DIVERGED}; {_FORECAST}"),
    SameRows("tuning", "quick", "c265b0f5458c", "7ec0c8cea8c7", f"{_SHARED}; {_DIVERGED}; {_SEARCHED}"),
    SameRows("tuning", "quick", "3468de5c170c", "7ec0c8cea8c7", f"{_SHARED}; {_SEARCHED}"),
)


def sources(task: str, root: Path = _ROOT) -> str:
    """Digest of the code, and of the files, that make the rows of a task.  Rows of other code are stale.

    root: the folder that holds what `sprung` does, of this checkout by default.
    """
    found = digest(root, *MADE_BY[task], *_without(task))
    files = FILES.get(task, ())
    return _short(found.encode(), *((root / file).read_bytes() for file in files)) if files else found


@cache
def digest(root: Path, module: str, name: str, *without: str) -> str:
    """Digest of all that `name` of a module reaches: 12 hexadecimal digits.

    without: modules that are left out.
    """
    reader = _SourceReader(root, without)
    found = {(MOVED.get(at, at), what): reader.text(at, what) for at, what in _reached(reader, (module, name))}
    if not found:
        raise ValueError(f"{module} has no {name}")
    return _short(*(f"{at}.{what}\n{text}\n".encode() for (at, what), text in sorted(found.items())))


def _short(*parts: bytes) -> str:
    return hashlib.sha256(b"".join(parts)).hexdigest()[:12]


def is_current(row: dict[str, Any]) -> bool:
    """Whether the present code makes a kept row."""
    now, made = sources(row["task"]), row.get("sources")
    return made == now or any(
        (same.task, same.budget, same.old, same.new) == (row["task"], row.get("budget"), made, now) for same in SAME
    )


def _without(task: str) -> tuple[str, ...]:
    """Modules that make no difference to a task's rows."""
    others = (f"{_ALPS}.{other}" for other in _VISUAL if task in _VISUAL and other != task)
    return (f"{_BENCH}.paper_pictures", "sprung.model.laws", *others)


Place = tuple[str, str]  # module and name in it, or `WHOLE`, or `LOOSE`


@dataclass
class _SourceFile:
    """One file: its definitions by name, and what its imported names mean."""

    definitions: dict[str, list[ast.stmt]] = field(default_factory=dict)
    imports: dict[str, Place] = field(default_factory=dict)


class _SourceReader:
    """Modules of the project by their dotted name."""

    def __init__(self, root: Path, without: tuple[str, ...]) -> None:
        self.root, self.without = root, without
        self.known: dict[str, _SourceFile | None] = {}

    def module(self, name: str) -> _SourceFile | None:
        if name not in self.known:
            path = None if name in self.without else self._path(name)
            self.known[name] = None if path is None else self._read(path)
        return self.known[name]

    def text(self, module: str, name: str) -> str:
        found = self.module(module)
        assert found is not None
        return "\n".join(ast.unparse(node) for node in found.definitions[name])

    def _path(self, name: str) -> Path | None:
        if not name.startswith("sprung."):
            return None
        base = self.root.joinpath(*name.split(".")[1:])
        return next((p for p in (base.with_suffix(".py"), base / "__init__.py") if p.is_file()), None)

    def _read(self, path: Path) -> _SourceFile:
        tree = ast.parse(path.read_text())
        found = _SourceFile()
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    whole = f"{node.module}.{alias.name}"
                    is_module = self._path(whole) is not None
                    found.imports[alias.asname or alias.name] = (
                        (whole, WHOLE) if is_module else (node.module, alias.name)
                    )
            _drop_docstring(node)
        for statement in tree.body:
            if not isinstance(statement, (ast.Import, ast.ImportFrom)):
                for name in _defined(statement) or (LOOSE,):
                    found.definitions.setdefault(name, []).append(statement)
        return found


def _reached(reader: _SourceReader, first: Place) -> set[Place]:
    """Definitions that `first` names, directly or through others, itself included."""
    found: set[Place] = set()
    waiting = [first]
    while waiting:
        at, name = waiting.pop()
        module = reader.module(at)
        if module is None or (at, name) in found:
            continue
        if name not in module.definitions:
            if name == WHOLE:
                waiting += [(at, each) for each in module.definitions]
            elif name in module.imports:  # passed on by a package
                waiting.append(module.imports[name])
            continue
        found.add((at, name))
        if LOOSE in module.definitions:
            waiting.append((at, LOOSE))
        for node in module.definitions[name]:
            waiting += _named(module, at, node)
    return found


def _named(module: _SourceFile, at: str, node: ast.AST) -> Iterator[Place]:
    """What a definition names: of its own module, and of others."""
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        of = module.imports.get(node.value.id)
        if of is not None and of[1] == WHOLE:  # a name of a module
            yield of[0], node.attr
            return
    if isinstance(node, ast.Name):
        if node.id in module.imports:
            yield module.imports[node.id]
        elif node.id in module.definitions:
            yield at, node.id
    for child in ast.iter_child_nodes(node):
        yield from _named(module, at, child)


def _defined(statement: ast.stmt) -> tuple[str, ...]:
    """Names that a statement of a module defines."""
    if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        return (statement.name,)
    targets = statement.targets if isinstance(statement, ast.Assign) else []
    if isinstance(statement, (ast.AnnAssign, ast.AugAssign)):
        targets = [statement.target]
    return tuple(node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name))


def _drop_docstring(node: ast.AST) -> None:
    if isinstance(node, (ast.Module, ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        first = node.body[0] if node.body else None
        if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
            node.body = node.body[1:] or [ast.Pass()]
