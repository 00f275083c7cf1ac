"""What a machine runs out of, taken from a real service: told, survived, given back."""

from __future__ import annotations

from pathlib import Path

import pytest

from sprung.benchmarks.trust_scarcity import SCARCITIES, missing, scarcity


@pytest.mark.slow
def test_what_is_lacking_is_reported_and_survived(tmp_path: Path) -> None:
    if reason := missing():
        pytest.skip(f"no disk of its own: {reason}")
    *lines, audit = scarcity(tmp_path, 4.0)
    assert [line["figure"] for line in lines] == list(SCARCITIES)
    for line in lines:
        name, answers = line["figure"], line["answers"]
        assert line["value"] is not None, f"{name}: not ready again"
        assert not any(answer.endswith(" 500") for answer in answers), (name, answers)
        if name != "no files":  # then no connection is accepted, and nobody can be told
            assert {answer for answer in answers if answer.startswith("live")} == {"live 200"}, (name, answers)
            assert line["not_ready"], name
    assert (audit["value"], audit["doubled"], audit["integrity"]) == (0, 0, "ok")
    assert audit["acknowledged"] > 0
