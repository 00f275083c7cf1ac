"""What one window does to a belief: windows that are skew, and windows that do not say what a sensor makes of them."""

import numpy as np

from sprung.model.identification.measurements.deviations import Deviation
from sprung.model.signals import Deviating, FloatArray
from sprung.model.tracking import filter as kalman
from sprung.model.tracking.tracker import Tracker, TrackerSettings
from tests.tracker_windows import EPOCH, TrackedParameter, estimate

SECOND = 1_000_000_000


def test_weak_windows_of_a_damper_do_not_make_it_seem_larger() -> None:
    rng = np.random.default_rng(1)
    tracker = Tracker([TrackedParameter("element.damping")])
    scores = []
    for truth in (-0.1, 0.0, 0.15):
        state = tracker.initial_state()
        for k in range(300):
            seen = max(np.exp(truth) * (1 + 0.15 * rng.normal()), 0.4)  # in N s/m a window errs by the same either way
            std = 0.15 * np.exp(truth) / seen
            state = tracker.update(state, estimate(np.log([seen]), np.array([[std**2]])), EPOCH + k * SECOND)
        mean, std = tracker.posterior(state)
        scores.append((mean - truth) / std)
    assert np.abs(scores).max() < 3
    assert np.mean(scores) < 1.2  # weighed as they state it, all three are 2 to 4 deviations too large


def test_windows_of_a_slow_train_err_alike_and_are_not_averaged_away() -> None:
    rng = np.random.default_rng(3)
    parts = [Deviation("car", "load", 0.15, -1)]
    tracker = Tracker([TrackedParameter("element.stiffness")], None, parts)
    state, std, carried = tracker.initial_state(), 0.06, 0.04
    for k in range(300):
        error, load_error = rng.normal(
            -0.45, 1.0, 2
        )  # of its deviations: what noise in the inputs makes of each window
        given, information = np.array([[std**2]]), np.array([[carried**-2.0]])
        found = Deviating(np.zeros(1), given, np.zeros((1, 1)), information, np.array([load_error / carried]), 300.0)
        window = estimate(np.array([error * std]), given, deviating=found, noise=0.15)
        state = tracker.update(state, window, EPOCH + k * SECOND)
    mean, deviation = tracker.posterior(state)
    (load, load_deviation), *_ = tracker.loads(state).values()
    assert state.used == 300
    assert abs(mean[0]) < 2 * deviation[0] < 0.12  # counted in full, eight
    assert abs(load) < 2 * load_deviation


def test_a_window_that_was_not_weighed_does_not_speak_of_what_moves_it() -> None:
    """A window that tells much is moved less by a gain than one that tells little; their mean is that of neither."""
    rng = np.random.default_rng(2)
    gains = [Deviation(f"c{i}", "gain", 0.015, i) for i in range(3)]
    tracker = Tracker([TrackedParameter("element.stiffness")], None, gains)
    state, off = tracker.initial_state(), np.array([0.04, 0.0, 0.0])
    apart = np.eye(3) - 1 / 3
    information = 0.02**-2 * apart
    for k in range(240):
        std, moved = ((0.01, 0.3), (0.04, 2.0))[k % 2]
        cross = np.array([[moved, 0.0, 0.0]])
        value, covariance = std * rng.normal(size=1) - cross @ off, np.array([[std**2]])
        score = information @ off + apart @ rng.normal(size=3) / 0.02
        found = Deviating(np.zeros(3), covariance, cross, information, score, 300.0, True)
        weighed = rng.random() < 0.5
        state = tracker.update(
            state, estimate(value, covariance, deviating=found if weighed else None), EPOCH + k * SECOND
        )
    mean, deviation = tracker.posterior(state)
    assert abs(mean[0]) < 3 * deviation[0]
    assert deviation[0] < 0.015
    (fault,) = tracker.sensors(state)
    assert fault.channel == "c0"


