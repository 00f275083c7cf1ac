"""Imports point at `model`: read from the source of every module."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from functools import cache
from importlib import import_module
from pathlib import Path
from runpy import run_path

import pytest

from sprung.model.laws import CATALOGUE
from sprung.model.laws.base import Parametrised

ROOT = Path(__file__).parent.parent
OURS = ("model", "replay", "service", "benchmarks")
MAY_IMPORT = {
    "model": {"model"},
    "replay": {"replay", "model.signals", "model.signal_filters", "model.text", "model.units"},
    "service": {"service", "model", "replay", "benchmarks"},
    "benchmarks": {"benchmarks", "model", "replay", "service"},
}
# Inside `model` every name imports only names to its left; the diagnosis and the paper stand beside identification
ORDER = [
    "signals",
    "signal_filters",
    "chunks",
    "work",
    "rule",
    "text",
    "units",
    "parameters",
    "address",
    "sensor_kinds",
    "schema",
    "digest",
    "mechanics",
    "laws",
    "systemfile",
    "system",
    "ratios",
    "identifier",
    "simulate",
    "ambient",
    "comfort",
    "identification",
    "experiment",
    "tracking",
]
_BELOW = ORDER[: ORDER.index("identification")]
BESIDE = {"diagnosis": _BELOW, "exchange": _BELOW, "alps": ORDER}
# Inside `service` every name imports only names to its left
SERVICE_ORDER = (
    "errors",
    "retrying",
    "times",
    "settings",
    "durable",
    "lock",
    "can_database",
    "processes",
    "store",
    "migrations",
    "condition",
    "access",
    "upload_room",
    "monitoring",
    "operations",
    "housekeeping",
    "sources",
    "observability",
    "jobs",
    "report",
    "diagnosis",
    "backup",
    "export",
    "notify",
    "fleet",
    "core",
    "rendering",
    "api",
    "pages",
    "app",
    "main",
    "cli",
)
STAGES = (
    "rules",
    "kinds",
    "record",
    "response",
    "fit",
    "screening",
    "selection",
    "force",
    "investigation",
    "report",
    "component",
    "ambient",
    "api",
)
# Inside these packages, too, every name imports only names to its left
PACKAGES = {
    "model.identification": (
        "likelihood",
        "excitation",
        "measurements",
        "refinement",
        "nonlinear",
        "fault_isolation",
        "amortised",
        "estimates",
        "window_deviations",
        "model_uncertainty",
        "identify",
    ),
    "model.diagnosis.investigation": (
        "configuration",
        "verdict",
        "state",
        "formula",
        "measurements",
        "search",
        "judgement",
        "diagnose",
    ),
}
# Imports inside functions of `model`, each with its reason
LATE: dict[str, str] = {
    "model/signal_filters.py:_signal": "half a second of processor time that services and replicas may never need",
}
# Outside `model`, a function imports what an extra brings, what one kind of machine has, or for these reasons
EXTRAS = {
    "aiokafka",
    "asammdf",
    "cryptography",
    "filterpy",
    "h5py",
    "jwt",
    "nats",
    "nptdms",
    "psycopg",
    "pyarrow",
    "pysindy",
    "ray",
}
OF_POSIX = {"fcntl", "resource"}
LATE_OUTSIDE = {
    "service/cli/": "a command loads what it needs when it is called: `--help` is there in a tenth of a second",
    "service/monitoring/engine.py": "torch, which processes that are forked before it may not have loaded",
    "service/monitoring/simulated.py": "torch, the same",
    "service/fleet/ray_replicas.py": "torch, in replicas: who starts them starts Ray's own processes first",
    "service/store/engine.py": "alembic, where somebody else has migrated the store",
    "service/api/ray_door.py": "FastAPI, in the door's replica alone",
    "service/diagnosis/worker.py": "threads of linear algebra are bounded before it is loaded",
}
CORE_KNOWS = {"numpy", "scipy", "torch", "torchdiffeq", "pydantic", "pydantic_core", "yaml", "safetensors"}
STANDARD_BUT_NOT_FOR_THE_CORE = {"socket", "http", "sqlite3", "logging", "argparse", "asyncio"}


@cache
def modules(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


@cache
def nodes(path: Path) -> tuple[ast.stmt, ...]:
    """Every statement of a file, those inside others too; read once."""
    found: list[ast.stmt] = []
    waiting: list[ast.AST] = [ast.parse(path.read_bytes())]
    while waiting:
        node = waiting.pop()
        for field in ("body", "orelse", "finalbody", "handlers", "cases"):
            inner = getattr(node, field, None)
            if isinstance(inner, list):
                waiting += inner
        if isinstance(node, ast.stmt):
            found.append(node)
    return tuple(found)


def imported(path: Path) -> set[str]:
    """Every module that a file names in an import, at the top or inside a function."""
    found: set[str] = set()
    for node in nodes(path):
        if isinstance(node, ast.Import):
            found |= {alias.name.removeprefix("sprung.") for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            module = (node.module or "").removeprefix("sprung.")
            found |= {alias.name for alias in node.names} if module == "sprung" else {module}
    return found


@cache
def edges() -> dict[str, set[str]]:
    """Which file imports which, as dotted names below `sprung`; names imported from a package count for its files."""
    files = {_dotted(path): path for folder in OURS for path in modules(folder)}
    graph: dict[str, set[str]] = {}
    for name, path in files.items():
        targets = set()
        for node in nodes(path):
            if isinstance(node, ast.Import):
                targets |= {alias.name.removeprefix("sprung.") for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                module = (node.module or "").removeprefix("sprung.")
                inside = {f"{module}.{alias.name}" for alias in node.names}
                targets |= {one for one in inside if one in files} or {module}
        graph[name] = {target for target in targets if target in files and target != name}
    return graph


def _dotted(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def circle(graph: dict[str, set[str]]) -> list[str]:
    """One import circle of a graph, as the names along it; empty when there is none."""
    done: set[str] = set()

    def walk(name: str, way: list[str]) -> list[str]:
        if name in way:
            return [*way[way.index(name) :], name]
        if name in done:
            return []
        for target in sorted(graph[name]):
            if found := walk(target, [*way, name]):
                return found
        done.add(name)
        return []

    return next((found for name in sorted(graph) if (found := walk(name, []))), [])


def test_no_file_imports_itself_by_a_detour() -> None:
    assert circle(edges()) == []


def test_folders_stand_above_those_that_they_import() -> None:
    """As drawn in docs/architecture.md: `make drawing` refuses a circle of folders, too."""
    folder_of = run_path(str(ROOT / "docs" / "imports.py"))["folder_of"]
    graph: dict[str, set[str]] = defaultdict(set)
    for name, targets in edges().items():
        graph[folder_of(name)] |= {folder_of(target) for target in targets}
    whole = {name: {target for target in targets if target != name} for name, targets in graph.items()}
    for package in ("model", "model.diagnosis", *PACKAGES):  # their own files hold nothing
        whole.pop(package, None)
    assert circle({name: targets & set(whole) for name, targets in whole.items()}) == []


def test_the_drawing_of_the_imports_is_up_to_date() -> None:
    drawing = run_path(str(ROOT / "docs" / "imports.py"))["drawing"]
    kept = (ROOT / "docs" / "img" / "imports.svg").read_text(encoding="utf-8")
    assert kept == drawing(), "docs/img/imports.svg: `make drawing` makes it anew"


def test_a_circle_would_be_seen() -> None:
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_every_module_of_the_core_has_its_place() -> None:
    names = {name.split(".")[1] for name in edges() if name.startswith("model.")}
    assert names - set(ORDER) - set(BESIDE) == set(), "give it a place in ORDER above"


def test_the_core_is_built_in_one_order() -> None:
    wrong = []
    for name, targets in edges().items():
        for target in targets:
            if not (name.startswith("model.") and target.startswith("model.")):
                continue
            upper, lower = name.split(".")[1], target.split(".")[1]
            allowed = BESIDE[upper] if upper in BESIDE else ORDER[: ORDER.index(upper)]
            if lower not in {upper, *allowed}:
                wrong.append(f"{name} imports {target}")
    assert wrong == []


def test_the_diagnosis_is_built_in_one_order() -> None:
    wrong = []
    for name, targets in edges().items():
        for target in targets:
            if name.startswith("model.diagnosis.") and target.startswith("model.diagnosis."):
                upper, lower = name.split(".")[2], target.split(".")[2]
                if STAGES.index(lower) > STAGES.index(upper):
                    wrong.append(f"{name} imports {target}")
    assert wrong == []


@pytest.mark.parametrize("package", PACKAGES)
def test_large_packages_are_built_in_one_order(package: str) -> None:
    order, depth, wrong = PACKAGES[package], len(package.split(".")), []
    for name, targets in edges().items():
        for target in targets:
            if name.startswith(f"{package}.") and target.startswith(f"{package}."):
                upper, lower = name.split(".")[depth], target.split(".")[depth]
                if order.index(lower) > order.index(upper):
                    wrong.append(f"{name} imports {target}")
    assert wrong == []


def test_the_service_is_built_in_one_order() -> None:
    wrong = []
    for name, targets in edges().items():
        for target in targets:
            if name.startswith("service.") and target.startswith("service."):
                upper, lower = name.split(".")[1], target.split(".")[1]
                if SERVICE_ORDER.index(lower) > SERVICE_ORDER.index(upper):
                    wrong.append(f"{name} imports {target}")
    assert wrong == []


def test_class_names_are_unique() -> None:
    named = defaultdict(list)
    files = [path for folder in (*OURS, "tests") for path in modules(folder)] + sorted((ROOT / "sprung").glob("*.py"))
    for path in files:
        for name in re.findall(r"^ *class (\w+)[:(\[]", path.read_text(encoding="utf-8"), re.MULTILINE):
            named[name].append(path.relative_to(ROOT).as_posix())
    assert {name: where for name, where in named.items() if len(where) > 1} == {}


@pytest.mark.parametrize("folder", OURS)
def test_no_import_is_hidden_from_those_who_run_the_code(folder: str) -> None:
    users = [
        path.relative_to(ROOT).as_posix()
        for path in modules(folder)
        if "TYPE_CHECKING" in path.read_text(encoding="utf-8")
    ]
    assert users == []


def test_the_core_imports_at_the_top_of_its_files() -> None:
    late = set()
    for path in modules("model"):
        for node in nodes(path):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                inner = [n for n in ast.walk(node) if isinstance(n, (ast.Import, ast.ImportFrom))]
                late |= {f"{path.relative_to(ROOT).as_posix()}:{node.name}" for _ in inner}
    assert late == set(LATE)


@pytest.mark.parametrize("folder", [folder for folder in OURS if folder != "model"])
def test_late_imports_have_a_reason(folder: str) -> None:
    """docs/decisions/0011-late-imports.md."""
    without = set()
    for path in modules(folder):
        name = path.relative_to(ROOT).as_posix()
        if any(name.startswith(place) for place in LATE_OUTSIDE):
            continue
        for node in nodes(path):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                for inner in ast.walk(node):
                    names = [one.name for one in inner.names] if isinstance(inner, ast.Import) else []
                    names += [inner.module or ""] if isinstance(inner, ast.ImportFrom) else []
                    without |= {f"{name}: {one}" for one in names if one.split(".")[0] not in EXTRAS | OF_POSIX}
    assert without == set()


@pytest.mark.parametrize("folder", OURS)
def test_folders_import_only_what_the_architecture_allows(folder: str) -> None:
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in modules(folder)
        for name in imported(path)
        if name.split(".")[0] in OURS
        and not any(name == allowed or name.startswith(f"{allowed}.") for allowed in MAY_IMPORT[folder])
    ]
    assert wrong == []


def test_only_the_command_line_knows_the_benchmarks() -> None:
    users = [p for p in modules("service") if any(n.split(".")[0] == "benchmarks" for n in imported(p))]
    assert [p.relative_to(ROOT).as_posix() for p in users] == ["service/cli/bench.py"]


def test_the_core_knows_no_server_and_no_socket() -> None:
    import sys

    wrong = []
    for path in modules("model"):
        for name in imported(path):
            top = name.split(".")[0]
            standard = top in sys.stdlib_module_names and top not in STANDARD_BUT_NOT_FOR_THE_CORE
            if not standard and top not in CORE_KNOWS | {"model", "__future__"}:
                wrong.append(f"{path.relative_to(ROOT)} imports {name}")
    assert wrong == []


def test_status_codes_of_http_are_given_in_one_folder() -> None:
    users = [
        path.relative_to(ROOT).as_posix()
        for path in modules("service")
        if any(name.split(".")[0] in ("fastapi", "starlette") for name in imported(path))
    ]
    assert all(name.startswith(("service/api/", "service/pages/", "service/app.py")) for name in users), users


def test_the_shared_vocabulary_is_a_leaf() -> None:
    assert not any(name.split(".")[0] in OURS for name in imported(ROOT / "model" / "signals.py"))


def _laws_imported(tree: ast.Module) -> set[str]:
    """Names by which a file knows particular laws."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sprung.model.laws"):
            module = import_module(node.module or "")
            found |= {one.name for one in node.names if isinstance(getattr(module, one.name), Parametrised)}
    return found


@pytest.mark.parametrize("folder", ["model/diagnosis", "model/simulate"])
def test_laws_are_asked_for_what_they_do_and_not_compared_with_particular_ones(folder: str) -> None:
    """docs/decisions/0006-laws-carry-behaviour.md."""
    listed, wrong = {law.name for law in CATALOGUE}, []
    for path in modules(folder):
        tree = ast.parse(path.read_bytes())
        laws = _laws_imported(tree)
        for node in (one for one in ast.walk(tree) if isinstance(one, ast.Compare)):
            parts = [part for side in (node.left, *node.comparators) for part in ast.walk(side)]
            named = {part.id for part in parts if isinstance(part, ast.Name)} & laws
            said = {str(part.value) for part in parts if isinstance(part, ast.Constant)} & listed
            wrong += [f"{path.relative_to(ROOT).as_posix()}:{node.lineno} {one}" for one in (*named, *said)]
    assert wrong == []
