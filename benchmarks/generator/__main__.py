"""`python -m sprung.benchmarks.generator --count 60 --seed 7 --out DIR`: a set of recordings with labels.json.

With `--day SECONDS` one recording of a working day (stops, passengers, weather, curves, clocks, wear), `DIR/day.mcap`,
and its truth beside it; `--fault secondary_1l.damping,600,0.8,300` (target, s, what remains, over s), repeatable.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from sprung.benchmarks.generator import draw_cases, read_vehicle, write_set
from sprung.benchmarks.generator.dayfile import FILES, write_day
from sprung.benchmarks.generator.make import FORMATS
from sprung.benchmarks.generator.timetable import Fault, Service

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
    parser.add_argument("--day", type=float, metavar="SECONDS", help="one recording of a working day instead of a set")
    parser.add_argument("--fault", action="append", default=[], help="of the day: TARGET,AT,REMAINS,OVER")
    parser.add_argument("--clock", type=float, default=5e-3, help="of the day: largest offset of a node's clock, s")
    parser.add_argument("--later", type=float, default=0.0, metavar="SECONDS", help="of the day: begins so much later")
    given = parser.parse_args()
    vehicle = read_vehicle(given.system)
    if given.day:
        kind = (given.formats or "mcap").split(",")[0]
        if kind not in FILES:
            parser.error(f"--formats: a day is written as {', '.join(FILES)}")
        faults = tuple(_fault(parser, text) for text in given.fault)
        given.out.mkdir(parents=True, exist_ok=True)
        service = Service(clock=given.clock, faults=faults)
        print(write_day(vehicle, service, given.day, given.seed, given.out / f"day.{kind}", given.later))
        return
    kinds = given.kinds.split(",") if given.kinds else None
    formats = tuple(given.formats.split(",")) if given.formats else FORMATS
    cases = draw_cases(vehicle, given.count, given.seed, kinds, given.weak)

    def progress(text: str) -> None:
        print(f"\r{text}", end="", file=sys.stderr)

    labels = write_set(vehicle, cases, given.out, given.seconds, formats, given.batch, progress)
    print(f"\n{labels}")


def _fault(parser: argparse.ArgumentParser, text: str) -> Fault:
    target, *numbers = text.split(",")
    try:
        at, ratio, over = (float(part) for part in [*numbers, "0"][:3])
    except ValueError:
        parser.error(f"--fault {text}: TARGET,AT,REMAINS,OVER is expected, e.g. secondary_1l.damping,600,0.8,300")
    return Fault(target, at, ratio, over)


if __name__ == "__main__":
    main()
