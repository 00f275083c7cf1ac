"""FMUs as a baseline system: linearised by their directional derivatives, the same motion again."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from sprung.model.exchange.fmu import write_fmu
from sprung.model.exchange.from_fmu import _pairs
from sprung.model.exchange.matrices import read_matrices
from sprung.model.exchange.statespace import ExchangeError
from sprung.model.system import System, load_system
from sprung.service.cli import main
from tests.strut import strut

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
LAW = "{cubic_stiffness: {k3: 4.0e+6}}"  # no slope at rest


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fmu") / "car.fmu"
    file = strut(LAW).file
    moved = {name: sensor for name, sensor in file.sensors.items() if name != "strut_f"}
    write_fmu(path, System(file.model_copy(update={"sensors": moved})))
    return path


def test_an_fmu_becomes_the_system_that_it_was_made_of(exported: Path, tmp_path: Path) -> None:
    assert main(["import", str(exported), "--rate", "200", "--out", str(tmp_path / "car.yaml")]) == 0
    found, first = load_system(tmp_path / "car.yaml"), strut()
    assert found.bodies == ("wheel", "car") and list(found.file.inputs) == ["road"]
    assert found.sensors == ("wheel_a", "car_a") and found.sample_rate == 200
    for ours, theirs in zip(found.mechanics.matrices(), first.mechanics.matrices(), strict=True):
        np.testing.assert_allclose(ours, theirs[: len(ours)], rtol=1e-6, atol=1e-6 * np.abs(theirs).max())


def test_what_is_no_such_fmu_is_refused_in_one_line(exported: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.fmu"
    broken.write_bytes(exported.read_bytes()[:200])
    write_fmu(tmp_path / "turning.fmu", load_system())
    for path, rate, said in (
        (broken, 100.0, "no FMU that can be read"),
        (exported, None, "--rate"),
        (tmp_path / "turning.fmu", 100.0, "hangs together with no other"),
    ):
        with pytest.raises(ExchangeError, match=said) as refused:
            read_matrices(path, rate=rate)
        assert "\n" not in str(refused.value) and str(path) in str(refused.value)


def test_inputs_that_are_no_pairs_are_reported_by_name() -> None:
    assert _pairs(Path("a"), ["road.displacement", "road.velocity", "wall"]) == (("road", "wall"), [0, 1, 2, -1])
    assert _pairs(Path("a"), ["der(road)", "road"]) == (("road",), [1, 0])
    with pytest.raises(ExchangeError, match=r"road.velocity is a velocity without road.displacement"):
        _pairs(Path("a"), ["road.velocity"])
