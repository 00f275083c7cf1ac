"""The tutorial, command by command, as a reader would type it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TUTORIAL = ROOT / "docs" / "tutorial.md"
FILES = re.compile(r"^`([\w.]+)`:\n\n```\w+\n(.*?)^```", re.S | re.M)
CONSOLE = re.compile(r"^```console\n(.*?)^```", re.S | re.M)


def commands() -> list[tuple[str, str]]:
    """Command and remark of every line that begins with a dollar sign."""
    lines = [line for block in CONSOLE.findall(TUTORIAL.read_text(encoding="utf-8")) for line in block.splitlines()]
    found = [line[2:].partition("#") for line in lines if line.startswith("$ ")]
    return [(command.strip(), remark.strip()) for command, _, remark in found]


@pytest.mark.slow
def test_every_command_of_the_tutorial_does_what_it_says(tmp_path: Path) -> None:
    for name, content in FILES.findall(TUTORIAL.read_text(encoding="utf-8")):
        (tmp_path / name).write_text(content, encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    said = {}
    for command, remark in commands():
        words = command.split()
        words[0:1] = [sys.executable] if words[0] == "python" else [sys.executable, "-m", "sprung"]
        if remark == "until Ctrl-C":
            serves(words, tmp_path, environment)
            continue
        done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == (1 if remark == "exit 1" else 0), (command, done.stdout, done.stderr)
        said[command] = done.stdout
    alarm = next(text for command, text in said.items() if "friday" in command)
    change = re.search(r"alarm: strut\.damping (-\d+\.\d) ± \d+\.\d %", alarm)
    assert change is not None and abs(float(change[1]) + 30.0) < 2.0, alarm
    assert not re.search(r"(alarm|warning): (?!strut\.damping)", alarm), alarm
    assert "strut.damping" in (tmp_path / "car-1.csv").read_text(encoding="utf-8")


def serves(words: list[str], folder: Path, environment: dict[str, str]) -> None:
    """The pages show the vehicle, and Ctrl-C ends the service."""
    address = f"http://127.0.0.1:{words[words.index('--port') + 1]}"
    service = subprocess.Popen(words, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        for _ in range(600):
            try:
                page = urllib.request.urlopen(f"{address}/pages/vehicles/car-1").read().decode()
                break
            except (urllib.error.URLError, ConnectionError):
                time.sleep(0.2)
        assert "strut.damping" in page and "-30" in page.replace("−", "-").replace("-29.", "-30.")
        service.send_signal(signal.SIGINT)
        assert service.wait(60) == 0
    finally:
        service.kill()
        service.wait()


def test_the_tutorial_names_only_commands_that_exist() -> None:
    from sprung.service.cli.app import app

    known = {one.callback.__name__ for one in app.registered_commands if one.callback is not None}
    used = {command.split()[1] for command, _ in commands() if command.startswith("sprung ")}
    assert used <= known and len(used) >= 5
