"""Which deviations of measurements are told, how sure they are, and that alarms of springs wait for them."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sprung.model.identification.measurements.deviations import Deviation
from sprung.model.signals import Deviating, Estimate, FloatArray, MeasurementFault
from sprung.model.tracking import jumps
from sprung.model.tracking.deviation_model import model_of
from sprung.model.tracking.rules import TRACKING_RULES
from sprung.model.tracking.state import Stuck
from sprung.model.tracking.tracker import Tracker, TrackerState
from tests.tracker_windows import EPOCH, TrackedParameter, correlated, estimate

SECOND = 1_000_000_000
DELAYS = [Deviation(f"c{i}", "delay", 5e-3, 0) for i in range(4)]
LOADED = [*DELAYS, Deviation("car", "load", 0.15, -1), Deviation("car", "roll_inertia", 0.1, -1)]
STD = np.full(6, 0.01)


def make(deviations: Sequence[Deviation] = DELAYS) -> Tracker:
    return Tracker([TrackedParameter(f"element_{i}.damping") for i in range(6)], None, deviations)


def told(rng: np.random.Generator, size: int, truth: FloatArray, information: float = (1e-4) ** -2) -> Estimate:
    """A window that is weighed: delays `truth` (H,), relative to their mean only, move no parameter."""
    apart = np.eye(size) - np.pad(np.ones((4, 4)) / 4, (0, size - 4))
    M = information * apart
    score = M @ truth + np.sqrt(information) * apart @ rng.normal(size=size)
    covariance = correlated(rng, STD)
    value = np.linalg.cholesky(covariance) @ rng.normal(size=6)
    found = Deviating(np.zeros(size), covariance, np.zeros((6, size)), M, score, 300.0, True)
    return estimate(value, covariance, deviating=found)


def test_a_channel_is_known_among_others_although_their_common_clock_is_open() -> None:
    rng, tracker = np.random.default_rng(1), make()
    truth = np.array([1e-3, 0.0, 0.0, 0.0])
    state = tracker.initial_state()
    for k in range(40):
        state = tracker.update(state, told(rng, 4, truth), EPOCH + k * SECOND)
    alone = np.sqrt(np.diag(state.belief.covariance)[-4:])
    relative = tracker.model.relative_std(state.belief.covariance[-4:, -4:])
    assert np.all(alone > 2e-3)  # what all of them share cannot be known
    assert np.all(relative < 1e-4)
    (fault,) = tracker.sensors(state)
    assert (fault.channel, fault.kind) == ("c0", "delay")
    assert fault.value == pytest.approx(1e-3, abs=3e-4)
    assert abs(fault.value - 1e-3) < 4 * fault.std + 2.6e-4  # a quarter of it is in the mean of four


@pytest.mark.parametrize("size", [2, 3, 4, 9, 28])
def test_relative_deviations_are_those_of_the_median_of_the_others(size: int) -> None:
    """What is stated of a channel is its difference to the median of the others, whatever is common to all."""
    rng = np.random.default_rng(2)
    model = model_of([*[Deviation(f"c{i}", "delay", 5e-3, 0) for i in range(size)], *LOADED[-2:]])
    own = np.append(rng.uniform(0.9, 1.1, size) * np.append(3.0, np.ones(size - 1)), [2.0, 0.5])
    covariance = np.diag(own**2) + 25 * np.pad(np.ones((size, size)), (0, 2))
    draws = rng.multivariate_normal(np.zeros(size + 2), covariance, 40_000)
    (stated, truth) = model.relative_std(covariance), np.array([draws[:, i].std() for i in range(size + 2)])
    truth[0] = (draws[:, 0] - np.median(draws[:, 1:size], axis=1)).std()
    np.testing.assert_allclose(stated[[0, -2, -1]], truth[[0, -2, -1]], rtol=0.04)


def test_a_change_waits_while_the_windows_speak_more_and_more_for_a_sensor() -> None:
    rng, tracker = np.random.default_rng(3), make()
    state = tracker.initial_state()
    for k in range(40):
        state = tracker.update(state, told(rng, 4, np.zeros(4)), EPOCH + k * SECOND)
    now = EPOCH + 40 * SECOND
    since = np.full(6, EPOCH + 36 * SECOND)
    changed = replace(state.changes, active=np.array([1, 0, 0, 0, 0, 0], dtype=np.int8), up_since=since)
    recent = np.full(3, EPOCH + 37 * SECOND)

    away = state.belief.mean.copy()
    away[0] += 0.1

    def opened(slope: FloatArray, at: int = now, mean: FloatArray = away) -> list[str]:
        calibration = replace(state.calibration, slope=slope, curvature=np.ones_like(slope), recent=recent)
        belief = replace(state.belief, mean=mean)
        asked = replace(state, changes=changed, calibration=calibration, belief=belief)
        drift = tracker._fusion.drift(asked)
        return [a.kind for a in tracker._alarms.updated(asked, drift, None, at)]

    quiet = np.zeros(len(tracker.model.directions))
    rising = quiet.copy()
    rising[1] = 4.0  # a log-likelihood ratio of 8
    assert opened(quiet) == ["change"]
    assert opened(rising) == []
    assert opened(rising, now + 30 * SECOND) == ["change"]  # not for ever
    assert opened(rising, now + 30 * SECOND, state.belief.mean) == []  # but not if by now it is explained


def test_a_state_that_did_not_know_how_loads_are_spread_goes_on() -> None:
    rng, old = np.random.default_rng(4), make(LOADED[:5])
    state = old.initial_state()
    for k in range(40):
        state = old.update(state, told(rng, 5, np.array([1e-3, 0, 0, 0, 0.0])), EPOCH + k * SECOND)
    state = TrackerState.from_dict(state.to_dict())
    new = make(LOADED)
    after = new.update(state, told(rng, 6, np.array([1e-3, 0, 0, 0, 0, 0.0])), EPOCH + 40 * SECOND)
    assert after.used == state.used + 1
    assert len(after.belief.mean) == 12 + 6
    assert after.calibration.cross.shape == (6, 6)
    before, now = old.report(state), new.report(after)
    assert [r.baseline for r in now] == pytest.approx([r.baseline for r in before], rel=1e-3)
    assert [f.channel for f in new.sensors(after)] == ["c0"]
    assert TrackerState.from_dict(after.to_dict()).to_dict() == after.to_dict()


def test_a_jump_is_looked_for_along_all_clocks_of_a_node_together() -> None:
    model = model_of([Deviation(f"c{i}", "delay", 5e-3, i // 2, i // 4) for i in range(6)])
    directions = {tuple(np.flatnonzero(row)) for row in model.directions}
    assert {(0, 1), (2, 3), (4, 5), (0, 1, 2, 3)} <= directions
    assert len(model.directions) == 6 + 3 + 1  # the second node has one clock, which is there already


def test_evidence_of_a_state_that_knew_fewer_directions_begins_anew() -> None:
    rng, old = np.random.default_rng(5), make()
    state = old.initial_state()
    for k in range(40):
        state = old.update(state, told(rng, 4, np.zeros(4)), EPOCH + k * SECOND)
    new = make([Deviation(f"c{i}", "delay", 5e-3, i // 2, 0) for i in range(4)])
    after = new.update(state, told(rng, 4, np.zeros(4)), EPOCH + 40 * SECOND)
    assert after.used == state.used + 1
    assert len(after.calibration.slope) == len(new.model.directions) != len(state.calibration.slope)


GAINS = [Deviation(f"c{i}", "gain", 0.015, i) for i in range(6)]


def gained(rng: np.random.Generator, gains: FloatArray, information: float = 0.01**-2) -> Estimate:
    """A weighed window: gains (6,), relative to their mean only; the first moves the first parameter."""
    apart = np.eye(6) - np.ones((6, 6)) / 6
    M = information * apart
    score = M @ gains + np.sqrt(information) * apart @ rng.normal(size=6)
    cross = np.zeros((6, 6))
    cross[0, 0] = 1.0
    covariance = correlated(rng, STD)
    value = np.linalg.cholesky(covariance) @ rng.normal(size=6) - cross @ gains
    return estimate(value, covariance, deviating=Deviating(np.zeros(6), covariance, cross, M, score, 300.0, True))


@cache
def learned(windows: int) -> tuple[Tracker, TrackerState, np.random.Generator]:
    """A tracker that has seen so many windows of right gains, its state, and the numbers that are drawn after them."""
    rng, tracker = np.random.default_rng(6), make(GAINS)
    state = tracker.initial_state()
    for k in range(windows):
        state = tracker.update(state, gained(rng, np.zeros(6)), EPOCH + k * SECOND)
        state = TrackerState.from_dict(state.to_dict()) if k % 100 == 0 else state
    return tracker, state, rng


@pytest.mark.parametrize(
    ("to", "begins"),  # from 60, the gains of the baseline are being refined; by 900 they have been
    [
        (0.06, 60),
        pytest.param(0.01, 900, marks=pytest.mark.slow),
        pytest.param(0.06, 900, marks=pytest.mark.slow),
        pytest.param(0.01, 60, marks=pytest.mark.slow),
    ],
)
def test_a_gain_that_drifts_slowly_is_an_alarm_where_it_is_more_than_ageing(begins: int, to: float) -> None:
    tracker, state, rng = copy.deepcopy(learned(begins))
    for k in range(begins, begins + 600):
        drift = to * np.clip((k - begins) / 400, 0, 1)
        state = tracker.update(state, gained(rng, np.array([drift, 0, 0, 0, 0, 0])), EPOCH + k * SECOND)
        state = TrackerState.from_dict(state.to_dict()) if k % 100 == 0 else state
    assert all(a.kind == "sensor" for a in state.alarms)
    assert [a.parameter for a in state.active] == ([] if to < TRACKING_RULES.jumps.gain_drift else ["c0.gain"])
    for alarm in state.active:
        assert alarm.change is not None and alarm.std is not None
        assert abs(alarm.change - to) < 3 * alarm.std < 0.02
        assert alarm.opened > EPOCH + begins * SECOND
    assert all(f.channel == "c0" and abs(f.value - 1 - to) < 3 * f.std for f in tracker.sensors(state))


def test_gains_and_clocks_that_were_always_off_are_reported_and_no_alarm() -> None:
    rng, tracker = np.random.default_rng(7), make(GAINS)
    state = tracker.initial_state()
    for k in range(200):
        state = tracker.update(state, gained(rng, np.array([0, 0.05, 0, 0, 0, 0])), EPOCH + k * SECOND)
    assert state.alarms == ()
    assert [f.channel for f in tracker.sensors(state)] == ["c1"]


def test_an_alarm_of_a_drift_closes_when_the_sensor_is_repaired() -> None:
    rng, tracker = np.random.default_rng(8), make(GAINS)
    state = tracker.initial_state()
    for k in range(900):
        drift = 0.06 * np.clip((k - 60) / 300, 0, 1) * (k < 500)
        state = tracker.update(state, gained(rng, np.array([0, 0, drift, 0, 0, 0])), EPOCH + k * SECOND)
    assert next(a.parameter for a in state.alarms if a.kind == "sensor") == "c2.gain"
    assert state.active == ()


def test_a_jump_of_two_deviations_of_a_window_is_named() -> None:
    rng, tracker = np.random.default_rng(9), make(GAINS)
    state = tracker.initial_state()
    for k in range(140):
        jumped = np.array([0, 0, 0, 0.02 * (k >= 100), 0, 0])
        state = tracker.update(state, gained(rng, jumped, information=0.008**-2), EPOCH + k * SECOND)
    (fault,) = tracker.sensors(state)
    assert (fault.channel, fault.kind) == ("c3", "gain")
    assert abs(fault.value - 1.02) < 3 * fault.std < 0.02
    assert [(a.kind, a.parameter) for a in state.alarms] == [("sensor", "c3.gain")]


def test_a_jump_that_is_found_late_takes_back_the_alarm_that_waited_for_it() -> None:
    """The gain jumps between two weighed windows: the parameter seems to change before the first that says why."""
    tracker, state, rng = copy.deepcopy(learned(60))
    waited = False
    for k in range(60, 110):
        window = gained(rng, np.array([0.06 * (k >= 61), 0, 0, 0, 0, 0]), information=0.012**-2)
        window = window if k % 3 == 0 else replace(window, deviating=None)
        state = tracker.update(state, window, EPOCH + k * SECOND)
        waited |= bool(state.changes.active[0]) and not state.alarms
    assert waited
    assert [(a.kind, a.parameter) for a in state.alarms] == [("sensor", "c0.gain")]
    assert not state.changes.active.any()


def test_one_window_that_shows_the_other_way_does_not_end_the_evidence_for_a_jump() -> None:
    rng, tracker = np.random.default_rng(11), make(GAINS)
    state = tracker.initial_state()
    for k in range(40):
        state = tracker.update(state, gained(rng, np.zeros(6)), EPOCH + k * SECOND)
    record = replace(state.calibration, slope=np.full(6, 3e4), curvature=np.full(6, 1e8))  # 3 deviations
    along, information = np.full(6, -1e3), np.full(6, 1e7)
    after, jump = jumps.tested_for_jumps(record, tracker.model, along, information, 1.0, EPOCH)
    assert jump is None
    np.testing.assert_allclose(after.slope, TRACKING_RULES.jumps.forgetting * 3e4 - 1e3)
    turned, _ = jumps.tested_for_jumps(record, tracker.model, np.full(6, -3e4), 10 * information, 1.0, EPOCH)
    np.testing.assert_allclose(turned.slope, -3e4)  # begins anew


def test_chance_names_no_sensor() -> None:
    rng, tracker = np.random.default_rng(10), make(GAINS)
    state = tracker.initial_state()
    named = 0
    for k in range(1000):
        state = tracker.update(state, gained(rng, np.zeros(6), information=0.02**-2), EPOCH + k * SECOND)
        named += bool(tracker.sensors(state)) and k > 30
    assert named == 0
    assert state.alarms == ()


@pytest.mark.parametrize(("kinds", "rivals"), [(("stiffness", "damping"), ("bogie.mass",)), (("damping",), ())])
def test_a_body_that_is_heavier_is_named_with_the_springs_and_dampers_at_it(
    kinds: tuple[str, ...], rivals: tuple[str, ...]
) -> None:
    """Ice on a bogie makes all its springs and dampers seem softer; old oil its dampers only."""
    rng = np.random.default_rng(9)
    names = [f"e{i}.{kind}" for kind in ("stiffness", "damping") for i in range(6)]
    tracker = Tracker([TrackedParameter(n) for n in names], masses={"bogie": ("e0", "e1", "e2", "e3")})
    covariance = correlated(rng, np.full(12, 0.01))
    off = np.array([-0.08 * (n[1] in "0123" and n.rpartition(".")[2] in kinds) for n in names])
    state = tracker.initial_state()
    for k in range(100):
        value = np.linalg.cholesky(covariance) @ rng.normal(size=12) + off * (k >= 40)
        state = tracker.update(state, estimate(value, covariance), EPOCH + k * SECOND)
    assert {a.parameter for a in state.alarms} == {n for n, o in zip(names, off, strict=True) if o}
    assert all(a.alternatives == rivals for a in state.alarms)


def test_the_baseline_keeps_its_gains_and_delays_while_a_jump_may_still_be_shared_out_among_channels() -> None:
    """A channel that takes part of another's jump before its own is found would else keep that part as its normal."""
    tracker, state, rng = copy.deepcopy(learned(60))
    wrong = np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0])
    before, rested = state, []
    for k in range(60, 100):
        before, state = state, tracker.update(state, gained(rng, wrong), EPOCH + k * SECOND)
        opened = [a.opened for a in state.alarms if a.kind == "sensor"]
        if opened:
            rested.append((k * SECOND + EPOCH - opened[0], np.array_equal(*_references(before, state))))
    assert [a.parameter for a in state.alarms] == ["c1.gain"]
    assert all(rests for since, rests in rested if since < 19 * SECOND)
    assert not any(rests for since, rests in rested if since > 25 * SECOND)


