"""Figures of the page that are made again: which are taken, and when one counts as the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sprung.benchmarks import paper, rerun_paper
from sprung.service.errors import UserError

PAGE = """
<!-- rows pendulum -->
| method | SE | PE |
|---|---|---|
| zero | 494.2 ± 12 | - |
| alps | 58.47 ± 21 (86.48) | 0.0365 (0.06) |

Made at `abc`, seeds 0, 1, 2.
<!-- end -->
<!-- rows kernels -->
| method | row_minimum |
|---|---|
| k_MAG | 0.8542 |

Made at `abc`, seed 4.
<!-- end -->
<!-- rows train -->
| method | SE |
|---|---|
| alps | 1.0 |
<!-- end -->
"""


def test_figures_are_read_with_their_spread_and_seeds() -> None:
    cells = {(c.task, c.method, c.column): c for c in rerun_paper.stated(PAGE)}
    assert len(cells) == 4  # the last table does not say its seeds
    assert cells["pendulum", "alps", "SE"].spread == 21
    assert cells["pendulum", "alps", "PE"].mean == 0.0365
    assert cells["kernels", "k_MAG", "row_minimum"].seeds == (4,)


@pytest.mark.parametrize(("again", "within"), [(0.8542, True), (0.8549, True), (0.8600, False), (None, False)])
def test_a_figure_of_one_seed_must_come_out_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, again: float | None, within: bool
) -> None:
    asked: list[Any] = []

    def made(task: str, **options: Any) -> list[dict[str, Any]]:
        asked.append((task, options["seed"]))
        return [{"method": "k_DFT", "row_minimum": 0.1}, {"method": "k_MAG", "row_minimum": again}]

    monkeypatch.setattr(paper, "run", made)
    (tmp_path / "page.md").write_text(PAGE)
    (row,) = rerun_paper.run(1, task="kernels", document=tmp_path / "page.md")
    assert (asked, row["within"]) == ([("kernels", 4)], within)


def test_a_table_without_methods_is_drawn_from_by_its_inputs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(paper, "run", lambda *_, **__: [{"inputs": n, "balance": 0.01 * n} for n in (1, 2)])
    text = "| method | balance |\n|---|---|\n| 2 inputs | 0.02 |\n\nMade at `abc`, seed 0."
    (tmp_path / "page.md").write_text(f"<!-- rows phase -->\n{text}\n<!-- end -->")
    (row,) = rerun_paper.run(1, task="phase", document=tmp_path / "page.md")
    assert (row["method"], row["again"], row["within"]) == ("2 inputs", 0.02, True)


def test_every_table_of_rows_on_the_page_is_drawn_from() -> None:
    text = rerun_paper.DOCUMENT.read_text()
    assert {task for task, _ in rerun_paper.BLOCK.findall(text)} == {cell.task for cell in rerun_paper.stated(text)}


def test_a_figure_of_several_seeds_may_vary_as_they_do() -> None:
    cell = next(c for c in rerun_paper.stated(PAGE) if (c.method, c.column) == ("zero", "SE"))
    assert 36 < cell.allowed < 45


def test_a_page_without_such_figures_is_said(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text("nothing")
    with pytest.raises(UserError, match="no figures that"):
        list(rerun_paper.run(document=tmp_path / "page.md"))
    with pytest.raises(UserError, match="no figures of train that"):
        list(rerun_paper.run(task="train", document=tmp_path / "page.md"))
    with pytest.raises(UserError, match="0 cells"):
        list(rerun_paper.run(0))
