"""The log: what strangers send does not fill it."""

from __future__ import annotations

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
