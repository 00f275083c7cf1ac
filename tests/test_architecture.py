"""Imports point at `model`: read from the source of every module."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
OURS = ("model", "replay", "service", "benchmarks")
MAY_IMPORT = {
    "model": {"model"},
    "replay": {"replay", "model.signals"},
    "service": {"service", "model", "replay", "benchmarks"},
    "benchmarks": {"benchmarks", "model", "replay", "service"},
}
CORE_KNOWS = {"numpy", "scipy", "torch", "torchdiffeq", "pydantic", "pydantic_core", "yaml", "safetensors"}
STANDARD_BUT_NOT_FOR_THE_CORE = {"socket", "http", "sqlite3", "logging", "argparse", "asyncio"}


def modules(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Every module that a file names in an import, at the top or inside a function."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.removeprefix("sprung.") for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            module = (node.module or "").removeprefix("sprung.")
            found |= {alias.name for alias in node.names} if module == "sprung" else {module}
    return found


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
    assert all(name.startswith(("service/api/", "service/pages/")) for name in users), users


def test_the_shared_vocabulary_is_a_leaf() -> None:
    assert not any(name.split(".")[0] in OURS for name in imported(ROOT / "model" / "signals.py"))
