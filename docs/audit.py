"""Known vulnerabilities of every package in the locks of the service and the fleet: `make audit`.

pip-audit says "No known vulnerabilities found" of packages that it could not look up, too; here they are counted, and
the status is 0 only if every package was looked up and nothing is known against any.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LOCKS = ("requirements.lock", "requirements-fleet.lock")


def asked(arguments: Sequence[str] = ()) -> list[dict[str, Any]]:
    """What pip-audit answers: a row a package with name, version and vulns, or with skip_reason."""
    command = ["pip-audit", "--disable-pip", "--no-deps", "--progress-spinner", "off", "--format", "json", *arguments]
    for lock in LOCKS:
        command += ["--requirement", str(ROOT / lock)]
    done = subprocess.run(
        [str(Path(sys.executable).with_name(command[0])), *command[1:]], capture_output=True, text=True, check=False
    )
    try:
        rows: list[dict[str, Any]] = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError):
        why = (done.stderr.strip() or done.stdout.strip() or f"exit status {done.returncode}").splitlines()[-1]
        raise SystemExit(f"pip-audit failed, nothing was audited: {why}") from None
    return rows


def judged(rows: Sequence[dict[str, Any]]) -> tuple[list[str], int]:
    """Lines to print, and the exit status."""
    unknown = [row for row in rows if "skip_reason" in row]
    bad = [row for row in rows if row.get("vulns")]
    lines = []
    for row in bad:
        for flaw in row["vulns"]:
            fixed = ", ".join(flaw["fix_versions"]) or "none yet"
            lines.append(f"{row['name']} {row['version']}: {flaw['id']} (mended in: {fixed})")
    if unknown:
        names = ", ".join(row["name"] for row in unknown)
        lines.append(f"Not looked up, so that nothing is known of them: {names}")
        lines.append(f"The first reason: {unknown[0]['skip_reason']}")
    lines.append(f"{len(rows) - len(unknown)} of {len(rows)} packages were looked up; {len(bad)} with vulnerabilities")
    return lines, int(bool(bad or unknown or not rows))


if __name__ == "__main__":
    told, status = judged(asked(sys.argv[1:]))
    print("\n".join(told))
    sys.exit(status)
