"""`make audit` does not say that nothing is known of packages that were not looked up."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest

AUDIT = Path(__file__).parents[2] / "docs" / "audit.py"
GOOD: dict[str, Any] = {"name": "idna", "version": "3.1", "vulns": []}
UNKNOWN = {"name": "rich", "skip_reason": "Dependency not found on PyPI and could not be audited: rich (1.0)"}
BAD = {"name": "lz4", "version": "1.0", "vulns": [{"id": "PYSEC-1", "fix_versions": ["1.1", "2.0"]}]}


def judged(rows: list[dict[str, Any]]) -> tuple[list[str], int]:
    spec = spec_from_file_location("audit", AUDIT)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    told: tuple[list[str], int] = module.judged(rows)
    return told


def test_only_packages_that_were_looked_up_are_good() -> None:
    assert judged([GOOD]) == (["1 of 1 packages were looked up; 0 with vulnerabilities"], 0)
    told, status = judged([GOOD, UNKNOWN])
    assert status == 1 and "nothing is known of them: rich" in told[0] and told[-1].startswith("1 of 2")
    told, status = judged([GOOD, BAD])
    assert status == 1 and told[0] == "lz4 1.0: PYSEC-1 (mended in: 1.1, 2.0)"
    assert judged([])[1] == 1


@pytest.mark.parametrize("answer", ["", json.dumps({"dependencies": [UNKNOWN]})])
def test_an_audit_that_reached_nothing_fails_and_says_so(answer: str, tmp_path: Path) -> None:
    (tmp_path / "python").symlink_to(sys.executable)
    program = tmp_path / "pip-audit"
    program.write_text(f"#!/bin/sh\necho first >&2\necho no network >&2\necho '{answer}'\n")
    os.chmod(program, 0o755)
    done = subprocess.run([tmp_path / "python", AUDIT], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "0 of 1 packages were looked up" in done.stdout or done.stderr == (
        "pip-audit failed, nothing was audited: no network\n"
    )
