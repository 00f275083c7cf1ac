"""Gains, delays and loads beside the parameters: what they are believed to be, and whether one has jumped.

The belief itself is part of the filter's (levels, rates, deviations).  Here is what surrounds it: the sensitivities of
the last windows, the deviations that the baseline was learned with, and a test for jumps.  The test sees only what a
window says about deviations whatever the parameters are (these are profiled out), so a spring that changes does not
speak for a sensor.  H deviations, V directions: each deviation alone, and one delay for all channels of a clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import expit

from sprung.model.identification.deviations import CARGO, OWN, Deviation
from sprung.model.signals import BoolArray, Deviating, FloatArray, IntArray
from sprung.model.tracking.filter import Belief
from sprung.model.tracking.middle import median

FORGETTING = 0.975  # of the evidence for a jump, per window that is weighed: 40 s; some channels show little at once
EVIDENCE = 22.0  # log-likelihood ratio of a jump; 2 exp(-22) times 92 directions: 0.1 in a month without pause
MOST = 5.0  # standard deviations that one window counts at most: two windows at least
RESTART = 1.0  # log-likelihood ratio below which the evidence of earlier windows is dropped
POINTING = 6.0  # log-likelihood ratio from which a deviation may be what moves parameters: alarms wait for the next
# windows; chance alone reaches it in some direction about once in ten weighed windows
DOUBTED = 6.0  # log-likelihood ratio from which what is believed is stated less surely
RISING = 3.0  # log-likelihood ratio at which a jump is taken to have begun
MEMORY = 0.3  # weight of the newest window in the mean sensitivities
SETTLED = 600.0  # s of used windows in which the gains of the learning phase go on being refined
GROUP_SHARE = 0.97  # of a delay's variance, common to the channels of one clock
GAIN_WALK = 1e-4  # per sqrt(s): 0.6 % in an hour, 2 % in a working day
CLOCK_WALK = 2e-5  # s per sqrt(s), of a node's clock; 1.2 ms in an hour
# Per sqrt(s), of a running vehicle: 1 % of the mass, 0.3 % of how it is spread in two minutes; one walks 10 m along the
# car, or from one side of it to the other, for 1e-3.
CARGO_WALK = {"load": 1e-3, "roll_inertia": 3e-4, "pitch_inertia": 3e-4, "centre": 1e-4, "side": 1e-4}
OWN_WALK = 1e-6  # s per sqrt(s), of one channel against its node
NAMED = {"gain": 0.012, "delay": 6e-4}  # a smaller deviation is inside what electronics may do
BUILT = 0.01  # a body that is closer than that to its file is as the file says
JUMPED = {"gain": 0.01, "delay": 3e-4, "load": 0.004}  # a smaller jump is followed and not told
CREPT = {"gain": 0.03, "delay": 2e-3}  # one that came slowly is an alarm from here on: electronics age by 2 % a month
KNOWN_SHARE = 0.2  # of that is the standard deviation of one that is known
STRAYED = 0.5  # of that: so far from where it was first known, a deviation is not what the baseline was learned with
BENDING = 0.5  # of the square of a gain: what a window in which it was not taken back errs by, being linearised without
TAKEN_BACK = 0.06  # gain from which windows are
LOST_LOAD = 6.0  # deviations of one window from the believed load beyond which it is taken for another
STOPPED = 5.0  # s without a used window after which passengers may have boarded


@dataclass(frozen=True, eq=False)
class DeviationModel:
    """Constants: how deviations are distributed at first, how they wander, and in which directions they jump."""

    kinds: tuple[str, ...]
    prior: FloatArray  # covariance, shape (H, H)
    walk: FloatArray  # covariance per second, shape (H, H)
    directions: FloatArray  # shape (V, H)
    loads: BoolArray  # True at the masses of loads, shape (H,)
    cargo: BoolArray  # True at all that describes loads, their masses included, shape (H,)
    own: BoolArray  # True at how bodies are built, which never changes, shape (H,)

    @property
    def size(self) -> int:
        return len(self.kinds)

    def common(self, values: FloatArray, among: BoolArray | None = None) -> FloatArray:
        """The middle one of the gains, and of the delays, (H,): what all channels share cannot be known.

        among: the deviations (H,) that tell it, all by default.
        """
        out = np.zeros(self.size)
        for at in self.groups:
            telling = at if among is None or not among[at].any() else at[among[at]]
            out[at] = median(values[telling])
        return out

    def relative_std(self, covariance: FloatArray) -> FloatArray:
        """Standard deviations (H,) of deviations less what their channels share, from their covariance (H, H).

        What all clocks share may be open by milliseconds while every channel's place among them is known.
        """
        return np.asarray(np.sqrt(((self.apart @ covariance) * self.apart).sum(axis=1).clip(0.0)))

    @cached_property
    def groups(self) -> tuple[IntArray, ...]:
        """Where the gains are, and where the delays; what all of one group share cannot be known."""
        found = (np.flatnonzero([kind == of for kind in self.kinds]) for of in ("gain", "delay"))
        return tuple(at for at in found if len(at))

    @cached_property
    def apart(self) -> FloatArray:
        """Takes from deviations the mean of their group, (H, H)."""
        apart = np.eye(self.size)
        for at in self.groups:
            apart[np.ix_(at, at)] -= 1 / len(at)
        return apart

    @cached_property
    def cargo_at(self) -> IntArray:
        """Where all that describes loads is."""
        return np.flatnonzero(self.cargo)

    @cached_property
    def along(self) -> BoolArray:
        """True at what every window is refined with beside its parameters, (H,)."""
        return self.cargo | self.own

    @cached_property
    def along_at(self) -> IntArray:
        """Where that is."""
        return np.flatnonzero(self.along)

    @cached_property
    def loads_at(self) -> IntArray:
        """Where the masses of loads are."""
        return np.flatnonzero(self.loads)

    @cached_property
    def gains(self) -> BoolArray:
        """True at gains, (H,)."""
        return np.array([kind == "gain" for kind in self.kinds], dtype=bool)

    @cached_property
    def named(self) -> FloatArray:
        """From which size on each deviation is named, (H,); infinite for loads."""
        return np.array([NAMED.get(kind, np.inf) for kind in self.kinds], dtype=np.float64)

    @cached_property
    def of_channels(self) -> BoolArray:
        """True at directions of jumps in which gains and delays alone move, (V,)."""
        return np.asarray(self.directions @ np.isinf(self.crept) == 0)

    @cached_property
    def crept(self) -> FloatArray:
        """How far each deviation may creep without being told, (H,); infinite for loads."""
        return np.array([CREPT.get(kind, np.inf) for kind in self.kinds], dtype=np.float64)


def model_of(deviations: Sequence[Deviation]) -> DeviationModel:
    """Delays of one clock share most of their variance; everything else is independent.

    A jump is looked for along each deviation, along the delays of a clock, and along those of all clocks of a node.
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
    rows = [*own[~constant]]
    for number in np.unique(group[late]):
        members = (late & (group == number)).astype(float)
        if members.sum() > 1:
            rows.append(members)
    node = np.array([d.node for d in deviations], dtype=np.int64)
    for number in np.unique(node[late & (node >= 0)]):
        members = late & (node == number)
        if len(np.unique(group[members])) > 1:  # of one clock alone it is there already
            rows.append(members.astype(float))
    loads = np.array([kind == "load" for kind in kinds], dtype=bool)
    cargo = np.array([kind in CARGO for kind in kinds], dtype=bool)
    directions = np.array(rows).reshape(len(rows), H)
    return DeviationModel(kinds, shared * np.outer(std, std), walk, directions, loads, cargo, constant)


