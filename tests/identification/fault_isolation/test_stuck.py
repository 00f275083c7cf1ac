"""Channels whose own samples show that they are stuck, noisy or silent, as put into samples of a running vehicle."""

import numpy as np
import pytest

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.fault_isolation.stuck import StuckChannels
from sprung.model.signals import FloatArray
from sprung.model.system import System, load_system


@pytest.fixture(scope="module")
def system() -> System:
    return load_system()


@pytest.fixture(scope="module")
def stuck(system: System) -> StuckChannels:
    return StuckChannels(system)


@pytest.fixture
def window(system: System) -> FloatArray:
    """Samples of a running vehicle, with the noise of the file."""
    return np.array(simulate_runs(system, np.zeros((1, 24)), system.window, np.random.default_rng(3)).values[0])


def names(system: System) -> list[str]:
    return [channel.name for channel in system.channels]


def test_nothing_is_wrong_with_a_running_vehicle(stuck: StuckChannels, window: FloatArray) -> None:
    assert stuck.channels(window) == stuck.noisy(window) == stuck.silent(window) == stuck.all_inputs(window) == ()


def test_a_channel_that_repeats_a_value_is_frozen_at_it(
    system: System, stuck: StuckChannels, window: FloatArray
) -> None:
    window[:, 20] = 0.7
    (fault,) = stuck.channels(window)
    assert (fault.channel, fault.kind, fault.value) == (names(system)[20], "frozen", 0.7)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_channel_cut_off_at_an_end_of_its_range_is_saturated_there(
    stuck: StuckChannels, window: FloatArray, sign: float
) -> None:
    end = float(np.quantile(sign * window[:, 20], 0.9))
    window[:, 20] = sign * np.minimum(sign * window[:, 20], end)
    (fault,) = stuck.channels(window)
    assert (fault.kind, fault.value) == ("saturated", sign * end)


def test_only_a_channel_noisier_than_the_others_of_its_unit_is_noisy(
    system: System, stuck: StuckChannels, window: FloatArray
) -> None:
    rng, levels = np.random.default_rng(4), np.array([channel.noise for channel in system.channels])
    alike = [c for c, channel in enumerate(system.channels) if channel.unit == system.channels[20].unit]
    one, all_of_them = window.copy(), window.copy()
    one[:, 20] += rng.normal(0, 8 * levels[20], len(window))
    (fault,) = stuck.noisy(one)
    assert (fault.channel, fault.kind) == (names(system)[20], "noisy")
    assert fault.value == pytest.approx(8 * levels[20], rel=0.4)
    all_of_them[:, alike] += rng.normal(0, 8 * levels[alike], (len(window), len(alike)))
    assert stuck.noisy(all_of_them) == ()  # the vehicle shakes


def test_a_channel_without_samples_is_silent_and_not_frozen(
    system: System, stuck: StuckChannels, window: FloatArray
) -> None:
    window[:, 21] = np.nan
    assert [(fault.channel, fault.kind) for fault in stuck.silent(window)] == [(names(system)[21], "silent")]
    assert stuck.channels(window) == ()


def test_inputs_that_are_all_flat_are_one_fault_of_a_running_vehicle_and_none_of_a_standing_one(
    system: System, stuck: StuckChannels, window: FloatArray
) -> None:
    inputs = len(system.inputs)
    window[:, :inputs] = window[0, :inputs]
    (fault,) = stuck.all_inputs(window)
    assert fault.channel == "|".join(names(system)[:inputs]) and fault.kind == "frozen"
    noise = np.array([channel.noise for channel in system.channels[inputs:]])
    window[:, inputs:] = np.random.default_rng(5).normal(0, noise, window[:, inputs:].shape)
    assert stuck.all_inputs(window) == ()
