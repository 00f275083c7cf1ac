"""What real rigs do beside springs and dampers, named and with its values; truth by code of the test's own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import butter, chirp, sosfiltfilt

from sprung.benchmarks.real_reference import bouc_wen
from sprung.model.diagnosis.api import Report, diagnose
from sprung.model.diagnosis.component.measured import component_records
from sprung.model.diagnosis.force.fit import ComponentTask
from sprung.model.diagnosis.force.motion import element_motion
from sprung.model.diagnosis.force.piece import FittedPiece
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.diagnosis.force.search import search
from sprung.model.diagnosis.rules import RULES
from sprung.model.laws import SpringDamper
from sprung.model.system import System, parse_system
from tests.diagnosis.component.test_component import RATE, C, K, RigRecording, sweep

T, D, V = sweep(20.0)


def diagnosed(force: np.ndarray, noise: float = 1.0, signals: dict[str, np.ndarray] | None = None) -> Report:
    random = np.random.default_rng(0)
    named = signals or {}
    columns = [
        D + 1e-6 * random.standard_normal(len(D)),
        force + noise * random.standard_normal(len(D)),
        *named.values(),
    ]
    listed = "".join(f"  {name}: {{csv: {name}, unit: V}}\n" for name in named)
    more = f"signals:\n{listed}" if named else ""
    system = parse_system(f"""
name: damper on a test bench
sample_rate: {RATE}
window: 64
inputs: {{rod: {{kind: displacement, displacement: {{csv: d, noise: 1e-6}}}}}}
elements:
  damper: {{upper: rod, lower: ground, stiffness: 4e4, damping: 1.5e3, depends_on: [{", ".join(named)}]}}
sensors: {{cell: {{kind: force, element: damper, csv: F, noise: {noise}}}}}
{more}""")
    return diagnose(system, RigRecording(np.column_stack(columns)))


def bench(rate: float, window: int, stiffness: float, damping: float, noise: str = ", noise: 1.0") -> System:
    """A specimen between a measured displacement and a load cell; noise: what the file says of the cell's."""
    return parse_system(f"""
name: damper on a test bench
sample_rate: {rate}
window: {window}
bodies: {{}}
inputs: {{rod: {{kind: displacement, displacement: {{csv: d, noise: 1e-6}}}}}}
elements:
  damper: {{upper: rod, lower: ground, stiffness: {stiffness}, damping: {damping}}}
sensors: {{cell: {{kind: force, element: damper, csv: F{noise}}}}}
""")


def presliding(force: float, stiffness: float, static: float, fall: float) -> np.ndarray:
    """LuGre's friction along the sweep; Dahl's where static is force."""

    def rate(at: float, z: np.ndarray) -> np.ndarray:
        v = np.interp(at, T, V)
        return v - stiffness * abs(v) * z / (force + (static - force) * np.exp(-((v / fall) ** 2)))

    return stiffness * solve_ivp(rate, (0, T[-1]), [0.0], t_eval=T, max_step=1e-3, rtol=1e-6).y[0]


def named(report: Report, effect: str) -> dict[str, float]:
    """Values of the finding of that name, which must lead or be in the leading family."""
    first = next(f for f in report.findings if f.effect != "preload")
    assert effect in (first.family or first.effect), first
    return {p.name: p.value for p in (*first.parameters, *first.quoted)}


@pytest.mark.parametrize(("smoothing", "plausible"), [(0.11, False), (0.01, True)])
def test_friction_that_falls_has_been_above_what_it_falls_to(smoothing: float, plausible: bool) -> None:
    piece = next(piece for piece in PIECES if piece.effect == "stribeck")
    values = {"force": 128.0, "static_force": 205.0, "stribeck_rate": 0.13, "smoothing": smoothing}
    shape = (smoothing, 0.13)
    fit = FittedPiece(
        values, np.array([128.0, 77.0]), shape, SpringDamper(K, C), D, 1e-3, RULES.component, 1 / RATE, 20.0
    )
    assert piece.plausible(fit) is plausible


def test_friction_whose_fall_is_not_identifiable_is_plain_friction_where_more_than_noise_is_left() -> None:
    """A swept sine through a low pass, with hum: Stribeck's law fits a little better, with a friction of about none."""
    fine, seconds = 4000.0, 20.0
    t, random = np.arange(int(seconds * fine)) / fine, np.random.default_rng(1)
    d = 0.02 * chirp(t, 0.1, seconds, 6.0) * np.linspace(1.0, 0.4, len(t))
    v = np.gradient(d) * fine
    low_pass = butter(8, 0.4 * RATE, fs=fine, output="sos")
    force = sosfiltfilt(low_pass, 660.0 * d + 150.0 * v + 160.0 * np.tanh(v / 1e-3))[:: int(fine / RATE)]
    seen = d[:: int(fine / RATE)] + 5e-6 * random.standard_normal(len(force))
    force += 5.0 * np.sin(2 * np.pi * 50.0 * np.arange(len(force)) / RATE) + random.standard_normal(len(force))
    motion = element_motion(seen, None, RATE)
    task = ComponentTask(motion, force, int(0.7 * len(force)), noise=11.0, declared=1.0)
    frictions = tuple(piece for piece in PIECES if piece.effect in ("coulomb_friction", "stribeck"))
    found = search(task, frictions)
    assert [step.chosen.last.effect for step in found.steps] == ["coulomb_friction"]
    assert found.steps[0].rivals[0].last.effect == "stribeck"


