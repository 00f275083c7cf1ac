"""A system file's laws in the free run, against an independent integrator; what is written is read again."""

from __future__ import annotations

import csv
import json
import re
import resource
import signal
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, solve_ivp
from scipy.interpolate import CubicHermiteSpline

import sprung
from sprung.model.laws import CLOCK_LEAD
from sprung.model.simulate.begun import fitted_start
from sprung.model.simulate.ride import SimulationError, simulate_ride, with_values
from sprung.model.system import MANCHESTER_DBC, System, load_system, parse_system
from sprung.replay.auxiliary import AuxiliaryMeans
from sprung.replay.record import load_record
from sprung.replay.recording import open_recording
from sprung.replay.windowing import Windower
from sprung.replay.writing import UnwritableRecording, write_recording
from sprung.service.cli import main

RATE = 200.0
TEXT = """
name: quarter-car
sample_rate: 200
window: 200
bodies:
  wheel: {{mass: 45}}
  car: {{mass: 400{body}}}
inputs:
  road: {{kind: displacement, displacement: {{csv: road, noise: 1.0e-5}}, velocity: {{csv: rate, unit: mm/s}}}}
elements:
  tyre: {{upper: wheel, lower: road, stiffness: 200000, damping: 50}}
  strut: {{upper: car, lower: wheel, stiffness: 20000, damping: 1500{strut}}}
sensors:
  wheel_a: {{kind: acceleration, body: wheel, csv: a, noise: 0.01}}
  car_a: {{kind: acceleration, body: car, csv: b, noise: 0.01, unit: g{sensor}}}
  strut_f: {{kind: force, element: strut, csv: f, noise: 1.0}}
"""


def system(strut: str = "", sensor: str = "", body: str = "") -> System:
    return parse_system(TEXT.format(strut=strut, sensor=sensor, body=body))


