"""Exports against our own free run, read by the programs that they are for."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import control
import numpy as np
import pytest
import scipy.io
from fmpy import read_model_description
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from sprung.benchmarks import exchange
from sprung.model.exchange.fmu import write_fmu
from sprung.model.exchange.modelica import write_modelica
from sprung.model.exchange.statespace import ExchangeError, state_space, write_mat, write_npz
from sprung.model.exchange.tables import write_tables
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import System, load_system, parse_system
from sprung.service.cli import main
from sprung.service.cli.export import left_out

RATE = 500.0
TEXT = """
name: quarter car
sample_rate: 500
window: 200
bodies:
  wheel: {mass: 45}
  car: {mass: 400}
inputs:
  road: {kind: displacement, displacement: {csv: road}, velocity: {csv: rate}}
  push: {kind: force, body: car, csv: p}
elements:
  tyre: {upper: wheel, lower: road, stiffness: 200000, damping: 50}
  strut: {upper: car, lower: wheel, stiffness: 20000, damping: 1500%s}
sensors:
  wheel_a: {kind: acceleration, body: wheel, csv: a}
  car_v: {kind: velocity, body: car, csv: b}
  travel: {kind: deflection, element: strut, csv: d}
  strut_f: {kind: force, element: strut, csv: f}
estimate: [stiffness, damping, mass]
"""
LAWS = {
    "linear": "",
    "friction": ", laws: [{coulomb_friction: {force: 40, smoothing: 0.05}}]",
    "hysteresis": ", laws: [{bouc_wen: {alpha: 8000, beta: 300, n: 1}}, {cubic_stiffness: {k3: 1.0e+8}}]",
}


def system(laws: str = "") -> System:
    return parse_system(TEXT % laws)


def inputs(seconds: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """Time, and displacement, velocity and force at it; all begin at zero, smoothly."""
    t = np.arange(int(seconds * RATE)) / RATE
    z, v, f = np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)
    for w, size in ((5.0, 4e-3), (11.0, 2e-3), (27.0, 5e-4)):
        z += size * (1 - np.cos(w * t))
        v += size * w * np.sin(w * t)
        f += 20 * (1 - np.cos(0.7 * w * t))
    return t, np.stack([z, v, f], axis=1)


DRIVES = ("road.displacement", "road.velocity", "push.force")


def cosimulated(path: Path, vehicle: System, u: np.ndarray) -> np.ndarray:
    """Outputs at the samples, in small steps of its own."""
    return exchange.cosimulated(path, vehicle, u)


def exchanged(path: Path, vehicle: System, u: np.ndarray) -> np.ndarray:
    """Outputs at the samples, its derivatives integrated by SciPy."""
    loaded = exchange.LoadedFmu(path, "modelExchange")
    t = np.arange(len(u)) / RATE
    drive, n = CubicSpline(t, u), loaded.states
    dx = np.zeros(n)
    pointer = ctypes.POINTER(ctypes.c_double)

    def put(time: float, x: np.ndarray) -> None:
        state = np.ascontiguousarray(x)
        loaded.fmu.setTime(time)
        loaded.fmu.setContinuousStates(state.ctypes.data_as(pointer), n)
        loaded.set(DRIVES, drive(time))

    def rate(time: float, x: np.ndarray) -> np.ndarray:
        put(time, x)
        loaded.fmu.getDerivatives(dx.ctypes.data_as(pointer), n)
        return dx.copy()

    path_x = solve_ivp(rate, (0, t[-1]), np.zeros(n), t_eval=t[:-1], rtol=1e-9, atol=1e-12, max_step=1 / RATE).y.T
    shown = []
    for time, x in zip(t, path_x, strict=False):
        put(time, x)
        shown.append(loaded.shown(vehicle.sensors))
    return np.array(shown)


@pytest.mark.parametrize("laws", LAWS)
@pytest.mark.parametrize("run", [cosimulated, exchanged])
def test_an_fmu_runs_as_our_own_simulation(laws: str, run: Callable[..., np.ndarray], tmp_path: Path) -> None:
    vehicle = system(LAWS[laws])
    write_fmu(tmp_path / "car.fmu", vehicle)
    assert validate_fmu(str(tmp_path / "car.fmu")) == []
    _, u = inputs(2.0)
    theirs, ours = run(tmp_path / "car.fmu", vehicle, u), simulate_ride(vehicle, u).sensors
    limit = 1e-6 if laws == "linear" else 1e-3
    for column, name in enumerate(vehicle.sensors):
        error = np.abs(theirs[:, column] - ours[: len(theirs), column]).max()
        assert error < limit * np.abs(ours[:, column]).max(), name


HANGING = "car: {mass: 400, laws: [{suspended_mass: {mass: 60, frequency: 6, damping_ratio: 0.1, x: 0, y: 0}}]}"
RUBBER = ", laws: [{fractional_stiffness: {stiffness: 6000, order: 0.35}}]"


@pytest.mark.parametrize("text", [TEXT % RUBBER, TEXT.replace("car: {mass: 400}", HANGING) % LAWS["friction"]])
def test_laws_of_several_parts_and_of_bodies_are_in_the_exports(text: str, tmp_path: Path) -> None:
    vehicle = parse_system(text)
    write_fmu(tmp_path / "car.fmu", vehicle)
    assert validate_fmu(str(tmp_path / "car.fmu")) == []
    _, u = inputs(1.0)
    ours = simulate_ride(vehicle, u).sensors
    theirs = cosimulated(tmp_path / "car.fmu", vehicle, u)
    error = np.abs(theirs - ours[: len(theirs)]).max(axis=0) / np.abs(ours).max(axis=0)
    assert (error < 1e-3).all()
    write_modelica(tmp_path / "car.mo", vehicle)
    assert (tmp_path / "car.mo").read_text().count("der(z)") == (0 if HANGING in text else 5)
    space = state_space(vehicle)
    assert len(space.A) == (6 if HANGING in text else 4)


def test_what_nobody_measures_is_not_exported(tmp_path: Path) -> None:
    law = "car: {mass: 400, laws: [{external_force: {amplitude: 10, frequency: 3, phase: 0}}]}"
    with pytest.raises(ExchangeError, match="car: external_force has no formula"):
        write_fmu(tmp_path / "car.fmu", parse_system(TEXT.replace("car: {mass: 400}", law) % ""))


def test_the_fmu_names_inputs_outputs_and_parameters(tmp_path: Path) -> None:
    write_fmu(tmp_path / "car.fmu", system(LAWS["friction"]))
    description = read_model_description(str(tmp_path / "car.fmu"))
    by = {v.name: v.causality for v in description.modelVariables}
    assert by["strut.stiffness"] == by["strut.coulomb_friction.force"] == "parameter"
    assert by["road.velocity"] == by["push.force"] == "input" and by["strut_f"] == "output"
    _, u = inputs(1.0)
    values = {"strut.damping": 3000.0}
    found = exchange.cosimulated(tmp_path / "car.fmu", system(LAWS["friction"]), u, ("car_v",), values)[:, 0]
    ours = simulate_ride(system(LAWS["friction"]), u, values).sensors[:-1, 1]
    assert np.abs(found - ours).max() < 1e-3 * np.abs(ours).max()


def test_the_whole_vehicle_is_an_fmu(tmp_path: Path) -> None:
    write_fmu(tmp_path / "train.fmu", load_system())
    assert validate_fmu(str(tmp_path / "train.fmu")) == []


def test_matrices_are_those_of_the_simulation(tmp_path: Path) -> None:
    vehicle = system()
    space = state_space(vehicle)
    write_mat(tmp_path / "a.mat", space)
    write_npz(tmp_path / "a.npz", space)
    read = scipy.io.loadmat(tmp_path / "a.mat")
    packed = np.load(tmp_path / "a.npz")
    assert [str(name[0]) for name in read["outputs"].ravel()] == list(vehicle.sensors)
    assert packed["inputs"].tolist() == ["road.displacement", "road.velocity", "push.force"]
    t, u = inputs()
    plant = control.ss(read["A"], read["B"], read["C"], read["D"])
    fine = np.arange(0, t[-1] + 1e-9, 1 / (64 * RATE))
    between = np.stack([np.interp(fine, t, column) for column in u.T])
    w = np.array([5.0, 11.0, 27.0])
    size = np.array([4e-3, 2e-3, 5e-4])
    between[0] = (size * (1 - np.cos(w * fine[:, None]))).sum(axis=1)
    between[1] = (size * w * np.sin(w * fine[:, None])).sum(axis=1)
    between[2] = (20 * (1 - np.cos(0.7 * w * fine[:, None]))).sum(axis=1)
    answer = control.forced_response(plant, fine, between).outputs[:, ::64].T
    ours = simulate_ride(vehicle, u).sensors
    assert np.all(np.abs(np.asarray(answer) - ours).max(axis=0) < 1e-6 * np.abs(ours).max(axis=0))


def test_derivatives_by_values_of_laws_are_those_of_differences() -> None:
    text = TEXT.replace("car: {mass: 400}", HANGING.replace("}}]", "}}, {mass_change: {ratio: 1.1}}]")) % ""
    space = state_space(parse_system(text))
    for name, value in (("frequency", 6), ("damping_ratio", 0.1), ("ratio", 1.1)):
        at = next(i for i, parameter in enumerate(space.parameters) if parameter.endswith(f".{name}"))
        ahead, behind = (
            state_space(parse_system(text.replace(f"{name}: {value}", f"{name}: {value * (1 + step)}")))
            for step in (1e-5, -1e-5)
        )
        for ours, one, other in ((space.dA, ahead.A, behind.A), (space.dC, ahead.C, behind.C)):
            np.testing.assert_allclose(ours[at], (one - other) / (2e-5 * value), rtol=1e-6, atol=1e-3)


def test_derivatives_by_the_parameters_are_those_of_differences() -> None:
    vehicle = system()
    space = state_space(vehicle)
    for index, parameter in enumerate(vehicle.parameters):
        step = 1e-5 * parameter.nominal
        up, down = (state_space(vehicle, {parameter.name: parameter.nominal + s}) for s in (step, -step))
        for name in "ABCD":
            difference = (getattr(up, name) - getattr(down, name)) / (2 * step)
            exact = getattr(space, f"d{name}")[index]
            np.testing.assert_allclose(exact, difference, rtol=1e-6, atol=1e-9 * np.abs(getattr(space, name)).max())


def test_tables_hold_the_forces_of_spring_damper_and_laws(tmp_path: Path) -> None:
    vehicle = system(", laws: [{coulomb_friction: {force: 40, smoothing: 0.05}}, {cubic_stiffness: {k3: 1.0e+8}}]")
    paths = write_tables(tmp_path, vehicle, 0.02, 0.5)
    assert {p.name for p in paths} == {"tyre-d.csv", "tyre-v.csv", "strut-d.csv", "strut-v.csv"}
    d, force = np.loadtxt(tmp_path / "strut-d.csv", delimiter=",", skiprows=1).T
    np.testing.assert_allclose(force, 2e4 * d + 1e8 * d**3, rtol=1e-7, atol=1e-6)
    v, force = np.loadtxt(tmp_path / "strut-v.csv", delimiter=",", skiprows=1).T
    np.testing.assert_allclose(force, 1500 * v + 40 * np.tanh(v / 0.05), rtol=1e-7, atol=1e-6)


@pytest.mark.parametrize("law", [LAWS["hysteresis"], ", laws: [{time_varying_stiffness: {p: 0.2, tau: 30}}]"])
def test_an_element_whose_force_is_no_curve_has_no_tables(law: str, tmp_path: Path) -> None:
    vehicle = system(law)
    assert {p.name for p in write_tables(tmp_path, vehicle, 0.02, 0.5)} == {"tyre-d.csv", "tyre-v.csv"}
    assert left_out(vehicle, tmp_path) == [f"strut.{placed.law.name}" for placed in vehicle.laws]
    strut = vehicle.file.elements["strut"].model_copy(update={"lower": vehicle.file.elements["tyre"].lower})
    alone = System(vehicle.file.model_copy(update={"elements": {"strut": strut}}))
    with pytest.raises(ExchangeError, match="no curve is left"):
        write_tables(tmp_path / "none", alone, 0.02, 0.5)
    assert not (tmp_path / "none").exists()


def evaluated(text: str, known: dict[str, float]) -> dict[str, float]:
    """All equations of the Modelica text solved one after the other from given values; der(x) is named der_x."""
    known, equations = dict(known), []
    blocks = dict(re.findall(r"  block (\w+) .*?\n(.*?)  end \1;", text, re.DOTALL))
    vehicle = text[text.index("  model Vehicle") :]
    bodies = [("", vehicle)]
    for kind, instance in re.findall(r"^    (\w+) (law_\d+);$", vehicle, re.MULTILINE):
        bodies.append((f"{instance}_", blocks[kind]))
    for prefix, body in bodies:
        for name, value in re.findall(r"parameter Real (\w+) = ([-+.\de]+)", body):
            known.setdefault(prefix + name, float(value))
        for left, right in re.findall(r"^    (.+?) = (.+);$", body.split("equation")[1], re.MULTILINE):
            sides = [
                re.sub(r"der\((\w+)\)", r"der_\1", s).replace(".f", "_f").replace("^", "**") for s in (left, right)
            ]
            sides = [re.sub(r"(law_\d+)\.(\w)", r"\1_\2", s) for s in sides]
            if prefix:
                sides = [re.sub(r"\b(?!tanh|abs|min|max|sign|exp|der)([a-z]\w*)", prefix + r"\1", s) for s in sides]
                sides = [re.sub(r"\bder_(\w+)", rf"der_{prefix}\1", s) for s in sides]
            equations.append(sides)
    functions = {"tanh": np.tanh, "abs": abs, "min": min, "max": max, "sign": np.sign, "exp": np.exp}
    for _ in range(len(equations)):
        for left, right in equations:
            try:
                value = float(eval(right, functions, known))  # the text is our own
            except NameError:
                continue
            factor, _, name = left.rpartition(" * ")
            known[name] = value / float(factor or 1)
    return known


def test_cosimulation_without_slopes_moves_supports_as_their_velocities_say(tmp_path: Path) -> None:
    vehicle, (_, u) = system(), inputs(2.0)
    write_fmu(tmp_path / "car.fmu", vehicle)
    loaded, shown = exchange.LoadedFmu(tmp_path / "car.fmu", "coSimulation"), []
    for k, now in enumerate(u):
        loaded.set(DRIVES, now)
        shown.append(loaded.shown(vehicle.sensors))
        loaded.fmu.doStep(currentCommunicationPoint=k / RATE, communicationStepSize=1 / RATE)
    ours = simulate_ride(vehicle, u).sensors
    error = np.abs(np.array(shown) - ours).max(axis=0) / np.abs(ours).max(axis=0)
    assert (error < 0.01).all()  # 0.22 with displacements that are held from step to step


@pytest.mark.parametrize("laws", LAWS)
def test_the_modelica_text_has_the_same_equations(laws: str, tmp_path: Path) -> None:
    vehicle = system(LAWS[laws])
    write_modelica(tmp_path / "car.mo", vehicle)
    x, u = np.array([1e-3, 4e-3, 0.1, -0.2]), np.array([3e-3, 0.05, 10.0])
    given = dict(zip(("wheel_z", "car_z", "wheel_z_rate", "car_z_rate"), x, strict=True))
    given |= {"road_displacement": u[0], "road_velocity": u[1], "push_force": u[2], "law_0_z": 2e-3, "time": 0.0}
    found = evaluated((tmp_path / "car.mo").read_text(), given)
    A, B, C, D = vehicle.mechanics.matrices()
    d, v = x[1] - x[0], x[3] - x[2]
    extra = {"linear": 0.0, "friction": 40 * np.tanh(v / 0.05), "hysteresis": 8000 * 2e-3 + 1e8 * d**3}[laws]
    push = np.array([0, 0, extra / 45, -extra / 400])
    rates = A @ x + B @ u + push
    np.testing.assert_allclose([found["der_wheel_z_rate"], found["der_car_z_rate"]], rates[2:], rtol=1e-12)
    shown = C @ x + D @ u + np.array([extra / 45, 0, 0, extra])
    np.testing.assert_allclose([found[name] for name in vehicle.sensors], shown, rtol=1e-12)


def grammatical(text: str) -> bool:
    """Whether a text is an arithmetic expression of Modelica (3.6, appendix A.2.7)."""
    factor = r"x(\^x)?"
    term = rf"{factor}([*/]{factor})*"
    total = rf"[-+]?{term}([-+]{term})*"
    text = re.sub(r"\d+\.?\d*(e[-+]?\d+)?|[A-Za-z_][\w.]*", "x", text.replace(" ", ""))
    before = ""
    while before != text:
        before, text = text, re.sub(rf"x?\({total}(,{total})*\)", "x", text)
    return re.fullmatch(total, text) is not None


def test_expressions_follow_the_grammar_of_modelica(tmp_path: Path) -> None:
    assert (
        not grammatical("a + -1.0*b") and not grammatical("2*-a") and grammatical("-a + (-1.0)*min(b, c.d)^(2 - 1e-3)")
    )
    (tmp_path / "car.yaml").write_text(TEXT % LAWS["hysteresis"])
    for file in ("end.mo", "2nd car.mo"):
        write_modelica(tmp_path / file, load_system(tmp_path / "car.yaml"))
    text = (tmp_path / "end.mo").read_text()
    equations = "".join(re.findall(r"  equation\n(.*?)  end ", text, re.DOTALL))
    sides = [side for pair in re.findall(r"^    (.+) = (.+);$", equations, re.MULTILINE) for side in pair]
    assert len(sides) > 40 and [side for side in sides if not grammatical(side)] == []
    assert text.startswith("package end_ ") and (tmp_path / "2nd car.mo").read_text().startswith("package _2nd_car ")


@pytest.mark.skipif(shutil.which("omc") is None, reason="OpenModelica is not installed")
def test_the_modelica_text_compiles(tmp_path: Path) -> None:
    write_modelica(tmp_path / "car.mo", system(LAWS["hysteresis"]))
    (tmp_path / "check.mos").write_text('loadFile("car.mo"); checkModel(car.Vehicle); getErrorString();')
    done = subprocess.run(["omc", "check.mos"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "completed successfully" in done.stdout, done.stdout


@pytest.mark.parametrize("name", ["car.fmu", "car.mo", "car.mat", "car.npz", "tables"])
def test_the_command_writes_every_format(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "car.yaml").write_text(TEXT % LAWS["friction"])
    assert main(["system", str(tmp_path / "car.yaml"), "--export", str(tmp_path / name)]) == 0
    assert all(Path(line).exists() for line in capsys.readouterr().out.split())
    assert main(["system", str(tmp_path / "car.yaml"), "--export", str(tmp_path / "car.xml")]) == 2
    assert "known are .mat" in capsys.readouterr().err


def test_a_system_file_written_again_is_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = load_system()
    assert main(["system", "--export", str(tmp_path / "again.yaml")]) == 0
    assert load_system(tmp_path / "again.yaml").file == first.file
    assert main(["system", "--export", str(tmp_path / "no" / "a.mat")]) == 2
    assert "there is no folder" in capsys.readouterr().err


def test_what_a_format_cannot_hold_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    law = "laws: [{coulomb_friction: {force: {value: 58, std: 1}, smoothing: {value: 0.02, fixed: true}}}]"
    path = tmp_path / "car.yaml"
    path.write_text(
        "{name: a, sample_rate: 100, window: 100, bodies: {car: {mass: 400}},"
        " inputs: {road: {kind: displacement, displacement: {csv: r, noise: 1e-5}, velocity: {csv: v, noise: 1e-3}}},"
        f" elements: {{strut: {{upper: car, lower: road, stiffness: 22000, damping: 1400, {law}}}}},"
        " sensors: {a: {kind: acceleration, body: car, csv: a, noise: 0.01}}}"
    )
    assert main(["system", str(path), "--export", str(tmp_path / "a.mat")]) == 0
    assert "does not hold strut.coulomb_friction" in capsys.readouterr().err
    assert main(["system", str(path), "--export", str(tmp_path / "b.yaml")]) == 0
    assert capsys.readouterr().err == "" and load_system(tmp_path / "b.yaml").file == load_system(path).file