@dataclass(frozen=True, slots=True, eq=False)
class DeviationRecord:
    """What the tracker keeps about deviations beside the filter's belief."""

    cross: FloatArray  # mean sensitivity of the log-ratios to the deviations, shape (P, H)
    base_cross: FloatArray  # the same over the windows of the baseline, shape (P, H)
    reference: FloatArray  # deviations while the baseline was learned, shape (H,)
    moved: FloatArray  # 1 where a deviation has jumped, or crept away, since, shape (H,)
    origin: FloatArray  # gains and delays when they were first known, shape (H,); NaN: not yet
    slope: FloatArray  # recent evidence for a jump along each direction, shape (V,)
    curvature: FloatArray  # its information, shape (V,)
    since: IntArray  # ns, when the evidence began to rise, shape (V,)
    excess: FloatArray  # part of chi-square that known deviations explain, mean over windows, shape (1,)
    recent: IntArray  # ns, the last windows that were weighed, shape (3,); 0: none

    @property
    def ratio(self) -> FloatArray:
        """Log-likelihood ratio of a jump along each direction, shape (V,)."""
        return np.asarray(self.slope**2 / (2 * np.maximum(self.curvature, 1e-12)))


def start(parameters: int, model: DeviationModel) -> DeviationRecord:
    H, V = model.size, len(model.directions)
    zeros = np.zeros
    return DeviationRecord(
        zeros((parameters, H)), zeros((parameters, H)), zeros(H), zeros(H), np.full(H, np.nan), zeros(V), zeros(V),
        zeros(V, dtype=np.int64), zeros(1), zeros(3, dtype=np.int64),
    )  # fmt: skip