@pytest.mark.slow
def test_friction_of_a_sliding_bearing_rises_from_creeping_to_fast_sliding() -> None:
    sliding = np.tanh(V / 1e-3) * (250.0 - 160.0 * np.exp(-np.abs(V) / 0.06))
    report = diagnosed(K * D + 300.0 * V + sliding)
    values = named(report, "coulomb_friction")
    assert values["force"] == pytest.approx(250, rel=0.05) and values["slow_force"] == pytest.approx(90, rel=0.05)
    assert values["rate"] == pytest.approx(0.06, rel=0.1)
    assert report.augmented_validation.nrmse < 2 * report.noise_floor.nrmse


def test_presliding_is_dahls_with_its_force_and_stiffness() -> None:
    report = diagnosed(K * D + C * V + presliding(120.0, 2.4e5, 120.0, 1.0))
    values = named(report, "dahl")
    assert values["yield_force"] == pytest.approx(120, rel=0.05)
    assert report.augmented_validation.nrmse < 2 * report.noise_floor.nrmse


def voltage() -> np.ndarray:
    """Steps between 0 and 3 V, every 1.3 s."""
    levels = np.random.default_rng(3).uniform(0, 3, 40)
    return levels[(T / 1.3).astype(int)]


def test_a_damper_that_a_voltage_controls_is_followed() -> None:
    u = voltage()
    report = diagnosed(K * D + C * (1 + 0.4 * (u - u.mean())) * V, signals={"valve": u})
    assert report.verdict == "missing_physics"
    finding = next(f for f in report.findings if f.effect == "damping_by_valve")
    (slope,) = finding.parameters
    assert slope.unit == "1/V"
    assert abs(slope.value - 0.4) < max(4 * slope.std, 0.02)
    assert report.augmented_validation.nrmse < 2 * report.noise_floor.nrmse


@pytest.mark.slow
def test_friction_that_a_voltage_makes_stronger_is_followed() -> None:
    u = voltage()
    report = diagnosed(K * D + C * V + (30 + 50 * u) * np.tanh(V / 1e-3), signals={"valve": u})
    first = next(f for f in report.findings if f.effect != "preload")
    values = {q.name: q for q in (*first.parameters, *first.quoted)}
    per_volt = next(q for name, q in values.items() if name.endswith("_force_per_valve"))
    assert per_volt.value == pytest.approx(50, rel=0.1)
    assert per_volt.unit == "N/V"


def late(signal: np.ndarray, time_constant: float) -> np.ndarray:
    """Through a first-order lag, in fine steps; constant before the start."""
    found, y = np.empty(len(signal)), signal[0]
    for i, x in enumerate(signal):
        found[i] = y
        for _ in range(50):
            y += (x - y) / (50 * RATE * time_constant)
    return found


@pytest.mark.slow
def test_a_yield_force_that_follows_a_voltage_late_keeps_its_slope_below_yielding() -> None:
    """As of a magnetorheological damper: the current takes its time, and the fluid is as viscous at any current."""
    u = voltage()
    yields = 60 + 50 * late(u, 0.05)
    report = diagnosed(K * D + 300 * V + yields * np.tanh(4e3 * V / yields), signals={"valve": u})
    first = next(f for f in report.findings if f.effect != "preload")
    values = {q.name: q for q in (*first.parameters, *first.quoted)}
    assert (first.effect, first.family) == ("coulomb_friction", None)
    lag, per_volt = values["valve_lag"], values["breakaway_force_per_valve"]
    assert abs(lag.value - 0.05) < max(4 * lag.std, 0.002) and lag.unit == "s"
    assert abs(per_volt.value - 50) < 3 * per_volt.std < 6
    assert values["force"].value / values["smoothing"].value == pytest.approx(4e3, rel=0.05)
    assert report.augmented_validation.nrmse < 2 * report.noise_floor.nrmse


def test_what_does_not_follow_a_signal_is_not_said_to() -> None:
    report = diagnosed(K * D + C * V, signals={"valve": voltage()})
    assert report.verdict == "consistent"
    assert report.findings == ()


def test_a_signal_that_does_not_change_is_uninformative_and_is_said_so() -> None:
    report = diagnosed(K * D + C * V + 200 * V * np.abs(V) / C, signals={"valve": np.full(len(T), 2.0)})
    assert not any("by_valve" in f.effect for f in report.findings)


