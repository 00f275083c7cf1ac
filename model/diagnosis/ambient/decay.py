"""Detection of free decays in recordings without inputs: they are simulated from their first sample."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from sprung.model.diagnosis.record.signals import Signals
from sprung.model.diagnosis.record.white_noise import roughness
from sprung.model.diagnosis.rules import RULES, AmbientRules, Rules
from sprung.model.signals import FloatArray


def decay_stretch(signals: Signals, noise: FloatArray, all_rules: Rules = RULES) -> slice | None:
    """The stretch in which the sensors decay; None if they do not.  noise: of one sample, (S,).

    Standstill at the end is excluded: it is uninformative, also as a held-out part.
    """
    rules = all_rules.ambient
    begin = _begin(signals, noise, rules)
    if begin is None:
        return None
    level = np.maximum(noise, roughness(signals.sensors, all_rules.white_noise))
    rest = np.median(signals.sensors[-signals.samples // rules.spans :], axis=0)
    moved = (signals.sensors[begin:] - rest) / level
    edges = np.linspace(0, len(moved), rules.spans + 1).astype(int)
    loud = [np.sqrt(np.mean(moved[a:b] ** 2, axis=0)).max() > rules.loud for a, b in pairwise(edges) if b > a]
    last = int(edges[int(np.flatnonzero(loud)[-1]) + 1]) if any(loud) else len(moved)
    end = begin + int(rules.beyond * last)
    return slice(begin, None if end - begin < all_rules.record.minimum_samples else min(end, signals.samples))


def _begin(signals: Signals, noise: FloatArray, rules: AmbientRules) -> int | None:
    edges = np.linspace(0, signals.samples, rules.blocks + 1).astype(int)
    moved = signals.sensors - np.median(signals.sensors, axis=0)
    blocks = [moved[a:b] for a, b in pairwise(edges)]
    level = np.array([np.sqrt(np.mean(np.mean((block / noise) ** 2, axis=0))) for block in blocks])
    first = int(np.argmax(level))
    falling = np.maximum(level[first:], rules.over_noise)
    if edges[first] > (1 - rules.least) * signals.samples or falling[-1] > rules.fallen * falling[0]:
        return None
    if np.any(falling[1:] > rules.rise * falling[:-1]):
        return None
    if first == 0:
        return 0
    size = np.abs(moved[edges[first - 1] : edges[first + 1]] / noise).max(axis=1)
    return int(edges[first - 1] + np.argmax(size))
