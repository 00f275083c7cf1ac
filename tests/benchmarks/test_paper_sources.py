"""When a row of the paper's benchmark is stale: what a change of code has to touch."""

from __future__ import annotations

from pathlib import Path

import pytest

from sprung.benchmarks import paper, paper_sources
from sprung.benchmarks.paper_sources import SameRows, digest, is_current, sources

FILES = {
    "benchmarks/rows.py": """
        from sprung.model import systems, used
        from sprung.model.kit import Tool

        def rows():
            return used.helper(Tool().work())

        def other_rows():
            return [system.TASK for system in (systems,)]
        """,
    "model/used.py": """
        LIMIT = 3

        def helper(x):
            '''What it does.'''
            return min(x, LIMIT)  # at most

        def idle(x):
            return -x
        """,
    "model/systems.py": """
        TASK = "a"
        SIZE = 2
        """,
    "model/kit/__init__.py": """
        from sprung.model.kit.tool import Tool
        """,
    "model/kit/tool.py": """
        def _turned(x):
            return x + 1

        class Tool:
            def work(self):
                return _turned(1)
        """,
}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(line.removeprefix("        ") for line in text.splitlines()))
    return tmp_path


def changed(tree: Path, name: str, old: str, new: str, rows: str = "rows") -> bool:
    """Whether a change of a file makes the rows stale."""

    def now() -> str:
        digest.cache_clear()
        return digest(tree, "sprung.benchmarks.rows", rows)

    before, path = now(), tree / name
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return now() != before


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("model/used.py", "min(x, LIMIT)", "max(x, LIMIT)"),
        ("model/used.py", "LIMIT = 3", "LIMIT = 4"),
        ("model/kit/tool.py", "x + 1", "x + 2"),
        ("model/kit/tool.py", "return _turned(1)", "return 1"),
        ("benchmarks/rows.py", "Tool().work()", "1"),
    ],
)
def test_rows_are_stale_where_code_on_their_path_changed(tree: Path, name: str, old: str, new: str) -> None:
    assert changed(tree, name, old, new)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("model/used.py", "-x", "+x"),
        ("model/used.py", "What it does.", "What it is for."),
        ("model/used.py", "  # at most", ""),
        ("model/systems.py", "SIZE = 2", "SIZE = 3"),
        ("benchmarks/rows.py", "system.TASK for", "system.SIZE for"),
    ],
)
def test_rows_are_not_stale_where_other_code_changed(tree: Path, name: str, old: str, new: str) -> None:
    assert not changed(tree, name, old, new)


def test_a_module_that_is_passed_on_counts_as_a_whole(tree: Path) -> None:
    assert changed(tree, "model/systems.py", "SIZE = 2", "SIZE = 3", rows="other_rows")


def test_every_task_has_code_and_is_told_from_the_others() -> None:
    assert paper_sources.MADE_BY.keys() == paper.TASKS.keys()
    assert len({sources(task) for task in paper.TASKS}) == len(paper.TASKS)
    with pytest.raises(ValueError, match="has no nonsense"):
        digest(Path(paper_sources.__file__).resolve().parent.parent, "sprung.benchmarks.paper_visual", "nonsense")


def test_rows_of_the_training_reach_what_trains_them() -> None:
    reader = paper_sources._SourceReader(Path(paper.__file__).resolve().parent.parent, ())
    reached = paper_sources._reached(reader, paper_sources.MADE_BY["pendulum"])
    for place in (
        ("sprung.model.alps.fit", "_update_loss"),
        ("sprung.model.alps.losses", "tempered"),
        ("sprung.model.alps.rollout", "runge_kutta"),
        ("sprung.model.identification.amortised.training", "TrainingRun"),
        ("sprung.model.alps.config", "_QUICK"),
    ):
        assert place in reached
    assert ("sprung.model.identification.amortised.training", "training_benefit") not in reached


def test_the_trains_vehicle_has_no_law_that_its_rows_would_depend_on() -> None:
    root = Path(paper.__file__).resolve().parent.parent
    assert "law" not in (root / paper_sources.FILES["train"][0]).read_text()


def test_code_that_makes_the_same_rows_ends_with_the_next_change(monkeypatch: pytest.MonkeyPatch) -> None:
    row = {"task": "pendulum", "budget": "quick", "sources": "old"}
    assert not is_current(row) and is_current(row | {"sources": sources("pendulum")})
    same = SameRows("pendulum", "quick", "old", sources("pendulum"), "only `full` changed")
    monkeypatch.setattr(paper_sources, "SAME", (same,))
    assert is_current(row) and not is_current(row | {"budget": "full"})
    monkeypatch.setattr(paper_sources, "SAME", (SameRows("pendulum", "quick", "old", "before", ""),))
    assert not is_current(row)
