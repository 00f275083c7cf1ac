"""Fits that still fall are fitted on before the best of them leads; what gets too little further is not tried again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import pytest

from sprung.model.diagnosis.rules import RULES
from sprung.model.diagnosis.selection import compete
from sprung.model.diagnosis.selection.compete import Trial


@dataclass(frozen=True)
class FallingFit:
    """As much of a fit as the order of trials looks at."""

    left: float
    converged: bool = False
    refused: bool = False
    grain: float = 1.0
    reduced: float = 1.0
    chi_square: float = 1.0


def trial(evidence: float, left: float) -> Trial:
    nothing: Any = None
    fit: Any = FallingFit(left)
    return Trial(nothing, fit, evidence, evidence, evidence, 1)


@pytest.mark.parametrize(("step", "calls", "leading"), [(0.0, 1, 100.0), (5.0, 1, 100.0), (30.0, 3, 150.0)])
def test_what_could_lead_is_fitted_on_while_it_gets_further(
    monkeypatch: pytest.MonkeyPatch, step: float, calls: int, leading: float
) -> None:
    tried = []

    def fitted_on(problem: Any, base: Any, one: Trial) -> Trial:
        tried.append(one)
        fit: Any = FallingFit(one.fit.left)
        return replace(one, fit=fit, evidence=one.evidence + step, gained=step)

    monkeypatch.setattr(compete, "_converged_fit", fitted_on)
    problem: Any = SimpleNamespace(work=None, process_noise=True, rules=RULES)
    base: Any = None
    done: Any = FallingFit(0.0, converged=True)
    settled = replace(trial(100.0, 0.0), fit=done)
    order = compete._with_unconverged_refitted(problem, base, [settled, trial(60.0, 50.0)])
    assert len(tried) == calls
    assert order[0].evidence == leading


def test_fits_far_behind_go_on_only_where_further_steps_could_bring_them_to_the_lead() -> None:
    def first_fit(evidence: float, left: float, chi_square: float) -> Trial:
        one = trial(evidence, left)
        fit: Any = replace(one.fit, chi_square=chi_square)
        return replace(one, fit=fit)

    best, near = first_fit(1000.0, 30.0, 200.0), first_fit(960.0, 0.1, 240.0)
    close = first_fit(800.0, 0.1, 300.0)  # its evidence counts as it is
    hopeless, falling = first_fit(200.0, 70.0, 1000.0), first_fit(100.0, 95.0, 1100.0)
    problem: Any = SimpleNamespace(process_noise=False, rules=RULES)
    leading, behind = compete._leading(problem, [best, near, close, hopeless])
    assert leading == [best, near]
    assert behind == [close, replace(hopeless, finished=False)]
    leading, behind = compete._leading(problem, [best, hopeless, falling])
    assert leading == [best, falling]
    assert behind == [replace(hopeless, finished=False)]
