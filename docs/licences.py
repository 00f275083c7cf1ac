"""The licence of every package that requirements.lock installs, as its own metadata says: `make licences`."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

LOCK = Path(__file__).resolve().parents[1] / "requirements.lock"


def licence(name: str) -> str:
    """The licence expression, else the classifier, else the first line of the licence field."""
    found = metadata(name)

    def stated(field: str) -> list[str]:
        return [str(value) for value in found.get_all(field) or []]

    classifiers = [line.rpartition(" :: ")[2] for line in stated("Classifier") if line.startswith("License")]
    said = next((", ".join(x) for x in (stated("License-Expression"), classifiers, stated("License")) if any(x)), "")
    said = said.strip() or "not stated"
    return said.splitlines()[0][:80]


def main() -> None:
    """A line a package."""
    for line in LOCK.read_text(encoding="utf-8").splitlines():
        name, _, version = line.partition("==")
        if not version or name.startswith("#"):
            continue
        try:
            print(f"{name:32s} {version:16s} {licence(name)}")
        except PackageNotFoundError:
            print(f"{name:32s} {version:16s} is not installed")


if __name__ == "__main__":
    main()