def road(samples: int = 1200) -> np.ndarray:
    t = np.arange(samples) / RATE
    rng = np.random.default_rng(3)
    f, phase = rng.uniform(0.6, 9, 10), rng.uniform(0, 6.3, 10)
    z = (3e-3 / f * np.sin(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
    v = (3e-3 * 2 * np.pi * np.cos(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
    return np.stack([z, v], axis=1)


def integrated(inputs: np.ndarray, friction: float, z0: bool = False) -> np.ndarray:
    """The same vehicle with friction (and a hysteretic formula) by DOP853, states at the samples."""
    t = np.arange(len(inputs)) / RATE
    u = CubicHermiteSpline(t, inputs[:, 0], inputs[:, 1])
    rate = u.derivative()

    def slope(time: float, x: np.ndarray) -> np.ndarray:
        w, c, wv, cv, z = x
        d, v = c - w, cv - wv
        strut = 2e4 * d + 1500 * v + friction * np.tanh(v / 0.02) + (3e3 * z if z0 else 0.0)
        tyre = 2e5 * (w - u(time)) + 50 * (wv - rate(time))
        return np.array([wv, cv, (strut - tyre) / 45, -strut / 400, v - z / 0.05])

    found = solve_ivp(slope, (0, t[-1]), np.zeros(5), t_eval=t, method="DOP853", rtol=1e-9, atol=1e-12, max_step=0.005)
    return found.y.T


@pytest.mark.parametrize("hysteresis", [False, True])
def test_laws_of_the_file_act_as_an_independent_integrator_has_it(hysteresis: bool) -> None:
    laws = "{coulomb_friction: {force: 60, smoothing: 0.02}}"
    if hysteresis:
        laws += ', {formula: {formula: "a * z", memory: "v - z / tau", a: 3000, tau: 0.05}}'
    ride = simulate_ride(system(f", laws: [{laws}]"), road())
    states = integrated(road(), 60.0, hysteresis)
    for column in range(4):
        truth = states[:, column]
        assert np.abs(ride.states[:, column] - truth).max() < 2e-4 * np.abs(truth).max()


def test_forces_of_the_elements_accelerate_the_bodies() -> None:
    loaded = system(", laws: [{bump_stop: {gap: 0.002, stiffness: 40000}}]")
    ride = simulate_ride(loaded, road())
    shown = ride.sensors[:, 2]  # behind the anti-alias filter
    assert np.std(ride.force[:, 1] - shown) < 0.02 * np.std(shown)
    impulse = cumulative_trapezoid(ride.force[:, 1], dx=1 / RATE)
    momentum = -400 * (ride.states[1:, 3] - ride.states[0, 3])
    assert np.abs(impulse - momentum).max() < 0.005 * np.abs(momentum).max()


def test_without_laws_it_is_the_linear_simulation() -> None:
    vehicle = load_system()
    inputs = np.random.default_rng(1).normal(0, 1e-3, (300, 16)).cumsum(axis=0) * 0.1
    inputs[:, 1::2] = np.gradient(inputs[:, 0::2], 0.01, axis=0)
    values = {"secondary_1l.damping": 12e3, "primary_11l.stiffness": 1.4e6}
    ours, linear = simulate_ride(vehicle, inputs, values).sensors, sprung.simulate(vehicle, inputs, values)
    np.testing.assert_allclose(ours, linear, rtol=0, atol=1e-8 * np.abs(linear).max())


@pytest.mark.parametrize("stop", ["", ", laws: [{bump_stop: {gap: 0.0008, stiffness: 400000}}]"])
def test_a_fitted_start_takes_out_what_happened_before(stop: str) -> None:
    """Where a stop is met hard, a start by the linear system's free motion alone begins far inside it."""
    vehicle, inputs = system(stop), road()
    before = simulate_ride(vehicle, inputs)
    later, rest = inputs[600:], before.sensors[600:]
    start = fitted_start(vehicle, later, rest)
    np.testing.assert_allclose(start, before.states[600], rtol=1e-3, atol=1e-6)
    fitted = simulate_ride(vehicle, later, start=start)
    assert np.abs(fitted.sensors - rest).max() < 1e-3 * np.abs(rest).max()


def test_faults_of_sensors_and_inputs_are_shown_and_undone() -> None:
    plain = simulate_ride(system(), road())
    biased = simulate_ride(system(sensor=", laws: [{sensor_bias: {offset: 0.5}}]"), road())
    np.testing.assert_allclose(biased.sensors[:, 1], plain.sensors[:, 1] + 0.5)
    noisy = simulate_ride(system(), road(), noise=np.random.default_rng(0))
    spread = (noisy.sensors - plain.sensors).std(axis=0)
    np.testing.assert_allclose(spread, [0.01, 0.01, 1.0], rtol=0.1)


def test_a_periodic_force_that_nobody_measured_acts_on_its_body() -> None:
    driven = system(body=", laws: [{external_force: {amplitude: 50, frequency: 3, phase: 0.4}}]")
    extra = simulate_ride(driven, road()).sensors - simulate_ride(system(), road()).sensors
    t = np.arange(600, 1200) / RATE
    wave = np.stack([np.sin(6 * np.pi * (t + CLOCK_LEAD)), np.cos(6 * np.pi * (t + CLOCK_LEAD))], axis=1)
    fit, *_ = np.linalg.lstsq(wave, extra[600:, 1], rcond=None)
    A, *_ = system().mechanics.matrices()
    s = 6j * np.pi
    push = np.array([0, 0, 0, 1 / 400])  # on the car
    receptance = s * s * np.linalg.solve(s * np.eye(4) - A, push)[1]
    assert np.hypot(*fit) == pytest.approx(50 * abs(receptance), rel=0.01)


def test_a_value_of_a_law_by_its_name_is_as_if_the_file_had_it() -> None:
    inputs, name = road(300), "strut.coulomb_friction.force"
    given = system(", laws: [{coulomb_friction: {force: 40, smoothing: 0.02}}]")
    wanted = system(", laws: [{coulomb_friction: {force: 90, smoothing: 0.02}}]")
    ride = simulate_ride(given, inputs, {name: 90.0, "strut.damping": 1400.0})
    other = simulate_ride(wanted, inputs, {"strut.damping": 1400.0})
    np.testing.assert_array_equal(ride.sensors, other.sensors)
    heavier = system(body=", laws: [{mass_change: {ratio: 1.2}}]")
    set_so = simulate_ride(heavier.whole_system, inputs, {"car.mass_change.ratio": 1.1})
    np.testing.assert_allclose(
        set_so.sensors, simulate_ride(system(), inputs, {"car.mass": 440.0}).sensors, atol=1e-9, rtol=1e-9
    )
    with pytest.raises(SimulationError, match="must lie between"):
        simulate_ride(given, inputs, {name: -1.0})


def test_values_by_name_are_checked() -> None:
    with pytest.raises(SimulationError, match="no such parameter"):
        with_values(system(), {"strut.stiffnes": 1.0})
    with pytest.raises(SimulationError, match="at least 0"):
        with_values(system(), {"strut.stiffness": -1.0})
    with pytest.raises(SimulationError, match="not finite"):
        simulate_ride(system(), np.full((100, 2), np.nan))
    assert with_values(system(), {"car.mass": 500.0}).mass[1] == 500.0


@pytest.mark.parametrize("suffix", [".csv", ".mcap", ".blf", ".asc", ".log"])
def test_what_is_written_is_read_again(suffix: str, tmp_path: Path) -> None:
    vehicle = load_system() if suffix != ".csv" else system()
    values = np.random.default_rng(2).normal(0, 2e-4, (400, len(vehicle.channels))).cumsum(axis=0)
    path, start = tmp_path / f"ride{suffix}", 1_790_000_000_000_000_000
    database = Path(__file__).parents[2] / "model/systems/bogie.dbc"
    write_recording(path, vehicle.channels, values, vehicle.sample_rate, start, dbc=database)
    record = load_record(path, vehicle.channels, vehicle.sample_rate, dbc=database)
    assert abs(record.start - start) < 1_000_000 and len(record.values) == 400
    step = 6e-3 if suffix in (".blf", ".asc", ".log") else 1e-6  # of the database's signals
    assert np.nanmax(np.abs(record.values - values)) < step


def test_a_recording_of_another_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnwritableRecording, match="known are"):
        write_recording(tmp_path / "a.xlsx", [], np.zeros((1, 0)), 1.0, 0)
    with pytest.raises(UnwritableRecording, match="database"):
        write_recording(tmp_path / "a.blf", load_system().channels, np.zeros((1, 28)), 1.0, 0)


@pytest.mark.parametrize("suffix", [".csv", ".mcap", ".blf", ".asc", ".log"])
def test_what_a_full_disk_cuts_off_is_told_and_removed(suffix: str, tmp_path: Path) -> None:
    vehicle = load_system()
    path, values = tmp_path / f"ride{suffix}", np.zeros((3000, len(vehicle.channels)))
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, usual[1]))
        with pytest.raises(UnwritableRecording, match=rf"ride{suffix}: cannot be written whole \(File too large\)"):
            write_recording(path, vehicle.channels, values, 100.0, 0, dbc=MANCHESTER_DBC)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
        signal.signal(signal.SIGXFSZ, handler)
    assert not path.exists()


def test_simulate_then_compare_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = TEXT.format(strut=", laws: [{coulomb_friction: {force: 60, smoothing: 0.02}}]", sensor="", body="")
    (tmp_path / "friction.yaml").write_text(text)
    (tmp_path / "plain.yaml").write_text(TEXT.format(strut="", sensor="", body=""))
    vehicle = system()
    values = np.concatenate([road(), np.zeros((1200, 3))], axis=1)
    write_recording(tmp_path / "road.csv", vehicle.channels, values, RATE, 1_790_000_000_000_000_000)
    told = ["--inputs", str(tmp_path / "road.csv"), "--out", str(tmp_path / "ride.csv"), "--noise"]
    assert main(["simulate", str(tmp_path / "friction.yaml"), *told]) == 0
    assert "coulomb_friction at strut" in capsys.readouterr().err
    ride, errors = str(tmp_path / "ride.csv"), {}
    for name, pictures in (("friction", ["--out", str(tmp_path / "pictures")]), ("plain", [])):
        of = str(tmp_path / f"{name}.yaml")
        assert main(["compare", ride, of, "--system", of, *pictures, "--json"]) == 0
        errors[name] = json.loads(capsys.readouterr().out)["nrmse"]
    assert (tmp_path / "pictures" / "loops.png").stat().st_size > 10_000
    assert errors["friction"] < 0.1 * errors["plain"]
    assert main(["compare", ride, ride, "--system", of, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["nrmse"] == 0


CAR = """
name: car
sample_rate: 100
window: 100
speed: {csv: v, mcap: /gps.speed, unit: km/h}
temperature: {csv: T}
bodies:
  body: {mass: 400, load: {max: 200, pressure: {csv: p, mcap: /air.p}}}
  axle: {mass: 45}
inputs:
  road: {kind: support, displacement: {csv: z, mcap: /road.z}, velocity: {csv: w, mcap: /road.w}}
elements:
  strut: {upper: body, lower: axle, stiffness: 2.0e+4, damping: 1500}
  tyre: {upper: axle, lower: road, stiffness: 2.0e+5, damping: 100}
sensors:
  top: {kind: acceleration, body: body, csv: a, mcap: /body.a}
  hub: {kind: acceleration, body: axle, csv: h, mcap: /axle.a}
"""


@pytest.fixture
def ride(tmp_path: Path) -> Path:
    """Speed once a second, rising by 1 km/h, temperature once; in the middle of the first second for the first time."""
    (tmp_path / "car.yaml").write_text(CAR)
    rows = []
    for i in range(600):
        beside = (f"{i // 100 + 36}" if i % 100 == 50 else "") + "," + ("18" if i == 250 else "")
        rows.append(f"{i / 100:.2f},{np.sin(i / 9):.6f},{11.1 * np.cos(i / 9):.6f},0,0,{beside},4e5")
    (tmp_path / "in.csv").write_text("time,z,w,a,h,v,T,p\n" + "\n".join(rows) + "\n")
    return tmp_path / "in.csv"


def simulated(ride: Path, out: str, *options: str) -> list[dict[str, str]]:
    made = ride.with_name(out)
    told = ["simulate", str(ride.with_name("car.yaml")), "--inputs", str(ride), "--out", str(made), *options]
    assert main(told) == 0
    return list(csv.DictReader(made.read_text().splitlines())) if made.suffix == ".csv" else []


def test_speed_and_temperature_of_the_ride_are_those_of_the_simulated_one(
    ride: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = simulated(ride, "out.csv")
    assert {float(row["T"]) for row in rows} == {18.0}
    speed = [float(row["v"]) for row in rows]
    assert speed == pytest.approx(np.interp(np.arange(600) / 100, np.arange(6) + 0.5, np.arange(6) + 36.0))
    told = capsys.readouterr().err
    assert "p" not in rows[0] and "is without body.pressure, which depends on the load: give it by --set" in told
    system = load_system(ride.with_name("car.yaml"))
    windows, beside = Windower(system.channels, 100.0, 100), AuxiliaryMeans(len(system.channels), 3)
    recording = open_recording(ride.with_name("out.csv"), system.channels, beside=system.auxiliary)
    read = [w for block in recording.at_rate(100.0, beside.keep) for w in windows.push(block)]
    conditions = system.conditions(beside.to(read[3]).auxiliary)  # as the monitor reads it
    assert conditions.temperature == 18.0 and 36 / 3.6 < conditions.speed < 42 / 3.6


def test_what_a_simulated_recording_lacks_is_named_and_can_be_given(
    ride: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ride.write_text("\n".join(",".join(line.split(",")[:5]) for line in ride.read_text().splitlines()) + "\n")
    rows = simulated(ride, "out.csv", "--set", "temperature=-5", "--set", "body.pressure=450000")
    assert {row["T"] for row in rows} == {"-5"} and {row["p"] for row in rows} == {"450000"}
    assert "is without speed, which is not in the recording: give it by --set speed=NUMBER" in capsys.readouterr().err
    simulated(ride, "out.mcap", "--set", "speed=10", "--set", "temperature=-5")
    assert "temperature, which has no `mcap` address in the system file; body.pressure" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("temperature=nan", "temperature lies from -70 to 150 degC"),
        ("temperature=inf", "temperature lies from -70 to 150 degC"),
        ("temperature=-5000", "temperature lies from -70 to 150 degC"),
        ("temperature=151", "temperature lies from -70 to 150 degC"),
        ("speed=300", "speed lies from -200 to 200 m/s"),
        ("body.pressure=1e12", "body.pressure lies from -1e+09 to 1e+09 Pa"),
        ("temperature=5,temperature=6", "temperature: is given twice"),
        ("body.mass=300,body.mass=400", "body.mass: is given twice"),
    ],
)
def test_conditions_that_no_vehicle_meets_are_refused(
    setting: str, told: str, ride: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = ride.with_name("out.csv")
    command = ["simulate", str(ride.with_name("car.yaml")), "--inputs", str(ride), "--out", str(made)]
    for one in setting.split(","):
        command += ["--set", one]
    assert main(command) == 2 and not made.exists()
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1


def test_a_condition_that_the_ride_cannot_have_had_is_unknown_and_told(
    ride: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A broken probe of the ride is not simulated; the monitor ignores it, too, and says so."""
    ride.write_text(ride.read_text().replace(",18,4e5", ",-3000,4e5"))
    assert "T" not in simulated(ride, "out.csv")[0]
    assert "is without temperature, which is not in the recording" in capsys.readouterr().err
    system = load_system(ride.with_name("car.yaml"))
    recording = open_recording(ride, system.channels, beside=system.auxiliary)
    for _ in recording.blocks():
        pass
    assert any("temperature: 1 of its values taken as missing" in problem for problem in recording.problems)
    unknown = system.conditions(np.array([250.0, -80.0, 4e5]))
    assert np.isnan(unknown.speed) and np.isnan(unknown.temperature)


def test_what_shares_a_can_message_is_not_written_as_zero(ride: Path, capsys: pytest.CaptureFixture[str]) -> None:
    car, fields = ride.with_name("car.yaml"), iter(["p", "z", "w", "a", "h"])
    text = CAR.replace("speed: {csv: v, mcap: /gps.speed, unit: km/h}\ntemperature: {csv: T}\n", "")
    car.write_text(re.sub(r"mcap: [^},]+", lambda _: f"can: Car.{next(fields)}", text))
    signals = "".join(f' SG_ {name} : {16 * i}|16@1- (0.001,0) [0|0] "" X\n' for i, name in enumerate("zwah"))
    pressure = ' SG_ p : 64|32@1+ (1,0) [0|0] "Pa" X\n'
    ride.with_name("car.dbc").write_text(f'VERSION ""\nBU_: X\nBO_ 1 Car: 64 X\n{signals}{pressure}')
    command = ["simulate", str(car), "--inputs", str(ride), "--out", str(ride.with_name("out.blf"))]
    command += ["--dbc", str(ride.with_name("car.dbc"))]
    assert main(command) == 2 and not ride.with_name("out.blf").exists()
    assert "body.pressure would be written as 0, in one CAN message with" in capsys.readouterr().err
    assert main([*command, "--set", "body.pressure=400000"]) == 0
