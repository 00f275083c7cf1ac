"""Constants of the deviations of one vehicle: prior, random walk, directions of jumps, thresholds.

H deviations (gains, delays, loads, body constants; `identification.measurements.deviations`), V directions in which a
jump is tested: each deviation alone, and what several channels may have in common.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sprung.model.identification.measurements.deviations import CARGO, OWN, Deviation, shared_directions
from sprung.model.signals import BoolArray, FloatArray, IntArray
from sprung.model.tracking.median import median
from sprung.model.tracking.rules import TRACKING_RULES, JumpRules

GROUP_SHARE = 0.97  # of a delay's variance, common to the channels of one clock
GAIN_WALK = 1e-4  # per sqrt(s): 0.6 % in an hour, 2 % in a working day
CLOCK_WALK = 2e-5  # s per sqrt(s), of a node's clock; 1.2 ms in an hour
# Per sqrt(s), of a running vehicle: in two minutes 1 % of the mass and 0.3 % of its moments of inertia; a passenger who
# walks 10 m along the car, or from one side to the other, is 1e-3.
CARGO_WALK = {"load": 1e-3, "roll_inertia": 3e-4, "pitch_inertia": 3e-4, "centre": 1e-4, "side": 1e-4}
OWN_WALK = 1e-6  # s per sqrt(s), of one channel against its node
PUT_RIGHT = {"gain": 0.005, "delay": 8e-4}  # from which it is taken back from samples; a delay costs their ends


@dataclass(frozen=True, eq=False)
class DeviationModel:
    """Prior and random walk of the deviations, and the directions in which jumps are tested."""

    kinds: tuple[str, ...]
    prior: FloatArray  # covariance, shape (H, H)
    walk: FloatArray  # covariance per second, shape (H, H)
    directions: FloatArray  # shape (V, H)
    loads: BoolArray  # True at the masses of loads, shape (H,)
    cargo: BoolArray  # True at everything that describes loads, their masses included, shape (H,)
    constant: BoolArray  # True at constants of bodies (inertia over mass, distances), which never change, shape (H,)
    rules: JumpRules = TRACKING_RULES.jumps

    @property
    def size(self) -> int:
        return len(self.kinds)

    @cached_property
    def prior_information(self) -> FloatArray:
        """Inverse of the prior covariance, (H, H)."""
        return np.asarray(np.linalg.inv(self.prior), dtype=np.float64).reshape(self.size, self.size)

    @cached_property
    def of_channels(self) -> IntArray:
        """Indices of gains and delays."""
        return np.flatnonzero(np.isfinite(self.drift_limit))

    def kind_along(self, direction: FloatArray) -> str:
        """Kind of the deviations that change along a direction (H,); one direction has one kind."""
        return self.kinds[int(np.argmax(direction != 0))]

    def common_value(self, values: FloatArray, among: BoolArray | None = None) -> FloatArray:
        """The median of the gains, and of the delays, (H,): a value common to all channels is not identifiable.

        among: the deviations (H,) that the median is taken of, all by default.
        """
        out = np.zeros(self.size)
        for at in self.groups:
            chosen = at if among is None or not among[at].any() else at[among[at]]
            out[at] = median(values[chosen])
        return out

    def relative_variance(self, covariance: FloatArray) -> FloatArray:
        """Variances (H,) of gains and delays less the median of the others of their group; own ones of the rest.

        covariance: of the deviations, (H, H).  The delay common to all clocks may be uncertain by milliseconds while
        differences between channels are known.  The mean of the others has the variance of the difference to the mean
        of all n, times (n / (n - 1))^2; their median is less certain than their mean by half of pi.
        """
        variance = covariance.diagonal().copy()
        for at in self.groups:
            among, others = covariance[np.ix_(at, at)], len(at) - 1
            with_all = among.mean(axis=1)
            centred = (among.diagonal() - 2 * with_all + with_all.mean()).clip(0.0)
            if others < 1:
                variance[at] = 0.0
                continue
            less_certain = np.pi / 2 - 1 if others > 2 else 0.0  # two have a median that is their mean
            variance[at] = centred * (len(at) / others) ** 2 + less_certain * centred.mean() / others
        return variance

    def relative_std(self, covariance: FloatArray) -> FloatArray:
        """Standard deviations (H,) of the same."""
        return np.asarray(np.sqrt(self.relative_variance(covariance)))

    @cached_property
    def prior_along(self) -> FloatArray:
        """Prior variance of a jump along each direction, (V,)."""
        return np.asarray(
            ((self.directions @ self.prior) * self.directions).sum(axis=1) / self.directions.sum(axis=1) ** 2
        )

    @cached_property
    def groups(self) -> tuple[IntArray, ...]:
        """Indices of the gains, and of the delays; the mean of a group is not identifiable."""
        found = (np.flatnonzero([kind == of for kind in self.kinds]) for of in ("gain", "delay"))
        return tuple(at for at in found if len(at))

    @cached_property
    def relative_walk(self) -> FloatArray:
        """Variance per second (H,) of gains and delays less the median of the others of their group."""
        return self.relative_variance(self.walk)

    @cached_property
    def cargo_at(self) -> IntArray:
        """Indices of everything that describes loads."""
        return np.flatnonzero(self.cargo)

    @cached_property
    def refined(self) -> BoolArray:
        """True at the deviations that every window estimates together with its parameters, (H,)."""
        return self.cargo | self.constant

    @cached_property
    def refined_at(self) -> IntArray:
        """Indices of those."""
        return np.flatnonzero(self.refined)

    @cached_property
    def loads_at(self) -> IntArray:
        """Indices of the masses of loads."""
        return np.flatnonzero(self.loads)

    @cached_property
    def gains(self) -> BoolArray:
        """True at gains, (H,)."""
        return np.array([kind == "gain" for kind in self.kinds], dtype=bool)

    @cached_property
    def report_limit(self) -> FloatArray:
        """Size from which each deviation is reported, (H,); infinite for loads."""
        return self._of_channels(self.rules.reported_gain, self.rules.reported_delay)

    @cached_property
    def put_right(self) -> FloatArray:
        """Size from which each deviation is taken back from samples, (H,); infinite for loads."""
        return self._of_channels(**PUT_RIGHT)

    @cached_property
    def channel_directions(self) -> BoolArray:
        """True at directions of jumps that consist of gains and delays only, (V,)."""
        return np.asarray(self.directions @ np.isinf(self.drift_limit) == 0)

    @cached_property
    def drift_limit(self) -> FloatArray:
        """Slow drift of each deviation up to which there is no alarm, (H,); infinite for loads."""
        return self._of_channels(self.rules.gain_drift, self.rules.delay_drift)

    def jump_limit(self, kind: str) -> float:
        """Size of a jump of a gain or a delay up to which there is no alarm."""
        return self.rules.gain if kind == "gain" else self.rules.delay

    def _of_channels(self, gain: float, delay: float) -> FloatArray:
        """Limits of gains and delays, (H,); infinite for others."""
        limits = {"gain": gain, "delay": delay}
        return np.array([limits.get(kind, np.inf) for kind in self.kinds], dtype=np.float64)


def model_of(deviations: Sequence[Deviation], rules: JumpRules = TRACKING_RULES.jumps) -> DeviationModel:
    """Delays of one clock share most of their variance; everything else is independent.

    Jumps are tested along each deviation, and along what several channels may have in common.
    """
    H = len(deviations)
    kinds = tuple(d.kind for d in deviations)
    std = np.array([d.std for d in deviations], dtype=np.float64)
    group = np.array([d.group for d in deviations], dtype=np.int64)
    late = np.array([kind == "delay" for kind in kinds], dtype=bool)
    together = late[:, None] & late[None, :] & (group[:, None] == group[None, :])
    constant = np.array([kind in OWN for kind in kinds], dtype=bool)
    own = np.eye(H)
    shared = np.where(together, GROUP_SHARE, 0.0) + own * np.where(late, 1 - GROUP_SHARE, 1.0)
    own_walk = {"gain": GAIN_WALK, "delay": OWN_WALK, **CARGO_WALK}
    walk = np.diag([own_walk.get(kind, 0.0) ** 2 for kind in kinds]).reshape(H, H) + together * CLOCK_WALK**2
    loads = np.array([kind == "load" for kind in kinds], dtype=bool)
    cargo = np.array([kind in CARGO for kind in kinds], dtype=bool)
    directions = np.concatenate([own[~constant], shared_directions(deviations)])
    return DeviationModel(kinds, shared * np.outer(std, std), walk, directions, loads, cargo, constant, rules)