def test_a_window_without_evidence_on_gains_determines_no_load_that_a_wrong_gain_has_moved() -> None:
    rng = np.random.default_rng(4)
    known = [*(Deviation(f"c{i}", "gain", 0.015, i) for i in range(3)), Deviation("car", "load", 0.15, -1)]
    tracker = Tracker([TrackedParameter("element.stiffness")], None, known)
    state, off, carried = tracker.initial_state(), np.array([0.04, -0.02, -0.02]), 0.1
    apart = np.pad(np.eye(3) - 1 / 3, (0, 1)) / 0.02**2
    seen = np.array([-1.0, 0.0, 0.0, 1.0]) / 0.02  # the gain makes the load seem smaller by as much
    cross = np.array([[0.3, 0.0, 0.0, 0.0]])
    for k in range(120):
        load = carried - off[0] + 0.02 * rng.normal()
        value, covariance = 0.01 * rng.normal(size=1) - cross[:, :3] @ off, np.array([[0.01**2]])
        weighed = rng.random() < 0.5
        information = apart + np.outer(seen, seen) if weighed else np.diag([0.0, 0.0, 0.0, 0.02**-2])
        score = apart @ np.append(off, 0.0) + np.append(rng.normal(size=3), 0.0) / 0.02 if weighed else np.zeros(4)
        found = Deviating(np.array([0, 0, 0, load]), covariance, cross, information, score, 300.0, weighed)
        state = tracker.update(state, estimate(value, covariance, deviating=found), EPOCH + k * SECOND)
    value, std = tracker.loads(state)["car"]
    assert abs(value - carried) < 3 * std < 0.06
    mean, deviation = tracker.posterior(state)
    assert abs(mean[0]) < 3 * deviation[0]


def test_considered_deviations_keep_their_belief_and_the_errors_are_as_stated() -> None:
    rng = np.random.default_rng(3)
    factor = rng.normal(size=(5, 5))
    covariance, cross, noise = factor @ factor.T + np.eye(5), np.array([[1.0], [-0.5]]), np.diag([0.5, 0.8])
    belief = kalman.Belief(np.zeros(5), covariance, 1)  # two levels, their rates, one deviation
    truth = rng.multivariate_normal(np.zeros(5), covariance, 20_000)
    values = truth[:, :2] - truth[:, 4:] @ cross.T + rng.normal(size=(20_000, 2)) @ np.sqrt(noise)
    everything = np.ones(2, dtype=bool)
    considered = np.ones(1, dtype=bool)

    def corrected(value: FloatArray) -> kalman.Belief:
        return kalman.correct(
            belief, value, noise, everything, share=1.0, bound=1e9, cross=cross, considered=considered
        )[0]

    after = corrected(values[0])
    assert after.mean[4] == 0.0
    assert after.covariance[4, 4] == covariance[4, 4]
    gain = np.stack([corrected(unit).mean for unit in np.eye(2)], axis=1)  # linear in the value
    errors = values @ gain.T - truth
    np.testing.assert_allclose(np.cov(errors.T), after.covariance, atol=0.04 * np.abs(covariance).max())


def test_what_clocks_move_is_no_contradiction_between_windows() -> None:
    """Clocks wander between rides by more than one ride tells of them, and move each ride's value by another amount."""
    rng = np.random.default_rng(5)
    clocks = [Deviation(f"c{i}", "delay", 0.002, i, i) for i in range(2)]
    tracker = Tracker(
        [TrackedParameter("element.stiffness")], TrackerSettings(window=60.0, hop=60.0, learning=600.0), clocks
    )
    state, late, std, seen = tracker.initial_state(), np.array([0.003, -0.003]), 0.002, 6e-5
    for k in range(300):
        late = late + 2e-5 * np.sqrt(300.0) * rng.normal(size=2)
        cross = 60.0 * np.array([[1.0, -1.0]]) * rng.uniform(0.8, 1.2, 2)
        value = std * rng.normal(size=1) - cross @ late
        information = np.eye(2) / seen**2
        score = information @ late + rng.normal(size=2) / seen
        found = Deviating(np.zeros(2), np.array([[std**2]]), cross, information, score, 300.0, True)
        told = estimate(value, np.array([[std**2]]), deviating=found)
        state = tracker.update(state, told, EPOCH + 300 * k * SECOND)
    assert state.inflation.factor[0] < 1.6
    assert not [alarm for alarm in state.alarms if alarm.kind != "sensor"]
