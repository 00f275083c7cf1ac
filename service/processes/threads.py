"""How numerics share the machine's threads.  Imports nothing numerical: it must come before they do."""

from __future__ import annotations

import os
import sys

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def one_thread_each() -> None:
    """Tell BLAS and OpenMP to use the calling thread only, unless the user said otherwise.

    Reading, identifying and tracking already run beside each other, on small matrices: threads inside each of them
    only wait for one another.  Measured on two busy cores, ten minutes of recording: 11 s of processor time with one
    thread each, 33 s with two.
    """
    for name in VARIABLES:
        os.environ.setdefault(name, "1")


def hand_over_often() -> None:
    """Let threads of small array operations take turns every 0.2 ms instead of every 5 ms.

    Each of them gives the interpreter's lock up for a fraction of a millisecond at a time and would wait for it longer.
    Measured on two cores, candidates of a diagnosis side by side: a tenth less time.
    """
    sys.setswitchinterval(2e-4)
