"""A search that ends at its budget says so, and is no all-clear."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.diagnosis.fit.optimise import optimise, try_optimise
from sprung.model.diagnosis.investigation.state import share_done
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.diagnosis.selection import compete
from sprung.model.work import WorkBudget
from tests.diagnosis_cases import problem_of, quarter_car, simulate


def test_a_search_without_any_work_left_is_not_consistent() -> None:
    said: list[str] = []
    options = Options(work=WorkBudget(0.0))
    report = diagnose(quarter_car(), simulate(seconds=6, seed=4), options, lambda share, text: said.append(text))
    assert report.verdict == "unknown_physics"
    assert "ended at its budget" in report.summary and "ended at its budget" in report.advice[0]
    assert any("budget" in text for text in said)


def test_a_search_at_its_limit_of_time_reports_what_was_found_until_then() -> None:
    options = Options(work=WorkBudget(1e9, time.monotonic()))
    report = diagnose(quarter_car(), simulate(seconds=6, seed=4), options)
    assert report.verdict == "unknown_physics"
    assert "ended at its limit of time" in report.summary and "ended at its limit of time" in report.advice[0]


def test_the_end_of_a_budget_that_was_not_needed_is_not_reported() -> None:
    work = WorkBudget(1e9, time.monotonic() + 1000)
    told = diagnose(quarter_car(), simulate(seconds=6, seed=4), Options(work=work))
    assert told.verdict == "consistent" and "ended" not in told.summary
    assert not work.ended and work.apart(2)[0].until == work.until


def test_work_is_counted_and_nothing_more_is_fitted_once_it_is_done() -> None:
    work = WorkBudget(1e9)
    problem = replace(problem_of(simulate(seconds=4, seed=4)), work=work)
    start = Point(np.zeros(len(problem.system.parameters)), (), np.zeros(4))
    assert try_optimise(problem, start, 2) is not None
    assert work.done > 0 and not work.ended
    work.most = work.done
    assert work.ended and try_optimise(problem, start, 2) is None


def test_where_a_search_ends_does_not_depend_on_which_thread_is_first(monkeypatch: pytest.MonkeyPatch) -> None:
    system, record = quarter_car(), simulate(lambda d, v: 300.0 * np.tanh(v / 2e-3), seconds=8, seed=4)
    whole = WorkBudget(1e9)
    diagnose(system, record, Options(work=whole))
    ends = []
    for workers in (1, 2, 2):
        monkeypatch.setattr(compete, "WORKERS", workers)
        work = WorkBudget(0.5 * whole.done)
        report = diagnose(system, record, Options(work=work))
        ends.append((report.to_dict(), work.done))
    assert ends[0] == ends[1] == ends[2] and work.ended


def test_the_share_done_grows_with_every_finding_and_ends_before_the_conclusion() -> None:
    shares = [share_done(findings) for findings in (0, 0.5, 1, 2, 6, 20)]
    assert shares[0] == 0.25 and shares == sorted(shares) and shares[-1] < 0.93


def test_a_portion_is_a_share_of_what_is_left_and_is_counted_with_the_rest() -> None:
    work = WorkBudget(100.0, until=math.inf)
    work.add(20.0)
    part = work.portion(0.25)
    assert part.most == 20.0 and part.until == work.until
    part.add(30.0)  # the last piece of it may be larger than what was left
    assert part.ended and not work.ended
    work.gather([part])
    assert work.done == 50.0


def test_a_competition_repeated_beside_the_same_model_fits_nothing_again() -> None:
    problem = problem_of(simulate(lambda d, v: 300.0 * np.tanh(v / 2e-3), seconds=8, seed=4))
    base = optimise(problem, Point(np.zeros(len(problem.system.parameters)), (), np.zeros(4)))
    best = sorted(screen(problem, base, problem.system.catalogue).candidates, key=lambda c: -c.score)[:3]
    first = compete.compete(problem, base, best)
    spent = replace(problem, work=WorkBudget(0.0))
    again = compete.compete(spent, base, best, known=first)
    assert len(first) > 1 and compete.compete(spent, base, best) == []
    assert [(t.term.key, t.fit.chi_square) for t in again] == [(t.term.key, t.fit.chi_square) for t in first]
