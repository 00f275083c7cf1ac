"""Recordings sampled far faster than anything moves are diagnosed at a fraction of their rate."""

from __future__ import annotations

import numpy as np
from scipy.signal import butter, sosfiltfilt

from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise
from sprung.model.diagnosis.record.slower import slower, slower_by
from sprung.model.diagnosis.rules import RULES
from sprung.model.system import parse_system

RIG = """name: slide
sample_rate: 1000
window: 1000
bodies: {slide: {mass: 95.0}}
inputs: {motor: {kind: force, body: slide, csv: force}}
elements: {guide: {upper: slide, lower: ground, stiffness: {value: 0.0, fixed: true}, damping: 400.0}}
sensors: {encoder: {kind: displacement, body: slide, csv: x, noise: 1.0e-6}}
estimate: [damping, mass]
"""
RATE = 1000.0


def slide(fastest: float, seconds: float = 20.0) -> np.ndarray:
    """Columns force and position, which moves up to a frequency."""
    random = np.random.default_rng(3)
    white = random.standard_normal((int(seconds * RATE), 2))
    moved = sosfiltfilt(butter(6, [0.3, fastest], "bandpass", fs=RATE, output="sos"), white, axis=0)
    moved[:, 1] = np.cumsum(moved[:, 1]) / RATE + 1e-6 * random.standard_normal(len(moved))
    return np.asarray(moved)


def test_what_is_slow_is_diagnosed_at_a_fraction_of_its_rate() -> None:
    system = parse_system(RIG)
    prepared = prepare(system, slide(15.0), RATE)
    assert prepared.signals.sample_rate == RATE / 3 and prepared.signals.samples < RULES.record.enough
    assert any("Hz instead of 1000 Hz" in note for note in prepared.notes)
    noise = declared_noise(system, prepared.signals)
    assert np.isclose(noise.sensors[0], 1e-6 / np.sqrt(3))


def test_what_moves_fast_keeps_its_rate() -> None:
    assert slower_by(parse_system(RIG), slide(250.0), RATE, RULES.record) == 1


def test_a_short_recording_keeps_its_rate() -> None:
    assert slower_by(parse_system(RIG), slide(15.0, 7.0), RATE, RULES.record) == 1


def test_what_passes_is_left_as_it_was_at_its_own_times() -> None:
    time = np.arange(4000) / RATE
    tones = np.column_stack([np.sin(2 * np.pi * 20 * time + 0.3), np.full(4000, np.nan)])
    reduced, first = slower(tones, 4)
    at = first + 4 * np.arange(len(reduced))
    assert np.abs(reduced[:, 0] - tones[at, 0]).max() < 2e-4 and np.isnan(reduced[:, 1]).all()
    gone, _ = slower(np.sin(2 * np.pi * 180 * time)[:, None], 4)
    assert np.abs(gone).max() < 2e-4