@pytest.mark.slow
def test_what_an_unmeasured_current_controls_is_unknown_and_predicted_no_worse_than_by_hand() -> None:
    held = np.repeat(np.random.default_rng(8).uniform(0.0, 2.0, 40), int(0.5 * RATE))[: len(T)]
    force = (600 + 1500 * held) * V + 900 * D + (40 + 400 * held) * np.tanh(25 * V + 0.8 * np.sign(D)) + 90
    report = diagnosed(force)
    assert report.verdict == "unknown_physics"
    split = int(0.7 * len(T))
    by_hand = force - bouc_wen(D, V, force, split)
    error = np.sqrt(np.mean(by_hand[split:] ** 2)) / np.std(force[split:])
    assert report.augmented_validation.nrmse < 1.01 * error


@pytest.mark.parametrize(("smoothing", "told"), [(2e-3, True), (0.08, False)])
def test_a_friction_that_turns_slowly_is_not_distinguished_from_a_valve(smoothing: float, told: bool) -> None:
    """Of a rate's deviation: a jump, which no valve imitates, and a knee that noise hides."""
    rate = smoothing * float(np.std(V))
    valve = 150 * np.clip(V / (1.5 * rate), -1, 1)
    report = diagnosed(K * D + C * V + (150 * np.tanh(V / rate) if told else valve), noise=30.0)
    (friction,) = [f for f in report.findings if f.effect in ("coulomb_friction", "damper_blowoff")]
    assert (friction.family is None) is told
    if not told:
        assert friction.family is not None
        assert {"coulomb_friction", "damper_blowoff"} <= set(friction.family.split(" or "))


def test_the_inertia_of_a_fixture_is_named_with_its_mass() -> None:
    """A rubber mount that is swept up to 40 Hz: clamp and rod between it and the load cell weigh 6 kg."""
    rate, seconds = 400.0, 20.0
    t = np.arange(int(rate * seconds)) / rate
    phase = 2 * np.pi * (0.5 * t + (40.0 - 0.5) / (2 * seconds) * t**2)
    turning = 2 * np.pi * (0.5 + (40.0 - 0.5) / seconds * t)
    d, v = 1.5e-3 * np.sin(phase), 1.5e-3 * turning * np.cos(phase)
    a = 1.5e-3 * (-(turning**2) * np.sin(phase) + 2 * np.pi * (40.0 - 0.5) / seconds * np.cos(phase))
    random = np.random.default_rng(5)
    force = 8e5 * d + 900.0 * v + 6.0 * a + 500.0 + random.standard_normal(len(t))
    system = bench(rate, 400, 6e5, 700.0)
    values = np.column_stack([d + 4e-7 * random.standard_normal(len(t)), force])
    report = diagnose(system, RigRecording(values, rate))
    assert report.verdict == "missing_physics"
    assert named(report, "inerter")["inertance"] == pytest.approx(6.0, rel=0.03)
    assert report.explained is not None and report.explained > 0.98


def shaken(seconds: float, rate: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time, deflection, rate and acceleration of random motion whose acceleration is white up to 0.45 of the rate."""
    count, random = int(seconds * rate), np.random.default_rng(seed)
    omega = 2 * np.pi * np.fft.rfftfreq(count, 1 / rate)
    spectrum = random.standard_normal(len(omega)) + 1j * random.standard_normal(len(omega))
    spectrum *= (omega > 2 * np.pi) & (omega < 0.9 * np.pi * rate)
    motion = [np.fft.irfft(spectrum / (1j * np.maximum(omega, 1.0)) ** power, count) for power in (2, 1, 0)]
    scale = 4e-3 / np.std(motion[0])
    d, v, a = (scale * series for series in motion)
    return np.arange(count) / rate, d, v, a


def test_a_force_at_the_highest_frequencies_that_follows_the_motion_is_no_noise() -> None:
    """A linear rig with a clamp of 1 kg: its force of inertia is white, and far above the noise of the cell."""
    rate, noise = 250.0, 1.0
    t, d, v, a = shaken(40.0, rate, 20)
    random = np.random.default_rng(21)
    force = 5e4 * d + 1200.0 * v + 1.0 * a + noise * random.standard_normal(len(t))
    system = bench(rate, 250, 3.5e4, 900.0)
    values = np.column_stack([d + 1e-6 * random.standard_normal(len(t)), force])
    (record,) = component_records(system, values, rate)
    assert record.task.noise == pytest.approx(noise, rel=0.5)
    assert diagnose(system, RigRecording(values, rate)).verdict != "consistent"


def test_friction_that_turns_as_fast_as_noise_is_no_noise_beyond_what_a_declaration_may_be_wrong_by() -> None:
    rate = 200.0
    _, d, v, _ = shaken(30.0, rate, 4)
    force = 4e4 * d + 600.0 * np.sign(v) + np.random.default_rng(5).standard_normal(len(d))

    def seen(declared: str) -> float:
        system = bench(rate, 64, 4e4, 1.5e3, declared)
        (record,) = component_records(system, np.column_stack([d, force]), rate)
        return record.task.noise

    assert seen("") > 50.0  # not declared: nothing speaks against it
    assert seen(", noise: 1.0") <= 10.0
