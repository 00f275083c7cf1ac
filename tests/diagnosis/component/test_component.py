"""Component tests: an element between a measured motion and ground, with its force; truth from independent code."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import butter, sosfiltfilt

from sprung.model.diagnosis.api import Report, TooLittleError, diagnose
from sprung.model.diagnosis.component.compose import DRAWN_CYCLES, largest_cycles
from sprung.model.diagnosis.force.motion import element_motion, noise_at_rest, still_stretches
from sprung.model.diagnosis.record.white_noise import white_noise
from sprung.model.laws import CATALOGUE, Law
from sprung.model.laws.paths import maxwell_path, presliding_path, stop_path
from sprung.model.laws.reversals import bouc_wen_memory
from sprung.model.signals import FloatArray
from sprung.model.system import System, load_system, parse_system
from sprung.service.diagnosis.improved import write_improved

RATE = 200.0
K, C = 4.0e4, 1.5e3


@dataclass
class RigRecording:
    values: np.ndarray
    sample_rate: float = RATE
    lost: int = 0


def system(noise: float = 1.0, more: str = "", stiffness: str = "4.0e4") -> System:
    return parse_system(TEXT.replace("noise: 1.0", f"noise: {noise}").replace("4.0e4", stiffness) + more)


TEXT = f"""
name: damper on a test bench
sample_rate: {RATE}
window: 64
inputs:
  rod: {{kind: displacement, displacement: {{csv: d, noise: 1e-6}}}}
elements:
  damper: {{upper: rod, lower: ground, stiffness: 4.0e4, damping: 1.5e3}}
sensors:
  cell: {{kind: force, element: damper, csv: F, noise: 1.0}}
"""


def sweep(seconds: float = 12.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, deflection and exact rate of several sines of two amplitudes."""
    t = np.arange(int(seconds * RATE)) / RATE
    swell = 0.6 + 0.4 * np.sin(2 * np.pi * 0.07 * t)
    slope = 0.4 * 2 * np.pi * 0.07 * np.cos(2 * np.pi * 0.07 * t)
    d, v = np.zeros_like(t), np.zeros_like(t)
    for size, f, phase in ((0.012, 0.7, 0.3), (0.004, 1.9, 1.0)):
        angle = 2 * np.pi * f * t + phase
        d += size * swell * np.sin(angle)
        v += size * (slope * np.sin(angle) + swell * 2 * np.pi * f * np.cos(angle))
    return t, d, v


def report(
    force: np.ndarray,
    d: np.ndarray,
    noise: float = 1.0,
    declared: float = 1.0,
    seed: int = 0,
    own: tuple[Law, ...] = (),
) -> Report:
    random = np.random.default_rng(seed)
    measured = force + noise * random.standard_normal(len(force))
    shown = d + 1e-6 * random.standard_normal(len(d))
    known = replace(system(declared), catalogue=(*CATALOGUE, *own))
    return diagnose(known, RigRecording(np.column_stack([shown, measured])))


def laws(found: Report) -> list[str]:
    return [f.effect for f in found.findings if f.effect != "preload"]


def test_a_spring_and_damper_with_preload_is_consistent_and_the_preload_no_fault() -> None:
    _, d, v = sweep()
    found = report(K * d + C * v + 120.0, d)
    assert found.verdict == "consistent"
    (preload,) = [f for f in found.findings if f.effect == "preload"]
    assert preload.parameters[0].value == pytest.approx(120.0, abs=5 * preload.parameters[0].std)
    values = {p.name: p for p in found.baseline}
    for name, truth in (("damper.stiffness", K), ("damper.damping", C), ("damper.preload", 120.0)):
        assert abs(values[name].value - truth) < 5 * values[name].std
    assert found.unexplained.share == 0.0


@pytest.mark.parametrize("factor", [0.1, pytest.param(1.0, marks=pytest.mark.slow), 10.0])
def test_the_verdict_does_not_hang_on_the_declared_noise(factor: float) -> None:
    _, d, v = sweep(8.0)
    assert report(K * d + C * v, d, declared=factor).verdict == "consistent"
    assert rubbing(factor).verdict == "missing_physics"


@cache
def rubbing(declared: float) -> Report:
    """A damper with 60 N of dry friction, its cell's noise declared as it may be."""
    _, d, v = sweep(8.0)
    return report(K * d + C * v + 60 * np.tanh(v / 1e-3), d, declared=declared)