def _references(before: TrackerState, after: TrackerState) -> tuple[FloatArray, FloatArray]:
    return before.calibration.reference, after.calibration.reference


def test_identification_is_told_all_gains_or_none_and_all_delays_or_none() -> None:
    tracker = make([Deviation(f"c{i}", "gain", 0.015, i) for i in range(4)] + DELAYS)
    state = tracker.initial_state()
    assert tracker.known_faults(state) == ()
    mean = state.belief.mean.copy()
    mean[-8:] = [0.02, 0.001, -0.002, 0.0, 1e-4, 0.0, 2e-4, 0.0]
    calibration = replace(state.calibration, recent=np.full(3, EPOCH))
    state = replace(state, belief=replace(state.belief, mean=mean), calibration=calibration)
    known = tracker.known_faults(state)
    assert [(f.channel, f.kind) for f in known] == [(f"c{i}", "gain") for i in range(4)]
    assert known[0].value == pytest.approx(1.0195)  # relative to the median of all
    stuck = replace(state, stuck=(Stuck("c1", "frozen", 0.0, 6, EPOCH),))
    assert [f.kind for f in tracker.known_faults(stuck)] == ["frozen", *["gain"] * 4]
    exchanged = replace(state, stuck=(Stuck("c0|c1", "swapped", 0.0, 6, EPOCH),))
    assert [f.kind for f in tracker.known_faults(exchanged)] == ["swapped"]


