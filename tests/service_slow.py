"""A task whose module takes long to import in its own process: as long as SPRUNG_TEST_IMPORT says, s."""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from pathlib import Path

from sprung.service.processes.worker import Emit, ProcessLimits, Worker

if multiprocessing.current_process().name == "sprung-worker" and __name__ != "__mp_main__":
    Path(os.environ["SPRUNG_TEST_NOTE"]).write_text(str(os.getpid()))
    time.sleep(float(os.environ["SPRUNG_TEST_IMPORT"]))


def answer(request: str, _emit: Emit[str]) -> str:
    """The request."""
    return request


if __name__ == "__main__":  # a parent that is killed while its worker imports
    from tests import service_slow

    worker: Worker[str, str] = Worker(service_slow.answer, sys.argv[1], ProcessLimits(600, 600), "the work")
    list(worker.messages())
