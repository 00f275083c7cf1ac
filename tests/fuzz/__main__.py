"""`python -m tests.fuzz --mutants 1000`: one JSON line per format."""

import argparse
import subprocess
import sys
from pathlib import Path

from tests.fuzz.harness import bounded
from tests.fuzz.seeds import SEEDS


def main() -> int:
    """0 when no mutant found a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=1000, help="per format")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder for mutants that show a fault")
    parser.add_argument("--here", action="store_true", help="in this process (one format)")
    parser.add_argument("formats", nargs="*", default=list(SEEDS))
    options = parser.parse_args()
    if options.here:
        bounded(options.formats[0], options.mutants, options.seed, options.keep)
        return 0
    status = 0
    for name in options.formats:
        command = [
            sys.executable,
            "-m",
            "tests.fuzz",
            "--here",
            f"--mutants={options.mutants}",
            f"--seed={options.seed}",
        ]
        command += [] if options.keep is None else [f"--keep={options.keep}"]
        done = subprocess.run([*command, name], stdout=subprocess.PIPE, text=True, check=False)
        print(
            done.stdout.strip() or f'{{"fuzz": "{name}", "faults": {{"ended with {done.returncode}": 1}}}}', flush=True
        )
        status |= done.returncode != 0 or '"faults": {}' not in done.stdout or '"silent": 0' not in done.stdout
    return status


if __name__ == "__main__":
    sys.exit(main())