def _stated(
    rng: np.random.Generator, begins: int, to: float, over: int, channels: int = 6
) -> tuple[list[float], list[float]]:
    """Errors over stated deviations, every ten windows, of the alarms and of the reports of one drifting gain.

    The gain of one channel drifts to 1 + `to` within `over` windows after `begins` windows.  What alarms state is the
    change since the baseline, what is reported the value now, both relative to the median of the other channels.
    """
    tracker = make([Deviation(f"c{i}", "gain", 0.015, i) for i in range(channels)])
    state, apart = tracker.initial_state(), np.eye(channels) - 1 / channels
    cross = np.zeros((6, channels))
    cross[0, 0] = 1.0
    changes, values = [], []
    for k in range(begins + over + 200):
        gains = np.zeros(channels)
        gains[0] = to * np.clip((k + 1 - begins) / max(over, 1), 0, 1)
        M, covariance = apart / 0.01**2, correlated(rng, STD)
        score = M @ gains + apart @ rng.normal(size=channels) / 0.01
        value = np.linalg.cholesky(covariance) @ rng.normal(size=6) - cross @ gains
        found = Deviating(np.zeros(channels), covariance, cross, M, score, 300.0, True)
        state = tracker.update(state, estimate(value, covariance, deviating=found), EPOCH + k * SECOND)
        if k % 10 == 0:
            changes += [(a.change - gains[0]) / a.std for a in state.active if a.change is not None and a.std]
            values += [(f.value - 1 - gains[int(f.channel[1:])]) / f.std for f in tracker.sensors(state)]
    assert [(a.kind, a.parameter, a.closed) for a in state.alarms] == [("sensor", "c0.gain", None)]
    return changes, values


