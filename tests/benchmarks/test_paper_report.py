"""Rows of the paper's benchmark in the document: tables, seeds, comparisons, targets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sprung.benchmarks import paper_report, rerun_paper
from sprung.benchmarks.paper_report import compare, document, kept
from sprung.benchmarks.paper_report.comparisons import (
    comparisons,
    comparisons_by_seed,
    comparisons_of_pairs,
    comparisons_of_tasks,
)
from sprung.benchmarks.paper_sources import sources
from sprung.service.errors import UserError

PAGE = """# Page
<!-- targets -->
<!-- end -->
<!-- rows pendulum -->
<!-- end -->
<!-- variants pendulum -->
<!-- end -->
<!-- rows train -->
as it was
<!-- end -->
"""


def keep(folder: Path, method: str, seed: int, **figures: Any) -> None:
    (folder / "rows").mkdir(exist_ok=True)
    row = {
        "task": "pendulum",
        "method": method,
        "seed": seed,
        "commit": "abc",
        "sources": sources("pendulum"),
    } | figures
    (folder / "rows" / f"pendulum-{method}-s{seed}.json").write_text(json.dumps(row))


def keep_errors(folder: Path, method: str, seed: int, **figures: np.ndarray) -> None:
    (folder / "errors").mkdir(exist_ok=True)
    np.savez(folder / "errors" / f"pendulum-{method}-s{seed}.npz", **figures)  # type: ignore[arg-type]


def lines(table: str) -> dict[str, list[str]]:
    """Cells of a table by method and figure, or by method alone."""
    split = [[cell.strip() for cell in line.strip("| ").split("|")] for line in table.splitlines()[2:]]
    return {cells[0] + (f" {cells[1]}" if cells[1] in ("SE", "PE") else ""): cells for cells in split}


def test_targets_that_are_met_are_said(tmp_path: Path) -> None:
    for seed, error in ((0, 0.03), (1, 0.05)):
        keep(tmp_path, "alps", seed, SE=100.0, PE=error)
    document = tmp_path / "paper.md"
    document.write_text(PAGE)
    paper_report.refresh(tmp_path, document)
    text = document.read_text()
    assert "| pendulum | alps PE | 0.06 | 0.05 | 0.04 ± 0.014 | yes |" in text
    assert "| pendulum | alps SE | 86.48 | 86.48 | 100 ± 0 | no |" in text
    assert "| train | alps SE | 3.02 | - | not run yet |  |" in text
    assert "<!-- rows train -->\nas it was\n<!-- end -->" in text


def test_methods_of_other_seeds_say_theirs_and_are_read_again_with_them(tmp_path: Path) -> None:
    for seed in (1, 2):
        keep(tmp_path, "alps", seed, SE=10.0 + seed, PE=0.1)
    keep(tmp_path, "no_phases", 1, SE=80.0)
    document = tmp_path / "paper.md"
    document.write_text(PAGE)
    paper_report.refresh(tmp_path, document)
    found = {(cell.method, cell.column): cell for cell in rerun_paper.stated(document.read_text())}
    assert (found["alps", "SE"].mean, found["alps", "SE"].seeds) == (11.5, (1, 2))
    assert (found["no_phases", "SE"].spread, found["no_phases", "SE"].seeds) == (None, (1,))


def test_only_the_places_that_are_named_are_written(tmp_path: Path) -> None:
    keep(tmp_path, "alps", 0, SE=1.0, PE=1.0)
    document = tmp_path / "paper.md"
    document.write_text(PAGE)
    (told,) = paper_report.run(tmp_path, document, only="variants pendulum")
    assert told == {"place": "variants pendulum", "rows": 1, "seeds": "0", "changed": True}
    assert "<!-- rows pendulum -->\n<!-- end -->" in document.read_text()
    with pytest.raises(UserError, match="no rows for any place of variants train"):
        list(paper_report.run(tmp_path, document, only="variants train"))


def test_r2_of_every_state_stands_on_the_page_and_is_made_again_from_there(tmp_path: Path) -> None:
    for seed in (0, 1):
        keep(tmp_path, "alps", seed, **{"R2 angle": 0.9 + 0.02 * seed, "R2 rate": 0.8})
        keep(tmp_path, "zero", seed, SE=1.0)
    document = tmp_path / "paper.md"
    document.write_text("<!-- explained pendulum -->\n<!-- end -->\n")
    paper_report.refresh(tmp_path, document)
    found = {(cell.method, cell.column): cell for cell in rerun_paper.stated(document.read_text())}
    assert found.keys() == {("alps", "R2 angle"), ("alps", "R2 rate")}
    assert (found["alps", "R2 angle"].mean, found["alps", "R2 angle"].spread) == (0.91, 0.014)


def test_rows_of_other_code_are_refused(tmp_path: Path) -> None:
    keep(tmp_path, "alps", 0, sources="other")
    document = tmp_path / "paper.md"
    document.write_text(PAGE)
    with pytest.raises(UserError, match="rows of other code than this: pendulum alps"):
        list(paper_report.run(tmp_path, document))


def test_tasks_with_rows_of_other_code_stay_as_they_stand(tmp_path: Path) -> None:
    keep(tmp_path, "alps", 0, SE=1.0, PE=1.0)
    keep(tmp_path, "alps", 1, task="train", SE=1.0, sources="other")
    document = tmp_path / "paper.md"
    document.write_text(PAGE)
    told = {row["place"]: row for row in paper_report.run(tmp_path, document, only="rows")}
    assert told["rows pendulum"]["changed"]
    assert told["rows train"] == {"place": "rows train", "rows_of_other_code": ["train alps"], "changed": False}
    assert "<!-- rows train -->\nas it was\n<!-- end -->" in document.read_text()


def test_a_method_that_is_worse_on_every_seed_is_distinguished_from_one_that_is_worse_on_one(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for seed in range(3):
        base = rng.uniform(1, 2, 60)
        keep_errors(tmp_path, "alps", seed, SE=base, PE=base)
        keep_errors(tmp_path, "no_phases", seed, SE=(2 + 0.01 * seed) * base * rng.uniform(0.99, 1.01, 60))
        keep_errors(tmp_path, "no_opening", seed, SE=(4.0 if seed == 0 else 1.01) * base * rng.uniform(0.99, 1.01, 60))
    both = lines(comparisons_by_seed("pendulum", tmp_path / "errors"))
    assert [float(x) for x in both["no_phases SE"][3].split(", ")] == pytest.approx([2, 2.01, 2.02], rel=0.01)
    by_trajectory, by_seed = (float(cell) for cell in both["no_phases SE"][4:])
    assert by_trajectory < 1e-20 and by_seed < 0.001
    by_trajectory, by_seed = (float(cell) for cell in both["no_opening SE"][4:])
    assert by_trajectory < 1e-20 and by_seed > 0.2  # the networks differ; that the methods do is not shown
    assert "no_phases PE" not in both  # it has no parameters


def test_the_smallest_p_is_corrected_for_the_number_of_methods(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    base = rng.uniform(1, 2, 40)
    keep_errors(tmp_path, "alps", 0, SE=base)
    keep_errors(tmp_path, "no_phases", 0, SE=base + 0.1 * rng.standard_normal(40) + 0.05)
    alone = float(lines(comparisons("pendulum", tmp_path / "errors"))["no_phases"][3])
    keep_errors(tmp_path, "no_opening", 0, SE=base)
    beside = lines(comparisons("pendulum", tmp_path / "errors"))
    assert float(beside["no_phases"][3]) == pytest.approx(2 * alone, rel=0.02)
    assert beside["no_opening"][2:4] == ["1 (1 to 1)", "1"]


def test_any_two_methods_can_be_held_against_each_other(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    for seed in range(3):
        base = rng.uniform(1, 2, 60)
        keep_errors(tmp_path, "cdm", seed, SE=base)
        keep_errors(tmp_path, "cdm_plain", seed, SE=1.5 * base * rng.uniform(0.9, 1.1, 60))
    keep_errors(tmp_path, "cdm_plain", 7, SE=np.ones(60))  # of a seed that the other has not
    (row,) = compare.run("pendulum", "cdm_plain", over="cdm", data=tmp_path)
    assert row["seeds"] == [0, 1, 2] and row["figure"] == "SE"
    assert row["interval"][0] < row["ratio"] < row["interval"][1]
    assert row["ratio"] == pytest.approx(1.5, rel=0.03) and row["by_seed"] == pytest.approx([1.5] * 3, rel=0.03)
    assert row["p_trajectories"] < 1e-20 and row["p_seeds"] < 0.01
    (said,) = comparisons_of_pairs("pendulum", tmp_path / "errors").splitlines()[2:]
    assert said.startswith(f"| cdm_plain | cdm | SE | {row['ratio']:.3g} (")
    with pytest.raises(UserError, match="no rows of zero and cdm on pendulum from one seed"):
        list(compare.run("pendulum", "zero", over="cdm", data=tmp_path))


def test_tables_say_which_seeds_have_other_arithmetic(tmp_path: Path) -> None:
    for seed, arithmetic in ((0, "AVX2"), (1, "AVX2"), (2, "AVX512")):
        keep(tmp_path, "alps", seed, SE=1.0, arithmetic=arithmetic)
    document = tmp_path / "paper.md"
    document.write_text(PAGE)
    paper_report.refresh(tmp_path, document, ["rows"])
    assert "Made at `abc`, seeds 0, 1, 2; AVX2 (seeds 0, 1); AVX512 (seed 2)." in document.read_text()
    assert {cell.seeds for cell in rerun_paper.stated(document.read_text())} == {(0, 1, 2)}


def test_rows_of_one_seed_with_different_arithmetic_are_not_held_against_each_other(tmp_path: Path) -> None:
    for method, arithmetic in (("alps", "AVX512"), ("cdm", "AVX2"), ("zero", "AVX512")):
        keep(tmp_path, method, 0, SE=1.0, PE=1.0, arithmetic=arithmetic)
        keep_errors(tmp_path, method, 0, SE=np.ones(9))
    page, archive = tmp_path / "paper.md", tmp_path / "rows.zip"
    page.write_text(PAGE)
    with pytest.raises(UserError, match="different arithmetic: pendulum seed 0"):
        list(paper_report.run(tmp_path, page))
    assert page.read_text() == PAGE
    for figure in (None, "SE"):
        with pytest.raises(UserError, match="cdm and alps were made with different arithmetic: pendulum seed 0"):
            list(compare.run("pendulum", "cdm", figure=figure, data=tmp_path))
        assert list(compare.run("pendulum", "zero", figure=figure, data=tmp_path))
    list(kept.run("core", tmp_path, methods="alps,zero", archive=archive))
    before = archive.read_bytes()
    with pytest.raises(UserError, match="pendulum seed 0: the set 'core' would hold rows of different arithmetic"):
        list(kept.run("core", tmp_path, methods="cdm", archive=archive))
    assert archive.read_bytes() == before


def test_methods_of_the_train_are_held_against_each_other_by_seed(tmp_path: Path) -> None:
    for seed in range(3):
        for method, error in (("alps", 0.01), ("cdm", 0.2 + 0.01 * seed)):
            keep(tmp_path, method, seed, task="train", SE_relative=error, sources=sources("train"))
    page = tmp_path / "paper.md"
    page.write_text("<!-- compared train -->\n<!-- end -->\n")
    list(paper_report.run(tmp_path, page))
    assert "| cdm over alps, SE_relative | 21 | 20, 21, 22 | 8.2e-05 |" in page.read_text()


def test_any_figure_of_the_rows_is_compared_by_seed(tmp_path: Path) -> None:
    for seed in range(3):
        keep(tmp_path, "alps", seed, PE_noisy=0.02 * (seed + 1))
        keep(tmp_path, "output_error", seed, PE_noisy=(2 + 0.1 * seed) * 0.02 * (seed + 1))
    keep(tmp_path, "output_error", 3, PE_noisy=1.0)  # of a seed that the other has not
    (row,) = compare.run("pendulum", "output_error", figure="PE_noisy", data=tmp_path)
    assert row["seeds"] == [0, 1, 2] and row["by_seed"] == [2, 2.1, 2.2] and row["p_seeds"] < 0.01
    assert row["values_over"] == [0.02, 0.04, 0.06]
    with pytest.raises(UserError, match="no rows of output_error and alps on pendulum from one seed with OE"):
        list(compare.run("pendulum", "output_error", figure="OE", data=tmp_path))


def test_p_of_one_figure_is_corrected_for_the_number_of_tasks() -> None:
    rows = [
        {"task": task, "method": method, "seed": seed, "PE_noisy": value}
        for seed in range(3)
        for task, ratio in (("pendulum", 2 + 0.1 * seed), ("two_body", 1 + 0.5 * seed))
        for method, value in (("alps", 0.1), ("output_error", 0.1 * ratio))
    ]
    one, other = (
        comparisons_of_tasks(rows, tasks, "output_error", "alps", "PE_noisy")
        for tasks in (["pendulum"], ["pendulum", "two_body"])
    )
    assert one is not None and other is not None
    alone, beside = (lines(table)["pendulum"] for table in (one, other))
    assert beside[:3] == ["pendulum", "2.1", "2, 2.1, 2.2"]
    assert float(beside[3]) == pytest.approx(2 * float(alone[3]), rel=0.02)
    assert comparisons_of_tasks(rows, ["pendulum", "train"], "output_error", "alps", "PE_noisy") is None


def test_rows_that_are_kept_are_compared_as_those_that_were_made(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    for seed in range(2):
        keep(tmp_path, "alps", seed, SE=1.0)
        keep(tmp_path, "cdm", seed, SE=2.0)
        keep_errors(tmp_path, "alps", seed, SE=rng.uniform(1, 2, 50))
        keep_errors(tmp_path, "cdm", seed, SE=rng.uniform(2, 4, 50))
    archive = tmp_path / "rows.zip"
    (told,) = kept.run("core", tmp_path, methods="cdm", archive=archive)
    assert told == {"kept": "core", "task": "pendulum", "method": "cdm", "seeds": [0, 1]}
    list(kept.run("core", tmp_path, methods="alps", archive=archive))  # beside what is there
    before = archive.read_bytes()
    list(kept.run("core", tmp_path, archive=archive))
    assert archive.read_bytes() == before
    with kept.opened("core", archive) as folder:
        (again,) = compare.run("pendulum", "cdm", data=folder)
    assert again == next(compare.run("pendulum", "cdm", data=tmp_path))
    with pytest.raises(UserError, match="no rows 'variants'; it has core"), kept.opened("variants", archive):
        pass
    with pytest.raises(UserError, match="no set 'cores'"):
        next(kept.run("cores", tmp_path, archive=archive))
    with pytest.raises(UserError, match="no rows of zero"):
        next(kept.run("core", tmp_path, methods="zero", archive=archive))


@pytest.mark.slow
def test_tables_of_the_page_are_those_of_the_kept_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(document, "is_current", lambda row: True)  # the page says what made its rows
    page = kept.ARCHIVE.parent / "paper.md"
    copy = tmp_path / "paper.md"
    copy.write_text(page.read_text())
    told = list(paper_report.run(None, copy))
    assert len(told) > 10 and [row["place"] for row in told if row["changed"]] == []


@pytest.mark.parametrize("made", [(), ("rows",)], ids=["no folder", "no rows"])
def test_a_folder_without_rows_is_refused(tmp_path: Path, made: tuple[str, ...]) -> None:
    document = tmp_path / "paper.md"
    document.write_text("<!-- targets -->\nkept\n<!-- end -->\n")
    for name in made:
        (tmp_path / name).mkdir()
    with pytest.raises(UserError, match="rows: no"):
        list(paper_report.run(tmp_path, document))
    assert "kept" in document.read_text()
