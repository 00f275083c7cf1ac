"""`sprung bench identify`: its figures are of what it says."""

from __future__ import annotations

from sprung.benchmarks.identify import _paper_sensing


def test_all_states_measured_identify_the_parameters_to_the_bound() -> None:
    (row,) = _paper_sensing(4)
    assert row["value"] < 2 * row["bound"] < 1.0
