"""A user's own law, exactly as the documentation shows it; and the documentation's table."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from sprung.model.laws import CATALOGUE, ElementLaw, SpringDamper, load_laws, observe
from sprung.model.laws.own import LawFileError
from sprung.model.laws.trajectory import along
from sprung.model.simulate.nonlinear import NonlinearSimulator, Placement
from sprung.model.system import load_system

DOCUMENT = Path(__file__).parent.parent.parent / "docs" / "catalogue.md"


def example() -> str:
    return re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.S)[0]


@pytest.fixture
def law(tmp_path: Path) -> ElementLaw:
    path = tmp_path / "my_laws.py"
    path.write_text(example(), encoding="utf-8")
    (found,) = load_laws(path, tuple(law.name for law in CATALOGUE))
    assert isinstance(found, ElementLaw)
    return found


def test_the_documented_law_screens_like_any_other(law: ElementLaw) -> None:
    rng = np.random.default_rng(0)
    d, v = 0.003 * rng.standard_normal(500), 0.05 * rng.standard_normal(500)
    seen = observe(d, v, 100.0, 4e5, 2e4)
    trials = law.shapes(seen)
    assert all(law.admits(p) for p in trials)
    element = SpringDamper(4e5, 2e4)
    forces = along(law, tuple(trials.T[:, :, None]), d, v, sample_rate=100.0, element=element)
    assert forces.shape == (len(trials), 500)
    assert (forces * v >= 0).all()


def test_the_documented_law_runs_in_the_simulation_and_takes_out_energy(law: ElementLaw) -> None:
    mechanics = load_system().mechanics
    x0 = np.zeros(2 * mechanics.n)
    x0[0] = 0.01
    simulator = NonlinearSimulator(mechanics, 100.0)
    still = np.zeros((150, 16))
    free = simulator.run(still, [], x0=x0)
    damped = simulator.run(still, [Placement(law, (e,), (0.2, 0.005)) for e in range(8, 12)], x0=x0)
    assert np.abs(damped.states[-50:, 0]).max() < 0.8 * np.abs(free.states[-50:, 0]).max()


def test_the_table_names_every_law_and_parameter() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    for law in CATALOGUE:
        rows = [line for line in text.splitlines() if line.startswith(f"| `{law.name}`")]
        missing = [[p.name for p in law.parameters if not re.search(rf"\b{p.name}( [A-Za-z]+)? \(", r)] for r in rows]
        assert [] in missing, (law.name, missing)  # a law in two forms has two rows


def test_a_file_without_laws_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "empty.py"
    path.write_text("x = 1\n", encoding="utf-8")
    with pytest.raises(LawFileError, match="no law is defined"):
        load_laws(path)
    path.write_text("def broken(:\n", encoding="utf-8")
    with pytest.raises(LawFileError, match="SyntaxError") as caught:
        load_laws(path)
    assert "\n" not in str(caught.value)
    with pytest.raises(LawFileError, match="FileNotFoundError"):
        load_laws(tmp_path / "absent.py")
