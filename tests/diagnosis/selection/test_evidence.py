"""The deciding arithmetic, on its own."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from sprung.model.diagnosis.selection.evidence import (
    bic,
    block_edges,
    bounded_gain,
    chance,
    chance_on_whole,
    effective_count,
    level_gain,
    monotone_gains,
    occam_cost,
    process_gain,
    profile_gain,
    unusual_cost,
)


def packed(bins: int, sensors: int, level: np.ndarray, seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    return (random.standard_normal((2, bins, sensors)) * level[None, :, None]).ravel()


@pytest.mark.parametrize("bins", [1, 5, 23, 24, 25, 60, 1000])
def test_blocks_cover_short_records_too(bins: int) -> None:
    edges = block_edges(bins)
    assert edges[0] == 0
    assert np.all(np.diff(edges) > 0)
    assert edges[-1] < bins
    r = packed(bins, 2, np.ones(bins))
    assert profile_gain(r, r, 2, quiet=0.5) == 0.0


def test_the_gain_of_a_small_effect_in_white_noise_is_the_fall_of_chi_square() -> None:
    bins = 4000
    after = packed(bins, 3, np.ones(bins))
    before = after + 0.1 * packed(bins, 3, np.ones(bins), seed=1)
    fall = float(before @ before - after @ after)
    assert profile_gain(before, after, 3, quiet=0.5) == pytest.approx(fall, rel=0.05)


def test_a_threefold_fall_of_chi_square_in_few_bins_is_never_evidence_against() -> None:
    bins = 2000
    before, after = np.ones((2, bins, 1)), np.full((2, bins, 1), 1.2)  # a law that makes every other bin louder
    before[:, 5], after[:, 5] = 120.0, 60.0
    assert float(before.ravel() @ before.ravel()) > 2.5 * float(after.ravel() @ after.ravel())
    assert profile_gain(before, after, 1, quiet=0.5) > 0
    assert profile_gain(after, before, 1, quiet=0.5) < 0


def test_gain_is_antisymmetric_so_that_a_better_fit_cannot_lose_to_a_worse_one() -> None:
    random = np.random.default_rng(2)
    for _ in range(50):
        logs, falls = random.standard_normal(10), None
        falls = np.sign(logs) * random.exponential(5.0, 10)
        assert bounded_gain(logs, falls) == pytest.approx(-bounded_gain(-logs, -falls))
        assert np.sign(bounded_gain(logs, falls)) in (0, np.sign(np.sum(falls)))


def test_a_sharper_noise_level_and_its_determinant_count_together() -> None:
    """Half the noise of a force: residuals of the same size, and a determinant lower by count log 4."""
    bins = 1500
    before, after = (packed(bins, 1, np.ones(bins), seed=seed) for seed in (5, 6))
    fall = 2 * bins * np.log(4)
    louder = packed(bins, 1, np.where(np.arange(bins) < 40, 3.0, 1.0), seed=6)  # some blocks look louder by it
    assert process_gain(before, after, 1, (0.0, -fall)) == pytest.approx(fall, rel=0.1)
    lost = process_gain(before, after, 1, (0.0, -fall)) - process_gain(before, louder, 1, (0.0, -fall))
    assert lost == pytest.approx(2 * 40 * np.log(9), rel=0.2)


def test_a_parameter_costs_its_information_in_the_recording() -> None:
    assert occam_cost([True], [1.0], np.array([[100.0]])) == pytest.approx(0.0, abs=0.1)
    costs = [occam_cost([False], [2.0], np.array([[sigma**2]])) for sigma in (1e-3, 1e-2)]
    assert costs[0] - costs[1] == pytest.approx(2 * np.log(10), rel=1e-3)
    assert occam_cost([False, True], [2.0, 1.0], np.diag([0.0, 1e6])) == pytest.approx(0.0, abs=1e-3)
    assert unusual_cost(1.0, (0.1, 10.0)) == 0.0
    assert unusual_cost(np.e * 10, (0.1, 10.0)) == pytest.approx(4.0)


@pytest.mark.parametrize("unknown", [10.0, 1e4])
def test_two_numbers_of_which_only_the_product_is_identifiable_cost_as_much_as_one(unknown: float) -> None:
    """Stiffness and yield displacement of a friction that hardly gives way: their product is its force."""
    told, either = np.array([1.0, 1.0]) / np.sqrt(2), np.array([1.0, -1.0]) / np.sqrt(2)
    covariance = 0.01**2 * np.outer(told, told) + unknown**2 * np.outer(either, either)
    one = occam_cost([True], [1.0], np.array([[0.01**2]]))
    assert occam_cost([True, True], [1.0, 1.0], covariance) == pytest.approx(one, abs=0.1)


def test_chance_is_uniform_for_noise() -> None:
    random = np.random.default_rng(3)
    values = [chance(float(x), 2, 1) for x in random.chisquare(2, 4000)]
    assert np.mean(np.array(values) < 0.1) == pytest.approx(0.1, abs=0.02)
    assert chance(-5.0, 1, 100) == 1.0


@pytest.mark.slow
def test_the_whole_recording_settles_what_its_fitted_part_does_not() -> None:
    """One amplitude, estimated on 0.7 of a recording, then predicts the rest; true: 0 or 3.4 deviations."""
    alpha, draws, share = 0.003, 40_000, np.array([0.7, 0.3])
    random = np.random.default_rng(5)
    found = {}
    for snr in (0.0, 3.4):
        product = snr * share + np.sqrt(share) * random.standard_normal((draws, 2))  # column with residual
        estimate = product[:, 0] / share[0]
        gain = estimate**2 * share[0]
        rest = 2 * estimate * product[:, 1] - estimate**2 * share[1]
        on_part = np.array([chance(float(one), 1, 1) for one in gain])
        on_whole = np.array(
            [
                chance_on_whole([(float(g), 1)], 1, alpha, 1 / share[0], partial(float, r))
                for g, r in zip(gain, rest, strict=True)
            ]
        )
        found[snr] = float(np.mean(on_part <= alpha)), float(np.mean(on_whole <= alpha))
    assert found[0.0][0] == pytest.approx(alpha, rel=0.25)
    assert found[0.0][1] < 2 * alpha  # two chances to exceed the threshold, of which the second is seldom taken
    assert found[3.4][1] > found[3.4][0] + 0.1


def test_the_rest_is_asked_only_where_it_could_matter() -> None:
    def unasked() -> float:
        raise AssertionError("asked")

    assert chance_on_whole([(30.0, 1)], 10, 1e-3, 1.4, unasked) < 1e-6
    assert chance_on_whole([(5.0, 1)], 10, 1e-3, 1.4, unasked) > 0.1
    assert chance_on_whole([(20.0, 1)], 100, 1e-3, 1.0, lambda: 20.0) == pytest.approx(chance(20.0, 1, 100))
    assert chance_on_whole([(17.0, 1)], 100, 1e-3, 1.4, lambda: 8.0) == pytest.approx(chance(25.0, 1, 100))


def test_what_repeats_itself_counts_once() -> None:
    t = np.arange(4000)
    noise = np.random.default_rng(4).standard_normal(4000)
    assert effective_count(noise) > 3000
    assert effective_count(np.sin(2 * np.pi * t / 100)) == pytest.approx(4, rel=0.1)
    assert level_gain(2.0, 1.0, 10) == pytest.approx(10 * np.log(2))
    assert bic(50.0, 3, 100) == pytest.approx(-50 + 3 * np.log(100))


def test_a_plainly_better_fit_does_not_lose_to_a_worse_one() -> None:
    # gains and chi-squares of three rivals as a sine test on a magneto-rheological damper gave them
    assert monotone_gains([312.0, 351.0, 290.0], [23.1, 41.8, 24.0]) == [312.0, 290.0, 290.0]
    assert monotone_gains([40.0, 44.0], [1000.0, 1010.0]) == [40.0, 44.0]
