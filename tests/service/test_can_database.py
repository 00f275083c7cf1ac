"""The CAN database of a system, one rule for all commands."""

from __future__ import annotations

from pathlib import Path

import pytest

from sprung.model.system import MANCHESTER, MANCHESTER_DBC, System, load_system, parse_system
from sprung.service.can_database import database_of


def with_signals(bogie: str) -> System:
    text = MANCHESTER.read_text(encoding="utf-8").replace("Bogie1", bogie).replace("name: manchester", "name: mine")
    return parse_system(text)


@pytest.mark.parametrize("bogie, expected", [("Bogie1", MANCHESTER_DBC), ("Drehgestell1", None)])
def test_the_bundled_database_serves_files_whose_signals_it_has(bogie: str, expected: Path | None) -> None:
    assert database_of(with_signals(bogie)) == expected


def test_a_named_database_is_taken() -> None:
    assert database_of(load_system(), Path("mine.dbc")) == Path("mine.dbc")