def grown(record: DeviationRecord, belief: Belief, model: DeviationModel) -> tuple[DeviationRecord, Belief]:
    """Of an older state, which did not know the last of the model's deviations, or of its directions, yet."""
    old, H, V = belief.deviations, model.size, len(model.directions)
    zeros = np.zeros(V)
    if len(record.slope) != V:
        record = replace(record, slope=zeros, curvature=zeros, since=zeros.astype(np.int64))
    if old >= H:
        return record, belief
    more, first = H - old, len(belief.mean)
    covariance = np.zeros((first + more, first + more))
    covariance[:first, :first] = belief.covariance
    covariance[first:, first:] = model.prior[old:, old:]
    wider = {name: np.pad(getattr(record, name), ((0, 0), (0, more))) for name in ("cross", "base_cross")}
    longer = {name: np.pad(getattr(record, name), (0, more)) for name in ("reference", "moved", "origin")}
    return (
        replace(record, **wider, **longer),
        Belief(np.pad(belief.mean, (0, more)), covariance, H),
    )


@dataclass(frozen=True, slots=True)
class Jump:
    """A deviation that has jumped."""

    direction: FloatArray  # shape (H,)
    size: float
    since: int  # ns
    kind: str


def weigh(
    calibration: DeviationRecord, model: DeviationModel, belief: Belief, found: Deviating, share: float, time: int
) -> tuple[DeviationRecord, Belief, Jump | None, bool]:
    """After a window that says something about deviations: belief, evidence for jumps, one that is certain, and whether
    the window and the belief agree now.

    share: of the window that no earlier weighed window saw.
    """
    H = model.size
    here = belief.mean[-H:]
    P = belief.covariance[-H:, -H:]
    M = found.information * share
    u = (found.score - found.information @ (here - found.point)) * share
    solved = np.linalg.solve(np.eye(H) + M @ P, np.column_stack([u, M]))
    slope, curvature = solved[:, 0], 0.5 * (solved[:, 1:] + solved[:, 1:].T)
    along = model.directions @ slope
    information = ((model.directions @ curvature) * model.directions).sum(axis=1).clip(1e-12)
    largest = float(np.max(np.abs(along) / np.sqrt(information), initial=0.0))
    bounded = min(1.0, MOST / max(largest, 1e-12))
    calibration, jump = _judged(calibration, model, along, information, bounded, time)
    agrees = bounded == 1.0 or jump is not None
    if jump is not None:
        belief = _loosened(belief, model, calibration.cross, jump)
        P = belief.covariance[-H:, -H:]
    elif bounded < 1.0:  # one window does not turn the belief over; several will, or a jump is found
        M, u = M * bounded**2, u * bounded**2
    if jump is not None or bounded < 1.0:
        solved = np.linalg.solve(np.eye(H) + M @ P, np.column_stack([u, M]))
        slope, curvature = solved[:, 0], 0.5 * (solved[:, 1:] + solved[:, 1:].T)
    across = belief.covariance[:, -H:]
    covariance = belief.covariance - across @ curvature @ across.T
    covariance = 0.5 * (covariance + covariance.T)
    belief = replace(belief, mean=belief.mean + across @ slope, covariance=covariance)
    mixed = MEMORY if calibration.recent[-1] else 1.0
    return (
        replace(
            calibration,
            cross=calibration.cross + mixed * (found.cross - calibration.cross),
            excess=calibration.excess + mixed * (explained(belief, found) - calibration.excess),
            recent=np.array([*calibration.recent[1:], time], dtype=np.int64),
        ),
        belief,
        jump,
        agrees,
    )