def test_dry_friction_is_named_with_its_force() -> None:
    found = rubbing(1.0)
    first = found.findings[0]
    assert "coulomb_friction" in (first.family or first.effect)
    quoted = {q.name: q.value for q in first.quoted}
    force = quoted.get("breakaway_force", quoted.get("yield_force"))
    assert force == pytest.approx(60, rel=0.1)


def test_bouc_wen_is_named_and_its_values_are_right() -> None:
    t, d, v = sweep()
    alpha, beta, n = 2.0e5, 2000.0, 1.0

    def rate(at: float, z: np.ndarray) -> np.ndarray:
        now = np.interp(at, t, v)
        return now - beta * (abs(now) * abs(z) ** (n - 1) * z + 0.5 * now * abs(z) ** n)

    z = solve_ivp(rate, (0, t[-1]), [0.0], t_eval=t, max_step=1e-3, rtol=1e-6).y[0]
    found = report(K * d + C * v + alpha * z, d)
    assert "bouc_wen" in (found.findings[0].family or found.findings[0].effect)
    quoted = {q.name: q for q in found.findings[0].quoted}
    assert quoted["yield_force"].value == pytest.approx(alpha / (1.5 * beta), rel=0.1)
    assert found.augmented_validation.nrmse < 3 * found.noise_floor.nrmse


def test_friction_with_backlash_is_named_with_slip_gap_and_stiffness() -> None:
    _, d, _ = sweep()
    u, force, truth = 0.0, [], (900.0, 0.006, 4.0e5)
    reach = truth[1] / 2 + truth[0] / truth[2]
    for way in np.diff(d, prepend=d[0]):
        u = float(np.clip(u + way, -reach, reach))
        force.append(truth[2] * np.sign(u) * max(abs(u) - truth[1] / 2, 0.0))
    found = report(np.array(force), d)
    assert laws(found)[0] == "friction_backlash"
    values = {p.name: p.value for p in found.findings[0].parameters}
    assert values["force"] == pytest.approx(truth[0], rel=0.03)
    assert values["gap"] == pytest.approx(truth[1], rel=0.05)
    assert values["stiffness"] == pytest.approx(truth[2], rel=0.1)


@pytest.mark.parametrize(
    ("effect", "force"),
    [
        ("damper_blowoff", lambda d, v: K * d + C * np.clip(v, -0.03, 0.03) + 0.1 * C * (v - np.clip(v, -0.03, 0.03))),
        ("damper_asymmetry", lambda d, v: K * d + C * v + 0.2 * C * np.abs(v)),
        pytest.param("quadratic_damping", lambda d, v: K * d + C * v + 8e3 * v * np.abs(v), marks=pytest.mark.slow),
        pytest.param("cubic_stiffness", lambda d, v: K * d + C * v + 1e8 * d**3, marks=pytest.mark.slow),
        ("bump_stop", lambda d, v: K * d + C * v + 3e5 * (d - np.clip(d, -0.009, 0.009))),
        ("clearance", lambda d, v: K * (d - np.clip(d, -0.003, 0.003)) + C * v),
    ],
)
def test_springs_and_dampers_that_are_not_linear_are_named(
    effect: str, force: Callable[[FloatArray, FloatArray], FloatArray]
) -> None:
    _, d, v = sweep(8.0)
    found = report(force(d, v), d)
    assert found.verdict == "missing_physics"
    assert laws(found) == [effect]


def test_what_no_law_explains_is_unknown_and_no_all_clear() -> None:
    _, d, v = sweep()
    found = report(K * d + C * v + 200 * np.sin(d / 0.0006) * np.sign(v), d)
    assert found.verdict == "unknown_physics"
    assert found.unexplained.share > 0.05
    assert "Hz" in found.unexplained.where


def test_a_force_of_the_wrong_sign_is_a_wrong_sign_and_no_physics() -> None:
    _, d, v = sweep()
    found = report(-(K * d + C * v), d)
    assert found.verdict == "sensor_fault"
    assert laws(found) == ["sign_reversed"]
    assert found.findings[0].location == "cell"


def test_standstill_is_cut_out_and_determines_the_noise() -> None:
    _, d, v = sweep(20.0)
    still = int(3 * RATE)
    d, v = np.concatenate([np.full(still, d[0]), d]), np.concatenate([np.zeros(still), v])
    found = report(K * d + C * v, d, noise=2.0)
    assert found.verdict == "consistent"
    assert found.noise_floor.nrmse * np.std(K * d[still:] + C * v[still:]) == pytest.approx(2.0, rel=0.4)


