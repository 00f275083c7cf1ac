"""The log: what strangers send does not fill it."""

from __future__ import annotations

import json
import subprocess
import sys


def test_malformed_forms_of_strangers_leave_no_line_each() -> None:
    code = (
        "from sprung.service.observability.logs import set_up\n"
        "from python_multipart.multipart import MultipartParser\n"
        "set_up('text', 'info')\n"
        "try: MultipartParser(b'b').write(b'--b\\nx: y')\n"
        "except ValueError: print('refused')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("refused\n", "")


def test_warnings_of_libraries_are_events_too() -> None:
    code = (
        "import warnings\n"
        "from sprung.service.observability.logs import set_up\n"
        "set_up('json', 'info')\n"
        "warnings.warn('a process died unexpectedly')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60)
    (line,) = done.stderr.splitlines()
    assert "UserWarning: a process died unexpectedly" in json.loads(line)["event"]
