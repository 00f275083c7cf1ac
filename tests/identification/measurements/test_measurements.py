"""Gains, delays, loads and broken sensors: what windows say of them, and that no spring is blamed for them."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.identify import Identifier, load_identifier
from sprung.model.identification.measurements.deviations import clock_groups, deviations, nodes
from sprung.model.identification.refinement.refine import Refiner
from sprung.model.signals import FloatArray
from sprung.model.system import BUNDLED, MANCHESTER, System, load_system, parse_system
from sprung.model.tracking.tracker import Tracker, TrackerSettings, TrackerState
from tests.tracker_windows import EPOCH

HOP = 500_000_000
BOGIE = [20, 21, 22, 23]  # columns of the accelerometers of bogie 1


@pytest.fixture(scope="module")
def system() -> System:
    return load_system()


@pytest.fixture(scope="module")
def identifier(system: System) -> Identifier:
    found = load_identifier(system)
    assert isinstance(found, Identifier)
    return found


def record(seconds: float, seed: int, load: float = 0.0, truth: FloatArray | None = None) -> FloatArray:
    """Clean samples (T, C) of running, the car heavier by `load`."""
    system = load_system()
    mechanics = system.mechanics
    heavier = mechanics.mass * np.where(mechanics.body_of_dof == 0, 1 + load, 1)
    system.__dict__["mechanics"] = replace(mechanics, mass=heavier)
    values = np.zeros((1, 24)) if truth is None else truth[None]
    return simulate_runs(system, values, int(100 * seconds), np.random.default_rng(seed)).clean[0]


def late(samples: FloatArray, columns: Sequence[int], delay: float) -> FloatArray:
    out, time = samples.copy(), np.arange(len(samples)) / 100
    for c in columns:
        out[:, c] = make_interp_spline(time, samples[:, c], k=5)(np.clip(time - delay, 0, time[-1]))
    return out


def noisy(system: System, samples: FloatArray, seed: int = 0) -> FloatArray:
    noise = np.array([channel.noise for channel in system.channels])
    return samples + noise * np.random.default_rng(seed).standard_normal(samples.shape)


def windows(system: System, samples: FloatArray, seed: int = 0, hop: int = 50) -> FloatArray:
    values = noisy(system, samples, seed)
    return np.stack([values[i : i + 100] for i in range(0, len(values) - 99, hop)])


def tracked(system: System, identifier: Identifier, samples: FloatArray, seed: int = 0) -> tuple[Tracker, TrackerState]:
    """Tracker and state after overlapping windows, one of three weighed."""
    values = windows(system, samples, seed)
    estimates = identifier.examine(values, np.arange(len(values)) % 3 == 0)
    tracker = Tracker(system.parameters, TrackerSettings(), deviations(system))
    state = tracker.initial_state()
    for k, estimate in enumerate(estimates):
        state = tracker.update(state, estimate, EPOCH + k * HOP)
    return tracker, state


def after(first: FloatArray, second: FloatArray, seconds: float) -> FloatArray:
    return np.concatenate([first[: int(100 * seconds)], second[int(100 * seconds) :]])


def test_every_channel_may_deviate_and_channels_of_one_message_share_a_clock(system: System) -> None:
    found = deviations(system)
    assert [d.kind for d in found].count("gain") == [d.kind for d in found].count("delay") == 28
    own = "own_roll", "own_pitch", "reach_x", "reach_y"
    assert [(d.name, d.kind) for d in found[56:]] == [
        ("car", "load"), ("car", "roll_inertia"), ("car", "pitch_inertia"), ("car", "centre"), ("car", "side"),
        *(("bogie1", kind) for kind in own), *(("bogie2", kind) for kind in own),
    ]  # fmt: skip
    groups = clock_groups(system)
    assert len(set(groups[BOGIE])) == 1 and len(set(groups)) == 7


def test_channels_without_messages_share_a_clock_and_a_node_where_they_are_measured(system: System) -> None:
    text = re.sub(r"mcap: [^,]*, can: ([^,}]*)", r"csv: \1", MANCHESTER.read_text("utf-8"))
    table = parse_system(text)
    assert not any(channel.mcap or channel.can for channel in table.channels)
    assert (clock_groups(table) == clock_groups(system)).all() and (nodes(table) == nodes(system)).all()


def test_the_estimate_moves_with_a_gain_as_the_sensitivities_say(system: System) -> None:
    refiner = Refiner(system)
    runs = windows(system, record(4, 1), hop=100)
    everything = np.ones(len(runs), dtype=bool)
    here = refiner.refine(runs, weigh=everything)
    for column, change in ((20, 0.002), (16, 0.002), (0, 0.002)):
        moved = runs.copy()
        moved[:, :, column] *= 1 + change
        there = refiner.refine(moved, here.log_ratio, weigh=everything)
        std = np.sqrt(np.diagonal(here.covariance, axis1=1, axis2=2))
        wrong = (there.log_ratio - here.log_ratio + here.cross[:, :, column] * change) / std
        assert np.abs(wrong).max() < 0.1


def test_what_a_window_says_of_deviations_is_as_uncertain_as_stated(system: System) -> None:
    refined = Refiner(system).refine(windows(system, record(40, 2), hop=100), weigh=np.ones(40, dtype=bool))
    z = refined.score[:, :56] / np.sqrt(np.einsum("bhh->bh", refined.information)[:, :56])
    assert 0.9 < np.sqrt(np.mean(z**2)) < 1.1


def test_a_gain_or_delay_that_all_channels_share_changes_nothing_and_is_not_claimed_to_be_known(system: System) -> None:
    refined = Refiner(system).refine(windows(system, record(4, 3), hop=100), weigh=np.ones(4, dtype=bool))
    for part in (slice(0, 28), slice(28, 56)):
        common = np.zeros(refined.score.shape[1])
        common[part] = 1.0
        assert np.abs(common @ refined.information @ common).max() < 1e-3 * np.abs(refined.information).max()


@pytest.mark.parametrize(
    ("change", "channel", "kind"),
    [
        (lambda x: x * np.where(np.arange(28) == 20, 1.1, 1), "bogie1_1l", "gain"),
        (lambda x: x * np.where(np.arange(28) == 0, 1.2, 1), "wheel_11l.displacement", "gain"),
        (lambda x: late(x, BOGIE, 0.003), "bogie1_1l|bogie1_1r|bogie1_2l|bogie1_2r", "delay"),
        (lambda x: late(x, [20], 0.01), "bogie1_1l", "delay"),
        (lambda x: late(x, [3], 0.027), "wheel_11r.velocity", "delay"),
        (lambda x: x * np.where(np.arange(28) == 17, -1, 1), "car_1r", "inverted"),
        (lambda x: x[:, [*range(20), 21, 20, *range(22, 28)]], "bogie1_1l|bogie1_1r", "swapped"),
    ],
)
def test_a_window_that_does_not_fit_names_the_measurement_and_then_fits(
    system: System, identifier: Identifier, change: Callable[[FloatArray], FloatArray], channel: str, kind: str
) -> None:
    values = windows(system, change(record(6, 4)), hop=100)[1:5]
    found = identifier.examine(values, np.zeros(len(values), dtype=bool))
    named = [{(f.channel, f.kind) for f in e.faults} for e in found]
    assert sum((channel, kind) in faults for faults in named) >= 3
    used = [estimate for estimate in found if estimate.adequate]
    assert len(used) >= 3
    for estimate in used:
        z = estimate.log_ratio / np.sqrt(np.diag(estimate.covariance))
        assert np.sqrt(np.mean(z**2)) < 1.6


def test_sensors_that_are_noisy_are_named_and_the_window_used_without_them(
    system: System, identifier: Identifier
) -> None:
    healthy = record(6, 5)
    for channels, noise in (([21], 0.15), ([3], 5e-3), ([16, 25], 0.2)):
        wrong = healthy.copy()
        wrong[:, channels] += noise * np.random.default_rng(8).standard_normal((len(wrong), len(channels)))
        found = identifier.examine(windows(system, wrong, hop=100)[1:5], np.zeros(4, dtype=bool))
        names = {system.channels[channel].name for channel in channels}
        for estimate in found:
            assert estimate.adequate
            assert {(f.channel, f.kind) for f in estimate.faults} == {(name, "noisy") for name in names}
            assert all(0.4 * noise < f.value < 1.8 * noise for f in estimate.faults)
            assert np.sqrt(np.mean(estimate.log_ratio**2 / np.diag(estimate.covariance))) < 1.6


@pytest.mark.parametrize("kind", ["frozen", "saturated"])
def test_a_stuck_sensor_is_named_and_the_window_used_without_it(
    system: System, identifier: Identifier, kind: str
) -> None:
    values = windows(system, record(6, 5), hop=100)[1:5]
    most = 1.1 * values[:, :, 21].std()
    values[:, :, 21] = values[:, :1, 21] if kind == "frozen" else np.clip(values[:, :, 21], -most, most)
    found = identifier.examine(values, np.zeros(4, dtype=bool))
    named = [estimate for estimate in found if estimate.faults]
    assert len(named) == 4 if kind == "frozen" else named
    for estimate in found:
        assert estimate.adequate
        assert [(f.channel, f.kind) for f in estimate.faults] == ([("bogie1_1r", kind)] if estimate.faults else [])


@pytest.mark.parametrize("gain", [0.02, pytest.param(0.05, marks=pytest.mark.slow), 0.1])
def test_a_gain_that_jumps_is_the_sensors_alarm_and_no_springs(
    system: System, identifier: Identifier, gain: float
) -> None:
    healthy = record(70, 6)
    wrong = healthy * np.where(np.arange(28) == 20, 1 + gain, 1)
    tracker, state = tracked(system, identifier, after(healthy, wrong, 40))
    assert [(a.kind, a.parameter) for a in state.alarms] == [("sensor", "bogie1_1l.gain")]
    (fault,) = tracker.sensors(state)
    assert (fault.channel, fault.kind) == ("bogie1_1l", "gain")
    assert fault.value == pytest.approx(1 + gain, abs=4 * fault.std)
    mean, std = tracker.posterior(state)
    assert np.abs(mean / std).max() < 3.5


def test_an_instrument_that_is_late_or_off_below_is_named_with_both_its_quantities_and_no_spring(
    system: System, identifier: Identifier
) -> None:
    """Displacement and velocity of one wheel, later by 1 ms; too large by 3 %."""
    healthy, wheel = record(75, 9), [8, 9]
    gained = healthy.copy()
    gained[:, wheel] *= 1.03
    for wrong, kind in ((late(healthy, wheel, 0.001), "delay"), (gained, "gain")):
        tracker, state = tracked(system, identifier, after(healthy, wrong, 35))
        assert [(a.kind, a.parameter) for a in state.alarms] == [
            ("sensor", f"wheel_21l.displacement|wheel_21l.velocity.{kind}")
        ]
        assert {(f.channel, f.kind) for f in tracker.sensors(state)} == {
            ("wheel_21l.displacement", kind),
            ("wheel_21l.velocity", kind),
        }
        mean, std = tracker.posterior(state)
        assert np.abs(mean / std).max() < 3.5


@pytest.mark.parametrize("seed", [5, pytest.param(9, marks=pytest.mark.slow), pytest.param(11, marks=pytest.mark.slow)])
def test_a_late_accelerometer_below_is_no_change_of_its_damper(seed: int) -> None:
    """Noise of accelerometers hides 0.6 ms for half a minute, in which the damper at the wheel seems to change."""
    system = load_system(BUNDLED / "axleboxes.yaml")
    identifier = load_identifier(system)
    assert isinstance(identifier, Identifier)
    rng = np.random.default_rng(seed)
    healthy = simulate_runs(system, np.zeros((1, 24)), 15_000, rng).clean[0]
    tracker, state = tracked(system, identifier, after(healthy, late(healthy, [0], 0.0006), 75))
    assert not [a for a in state.alarms if a.kind == "change"]
    mean, std = tracker.posterior(state)
    assert np.abs(mean / std).max() < 3.5


def test_all_wheels_of_a_bogie_that_are_late_are_named_and_not_its_sensors(
    system: System, identifier: Identifier
) -> None:
    healthy = record(75, 10)
    tracker, state = tracked(system, identifier, after(healthy, late(healthy, range(8), 0.002), 35))
    assert {a.parameter for a in state.active} == {"|".join(c.name for c in system.channels[:8]) + ".delay"}
    assert state.active[0].change == pytest.approx(0.002, abs=1.5e-3)
    mean, std = tracker.posterior(state)
    assert np.abs(mean / std).max() < 3.5


def test_a_gain_that_all_channels_of_a_message_share_is_one_alarm(system: System, identifier: Identifier) -> None:
    healthy = record(75, 9)
    wrong = healthy.copy()
    wrong[:, BOGIE] *= 1.05
    tracker, state = tracked(system, identifier, after(healthy, wrong, 35))
    assert [(a.kind, a.parameter) for a in state.alarms] == [("sensor", "bogie1_1l|bogie1_1r|bogie1_2l|bogie1_2r.gain")]
    mean, std = tracker.posterior(state)
    assert np.abs(mean / std).max() < 3.5


def test_of_two_quantities_that_an_alarm_names_the_one_that_is_right_leaves_it(
    system: System, identifier: Identifier
) -> None:
    """A large gain of a displacement alone begins within a window, which tells that of both and of one alike."""
    healthy = record(70, 12)
    wrong = healthy * np.where(np.arange(28) == 4, 1.1, 1)
    _, state = tracked(system, identifier, after(healthy, wrong, 35.25))
    assert [(a.kind, a.parameter) for a in state.active] == [("sensor", "wheel_12l.displacement.gain")]


def test_a_delay_that_jumps_leaves_the_springs_where_they_were(system: System, identifier: Identifier) -> None:
    healthy = record(75, 7)
    tracker, state = tracked(system, identifier, after(healthy, late(healthy, [20], -0.003), 35))
    assert [(a.kind, a.parameter) for a in state.alarms] == [("sensor", "bogie1_1l.delay")]
    assert state.alarms[0].change == pytest.approx(-0.003, abs=5e-4)  # against all others, wherever they wander
    drift = np.array([p.drift for p in tracker.report(state)])
    assert np.abs(drift).max() < 0.025


def test_a_large_delay_from_the_first_window_on_is_accepted_at_once(system: System, identifier: Identifier) -> None:
    tracker, state = tracked(system, identifier, late(record(20, 8), [8], 0.03))
    assert state.rejected <= 6 and not state.alarms
    assert {(f.channel, f.kind) for f in tracker.sensors(state)} == {("wheel_21l.displacement", "delay")}
    mean, std = tracker.posterior(state)
    assert np.abs(mean / std).max() < 4.0


@pytest.mark.parametrize(("channels", "steps"), [("car_", 15), ("bogie1_", -18)])
def test_a_clock_that_was_set_anew_is_named_with_its_delay(
    system: System, identifier: Identifier, channels: str, steps: int
) -> None:
    whole = noisy(system, record(3, 12))
    rows = np.array([[50]]) + np.arange(system.window)
    names = [channel.name for channel in system.channels]
    columns = [c for c, name in enumerate(names) if name.startswith(channels)]
    apart = whole[rows]
    apart[:, :, columns] = whole[rows - steps][:, :, columns]
    for found in identifier.examine(apart, np.ones(len(rows), dtype=bool)):
        (fault,) = found.faults
        assert found.adequate and fault.kind == "delay"
        assert fault.channel.split("|") == [names[c] for c in columns]
        assert fault.value == pytest.approx(steps / system.sample_rate, abs=1.5e-3)


@pytest.mark.parametrize(
    "load", [pytest.param(0.02, marks=pytest.mark.slow), 0.1, pytest.param(0.3, marks=pytest.mark.slow)]
)
def test_passengers_change_the_load_and_no_spring(system: System, identifier: Identifier, load: float) -> None:
    tracker, state = tracked(system, identifier, record(40, 7, load))
    assert state.alarms == ()
    assert tracker.sensors(state) == ()
    value, std = tracker.loads(state)["car"]
    assert abs(value - np.log1p(load)) < min(0.02, 4 * std)
    mean, spread = tracker.posterior(state)
    assert np.abs(mean / spread).max() < 3.5


def test_what_a_loaded_car_is_simulated_to_do_fits_what_it_did(system: System, identifier: Identifier) -> None:
    values = windows(system, record(5, 7, load=-0.25))
    shown = identifier.identify(values, states=True, loads=True)
    assert all(estimate.adequate and estimate.nrmse < 0.05 for estimate in shown), [e.nrmse for e in shown]


def test_a_true_change_is_the_elements_and_all_dampers_together_are_one_message(
    system: System, identifier: Identifier
) -> None:
    one, every = np.zeros(24), np.zeros(24)
    one[8] = np.log(0.92)
    every[12:] = np.log(0.88)
    for truth, name in ((one, "secondary_1l.stiffness"), (every, "*.damping")):
        samples = after(record(60, 8), record(60, 9, truth=truth), 38)
        tracker, state = tracked(system, identifier, samples)
        assert [(a.kind, a.parameter) for a in state.alarms] == [("change", name)]
        assert tracker.sensors(state) == ()
        again = TrackerState.from_dict(state.to_dict())
        assert np.array_equal(again.belief.covariance, state.belief.covariance)
        assert np.array_equal(again.calibration.cross, state.calibration.cross)


def test_a_declared_load_leaves_the_weights_usable() -> None:
    text = MANCHESTER.read_text()

    loaded = parse_system(text.replace("position: [0.0, 0.0]}", "position: [0.0, 0.0], load: true}", 1))
    assert loaded.loads[0].declared
    assert loaded.loads[0].name == "car.load"
    assert loaded.digest == load_system().digest


@pytest.mark.parametrize(("speed", "count"), [(4.0, 64), (35.0, 24)])
def test_gains_are_read_without_bias_where_inputs_are_noisy(
    system: System, identifier: Identifier, speed: float, count: int
) -> None:
    """At walking pace the model answers to the noise of the inputs, which sensors do not show: along the inputs as
    measured all sensors would seem to show 4 % too little, five standard deviations."""
    rng = np.random.default_rng(12)
    runs = simulate_runs(system, np.zeros((count, 24)), system.window, rng, speed=(speed, 1.0001 * speed))
    estimates = identifier.examine(runs.values, np.ones(count, dtype=bool))
    assert not any(e.faults for e in estimates)
    told = [e.deviating for e in estimates if e.deviating is not None]
    assert len(told) > 0.9 * count
    prior = np.array([d.std for d in deviations(system)])
    information = sum(found.information for found in told) + np.diag(prior**-2)
    gains = np.linalg.solve(information, sum(found.score for found in told))[:28]
    std = np.sqrt(np.diag(np.linalg.inv(information)))[:28]
    assert np.abs((gains - np.median(gains)) / std).max() < 3.5
    below, above = gains[:16].mean(), gains[16:].mean()
    assert abs(above - below) < 0.012
