"""One service a data folder."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sprung.service.errors import UserError
from sprung.service.lock import held

HOLDER = """
import sys, time
from pathlib import Path
from sprung.service.lock import held
with held(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_second_service_on_a_folder_is_refused_in_one_line_until_the_first_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    first = subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdout=subprocess.PIPE, text=True)
    try:
        assert first.stdout is not None and first.stdout.readline() == "held\n"
        with pytest.raises(UserError, match=rf"data.*process {first.pid}\).*--data-dir") as refused, held(folder):
            pass
        assert "\n" not in str(refused.value)
    finally:
        os.kill(first.pid, signal.SIGKILL)
        first.wait()
        assert first.stdout is not None
        first.stdout.close()
    with held(folder):  # a process that dies lets go
        assert (folder / "sprung.pid").read_text().strip() == str(os.getpid())
    with held(folder):
        pass
