"""The public form of a report: what JSON can hold, nothing that is not there."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.report.report import Finding, FitFigures, IdentifiedLaw, LawParameter, plain


def test_numbers_that_are_not_finite_are_null() -> None:
    figures = FitFigures(np.float64(0.5), {"car_1": float("nan"), "car_2": np.inf})
    assert plain(figures) == {"nrmse": 0.5, "per_sensor": {"car_1": None, "car_2": None}}
    assert json.dumps(plain(figures), allow_nan=False)


def test_a_finding_says_only_what_is_known_of_it() -> None:
    force = LawParameter("force", 395.0, 6.0, "N")
    bare = Finding("k1", "coulomb_friction", EffectKind.LISTED, (force,), None, None)
    assert set(bare.to_dict()) == {
        "location",
        "effect",
        "kind",
        "parameters",
        "p_value",
        "delta_bic",
        "runner_up",
        "sentence",
    }
    told = Finding(
        "k1",
        "coulomb_friction",
        EffectKind.LISTED,
        (force,),
        1e-9,
        -50.0,
        runner_up=("bouc_wen", -10.0),
        runner_up_location="k2",
        family="coulomb_friction or bouc_wen",
        look_alikes={"bouc_wen": 3.0},
    ).to_dict()
    assert told["runner_up"] == {"effect": "bouc_wen", "delta_bic": -10.0, "location": "k2"}
    assert told["look_alikes"] == {"bouc_wen": 3.0}
    assert told["parameters"] == [{"name": "force", "value": 395.0, "std": 6.0, "unit": "N"}]


def test_a_variant_is_reported_where_there_is_one() -> None:
    assert "variant" not in IdentifiedLaw("k1", "bump_stop", ()).to_dict()
    assert IdentifiedLaw("car", "flexible_mode", (), "bending").to_dict()["variant"] == "bending"


def test_a_number_whose_deviation_exceeds_it_is_reported_as_not_determined() -> None:
    beta = LawParameter("beta", 3.5e13, 6.3e14, "m^-n")
    assert not beta.determined
    assert beta.words() == "not determined"
    assert plain(beta)["determined"] is False
    force = LawParameter("yield_force", 63.0, 8.4, "N")
    assert force.words() == "63 +- 8.4 N"
    lasting = LawParameter("tau", 347.0, 65.0, "s")
    assert lasting.words() == "350 +- 65 s" and replace(lasting, std=123.0).words() == "350 +- 120 s"
    assert replace(lasting, value=1.22e6, std=3.4e4, unit="N/m").words() == "1.22e+06 +- 3.4e+04 N/m"
    assert "determined" not in plain(force)
    assert LawParameter("loop_area", 5.0, float("nan"), "J").determined
