"""`sprung bench length [--longest 600] [--seed 1]`: time and memory of a diagnosis over the length of the recording.

A healthy vehicle of the independent generator, diagnosed in a process of its own for every length: processor time and
peak memory, and the stretch that was diagnosed where that is not all of it.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sprung.benchmarks.generator import draw_cases, make_recordings, read_vehicle
from sprung.benchmarks.setups import in_order
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.system import MANCHESTER, load_system

LENGTHS = (60.0, 120.0, 300.0, 600.0)  # s
MEGABYTE = 2**20 if sys.platform == "darwin" else 2**10  # in units of ru_maxrss


@dataclass(frozen=True)
class LongRecord:
    """What a diagnosis needs of a recording."""

    values: NDArray[np.float64]
    sample_rate: float = 100.0
    lost: int = 0


def run(longest: float = 600.0, seed: int = 1) -> Iterator[dict[str, Any]]:
    """Yields one line per length."""
    for seconds in (one for one in LENGTHS if one <= longest):
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            yield pool.submit(measured, seconds, seed).result()


def measured(seconds: float, seed: int) -> dict[str, Any]:
    """One diagnosis: what it took, and what it said."""
    system, vehicle = load_system(), read_vehicle(MANCHESTER)
    (made,) = make_recordings(vehicle, draw_cases(vehicle, 1, seed, ["clean"]), seconds)
    record = LongRecord(in_order(system, made.values))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MEGABYTE
    began = time.process_time()
    report = diagnose(system, record, Options(file=f"{seconds:g} s"))
    return {
        "seconds": seconds,
        "samples": len(record.values),
        "verdict": report.verdict,
        "cpu_seconds": round(time.process_time() - began, 1),
        "megabytes_before": round(before),
        "megabytes_at_most": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MEGABYTE),
        "used": report.recording.used,
    }
