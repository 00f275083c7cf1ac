"""The reference that is made from the code (`make docs`)."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from typer.main import get_command

from sprung.service.cli.app import app

REFERENCE = Path(__file__).resolve().parents[2] / "docs" / "reference.py"


def test_the_reference_calls_every_command_by_its_name() -> None:
    spec = importlib.util.spec_from_file_location("reference", REFERENCE)
    assert spec is not None and spec.loader is not None
    reference = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(reference)
    names = reference.names()
    assert {words[0] for words in names} == set(get_command(app).commands)  # type: ignore[attr-defined]
    assert ["fleet", "backfill"] in names
