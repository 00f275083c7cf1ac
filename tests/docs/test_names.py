"""Files that documents name are there: a text that outlives what it tells of misleads."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXTS = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]
FOLDERS = ("model", "replay", "service", "benchmarks", "deploy", "tests", "docs")


@pytest.fixture(scope="module")
def files() -> list[str]:
    inside = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    paths = {*inside, *ROOT.glob("*.py"), *ROOT.glob("sprung/*.py")}
    return [f"/{path.relative_to(ROOT).as_posix()}" for path in paths]


@pytest.mark.parametrize("text", TEXTS, ids=lambda path: path.name)
def test_every_module_that_a_document_names_is_there(text: Path, files: list[str]) -> None:
    words = text.read_text(encoding="utf-8")
    made = set(re.findall(r"^`([\w/]+\.py)`:$", words, re.MULTILINE))  # a file that the reader is told to write
    named = set(re.findall(r"`([\w/]+\.py)`", words)) - made
    assert [name for name in sorted(named) if not any(file.endswith(f"/{name}") for file in files)] == []


@pytest.mark.parametrize("text", TEXTS, ids=lambda path: path.name)
def test_every_link_to_a_file_leads_somewhere(text: Path) -> None:
    links = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", text.read_text(encoding="utf-8"))
    assert [link for link in links if not (text.parent / link).exists()] == []
