"""The generated reference: docs/reference/cli.md, laws.md, metrics.md, openapi.json, system.schema.json.

`make docs` runs it.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import tempfile
from pathlib import Path

import typer

from sprung.model.laws import CATALOGUE
from sprung.model.systemfile import json_schema
from sprung.service.app import create_app
from sprung.service.cli import main as run
from sprung.service.cli.app import app
from sprung.service.core import build_core
from sprung.service.monitoring.engine import load_engine
from sprung.service.settings import Settings

TARGET = Path(__file__).resolve().parent / "reference"


def names() -> list[list[str]]:
    """Words of every command, groups before their commands."""
    found = [[name] for name in _names(app)]
    for group in app.registered_groups:
        found.append([str(group.name)])
        found += [[str(group.name), name] for name in _names(group.typer_instance)]
    return found


def commands() -> str:
    """The help of every command."""
    os.environ["COLUMNS"] = "100"
    parts = ["# Commands\n\nAs `sprung COMMAND --help` prints them.\n"]
    for words in names():
        text = io.StringIO()
        with contextlib.redirect_stdout(text):
            if run([*words, "--help"]) != 0:
                raise SystemExit(f"sprung {' '.join(words)} --help failed")
        parts.append(f"## sprung {' '.join(words)}\n\n```\n{text.getvalue().strip()}\n```\n")
    return "\n".join(parts)


def _names(of: typer.Typer | None) -> list[str]:
    registered = [] if of is None else of.registered_commands
    return [str(one.name or one.callback.__name__) for one in registered if one.callback is not None]


def laws() -> str:
    """Every law of the catalogue, its parameters, and what it looks like."""
    parts = ["# Laws\n\nWhat the code says of every law; [the catalogue](../catalogue.md) has their forces.\n"]
    for law in CATALOGUE:
        others = ", ".join(f"`{name}`" for name in law.confused_with) or "nothing"
        parts.append(f"## {law.name}\n\n{law.title}. Looks like: {law.looks_like}. Confused with: {others}.\n")
        rows = [f"| `{p.name}` | {p.unit} | {p.low:g} to {p.high:g} | {p.meaning} |" for p in law.parameters]
        if rows:
            parts.append("\n".join(["| parameter | unit | admissible | meaning |", "|---|---|---|---|", *rows, ""]))
    return "\n".join(parts)


def service() -> tuple[str, str]:
    """Metrics as a table, and the OpenAPI description."""
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(data_dir=Path(folder))
        core = build_core(settings, load_engine(settings))
        try:
            rows = [
                f"| `{family.name}` | {family.type} | {family.documentation} |"
                for family in sorted(core.metrics.registry.collect(), key=lambda one: one.name)
            ]
            description = json.dumps(create_app(core).openapi(), indent=1)
        finally:
            core.store.close()
            core.compute.close()
    table = "| metric | kind | what it says |\n|---|---|---|\n" + "\n".join(rows)
    return f"# Metrics\n\nWhat `/metrics` holds.\n\n{table}\n", description


def main() -> None:
    """Write all of it."""
    TARGET.mkdir(exist_ok=True)
    metrics, description = service()
    (TARGET / "cli.md").write_text(commands(), encoding="utf-8")
    (TARGET / "metrics.md").write_text(metrics, encoding="utf-8")
    (TARGET / "openapi.json").write_text(description + "\n", encoding="utf-8")
    (TARGET / "laws.md").write_text(laws(), encoding="utf-8")
    schema = json.dumps(json_schema(), indent=1)
    (TARGET / "system.schema.json").write_text(schema + "\n", encoding="utf-8")
    (TARGET / "index.md").write_text(
        "# Reference\n\n[Commands](cli.md), [laws](laws.md), [metrics](metrics.md), [OpenAPI](openapi.json), "
        "[JSON Schema of system files](system.schema.json): all made from the code by `make docs`.\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
