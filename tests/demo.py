"""The demo of the README: the recording that `make demo` makes, and the service that replays it."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[1]
VEHICLE = "day"


def demo_command() -> list[str]:
    """What `make demo` makes its recording with, but for the folder."""
    makefile = (ROOT / "Makefile").read_text()
    recipe = re.search(r"^\$\(DEMO\):.*\n((?:\t.*\n)+)", makefile, re.MULTILINE)
    seconds = re.search(r"^DAY \?= (\d+)$", makefile, re.MULTILINE)
    assert recipe is not None and seconds is not None
    words = shlex.split(recipe[1].replace("\\\n", " ").replace("$(DAY)", seconds[1]))
    assert words[0] == "$(BIN)/python" and words[words.index("--out") + 1] == "$(@D)", words
    return [sys.executable, *words[1:]]


def made_demo(folder: Path, *options: str, faults: bool = True) -> Path:
    """The recording, which `make demo` may have left; or another one by further options of the generator."""
    words = demo_command()
    left = ROOT / ".demo" / words[words.index("--day") + 1] / f"{VEHICLE}.blf"
    if left.is_file() and faults and not options:
        return left
    words[words.index("--out") + 1] = str(folder)
    if not faults:
        words = [word for before, word in zip(["", *words], words, strict=False) if "--fault" not in (before, word)]
    subprocess.run([*words, *options], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    return folder / left.name


@contextmanager
def serving(recording: Path, folder: Path, *options: str) -> Iterator[str]:
    """The address of `sprung serve --replay`; it ends by SIGTERM."""
    command = [sys.executable, "-m", "sprung", "serve", "--replay", str(recording), "--port", "0", *options]
    with subprocess.Popen(
        [*command, "--data-dir", str(folder)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as service:
        try:
            assert service.stdout is not None
            said = service.stdout.readline()
            address = re.search(r"http://[\d.]+:\d+", said)
            assert address is not None, said
            threading.Thread(target=service.stdout.read, daemon=True).start()
            yield address[0]
        finally:
            service.terminate()
            service.wait(60)