@pytest.mark.parametrize(
    ("begins", "to", "over", "channels"),
    [
        pytest.param(400, 0.06, 400, 6, marks=pytest.mark.slow),
        (60, 0.06, 400, 6),  # while the gains of the baseline are being determined
        pytest.param(60, 0.05, 0, 6, marks=pytest.mark.slow),
        pytest.param(400, 0.05, 0, 3, marks=pytest.mark.slow),
        pytest.param(900, 0.06, 400, 6, marks=pytest.mark.slow),
        pytest.param(900, -0.06, 1500, 6, marks=pytest.mark.slow),
        pytest.param(60, 0.06, 1500, 6, marks=pytest.mark.slow),
        pytest.param(900, 0.05, 0, 16, marks=pytest.mark.slow),
        pytest.param(900, 0.06, 400, 16, marks=pytest.mark.slow),
    ],
)
def test_what_is_stated_of_a_gain_is_as_wrong_as_it_says(begins: int, to: float, over: int, channels: int) -> None:
    """A gain that drifts faster than electronics age is followed late, and its baseline may have followed it."""
    both = [_stated(np.random.default_rng(seed), begins, to, over, channels) for seed in (41, 42)]
    for errors in (np.concatenate([one[part] for one in both]) for part in (0, 1)):
        assert len(errors) > 20
        assert np.mean(np.abs(errors) < 3) > 0.95
        assert 0.3 < np.sqrt(np.mean(errors**2)) < 1.6
        assert np.abs(errors[-5:]).max() < 3


