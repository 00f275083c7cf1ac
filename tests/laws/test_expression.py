"""Formulas of laws: what they admit, and that every law's text is its force."""

from __future__ import annotations

import gc
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from sprung.model.laws import CATALOGUE, ElementLaw
from sprung.model.laws.expression import MOTION, FormulaError, parse
from sprung.model.laws.motion import Motion, SpringDamper

SEVERAL = {"fractional_stiffness"}  # memories, which no formula of one z tells
WRITTEN = [law for law in CATALOGUE if isinstance(law, ElementLaw) and law.name not in SEVERAL]
WRITTEN += [law.wider for law in WRITTEN if law.wider is not None]


def test_laws_of_several_memories_alone_have_no_formula() -> None:
    assert {
        law.name for law in CATALOGUE if isinstance(law, ElementLaw) and not law.formula and law.memory > 1
    } == SEVERAL


@pytest.mark.parametrize("law", WRITTEN, ids=lambda law: f"{law.name}-{len(law.parameters)}")
def test_a_laws_formula_is_its_force(law: ElementLaw) -> None:
    rng = np.random.default_rng(1)
    d, v, t, z = rng.normal(0, 0.01, 200), rng.normal(0, 0.1, 200), rng.uniform(5, 60, 200), rng.normal(0, 0.02, 200)
    p = [min(max(low, 0.7 + 0.1 * i), 2.0) for i, low in enumerate(q.low for q in law.parameters)]
    element = SpringDamper(3e4, 2e3)
    motion = Motion(d, v, t, z[None] if law.memory else ())
    values = dict(zip(law.names, p, strict=True)) | {"d": d, "v": v, "t": t, "z": z, "k": 3e4, "c": 2e3}
    known = {*law.names, *MOTION}
    np.testing.assert_allclose(parse(law.formula, known)(**values), law.force(motion, p, element), rtol=1e-12)
    if law.memory:
        rate = parse(law.memory_formula, known)(**values)
        np.testing.assert_allclose(rate, law.memory_rate(motion, p, element)[0], rtol=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os')",
        "d.real",
        "d * 1" + 40 * "0",
        "d" + 600 * " + d",
        "d[0]",
        "lambda: d",
        "d if v else 1",
        "tanh(d, v)",
        "f(d)",
        "d <",
        "'d'",
        "True",
        "1e999",
        "[d]",
        "min(d, default=1)",
        "(" * 500 + "d" + ")" * 500,
        "d // 2",
    ],
)
def test_only_arithmetic_is_admitted(text: str) -> None:
    with pytest.raises(FormulaError, match="formula"):
        parse(text, {"d", "v"})


def test_an_unknown_name_is_reported_with_those_that_exist() -> None:
    with pytest.raises(FormulaError, match="'stiffnes' is none of d, stiffness"):
        parse("stiffnes * d", {"stiffness", "d"})


def test_a_formula_says_the_same_in_c(tmp_path: Path) -> None:
    text = "-a * min(max(d, -gap), gap) + tanh(v / s) * abs(d)**1.5 - sign(v) * sqrt(a) + exp(-d) * 2 ** -v"
    values = {"a": 3.0, "gap": 0.1, "d": 0.4, "v": -0.3, "s": 0.2}
    formula = parse(text, set(values))
    source = tmp_path / "f.c"
    declared = "".join(f"double {name} = {value!r};" for name, value in values.items())
    source.write_text(
        f'#include <math.h>\n#include <stdio.h>\nint main(void){{{declared}printf("%.17g", {formula.c()});}}'
    )
    subprocess.run(["cc", "-o", str(tmp_path / "f"), str(source), "-lm"], check=True)
    shown = subprocess.run([str(tmp_path / "f")], check=True, capture_output=True, text=True).stdout
    assert float(shown) == pytest.approx(float(formula(**values)), rel=1e-14)


def test_formulas_can_be_read_by_several_threads_at_once() -> None:
    """As when several vehicles are given models: by itself CPython 3.11 raises SystemError where threads take turns
    within a tree, as they do when objects are collected."""

    def called(deep: int) -> str:  # at different depths, or nothing is noticed
        return parse("+".join(["a*d*v*t"] * 30), {"a", "d", "v", "t"}).text if deep == 0 else called(deep - 1)

    def yields(*_: object) -> None:
        time.sleep(1e-4)

    thresholds = gc.get_threshold()
    gc.callbacks.append(yields)
    gc.set_threshold(50)
    try:
        with ThreadPoolExecutor(8) as threads:
            assert len(set(threads.map(called, (i % 40 for i in range(60))))) == 1
    finally:
        gc.callbacks.remove(yields)
        gc.set_threshold(*thresholds)


def test_a_third_power_is_the_product_of_three() -> None:
    d = np.array([-2.0, 0.0, 1.5])
    assert np.array_equal(parse("d**3", frozenset({"d"}))(d=d), d * d * d)
    assert parse("(d + 1)**3", frozenset({"d"}))(d=0.5) == 1.5**3
