"""Diagnoses of many recordings: each told of as it is done, what fails told with it, and nothing done twice."""

from __future__ import annotations

from pathlib import Path

import pytest

from sprung.service.diagnosis.task import DiagnosisRequest, DiagnosisResult
from sprung.service.errors import UserError
from sprung.service.fleet import many
from sprung.service.fleet.many import DiagnosedFile, diagnose_many
from sprung.service.fleet.tasks import HereTasks, WorkLost
from sprung.service.settings import Settings


@pytest.fixture
def place(tmp_path: Path) -> Path:
    folder = tmp_path / "recordings"
    (folder / "north").mkdir(parents=True)
    for name in ("a.csv", "b.csv", "north/c.csv"):
        (folder / name).write_text(name)
    return folder


@pytest.fixture
def diagnosed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of what was diagnosed, in order; b breaks something, c is no recording."""
    names: list[str] = []

    def run(request: DiagnosisRequest, emit: object) -> DiagnosisResult:
        names.append(request.name)
        if request.name == "b.csv":
            raise RuntimeError("nobody has\nthought of it")
        if request.name == "c.csv":
            raise ValueError("c.csv: no channel of it is known")
        return DiagnosisResult("mismatch", {"findings": [{"sentence": "A friction."}]})

    monkeypatch.setattr(many, "run", run)
    return names


def told(place: Path, out: Path) -> list[DiagnosedFile]:
    found = list(diagnose_many(Settings(), str(place), out, HereTasks(), 2))
    assert {of for _, of in found} == {len(found)}
    return [one for one, _ in found]


def test_what_fails_is_reported_and_the_others_go_on(place: Path, diagnosed: list[str], tmp_path: Path) -> None:
    a, b, c = told(place, tmp_path / "out")
    assert (a.verdict, a.findings, a.problem) == ("mismatch", ("A friction.",), "")
    assert (b.verdict, b.problem) == ("", "unexpected RuntimeError: nobody has thought of it")
    assert (c.verdict, c.problem) == ("", "c.csv: no channel of it is known")


def test_started_again_it_does_what_is_left_and_what_has_changed(
    place: Path, diagnosed: list[str], tmp_path: Path
) -> None:
    first = told(place, tmp_path / "out")
    diagnosed.clear()
    again = told(place, tmp_path / "out")
    assert diagnosed == ["b.csv", "c.csv"]  # of which there is no report
    assert again[0].before and again[0].findings == first[0].findings and not again[1].before
    (place / "a.csv").write_text("another one")
    diagnosed.clear()
    assert not told(place, tmp_path / "out")[0].before
    assert diagnosed == ["a.csv", "b.csv", "c.csv"]


def test_each_is_reported_before_the_next_is_begun(place: Path, diagnosed: list[str], tmp_path: Path) -> None:
    found = diagnose_many(Settings(), str(place), tmp_path / "out", HereTasks(), 2)
    next(found)
    assert diagnosed == ["a.csv"]


def test_work_that_is_lost_is_a_problem_of_its_recording(place: Path, tmp_path: Path) -> None:
    class LosingAll(HereTasks):
        def submit(self, work: object, *arguments: object) -> object:
            return "pending"

        def result(self, pending: object) -> object:
            raise WorkLost("its process ended")

    found = [one for one, _ in diagnose_many(Settings(), str(place), tmp_path / "out", LosingAll(), 2)]
    assert [one.problem for one in found] == ["its process ended"] * 3


def test_a_folder_that_is_none_is_one_line(place: Path, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(UserError, match="out: is no folder"):
        told(place, tmp_path / "out")
