"""Processes below one are found, and their processor time."""

from __future__ import annotations

import os
import subprocess
import sys

from sprung.benchmarks.fleet_processes import busy_seconds, descendants

BUSY = "import time\nwhile time.process_time() < 0.3: pass\nprint('done', flush=True)\ninput()"


def test_what_a_child_takes_is_counted_while_it_runs() -> None:
    before = busy_seconds()
    child = subprocess.Popen([sys.executable, "-c", BUSY], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    assert child.stdout.readline() == "done\n"
    assert child.pid in [one.pid for one in descendants(os.getpid())]
    assert busy_seconds() - before >= 0.28
    child.communicate("\n")
    assert child.pid not in [one.pid for one in descendants(os.getpid())]
    assert busy_seconds() - before >= 0.28  # also when it has ended