def test_a_gain_that_is_found_beyond_its_prior_in_the_first_windows_belongs_to_the_baseline() -> None:
    rng, tracker = np.random.default_rng(12), make(GAINS)
    gains, state = np.array([0.1, 0, 0, 0, 0, 0]), tracker.initial_state()
    for k in range(120):
        window = gained(rng, gains, information=0.002**-2)
        if k == 0:  # found by identification, and not believed yet
            window = replace(window, faults=(MeasurementFault("c0", "gain", 1.1),))
        state = tracker.update(state, window, EPOCH + k * SECOND)
    reference = state.calibration.reference
    assert reference[0] - np.median(reference) == pytest.approx(0.1, abs=0.005)
    assert not state.changes.active.any()
    assert not [a for a in state.alarms if a.kind != "sensor"]


def test_one_window_that_lies_far_off_is_no_drift() -> None:
    rng, tracker, stds = np.random.default_rng(13), make(GAINS), []
    for odd in (0.0, 0.045):  # one of two vehicles has an odd window among its first
        state = tracker.initial_state()
        for k in range(8):
            state = tracker.update(state, gained(rng, np.array([odd * (k == 3), 0, 0, 0, 0, 0])), EPOCH + k * SECOND)
        stds.append(tracker.model.relative_std(state.belief.covariance[-6:, -6:])[0])
    assert stds[1] == pytest.approx(stds[0], rel=0.01)
