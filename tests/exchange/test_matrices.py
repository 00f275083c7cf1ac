"""Matrices of other programs as a baseline system: the same motion again, or one line that says what is wrong."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from sprung.model.exchange.matrices import read_matrices
from sprung.model.exchange.statespace import ExchangeError, state_space, write_mat
from sprung.model.system import load_system, parse_system
from sprung.service.cli import main

K = np.array([[220e3, -20e3, 0], [-20e3, 50e3, -30e3], [0, -30e3, 30e3]])  # to the road 200e3
C = np.array([[1550.0, -1500, 0], [-1500, 1700, -200], [0, -200, 200]])
MASS = np.array([45.0, 400, 80])
ROWS = np.array([[0, 1.0, 0], [0, 0, 1], [-1, 1, 0]])


def written(path: Path, **matrices: object) -> Path:
    scipy.io.savemat(path, {"sample_rate": 200.0} | matrices)
    return path


def test_m_c_k_with_sensor_rows_become_the_same_system(tmp_path: Path) -> None:
    system = parse_system(read_matrices(written(tmp_path / "a.mat", M=np.diag(MASS), C=C, K=K, S=ROWS)))
    A, B, out, _ = system.mechanics.matrices()
    np.testing.assert_allclose(A[3:, :3], -K / MASS[:, None], atol=1e-9)
    np.testing.assert_allclose(A[3:, 3:], -C / MASS[:, None], atol=1e-9)
    np.testing.assert_allclose(B[3:, 0] * MASS, [200e3, 0, 0], atol=1e-6)
    np.testing.assert_allclose(out[0], A[4])
    np.testing.assert_allclose(out[2], [1, -1, 0, 0, 0, 0])
    assert system.file.sensors["body1_body2_deflection"].sign == -1  # the row counts it the other way
    assert {p.name for p in system.parameters} >= {"body1_body2.stiffness", "body2_body3.damping"}


def test_state_space_of_an_export_comes_back(tmp_path: Path) -> None:
    first = parse_system(read_matrices(written(tmp_path / "a.mat", M=np.diag(MASS), C=C, K=K, S=ROWS)))
    write_mat(tmp_path / "b.mat", state_space(first))
    again = parse_system(read_matrices(tmp_path / "b.mat"))
    np.testing.assert_allclose(again.mechanics.mass, MASS)
    assert again.bodies == first.bodies and again.elements == first.elements
    for ours, theirs in zip(again.mechanics.matrices(), first.mechanics.matrices(), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


def test_names_of_states_inputs_and_outputs_are_kept(tmp_path: Path) -> None:
    first = parse_system(read_matrices(written(tmp_path / "a.mat", M=np.diag(MASS), C=C, K=K, S=ROWS)))
    names = np.array(["axle", "frame.z", "car body"], dtype=object)
    matrices = state_space(first)
    data = {key: getattr(matrices, key) for key in "ABCD"} | {"mass": 45.0, "states": names}
    data |= {"inputs": ["road.displacement", "road.velocity"], "outputs": ["a2", "a3", "strut"]}  # rows of characters
    again = parse_system(read_matrices(written(tmp_path / "c.mat", **data)))
    assert again.bodies == ("axle", "frame", "car_body")
    assert [channel.name for channel in again.channels] == ["road.displacement", "road.velocity", "a2", "a3", "strut"]
    assert again.elements == ("axle_frame", "axle_road", "frame_car_body")
    coordinates = written(tmp_path / "d.mat", M=np.diag(MASS), C=C, K=K, states=names)
    assert parse_system(read_matrices(coordinates)).sensors[0] == "axle_acceleration"
    with pytest.raises(ExchangeError, match="outputs: 2 names for 3"):
        read_matrices(written(tmp_path / "e.mat", **data | {"outputs": ["a2", "a3"]}))


def test_sensors_that_measure_the_same_stay_apart(tmp_path: Path) -> None:
    rows = np.vstack([ROWS, ROWS[0], -ROWS[2]])
    text = read_matrices(written(tmp_path / "a.mat", M=np.diag(MASS), C=C, K=K, S=rows))
    sensors = parse_system(text).file.sensors
    assert [*sensors][3:] == ["body2_acceleration_2", "body1_body2_deflection_2"]
    assert [sensors[name].sign for name in ("body1_body2_deflection", "body1_body2_deflection_2")] == [-1, 1]


def test_a_feedthrough_that_contradicts_the_other_matrices_is_refused(tmp_path: Path) -> None:
    first = parse_system(read_matrices(written(tmp_path / "a.mat", M=np.diag(MASS), C=C, K=K, S=np.eye(3))))
    write_mat(tmp_path / "b.mat", state_space(first))
    data = {key: scipy.io.loadmat(tmp_path / "b.mat")[key] for key in "ABCD"}
    for D, said in ((3 * data["D"], "row 1 is not what A, B and C say"), (data["D"][:2], "a row for each row of C")):
        with pytest.raises(ExchangeError, match=said):
            read_matrices(written(tmp_path / "c.mat", mass=45.0, **data | {"D": D}))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["none.mat"], "there is no such file"),
        (["."], "is a folder"),
        (["cut.mat"], "damaged, cut short"),
        (["a.mat", "--rate", "inf"], "sample_rate inf Hz"),
        (["a.mat", "--rate", "1e9"], "at most 1e\\+06"),
        (["loose.mat"], "nothing couples"),
    ],
)
def test_files_that_cannot_be_used_are_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    whole = written(Path("a.mat"), M=MASS, C=C, K=K).read_bytes()
    Path("cut.mat").write_bytes(whole[: len(whole) // 2])
    written(Path("loose.mat"), M=MASS, C=0 * C, K=0 * K)
    assert main(["import", *arguments, "--out", "car.yaml"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(said, line) and "unexpected" not in line, line
    assert not Path("car.yaml").exists()


def test_the_command_writes_a_file_that_the_others_take(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = written(tmp_path / "a.mat", M=MASS, C=C, K=K)
    assert main(["import", str(source), "--out", str(tmp_path / "car.yaml")]) == 0
    assert "3 bodies" in capsys.readouterr().err
    assert load_system(tmp_path / "car.yaml").sensors == (
        "body1_acceleration",
        "body2_acceleration",
        "body3_acceleration",
    )
    assert main(["import", str(tmp_path / "car.yaml"), "--out", str(tmp_path / "x.yaml")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"K": K + np.triu(np.full((3, 3), 10.0), 1)}, "symmetric"),
        ({"K": np.abs(K)}, "positive"),
        ({"M": np.diag(MASS) + 1}, "diagonal"),
        ({"M": -MASS}, "mass"),
        ({"K": np.full((3, 3), np.nan)}, "finite"),
        ({"S": np.array([[1.0, 1, 0]])}, "row 1"),
        ({"S": np.array([[-1.0, 0, 1]])}, "nothing connects"),
        ({"Kb": np.array([[150e3], [0], [0]])}, "row 1 leaves"),
        ({"sample_rate": 0.0}, "sample_rate"),
        ({"K": K + 0.1j}, "K: its numbers are complex"),
        ({"K": "stiff"}, "K: is no matrix"),
        ({"K": np.zeros((0, 0))}, "empty"),
        ({"K": K[:2]}, "not of the same size"),
        ({"S": np.eye(4)}, "a column for each of 3"),
        ({"M": {"car": 400.0}}, "M: is no matrix"),
    ],
)
def test_what_is_no_network_is_refused_in_one_line(tmp_path: Path, change: dict[str, object], said: str) -> None:
    with pytest.raises(ExchangeError, match=said) as refused:
        read_matrices(written(tmp_path / "a.mat", **({"M": MASS, "C": C, "K": K, "S": ROWS} | change)))
    assert "\n" not in str(refused.value)


def test_an_exported_vehicle_that_rolls_is_refused_with_the_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["system", "--export", str(tmp_path / "train.mat")]) == 0
    assert main(["import", str(tmp_path / "train.mat"), "--rate", "100", "--out", str(tmp_path / "back.yaml")]) == 2
    assert "bodies that roll or pitch cannot be imported" in capsys.readouterr().err
