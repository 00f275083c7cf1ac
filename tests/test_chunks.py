"""Work shared among threads: results in order, in the context of the caller."""

from __future__ import annotations

import numpy as np

from sprung.model.chunks import share


def test_results_come_in_the_order_of_the_pieces() -> None:
    assert share(lambda piece: 2 * piece, [3, 1, 2], 2) == [6, 2, 4]


def test_handling_of_overflow_is_that_of_the_caller() -> None:
    with np.errstate(over="ignore", divide="raise"):
        handled = share(lambda _: (np.geterr()["over"], np.geterr()["divide"]), range(4), 2)
    assert handled == [("ignore", "raise")] * 4