def followed(record: DeviationRecord, model: DeviationModel, belief: Belief, here: BoolArray) -> DeviationRecord:
    """With the deviations that the baseline was learned with, as far as they can be told by now.

    What is known better than then is taken over, but for what has strayed meanwhile: it keeps what was known first.
    here: deviations (H,) that may be said to be known first now.
    """
    value, moved = belief.mean[-model.size :], record.moved > 0
    known, origin = np.isfinite(record.origin), record.origin
    if not (known | moved | ~here).all():
        std = model.relative_std(belief.covariance[-model.size :, -model.size :])
        origin = np.where(here & ~known & ~moved & (std < KNOWN_SHARE * model.crept), value, origin)
        known = np.isfinite(origin)
    off = np.where(known, value - origin, 0.0)
    strayed = known & ~moved & (np.abs(off - model.common(off, known & ~moved)) > STRAYED * model.crept)
    # What all channels share cannot be known: where it wanders, the reference of one that moved goes along.
    kept = np.where(strayed, origin, record.reference)
    kept = kept + model.common(value - record.reference, ~(moved | strayed))
    return replace(
        record,
        origin=origin,
        moved=np.maximum(record.moved, strayed),
        reference=np.where(moved | strayed, kept, value),
    )


def crept(record: DeviationRecord, model: DeviationModel, belief: Belief) -> tuple[FloatArray, BoolArray]:
    """How far deviations (H,) are from those of the baseline, whatever they share, and which have left them slowly or
    at once by more than electronics do."""
    off = belief.mean[-model.size :] - record.reference
    off = off - model.common(off, record.moved == 0)
    far = np.abs(off) > model.crept
    if far.any():
        std = model.relative_std(belief.covariance[-model.size :, -model.size :])
        far &= std < KNOWN_SHARE * model.crept
    return off, far


def pending(record: DeviationRecord, model: DeviationModel) -> FloatArray:
    """Variance (H,) of gains and delays for what recent windows say beyond the belief, in the most evident direction.

    The belief follows what wanders as electronics do; what is faster it follows late, until it is found to have jumped.
    """
    ratio = np.where(model.of_channels, record.ratio, 0.0)
    if not ratio.max(initial=0.0) > 0:
        return np.zeros(model.size)
    best = int(np.argmax(ratio))
    size = record.slope[best] / record.curvature[best]
    return np.asarray((model.directions[best] != 0) * expit(ratio[best] - DOUBTED) * size**2)


def bending(gain: FloatArray) -> FloatArray:
    """Standard deviations that gains of this size have because windows are linearised without them."""
    return np.asarray(BENDING * np.minimum(np.abs(gain), TAKEN_BACK) ** 2)


def explained(belief: Belief, found: Deviating) -> float:
    """Part of a window's chi-square per degree of freedom that the believed deviations account for."""
    off = belief.mean[-len(found.point) :] - found.point
    gained = float(2 * found.score @ off - off @ found.information @ off)
    return max(0.0, gained) / max(found.freedom, 1.0)


def level_variance(belief: Belief, model: DeviationModel, cross: FloatArray) -> FloatArray:
    """Variances of the levels (P,) as all windows take them, however bodies are built: what is not known of that moves
    windows, by `cross` (P, H) per deviation, and what is believed of the levels alike."""
    variance = belief.level_variance
    if not model.own.any():
        return variance
    at, p = np.flatnonzero(model.own), belief.size
    rows, cross = at + 2 * p, cross[:, at]
    with_levels, among = belief.covariance[:p, rows], belief.covariance[rows][:, rows]
    return np.asarray((variance + (cross * (cross @ among - 2 * with_levels)).sum(axis=1)).clip(1e-12))


def loaded(belief: Belief, model: DeviationModel, found: Deviating, share: float) -> Belief:
    """Belief after a window that speaks of loads, and of how bodies are built, only."""
    at = model.along_at
    rows = at + len(belief.mean) - model.size
    M = found.information[at][:, at] * share
    u = found.score[at] * share - M @ (belief.mean[rows] - found.point[at])
    across = belief.covariance[:, rows]
    gain = np.linalg.solve(np.eye(len(at)) + M @ across[rows], np.column_stack([u, M]))
    covariance = belief.covariance - across @ gain[:, 1:] @ across.T
    return replace(belief, mean=belief.mean + across @ gain[:, 0], covariance=0.5 * (covariance + covariance.T))