def test_a_rod_that_does_not_move_is_too_still_to_decide() -> None:
    random = np.random.default_rng(1)
    values = np.column_stack([1e-6 * random.standard_normal(2000), random.standard_normal(2000)])
    with pytest.raises(TooLittleError, match="damper is not moved"):
        diagnose(system(), RigRecording(values))


def test_a_foundation_that_hardly_moves_is_treated_as_ground() -> None:
    _, d, v = sweep(8.0)
    random = np.random.default_rng(2)
    force = K * d + C * v + 60 * np.tanh(v / 1e-3) + random.standard_normal(len(d))
    framed = parse_system(f"""
name: damper in a frame
sample_rate: {RATE}
window: 64
bodies: {{frame: {{mass: 1.0e6}}}}
inputs:
  rod: {{kind: displacement, displacement: {{csv: d, noise: 1e-6}}}}
elements:
  damper: {{upper: rod, lower: frame, stiffness: 4.0e4, damping: 1.5e3}}
  foundation:
    upper: frame
    lower: ground
    stiffness: {{value: 1.0e+9, fixed: true}}
    damping: {{value: 1.0e+6, fixed: true}}
sensors:
  cell: {{kind: force, element: damper, csv: F, noise: 1.0}}
""")
    found = diagnose(framed, RigRecording(np.column_stack([d, force])))
    assert found.verdict == "missing_physics"
    assert any("treated as ground" in note for note in found.advice)


def test_the_deviations_cover_the_truth() -> None:
    _, d, v = sweep(20.0)
    outside = []
    for seed in range(12):
        found = report(K * d + C * v + 40.0, d, noise=20.0, seed=seed)
        truth = {"damper.stiffness": K, "damper.damping": C, "damper.preload": 40.0}
        outside += [abs(p.value - truth[p.name]) / p.std for p in found.baseline]
    assert 0.5 < np.sqrt(np.mean(np.square(outside))) < 1.6


def test_paths_of_memories_follow_their_differential_equations() -> None:
    t = np.linspace(0, 3, 3001)
    d = 0.01 * np.sin(2 * np.pi * t) * (1 + 0.3 * np.sin(2.7 * t))
    rate = np.gradient(d, t)

    def solved(slope: Callable[[float, FloatArray], object]) -> np.ndarray:
        return solve_ivp(lambda x, z: slope(np.interp(x, t, rate), z), (0, 3), [0.0], t_eval=t, max_step=5e-4).y[0]

    reach = 0.004
    np.testing.assert_allclose(presliding_path(d, reach), solved(lambda v, z: (v - abs(v) * z) / reach), atol=3e-3)
    np.testing.assert_allclose(maxwell_path(d, 0.2, t[1]), solved(lambda v, z: v - z / 0.2), atol=2e-5)
    beta = 1 / (1.5 * reach**2)  # saturates at `reach`
    memory = solved(lambda v, z: v - beta * (abs(v) * abs(z) * z + 0.5 * v * z**2))
    np.testing.assert_allclose(bouc_wen_memory(d, beta, 2.0), memory, atol=3e-3 * reach)
    stop = stop_path(d, reach)
    assert np.max(np.abs(stop)) == reach
    inside = np.abs(stop[1:]) < reach
    np.testing.assert_allclose(np.diff(stop)[inside], np.diff(d)[inside], atol=1e-12)


def test_white_noise_is_estimated_below_the_cutoff_of_a_filter() -> None:
    """Resampling leaves nothing next to half the sample rate, and what is left is no smooth motion's."""
    random, (_, d, _) = np.random.default_rng(5), sweep()
    noise = 2e-5 * random.standard_normal(len(d))
    cut = sosfiltfilt(butter(8, 0.8, output="sos"), noise)
    assert white_noise(d + cut) == pytest.approx(2e-5, rel=0.1)
    smooth = sosfiltfilt(butter(2, 0.3, output="sos"), 100 * noise)
    assert white_noise(d + smooth) < 2 * np.std(smooth)  # no even spectrum: nothing is made of it


def test_a_displacement_is_differentiated_with_its_noise_known() -> None:
    _, d, v = sweep()
    noise = 2e-5
    shown = d + noise * np.random.default_rng(3).standard_normal(len(d))
    motion = element_motion(shown, None, RATE)
    assert white_noise(shown) == pytest.approx(noise, rel=0.1)
    inner = slice(400, -400)
    error = float(np.std((motion.rate - v)[inner]))
    assert error < 0.1 * noise * RATE  # far less than differences of the samples would have
    assert error < 2.5 * motion.rate_noise


