"""The judge of concealed effects, against cases whose answer is plain."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sprung.benchmarks.concealed_score import (
    confusion,
    detection_limit,
    explained,
    oracle_threshold,
    rate_bound,
    same_place,
    score,
    summary,
)

LAWS = ("coulomb_friction", "cubic_stiffness", "sensor_gain")


def truth(verdict: str, *findings: tuple[str, str, list[float]], snr: float = 50.0) -> dict[str, Any]:
    return {
        "verdict": verdict,
        "kind": findings[0][1] if findings else "clean",
        "oracle_snr": snr,
        "findings": [{"location": a, "effect": b, "parameters": c} for a, b, c in findings],
        "stiffness": {"secondary_1r": 4.0e5},
        "damping": {"secondary_1r": 2.0e4},
    }


def report(
    verdict: str = "missing_physics", *findings: tuple[str, str, list[tuple[str, float, float]]]
) -> dict[str, Any]:
    values = [{"name": "secondary_1r.stiffness", "value": 4.02e5, "std": 1e3}]
    fit = {"parameters": values, "validation": {"nrmse": 0.1}}
    return {
        "verdict": verdict,
        "baseline": fit,
        "augmented": fit | {"validation": {"nrmse": 0.031}},
        "noise_floor": {"nrmse": 0.03},
        "findings": [
            {
                "location": a,
                "effect": b,
                "kind": "unlisted" if b == "unknown" else "law",
                "parameters": [{"name": n, "value": v, "std": s} for n, v, s in c],
            }
            for a, b, c in findings
        ],
    }


FRICTION = ("secondary_1r", "coulomb_friction", [400.0, 0.002])
SAID = ("secondary_1r", "coulomb_friction", [("force", 406.0, 3.0), ("smoothing", 0.01, 1e-5)])


def test_a_right_answer_scores_right_with_its_parameter_errors() -> None:
    result = score(truth("missing_physics", FRICTION), report("missing_physics", SAID), LAWS)
    assert result.verdict and result.located and result.named
    assert result.parameter_z == pytest.approx((2.0,))
    assert result.structure_z == pytest.approx((2.0,))


def test_a_right_place_with_a_wrong_name_is_located_and_not_named() -> None:
    wrong = ("secondary_1r", "cubic_stiffness", [("k3", 1.0, 1.0)])
    result = score(truth("missing_physics", FRICTION), report("missing_physics", wrong), LAWS)
    assert result.located and not result.named and result.parameter_z == ()


def test_one_finding_too_many_or_too_few_is_not_located() -> None:
    other = ("primary_11l", "cubic_stiffness", [("k3", 1.0, 1.0)])
    more = score(truth("missing_physics", FRICTION), report("missing_physics", SAID, other), LAWS)
    assert not more.located and more.found
    two = truth("missing_physics", FRICTION, ("primary_11l", "cubic_stiffness", [1.0]))
    assert not score(two, report("missing_physics", SAID), LAWS).located
    assert score(two, report("missing_physics", SAID, other), LAWS).located


def test_a_law_outside_the_catalogue_is_named_by_unknown() -> None:
    strange = truth("unknown_physics", ("primary_21r", "force_ripple", [1.0]))
    result = score(strange, report("unknown_physics", ("primary_21r", "unknown", [])), LAWS)
    assert result.verdict and result.located and result.named


def test_an_input_may_be_called_by_its_name_or_its_channel() -> None:
    assert same_place("wheel_11l", "wheel_11l.velocity") and same_place("wheel_11l.velocity", "wheel_11l")
    assert not same_place("wheel_11r.velocity", "wheel_11l.velocity")


def test_explained_is_one_at_the_floor_and_zero_at_the_baseline() -> None:
    said = report()
    said["augmented"]["validation"]["nrmse"] = 0.03
    assert explained(said) == pytest.approx(1.0)
    said["augmented"]["validation"]["nrmse"] = 0.1
    assert explained(said) == pytest.approx(0.0)
    said["noise_floor"]["nrmse"] = 0.1
    assert explained(said) is None


def test_the_detection_limit_is_found_where_it_was_put() -> None:
    rng = np.random.default_rng(2)
    snr = np.exp(rng.uniform(np.log(1), np.log(100), 400))
    detected = rng.random(400) < 1 / (1 + (6.0 / snr) ** 6)
    found = detection_limit(snr.tolist(), detected.tolist())
    assert found == pytest.approx(6.0, rel=0.1)
    assert detection_limit([1.0, 2.0, 3.0, 4.0], [True] * 4) is None


def test_the_oracle_needs_its_quantile_and_no_hits_bound_the_rate_by_the_rule_of_three() -> None:
    assert oracle_threshold(0.01) == pytest.approx(2.5758, abs=1e-4)
    assert rate_bound(0, 200) == pytest.approx(3 / 200, rel=0.02)
    assert rate_bound(0, 0) is None


def test_false_alarms_are_counted_on_clean_recordings_alone() -> None:
    scores = [score(truth("consistent"), report(v), LAWS) for v in ("consistent", "consistent", "missing_physics")]
    scores.append(score(truth("missing_physics", FRICTION), report("missing_physics", SAID), LAWS))
    figures = summary(scores, 0.01)
    assert figures["false_alarms"] == 1 and figures["clean"] == 3
    assert figures["located"] == 1.0
    assert confusion(scores)["consistent"] == {"consistent": 2, "missing_physics": 1}