def _judged(
    calibration: DeviationRecord,
    model: DeviationModel,
    along: FloatArray,
    information: FloatArray,
    bounded: float,
    time: int,
) -> tuple[DeviationRecord, Jump | None]:
    """Evidence after a window whose scores count by `bounded`; a jump where there is enough."""
    # Directions for which nothing speaks begin anew: what was quiet before must not outvote a jump.
    old = calibration.slope
    going = (old**2 > 2 * calibration.curvature * RESTART) & (old * (FORGETTING * old + along * bounded) > 0)
    keep = np.where(going, FORGETTING, 0.0)
    slope = keep * old + along * bounded
    curvature = keep * calibration.curvature + information
    ratio = slope**2 / (2 * curvature)
    since = np.where((ratio >= RISING) & (calibration.ratio < RISING), time, calibration.since)
    best = int(np.argmax(ratio)) if len(ratio) else -1
    jump = None
    if best >= 0 and ratio[best] >= EVIDENCE:
        direction = model.directions[best]
        kind = model.kinds[int(np.argmax(direction))]
        size = slope[best] / curvature[best] if bounded == 1.0 else along[best] / information[best]
        jump = Jump(direction, float(size), int(since[best]), kind)
        slope, curvature = np.zeros_like(slope), np.zeros_like(curvature)
    return replace(calibration, slope=slope, curvature=curvature, since=since), jump


def _loosened(belief: Belief, model: DeviationModel, cross: FloatArray, jump: Jump) -> Belief:
    """Belief after a jump was found: the deviation, and what the parameters took of it, are open again."""
    H = model.size
    open_ = np.zeros(len(belief.mean))
    open_[-H:] = 2 * jump.size * jump.direction
    taken = np.zeros(len(belief.mean))
    taken[: belief.size] = cross @ jump.direction * jump.size
    return replace(belief, covariance=belief.covariance + np.outer(open_, open_) + np.outer(taken, taken))


def boarded(
    belief: Belief, model: DeviationModel, mean: FloatArray | None = None, variance: FloatArray | None = None
) -> Belief:
    """Belief after a stop: any load, or what is known of its mass, `mean` and `variance` (L,)."""
    covariance, state = belief.covariance.copy(), belief.mean.copy()
    first = len(belief.mean) - model.size
    at = model.cargo_at + first
    covariance[at, :] = covariance[:, at] = 0.0
    state[at], covariance[at, at] = 0.0, np.diag(model.prior)[model.cargo]
    if mean is not None and variance is not None:
        masses = model.loads_at + first
        state[masses], covariance[masses, masses] = mean, variance
    return replace(belief, mean=state, covariance=covariance)


def moved(belief: Belief, model: DeviationModel, found: Deviating) -> bool:
    """Whether a window's loads are none that the belief allows: something was put on, or let down, on the way."""
    at, along = model.cargo_at, model.along_at
    if not len(at):
        return False
    values, vectors = np.linalg.eigh(found.information[at][:, at])
    told = values > 1e-9 * max(float(values[-1]), 1e-300)
    root = vectors[:, told] / np.sqrt(values[told])  # of what the window tells; bodies are built as believed
    rows = along + len(belief.mean) - model.size
    M = root.T @ found.information[at][:, along]
    seen = M @ (found.point[along] - belief.mean[rows]) + root.T @ found.score[at]
    spread = np.eye(len(seen)) + M @ belief.covariance[rows][:, rows] @ M.T
    return bool(seen @ np.linalg.solve(spread, seen) > LOST_LOAD**2)


def unsure(belief: Belief, model: DeviationModel) -> Belief:
    """Belief after a parameter was lost: it may have been a sensor, whose deviation is open to a third of its prior."""
    H = model.size
    covariance = belief.covariance.copy()
    covariance[-H:, -H:] += model.prior / 9 * ~(model.along[:, None] | model.along[None, :])
    return replace(belief, covariance=covariance)