def test_standstill_is_found_and_its_noise_measured() -> None:
    _, d, _ = sweep()
    series = np.concatenate([np.full(600, d[0]), d])
    (stretch, *_) = still_stretches(series, RATE)
    assert stretch.start == 0
    assert 560 <= stretch.stop <= 620
    force = np.random.default_rng(4).standard_normal(len(series)) * 3.0
    assert noise_at_rest(force, [stretch]) == pytest.approx(3.0, rel=0.1)
    ringing = force + np.where(np.arange(len(force)) < 2000, 0.0, 40.0 * np.sin(np.arange(len(force))))
    assert noise_at_rest(ringing, [stretch, slice(2000, 2200)]) == pytest.approx(3.0, rel=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_a_differentiated_motion_is_no_law(seed: int) -> None:
    """A sine at one amplitude: the noise that passes with it lies in few bins and looks like a knee at the top."""
    random = np.random.default_rng(seed)
    t = np.arange(3000) / RATE
    d, v = 0.025 * np.sin(6.6 * t), 0.165 * np.cos(6.6 * t)
    columns = [d + 2e-5 * random.standard_normal(len(t)), 800 * d + 1e3 * v + 0.5 * random.standard_normal(len(t))]
    found = diagnose(system(0.5), RigRecording(np.column_stack(columns)))
    assert (found.verdict, laws(found)) == ("consistent", [])


@pytest.mark.slow
def test_what_a_law_leaves_large_is_not_that_law() -> None:
    """A slider driven through a play that stays where it was pushed: no law of the catalogue is near."""
    random, t = np.random.default_rng(4), np.arange(4000) / RATE
    waves = [np.sin(2 * np.pi * f * t + random.uniform(0, 6)) for f in random.uniform(0.2, 3.0, 12)]
    d = 0.006 * np.interp(t, [0, 3, 8, 20], [0, 1, 1, 0.1]) * np.sum(waves, axis=0)
    place, force, forces = 0.0, 0.0, []
    for at in d:
        moved = float(np.clip(place, at - 0.004, at + 0.004))
        force = float(np.clip(force + 2e6 * (moved - place), -9000.0, 9000.0))
        place = moved
        forces.append(force)
    found = report(np.array(forces), d, noise=20.0, declared=20.0)
    assert found.verdict == "unknown_physics"
    assert laws(found) == ["unknown"]
    assert "would come closest" in (found.findings[0].sentence or "")


def test_what_was_found_is_written_into_the_system_file_and_found_there(tmp_path: Path) -> None:
    _, d, v = sweep(8.0)
    random = np.random.default_rng(2)
    force = K * d + C * v + 60 * np.tanh(v / 1e-3) + 3e7 * (d - 0.5 * (d.max() + d.min())) ** 3 + 150
    columns = np.column_stack([d + 1e-6 * random.standard_normal(len(d)), force + random.standard_normal(len(d))])
    first = diagnose(system(), RigRecording(columns))
    assert {law.effect for law in first.laws} == {"coulomb_friction", "cubic_stiffness", "preload"}
    source = tmp_path / "rig.yaml"
    source.write_text(TEXT)
    write_improved(tmp_path / "better.yaml", source.read_text(), system(), first)
    improved = load_system(tmp_path / "better.yaml")
    again = diagnose(improved, RigRecording(columns))
    assert (again.verdict, laws(again)) == ("consistent", [])
    assert again.baseline_validation.nrmse == pytest.approx(first.augmented_validation.nrmse, rel=0.02)
    assert {law.effect for law in again.laws} == {law.effect for law in first.laws}


def test_a_law_of_the_system_file_is_no_finding_and_what_is_beside_it_is() -> None:
    _, d, v = sweep(8.0)
    stop = "laws: [{coulomb_friction: {force: 40, smoothing: 1.0e-3}}]"
    text = TEXT.replace("damping: 1.5e3", f"damping: 1.5e3, {stop}")
    force = K * d + C * v + 60 * np.tanh(v / 1e-3) + 3e7 * (d - 0.5 * (d.max() + d.min())) ** 3
    random = np.random.default_rng(3)
    columns = np.column_stack([d + 1e-6 * random.standard_normal(len(d)), force + random.standard_normal(len(d))])
    found = diagnose(parse_system(text), RigRecording(columns))
    assert laws(found) == ["cubic_stiffness"]
    friction = next(law for law in found.laws if law.effect == "coulomb_friction")
    assert friction.parameters[0].value == pytest.approx(60, rel=0.05)


@pytest.mark.slow
def test_a_force_of_no_law_is_reported_as_a_formula_and_goes_into_the_system_file(tmp_path: Path) -> None:
    _, d, v = sweep()
    found = report(K * d + C * v + 6e4 * d * np.abs(v) + 3e6 * d**2, d)
    assert found.verdict == "unknown_physics"
    first = found.findings[0]
    assert (first.effect, first.formula) == ("formula", "a * d**2 + b * d * abs(v)")
    assert [p.value for p in first.parameters] == pytest.approx([3e6, 6e4], rel=0.01)
    file = tmp_path / "damper.yaml"
    file.write_text(TEXT, encoding="utf-8")
    improved = tmp_path / "improved.yaml"
    write_improved(improved, file.read_text(encoding="utf-8"), system(), found)
    assert "a * d**2 + b * d * abs(v)" in improved.read_text(encoding="utf-8")
    values = np.column_stack([d, K * d + C * v + 6e4 * d * np.abs(v) + 3e6 * d**2])
    noisy = values + np.random.default_rng(3).normal(0, [1e-6, 1.0], values.shape)
    assert diagnose(load_system(improved), RigRecording(noisy)).verdict == "consistent"


def test_a_law_that_the_file_fixes_is_held_and_stays_in_the_system_file() -> None:
    _, d, v = sweep(8.0)
    held = "laws: [{coulomb_friction: {force: {value: 60, fixed: true}, smoothing: {value: 1.0e-3, fixed: true}}}]"
    columns = np.column_stack([d, K * d + C * v + 60 * np.tanh(v / 1e-3)])
    columns = columns + np.random.default_rng(3).standard_normal(columns.shape) * [1e-6, 1.0]
    found = diagnose(parse_system(TEXT.replace("damping: 1.5e3", f"damping: 1.5e3, {held}")), RigRecording(columns))
    assert (found.verdict, laws(found)) == ("consistent", [])
    (friction,) = [law for law in found.laws if law.effect != "preload"]
    assert [p.value for p in friction.parameters] == [60, 1e-3]
    columns[:, 1] += 40 * np.tanh(v / 1e-3)
    more = diagnose(parse_system(TEXT.replace("damping: 1.5e3", f"damping: 1.5e3, {held}")), RigRecording(columns))
    assert more.verdict == "missing_physics"
    assert more.laws[0].parameters[0].value == 60
    assert {q.name: q.value for q in more.findings[0].quoted}["breakaway_force"] == pytest.approx(40, rel=0.1)


def test_a_motion_measured_by_acceleration_alone_is_integrated() -> None:
    step, band = 1 / RATE, butter(3, [1.0, 15.0], "bandpass", fs=RATE, output="sos")
    v = sosfiltfilt(band, np.random.default_rng(8).standard_normal(int(30 * RATE)))
    v *= 0.15 / v.std()
    spectrum, omega = np.fft.rfft(v), 2 * np.pi * np.fft.rfftfreq(len(v), step)
    d = np.fft.irfft(spectrum / np.maximum(omega, 1e-9) / 1j * (omega > 1), len(v))
    a = np.fft.irfft(1j * omega * spectrum, len(v))
    columns = np.column_stack([a, K * d + C * v + 60 * np.tanh(v / 2e-2) + 90])
    columns = columns + np.random.default_rng(3).standard_normal(columns.shape) * [0.05, 1.0]
    text = TEXT.replace("displacement: {csv: d, noise: 1e-6}", "acceleration: {csv: a, noise: 0.05}")
    found = diagnose(parse_system(text), RigRecording(columns))
    assert laws(found) == ["coulomb_friction"]
    values = {p.name: p.value for p in found.augmented}
    assert values["damper.stiffness"] == pytest.approx(K, rel=0.02)
    assert values["damper.damping"] == pytest.approx(C, rel=0.02)
    assert any("integrated from its acceleration" in note for note in found.advice)


def test_a_loop_is_drawn_of_the_few_largest_cycles() -> None:
    time = np.arange(0, 60, 0.01)
    size = np.exp(-(((time - 40) / 5) ** 2))
    deflection, rate = size * np.sin(2 * np.pi * time), size * 2 * np.pi * np.cos(2 * np.pi * time)
    drawn = largest_cycles(deflection, rate)
    assert drawn.stop - drawn.start == pytest.approx(100 * DRAWN_CYCLES, abs=2)
    assert abs(time[drawn].mean() - 40) < 1 and np.argmax(np.abs(deflection)) in range(drawn.start, drawn.stop)
    assert largest_cycles(deflection[:300], rate[:300]) == slice(None)
