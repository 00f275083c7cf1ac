"""`python -m sprung.benchmarks.generator --count 60 --seed 7 --out DIR`: a set of recordings with labels.json."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from sprung.benchmarks.generator import draw_cases, read_vehicle, write_set
from sprung.benchmarks.generator.make import FORMATS

DEFAULT = Path(__file__).resolve().parents[2] / "model" / "systems" / "manchester.yaml"


def main() -> None:
    """Parses the command line, makes the set, says where it is."""
    parser = argparse.ArgumentParser(prog="python -m sprung.benchmarks.generator", description=__doc__)
    parser.add_argument("--count", type=int, default=32)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--weak", type=float, default=1.0, help="0: only strong effects; 1: down to hidden")
    parser.add_argument("--kinds", help="comma-separated kinds; default all")
    parser.add_argument("--formats", help="comma-separated, taken in turn; default " + ",".join(FORMATS))
    parser.add_argument("--system", type=Path, default=DEFAULT)
    given = parser.parse_args()
    vehicle = read_vehicle(given.system)
    kinds = given.kinds.split(",") if given.kinds else None
    formats = tuple(given.formats.split(",")) if given.formats else FORMATS
    cases = draw_cases(vehicle, given.count, given.seed, kinds, given.weak)

    def progress(text: str) -> None:
        print(f"\r{text}", end="", file=sys.stderr)

    labels = write_set(vehicle, cases, given.out, given.seconds, formats, given.batch, progress)
    print(f"\n{labels}")


if __name__ == "__main__":
    main()
