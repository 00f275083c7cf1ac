"""Every number that decides the result of a diagnosis, by stage, with its reason.

A number is here when another value could change a verdict, a place or a name.  Tolerances of the numerics, which only
have to be small, stay beside the code that iterates.  A reason begins with "derived" where the number follows from
statistics or the sampling, and with "chosen" where it was found on simulated vehicles; `sprung bench sensitivity`
varies every one over its range and prints what changes.  Its latest results are in `varied.json` beside this file;
`reason` quotes both.
"""

from __future__ import annotations

import json
from dataclasses import Field, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from sprung.model.ambient.rules import WINDOW_RULES, AmbientWindowRules
from sprung.model.rule import RuleTable, reason_of, rule

VARIED = Path(__file__).with_name("varied.json")  # made by `sprung bench sensitivity --write`


def reason(stage: str, number: Field[Any]) -> str:
    """Reason for a number's value, and the result of the sensitivity bench for other values."""
    return reason_of(stage, number, _varied())


@cache
def _varied() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(VARIED.read_text(encoding="utf-8"))
    return found


@dataclass(frozen=True)
class RecordRules:
    """Requirements on recordings."""

    minimum_samples: int = rule(200, "derived: two periods of the slowest mode of a vehicle at 100 Hz", 100, 400)
    fitted: float = rule(0.7, "of the recording, from its start; chosen: the rest judges what was fitted", 0.6, 0.8)
    gap: float = rule(0.05, "s; derived: a period of the highest frequency compared at 100 Hz loses nothing", 0.02, 0.1)
    moves: float = rule(2.0, "noise deviations by which one sensor has to move; chosen: 1 is noise alone", 1.5, 3.0)
    longest: int = rule(18_000, "samples; chosen: three minutes of a vehicle, 2 to 3 GB of memory", 12_000, 60_000)
    enough: int = rule(8_000, "samples; chosen: more are reduced where nothing moves that fast", 6_000, 18_000)
    faster: float = rule(0.01, "of a sensor's power, that a lower rate may lose; chosen", 0.003, 0.02)
    by_noise: float = rule(4.0, "times the declared noise's power, the same; chosen", 2.0, 10.0)
    modes_within: float = rule(1.5, "times the fastest mode, that is compared at a lower rate; chosen", 1.2, 3.0)
    passed: float = rule(0.4, "of the slowest mode, edge of the filter for integrals; chosen", 0.3, 0.5)
    settled: float = rule(2.0, "periods of that edge lost at either end; derived: 1e-4 of a transient left", 1.5, 3.0)
    stuck: float = rule(0.02, "of the recording; chosen: quantised sensors at rest repeat for less", 0.01, 0.05)
    stuck_samples: int = rule(20, "at least, the same; derived: coarse steps of slow channels repeat for less", 10, 40)
    resting: float = rule(0.5, "of the channels that repeat a value together: standstill; chosen", 0.3, 0.7)
    rest: float = rule(5.0, "s at the noise of all channels: a vehicle that stands; chosen: a platform", 3.0, 10.0)
    held: float = rule(0.05, "Hz; derived: a slower mode is one that no stiffness holds", 0.02, 0.1)
    compared: float = rule(
        0.3, "of the sample rate, up to which spectra are compared; derived: anti-alias filters", 0.25, 0.35
    )
    end_samples: int = rule(
        9, "that determine the slope at an end of a record; chosen: more bend, fewer are noise", 7, 13
    )
    end_degree: int = rule(4, "of the polynomial through them; chosen", 3, 6)
    end_degree_integrated: int = rule(
        7, "the same of an integrated acceleration; chosen: its fast noise is small, and fast motion is not", 5, 8
    )
    least_noise: float = rule(0.2, "of a declared noise that an estimate may fall to; chosen: data sheets", 0.1, 0.4)
    undeclared: float = rule(1e-3, "of a signal, noise of a channel that declares none; chosen: 10 bits", 3e-4, 3e-3)
    shock: float = rule(9.0, "of a sample's power over the mean, that counts; derived: three deviations", 4.0, 16.0)
    cut_seconds: float = rule(0.5, "s that a cut may be moved to a quiet moment; chosen: a joint passes", 0.25, 1.0)
    cut_share: float = rule(0.01, "of the recording, the same at most; chosen", 0.005, 0.02)
    cut_samples: int = rule(7, "for the level around a cut; chosen: what leaks from an end", 5, 11)


@dataclass(frozen=True)
class WhiteNoiseRules:
    """White noise of a channel from its fastest changes."""

    order: int = rule(6, "of differences; derived: motion above a third of the sample rate passes", 5, 8)
    upper_order: int = rule(8, "the same for the most noise there can be; chosen", 6, 10)
    blocks: int = rule(40, "whose median counts; chosen: bursts are no noise", 20, 80)
    filtered_samples: int = rule(100, "of blocks in which a filter's cutoff is looked for; chosen", 60, 200)
    filtered_blocks: int = rule(5, "of them at least; chosen: a median", 3, 8)
    even_from: float = rule(0.26, "of the sample rate, where three even bands begin; chosen: above motion", 0.22, 0.28)
    even_to: float = rule(0.38, "the same, where they end; derived: below the cutoff of usual filters", 0.36, 0.4)
    empty_from: float = rule(0.46, "the same, above which a filter leaves nothing; derived", 0.44, 0.48)
    even: float = rule(1.8, "ratio of the powers of even bands; chosen: chance of few blocks", 1.5, 2.5)
    empty: float = rule(0.2, "of them that an empty band has at most; chosen: a filter leaves 0.01", 0.1, 0.3)
    response: int = rule(6, "samples either way, of a force's response to a motion; chosen: spring to inertia", 3, 10)
    response_samples: int = rule(20, "of a series for each of them; derived: noise lost is a fortieth", 10, 50)
    response_seen: float = rule(1e-8, "of the largest, of directions that are fitted; derived: rounding", 1e-10, 1e-6)


@dataclass(frozen=True)
class FitRules:
    """Priors, and the budget of work."""

    prior: float = rule(
        1.0, "deviation of a log-ratio to nominal; derived: a factor e, no vehicle is further", 0.7, 2.0
    )
    work: float = rule(
        1e7,
        "samples of all models linearised; chosen: thousands on a minute at 100 Hz, minutes of processor time",
        3e6,
        3e7,
    )
    done: float = rule(
        0.02, "fall of the objective per deviation moved, that ends a fit; derived: little of 6", 0.005, 0.05
    )
    numerical: float = rule(
        0.3, "promised fall, below which a failed step ends a fit; derived: half of the next", 0.1, 0.6
    )
    unsettled: float = rule(0.6, "last fall, beyond which a fit is compared with none; derived: a tenth of 6", 0.3, 1.0)
    smoothing: float = rule(5e-4, "of chi-square, by which smoothing the inputs anew may move it; chosen", 2e-4, 1e-3)
    told: float = rule(
        2.0,
        "promised fall, up to which a failed step ends a fit if smoothing moves as much; derived: a third of 6",
        1.0,
        3.0,
    )
    patience: float = rule(1.0, "times the steps of every fit, which converge before; chosen", 0.7, 1.5)
    restarts: int = rule(5, "of a fit that has not converged; chosen", 3, 8)
    restarted: int = rule(10, "steps of each; chosen", 6, 15)
    renewals: int = rule(12, "of noise levels, each with a fit; chosen", 8, 20)
    renewed: float = rule(0.05, "change of a force's noise, below which it is as found; chosen", 0.02, 0.1)
    shared: float = rule(0.2, "deviations of the channels' common gain, up to which it is 1; chosen", 0.1, 0.4)


@dataclass(frozen=True)
class ScreeningRules:
    """Range of the scored trials."""

    slowest: float = rule(0.5, "Hz, of fundamentals; derived: rail joints at walking pace", 0.3, 1.0)
    fastest: float = rule(21.0, "Hz, of fundamentals; derived: wheels of 0.92 m at 60 m/s", 15.0, 30.0)
    lowest_line: int = rule(2, "bins, of a line; derived: below, it is a drift", 1, 4)
    harmonics: int = rule(2, "that are seen; derived: one alone is a line", 2, 3)
    reach: int = rule(24, "bins; derived: a median of 49 knows the level to 18 %", 12, 48)
    colour: float = rule(2.5, "by which exact columns may raise a score; chosen", 1.5, 4.0)
    per_freedom: float = rule(2.0, "score of every further parameter; derived: Akaike's", 1.0, 4.0)
    of_laws: float = rule(
        0.5, "of the chance of a false finding, for laws at elements; chosen: they are looked for first", 0.1, 0.7
    )
    of_shapes: float = rule(4.0, "score by chance, of the shapes of an unnamed force; derived: 2 log 7", 2.0, 6.0)
    of_places: float = rule(9.0, "the same of the places of a missing part; derived: 2 log 100", 7.0, 12.0)
    of_lines: float = rule(22.0, "the same of frequencies and phases; derived: 2 log 60 000", 18.0, 26.0)
    reaction: float = rule(
        0.02,
        "relative error of columns with the laws' reaction; derived: slopes of laws from sample to sample",
        0.01,
        0.05,
    )
    lowest_mode: float = rule(1.0, "Hz; derived: below, an elastic mode is a rigid one of a train's body", 0.5, 2.0)
    highest_mode: float = rule(0.4, "of the sample rate; derived: there anti-alias filters cut", 0.3, 0.45)
    mode_damping: float = rule(0.01, "ratio of trial modes, and three times that; chosen: car bodies", 0.005, 0.02)
    damped_lightly: float = rule(
        0.05, "median damping ratio up to which modes may have their own; chosen: buildings, frames, wings", 0.03, 0.07
    )
    mass_damping: float = rule(0.05, "the same of trial masses; chosen: equipment on rubber", 0.025, 0.1)
    # Sizes of values, by which their priors are wide; of others, their laws state it, or it is the value found
    phase: float = rule(1.0, "rad, of a force; derived: it may have any", 0.5, 3.0)
    turn: float = rule(0.1, "periods, of a dip; chosen: a tenth of a turn", 0.05, 0.3)
    place: float = rule(1.0, "m, of a part; chosen: vehicles and rigs", 0.5, 2.0)
    modal: float = rule(0.01, "damping ratio of a mode; chosen: buildings, frames, wings", 0.005, 0.02)
    power: float = rule(0.1, "power of the frequency, of a loss factor; chosen: rubber", 0.05, 0.2)


@dataclass(frozen=True)
class EvidenceRules:
    """Evidence of a better fit."""

    blocks: int = rule(14, "per sensor; chosen", 8, 24)
    first_block: int = rule(24, "bins; derived: the level of a block is then known to 20 %", 16, 48)
    quiet: float = rule(0.5, "of the noise power; derived: no white block of 24 bins is quieter by chance", 0.3, 0.7)
    plainly: float = rule(1.2, "ratio of what two fits leave; derived: white noise gives 1.02", 1.05, 1.5)
    log_width: float = rule(4.6, "derived: the logarithm of a factor of 100, an unknown order", 2.3, 9.2)
    widths: float = rule(4.0, "sizes at which a parameter matters; chosen", 2.0, 8.0)
    rarity: float = rule(1.0, "times the evidence that rare laws state to need; derived: 12 is odds of 400", 0.5, 1.5)
    unusual: float = rule(4.0, "evidence for a factor e outside the usual range; chosen", 2.0, 8.0)


@dataclass(frozen=True)
class SelectionRules:
    """Choice of the candidates that are fitted, and of the leading one."""

    close: float = rule(0.25, "of the best score, from which a candidate at its place is fitted; chosen", 0.12, 0.5)
    close_elsewhere: float = rule(0.6, "the same at other places; chosen", 0.4, 0.8)
    near: float = rule(45.0, "score or evidence to the best one that is close in any case; chosen", 25.0, 90.0)
    near_share: float = rule(0.3, "of the best evidence, the same; chosen", 0.15, 0.5)
    again: float = rule(0.8, "of the best score, from which a law that leaves much starts once more; chosen", 0.6, 1.0)
    far: float = rule(
        1.0, "log-ratio to nominal of a parameter, from which a part is tried from nominal, too; chosen", 0.5, 1.5
    )
    most: int = rule(9, "candidates that are fitted; chosen", 6, 14)
    gross: float = rule(0.3, "error over the signal, from which scores only indicate the place; chosen", 0.2, 0.5)
    most_gross: int = rule(14, "candidates that are fitted then; chosen: all laws of an element", 9, 20)
    wider: int = rule(2, "of the best laws beside another, that are fitted in their wider forms; chosen", 1, 3)
    unnamed: int = rule(2, "unnamed forces among them at one place; chosen", 1, 3)
    several: float = rule(
        0.5, "of that error, from which several laws of one element are sought together; chosen: cars", 0.3, 1.0
    )
    together: float = rule(0.5, "of the work of a search, on top of it, for that; chosen", 0.3, 1.0)
    alike: float = rule(2.0, "of the error in a force, up to which another set of laws is simulated; chosen", 1.5, 4.0)
    fine: float = rule(
        0.02, "of the misfit, that a set of plausible laws may leave so that no other is simulated; chosen", 0.005, 0.05
    )
    last: int = rule(4, "that are fitted to the end if they fall fast; chosen", 2, 6)
    finished: int = rule(6, "that are fitted to the end when they are close; chosen", 4, 9)
    settling: int = rule(3, "rounds in which fits that still fall and could lead are fitted on; chosen", 1, 6)
    further: int = rule(3, "candidates tried for a runner-up where none was close; chosen", 1, 6)
    chance: float = rule(4.0, "standard deviations; derived: one noise in 30 000 exceeds it", 3.0, 6.0)
    unnamed_ratio: float = rule(1.3, "times a named law, that an unnamed force explains; chosen", 1.1, 1.7)
    unnamed_sure: float = rule(1.1, "the same, where its evidence is plainly higher; chosen", 1.05, 1.2)
    unnamed_margin: float = rule(12.0, "evidence, that is plainly higher; chosen: odds of 400 to 1", 6.0, 20.0)
    stronger: float = rule(1.1, "times the damper that a law of shares asks for, as a second start; chosen", 1.02, 1.5)
    hint: float = rule(0.02, "of a law's strength at which its first step is taken; chosen", 0.005, 0.1)
    still: float = rule(0.05, "of the fitted part's motion, below which nothing is judged; chosen", 0.02, 0.1)
    refuted: float = rule(3.0, "standard deviations; derived: one true finding in 700 is refuted", 2.0, 5.0)
    closer: float = rule(
        0.7, "of the error at every sensor, up to which nothing is refuted; derived: half of its power", 0.5, 0.85
    )


@dataclass(frozen=True)
class PlausibleRules:
    """Limits of plausible values."""

    knees: float = rule(0.5, "of the rate passed within a sample; derived: both knees lie within it", 0.3, 0.8)
    corner: float = rule(
        0.4, "of the rms rate, over which friction changes its sign; chosen: wider, a damper saturates", 0.25, 0.7
    )
    pure: float = rule(0.8, "of an excitation's power in a few lines, its own frequencies; chosen", 0.6, 0.95)
    lines: int = rule(4, "of them at most; chosen", 2, 8)
    bins: int = rule(2, "on either side of a line; derived: they hold 92 % of a sine between two bins", 1, 4)
    harmonics: int = rule(30, "of a line that a non-linear answer may have; chosen", 15, 60)
    mains: float = rule(0.15, "Hz, by which a mains frequency strays; derived: grids are kept within 0.1", 0.1, 0.3)
    apart: float = rule(3.0, "deviations from what it is without, of a gain or a mass; derived: one in 400", 2.0, 4.0)
    calibration: float = rule(
        1.5, "deviations of a data sheet, up to which a gain or zero is in order; chosen: 2.2 % by default", 1.0, 2.0
    )
    alone: float = rule(
        3.0, "times the next largest, that one gain or zero is off alone; derived: of 8, one rig in 90", 2.0, 5.0
    )
    weighed: float = rule(
        0.015, "of a body's mass, its deviation where the file states none; chosen: as a gain's", 0.01, 0.03
    )
    masses: float = rule(
        0.3, "of a body's mass, deviation of the prior beyond that; chosen: undetermined ones stay near", 0.1, 1.0
    )
    faulty: float = rule(
        10.0,
        "data sheets' deviations, the prior's of an instrument beyond; chosen: large faults are kept",
        5.0,
        20.0,
    )
    slow_mode: float = rule(
        0.5, "times the slowest mode on springs, below which no body bends; chosen: it is lighter", 0.3, 0.8
    )
    by_chance: float = rule(0.02, "chance that it is as far off its kind; derived: of few, one rig in 50", 0.01, 0.05)
    simulated: float = rule(
        1e-3, "of a law's parameter, that simulating kinks leaves; derived: 4 steps per sample", 3e-4, 3e-3
    )
    spring: float = rule(
        5.0, "times nominal or its inverse, as no linear part leaves a spring; chosen: it carries the load", 4.0, 10.0
    )
    close: float = rule(1.0, "bins within which a frequency is a multiple; derived: none is known better", 0.5, 2.0)


@dataclass(frozen=True)
class AcceptanceRules:
    """Acceptance of further findings, and compensation of input faults."""

    nearly: float = rule(
        0.97, "of a linear part's evidence, from which an error of calibration stands for it; chosen", 0.93, 0.99
    )
    alpha: float = rule(1e-3, "chance of a false finding before the held-out check; chosen: one recording", 1e-4, 1e-2)
    findings: int = rule(6, "that are sought at most; chosen: five, and one to see that there is none", 5, 8)
    minor_beside: float = rule(0.05, "of an earlier finding at the same place; chosen", 0.02, 0.1)
    minor_elsewhere: float = rule(0.002, "of the findings elsewhere together, or in any case; chosen", 0.0005, 0.01)
    minor_followed: float = rule(0.01, "of logarithmic gains; chosen: laws are simulated no better", 0.003, 0.03)
    idle: float = rule(0.05, "of what a finding explained at first, beside later ones; chosen", 0.01, 0.2)
    better_than_promised: float = rule(4.0, "times that a fit may exceed its first step's promise; chosen", 2.0, 8.0)
    most_left: float = rule(0.5, "of the unmeasured forces that earlier findings left; chosen", 0.3, 0.8)
    diverged: float = rule(1.5, "rise of the reduced chi-square on the whole recording; chosen", 1.2, 3.0)
    isolated: float = rule(
        6.0, "deviations of chi-square by which leaving out another sensor is worse; derived: no chance", 4.0, 10.0
    )
    steady: float = rule(6.0, "deviations of a clock's rate, of eight segments; derived: no chance", 4.0, 10.0)
    clock_rounds: int = rule(4, "in which a clock's rate is estimated; chosen", 2, 6)
    quartz: float = rule(1e-4, "rate of a clock against another; derived: 50 ppm of each quartz", 5e-5, 2e-4)
    input_faults: int = rule(2, "of input channels that are looked for; chosen", 1, 4)
    input_rounds: int = rule(3, "of estimating and compensating an input fault; chosen", 2, 5)
    input_rival: float = rule(0.3, "of the leading input fault's score, from which others are tried; chosen", 0.15, 0.6)
    input_rivals: int = rule(3, "of them; chosen", 1, 6)
    input_done: float = rule(0.01, "chi-square, below which nothing of an input fault is left; derived", 0.001, 0.1)


@dataclass(frozen=True)
class FormulaRules:
    """When an unnamed force is expressed by a formula."""

    partners: int = rule(40, "single shapes, and pairs, that are scored at finer values; chosen", 20, 80)
    rounds: int = rule(2, "of scores along the motion of the best so far; chosen", 1, 3)
    hopeful: float = rule(0.3, "of the misfit, that scores may promise to leave to be fitted; chosen", 0.15, 0.6)
    near: float = rule(0.9, "of the best score, from which a formula is fitted; chosen", 0.8, 0.97)
    fitted: int = rule(6, "single shapes, and pairs, that are fitted; chosen", 3, 9)
    slack: float = rule(15.0, "evidence behind the unnamed force; chosen: what a formula costs more", 8.0, 25.0)
    beyond: float = rule(1.1, "times what a preferred named law explains; chosen", 1.05, 1.3)
    likelier: float = rule(
        30.0, "evidence by which a formula beats a listed law that leaves noise; chosen: a law is expected", 20.0, 60.0
    )
    leaves: float = rule(
        0.02, "of the misfit beyond noise, that a formula may leave; derived: a force 15 % off leaves 0.022", 0.01, 0.1
    )
    chance: float = rule(25.0, "score beside a formula that is chance; derived: some 700 trials", 20.0, 40.0)
    missing: float = rule(0.05, "of its force, that may be missing; chosen: what counts as equivalent", 0.02, 0.1)
    rival: float = rule(10.0, "evidence behind, at which another formula is equivalent; chosen: odds of 150", 5.0, 20.0)
    agree: float = rule(0.1, "of its force, by which rivals differ; chosen: a false one is 0.15 off", 0.05, 0.15)
    explains: float = rule(0.97, "of the unnamed force's gain, that a formula must explain; chosen", 0.9, 0.995)
    work: float = rule(
        0.3, "of the work that is left, for the search of one; chosen: three more laws may be found after it", 0.2, 0.6
    )


@dataclass(frozen=True)
class NoiseRules:
    """Noise of single channels as a fault."""

    least: float = rule(1.12, "ratio to its peers; chosen: less is no maintenance", 1.06, 1.25)
    sigmas: float = rule(6.0, "by which the ratio leaves its peers'; derived: chance and modelling errors", 4.0, 8.0)
    of_error: float = rule(0.5, "of the power that a model leaves, that noise must be; derived: most of it", 0.3, 0.7)
    inaccuracy: float = rule(0.05, "of the power that findings changed, which they may have wrong; chosen", 0.02, 0.1)
    upper: float = rule(0.38, "of the sample rate; derived: above, anti-alias filters cut", 0.34, 0.42)
    white: float = rule(0.5, "of the excess, that goes on above the band; derived: noise does, physics ends", 0.3, 0.7)
    reach: float = rule(0.05, "of a sensor's noise power, that a support's noise makes up; chosen", 0.02, 0.1)
    bins: int = rule(20, "above the band, for the noise level; derived: their level is known to 20 %", 10, 40)
    blocks: int = rule(24, "of the band, whose median is a sensor's level; chosen: physics fills few", 12, 48)
    own: float = rule(0.01, "of a bin's variance, from which it informs on a sensor's own noise; chosen", 0.003, 0.03)
    quieter: float = rule(0.3, "of the blocks, whose level is that of noise alone; chosen: physics fills few", 0.2, 0.4)
    agree: float = rule(4.0, "deviations within which blocks agree with it; derived: one in 16 000", 3.0, 6.0)
    fall: float = rule(0.01, "of a force's noise power, that one round may leave; chosen: steps of ten", 0.003, 0.1)
    misdeclared: float = rule(
        10.0, "times a declared noise, that an instrument may show; chosen: a slip of ten", 5.0, 20.0
    )
    displacement: float = rule(
        0.5, "of the bins, informative on a support's displacement; derived: the fast half", 0.3, 0.7
    )
    velocity: float = rule(0.15, "the same on its velocity; derived: the slow ones alone", 0.08, 0.3)


@dataclass(frozen=True)
class SetupRules:
    """Search for set-up faults."""

    misfit: float = rule(4e-3, "misfit of a sensor; chosen: vehicles fitted well have 1e-3", 2e-3, 8e-3)
    promising: float = rule(0.85, "of the misfit that one may leave by spectra, to be fitted; chosen", 0.7, 0.95)
    tried: int = rule(5, "hypotheses that are fitted; chosen", 3, 8)
    beside: int = rule(2, "faults of single sensors that are fitted beside them; chosen", 1, 4)
    explains: float = rule(0.3, "of the misfit that one may leave once fitted; chosen", 0.15, 0.5)
    parts: int = rule(2, "missing parts that are fitted beside an accepted one; chosen", 1, 4)
    outdone: float = rule(
        0.7, "of what it leaves, that a missing part leaves instead; chosen: noise is in both", 0.4, 0.9
    )
    latest: float = rule(0.5, "s, of a node; derived: later, a node is another recording", 0.3, 1.0)
    late_share: float = rule(
        0.125, "of what is fitted, that a delay may be; derived: as much is lost at either end", 0.06, 0.2
    )
    scale: float = rule(1.3, "ratio from which a scale is wrong; derived: less is a sensor's gain", 1.2, 1.5)
    offset: float = rule(0.1, "m, from which a position is wrong; derived: less is a mounting tolerance", 0.05, 0.2)
    rounds: int = rule(2, "in which an accepted delay or scale is estimated again; chosen", 1, 4)
    most: int = rule(2, "faults of one recording; chosen", 1, 3)
    few: int = rule(16, "hypotheses that spectra cannot rank, up to which all are fitted; chosen", 8, 24)
    stretch: int = rule(2000, "samples on which many are fitted first; chosen: tens of periods", 700, 4000)
    on_a_stretch: float = rule(0.5, "of its misfit, that one may leave there to be fitted; chosen", 0.35, 0.7)
    rivals: int = rule(3, "hypotheses of one channel that are estimated again; chosen", 2, 5)
    part_steps: int = rule(8, "of the fit of a missing part; chosen: it then stands within 1 %", 5, 12)
    bins: int = rule(400, "that rank what may be wrong with the file; derived: a misfit known to 5 %", 200, 2000)
    asked: float = rule(0.2, "of another body that least squares must ask for; derived: a right one is 1", 0.1, 0.4)
    above: float = rule(1.3, "times the fastest mode, above which only masses matter; chosen", 1.15, 1.6)
    by_mass: float = rule(0.5, "of the misfit there, that an explanation may leave; chosen", 0.35, 0.65)
    soonest: float = rule(0.75, "samples of a delay there; derived: rounding a clock makes half of one", 0.5, 1.5)
    gravity_least: float = rule(5.0, "ratio by spectra alone, that may be standard gravity; chosen", 3.0, 7.0)
    gravity_most: float = rule(20.0, "the same; chosen", 14.0, 30.0)
    gravity: float = rule(0.1, "of a log-ratio, within which it is standard gravity; chosen", 0.05, 0.2)
    in_common: float = rule(0.5, "samples between lags that are one delay; derived: a clock's rounding", 0.25, 1.0)
    segments: int = rule(8, "of a recording, for a frequency response without a model; chosen", 5, 16)
    unexcited: float = rule(0.01, "of the largest power of a force, below which it excites nothing; chosen", 3e-3, 0.03)
    onset: float = rule(8.0, "times what precedes an impulse, of a response that begins with it; chosen", 5.0, 12.0)
    first: float = rule(0.5, "of the largest that the first is, and of it before; derived: it is the largest", 0.3, 0.8)


@dataclass(frozen=True)
class VerdictRules:
    """Verdict from held-out errors."""

    clear: float = rule(1.5, "error over the floor, pooled, up to which nothing is left; chosen", 1.25, 2.0)
    clear_sensor: float = rule(2.0, "the same of a single sensor; chosen", 1.6, 3.0)
    carried: float = rule(0.5, "of the excess error; derived: findings explain more than they leave", 0.3, 0.7)
    gross: float = rule(0.1, "of a sensor's power, left by what is no more a name; chosen: 30 % of it", 0.05, 0.2)
    rejected: float = rule(0.6, "error over the signal, of another vehicle than the file's; chosen", 0.45, 0.8)
    least: float = rule(2e-3, "error over the signal that sampling leaves of a perfect model; derived", 1e-3, 4e-3)
    spread: float = rule(4.0, "standard deviations of a level; derived: one in 16 000 leaves them", 3.0, 6.0)
    parts: int = rule(2, "changes of the structure that are named; chosen: more of them imitate any other", 1, 3)
    parts_leave: float = rule(
        0.02, "of the excess error, that one of them and values that are off may leave; chosen", 0.01, 0.05
    )
    slack: float = rule(1.5, "times a declared noise; chosen: a declaration is a round number", 1.2, 2.0)
    imitated: float = rule(
        0.01, "of the excess error, that laws may leave as a force of the motion; chosen: 10 % of a force", 0.005, 0.02
    )
    another_force: float = rule(
        0.5, "of what laws leave, left beside an unnamed force that they lack; chosen: most of it", 0.3, 0.7
    )


@dataclass(frozen=True)
class ReportRules:
    """Contents of a report beside the verdict."""

    naming_margin: float = rule(6.0, "evidence over look-alikes to be named alone; derived: odds of 20 to 1", 3.0, 10.0)
    changed: float = rule(0.25, "from nominal, at which a parameter is listed as changed; chosen", 0.15, 0.4)
    sure: float = rule(5.0, "deviations of a change that is reported; derived: no chance in any of 24 values", 4.0, 6.0)
    no_longer: float = rule(10.0, "times, by which what stood for a finding was read too high; chosen", 5.0, 20.0)
    alike: float = rule(0.5, "correlation from which a sign or scale is a likely reason; chosen", 0.3, 0.7)
    scale: float = rule(3.0, "ratio of sizes; chosen: no parameter explains it", 2.0, 5.0)
    far: float = rule(1.6, "log-ratio to nominal; chosen: a factor of 5, no rebuilt vehicle is as far off", 1.1, 2.3)
    stretches: int = rule(20, "of the spectrum, with misfits of their own; derived: a covariance needs some", 10, 40)
    bias: float = rule(0.01, "log-ratio by which a parameter was misread, that is reported; chosen", 0.005, 0.03)
    loose: float = rule(0.2, "standard deviation of a log-ratio of an undecided parameter; chosen", 0.1, 0.4)


@dataclass(frozen=True)
class ComponentRules:
    """Diagnosis of component tests."""

    search: int = rule(4000, "samples that trial shapes are compared on; chosen", 2000, 8000)
    fit: int = rule(16000, "samples of the final fit; chosen: few of them are independent", 8000, 32000)
    most: int = rule(3, "laws; chosen: real rigs have more imperfections than a record can name", 2, 4)
    per_signal: int = rule(2, "more for every signal; derived: spring and damper may follow it", 1, 3)
    alpha: float = rule(1e-3, "chance of a false finding per recording; chosen", 1e-4, 1e-2)
    significant: float = rule(2.0, "deviations that a law's force must exceed; derived: 5 % of chance", 1.0, 3.0)
    least_share: float = rule(0.2, "of the power still left that a further law must remove; chosen", 0.1, 0.4)
    minor: float = rule(0.003, "of the error's power, that a further law must remove; chosen", 1e-3, 0.01)
    naming_margin: float = rule(6.0, "evidence over look-alikes; derived: odds of 20 to 1", 3.0, 10.0)
    plain_cost: float = rule(6.0, "evidence over a commoner law that it contains; derived: odds of 20 to 1", 3.0, 10.0)
    hardly_more: float = rule(2.0, "times the power beyond noise that a law leaves; chosen: as close to it", 1.5, 3.0)
    trials_of_a_law: int = rule(10, "independent ones, of all its shapes; chosen: of some 10 to 40 in a grid", 5, 40)
    starts: int = rule(2, "trial shapes from which a law is refined; chosen", 1, 4)
    close: int = rule(6, "laws that are refined in every round; chosen", 4, 10)
    firsts: int = rule(3, "laws beside which a second is sought where none predicts better; chosen", 2, 5)
    declared: float = rule(0.02, "of the force, up to which a declared noise is believed; chosen", 0.01, 0.05)
    surface_serves: float = rule(0.9, "of the held-out power that an unnamed force may leave; chosen", 0.8, 0.97)
    named: float = rule(0.8, "of the excess power; chosen: laws that leave more are not the component's", 0.6, 0.9)
    together: float = rule(
        0.02, "of the excess power, that several laws may leave; chosen: true ones leave less", 0.01, 0.05
    )
    at_noise: float = rule(1.2, "of the power of the record's own noise; derived: a level's scatter", 1.1, 1.4)
    drift: float = rule(0.05, "of the record, within which a change is no drift but its beginning; chosen", 0.03, 0.1)
    drift_powers: int = rule(5, "of the time, of a zero that drifts; chosen: an amplifier that warms up", 3, 7)
    drift_turns: float = rule(4.0, "of the motion for each of them; derived: a drift is slower than a cycle", 3.0, 8.0)
    slow: int = rule(40, "slowest changes, among which a drift stands out; chosen: its powers are few", 30, 60)
    as_well: float = rule(1.05, "of the held-out power, up to which a plainer law serves as well; chosen", 1.02, 1.1)
    by_lag: float = rule(0.95, "of the excess power, that a late channel explains; chosen", 0.9, 0.98)
    above: float = rule(
        2.25, "times the floor's power, from which the fault is the channel's; derived: as the verdict", 1.5, 4.0
    )
    late: float = rule(
        0.1, "samples, from which a channel is late; derived: sampling at a time is no better", 0.05, 0.3
    )
    latest: float = rule(0.04, "s, of a late channel; chosen: filters and nodes of test benches", 0.02, 0.08)
    refined_latest: float = rule(
        1.4, "times that, up to which a refined delay is one; chosen: not its limit", 1.2, 1.49
    )
    stops: float = rule(
        0.2, "of the spring, that a stop of two sides is stiff; chosen: softer, it mends a law", 0.1, 0.4
    )
    lost: float = rule(0.05, "of the stiffness that a spring keeps within its gap; chosen", 0.02, 0.1)
    slips: float = rule(0.05, "of the time; chosen: what slips less has shown its gap only", 0.02, 0.1)
    lowest_knee: float = rule(0.3, "of the median rate; chosen: a valve that opens below acts as friction", 0.2, 0.5)
    knees: float = rule(
        0.5, "of the rate passed within a sample, that such a valve's is; derived: both knees lie within it", 0.3, 0.8
    )
    valve_least: float = rule(-0.02, "of the damping, left beyond a knee; derived: none, and its error", -0.1, 0.0)
    no_longer: float = rule(10.0, "times, by which a damping was read too high without a law; chosen", 5.0, 20.0)
    frame: float = rule(0.01, "of the rod's motion; chosen: a body that moves less is ground", 0.005, 0.02)
    moves: float = rule(2.0, "noise deviations by which a rod has to move; chosen: 1 is noise alone", 1.5, 3.0)
    rests: float = rule(0.004, "of the motion's deviation; chosen: less is standstill", 0.002, 0.008)
    rest: float = rule(0.25, "s that a standstill lasts; chosen: a turning point is shorter", 0.15, 0.5)
    stands_out: float = rule(3.0, "times the noise's power, that motion has; derived: 5 % of chance", 2.0, 5.0)
    turned: float = rule(3.0, "times what speaks for its sign, that speaks against it; chosen", 2.0, 5.0)
    preload: float = rule(5.0, "deviations of a preload that is reported; derived: one in a million", 3.0, 8.0)
    beside: int = rule(4, "trials that are refined beside the close laws; chosen", 2, 8)
    stands_clear: float = rule(
        300.0, "times the noise's power, of an acceleration that is integrated; chosen", 100.0, 1000.0
    )
    periods: float = rule(4.0, "of the slowest motion that an integral holds; derived: a level needs some", 3.0, 8.0)
    integral_settled: float = rule(1.5, "of those periods lost at either end; chosen", 1.0, 2.5)
    seen_to_fall: float = rule(0.25, "of a friction's fall with the rate, that it must show; chosen", 0.1, 0.5)
    turn: float = rule(0.05, "of the travel's range, that a turning point turns by; chosen", 0.02, 0.1)
    cycles: int = rule(6, "turning points of what repeats itself; derived: three cycles", 4, 10)
    still_samples: int = rule(25, "of a standstill; derived: its noise is then known to 14 %", 15, 50)
    cycles_alike: float = rule(0.8, "of the cycles, that must be; chosen: ends of a test differ", 0.6, 0.9)
    limits: float = rule(1.0, "times the range of every shape, as its law states it; chosen", 0.8, 1.1)
    surface: int = rule(16, "values that an unnamed force counts as; chosen: its splines have 80, smoothed", 8, 40)
    one_cycle: float = rule(0.1, "of a cycle's travel and duration, within which all are one; chosen", 0.05, 0.2)
    stretches: int = rule(20, "of the fitted part, with errors of their own; derived: a covariance needs some", 10, 40)
    another_curve: float = rule(
        0.5, "of what a sum of curves leaves, left beside one more; chosen: most of it", 0.3, 0.7
    )
    imitated: float = rule(
        0.005, "of the excess power, that laws may leave as a force of the motion; chosen: 7 % of a force", 0.002, 0.02
    )
    as_good: float = rule(
        1.1, "times the held-out power left by a law, that a look-alike may leave; chosen: of 1.07 and 1.22", 1.07, 1.2
    )
    another_force: float = rule(
        0.5, "of what laws leave, left beside an unnamed force that they lack; chosen: most of it", 0.3, 0.7
    )
    spikes: int = rule(20, "wrong values or pairs of a channel, to be left out; chosen: more are no exception", 10, 50)
    spike: float = rule(
        4.0, "times what is left between neighbours, that such a value is off; derived: a step leaves a third", 3.2, 6.0
    )
    spike_noise: float = rule(8.0, "deviations of the noise that it is off; derived: never by chance", 6.0, 12.0)
    formula_reach: float = rule(20.0, "times the usual size of a length or rate, either way; chosen", 10.0, 40.0)
    formula_partners: int = rule(3, "shapes of a formula that others are tried beside; chosen", 2, 5)
    formula_significant: float = rule(5.0, "deviations of an amplitude; derived: one in a million", 3.0, 8.0)
    formula_pair: float = rule(0.5, "of the held-out power of one shape, that two may leave; chosen", 0.3, 0.7)


@dataclass(frozen=True)
class AmbientRules:
    """Diagnosis without measured inputs."""

    alpha: float = rule(1e-4, "chance of a false variation over windows; chosen", 1e-5, 1e-3)
    varies: float = rule(0.02, "of a parameter's logarithm; derived: a hundredth of a frequency", 0.01, 0.04)
    spread: float = rule(4.0, "deviations of single windows by which most of them must differ; chosen", 2.0, 8.0)
    within: float = rule(0.7, "of the windows, over which a variation reaches; chosen: others are outliers", 0.5, 0.8)
    sure: float = rule(0.03, "deviation of a window that stands for the lowest or highest value; chosen", 0.015, 0.06)
    undetermined: float = rule(0.3, "deviation of a log-ratio from which a window is uninformative; chosen", 0.15, 0.5)
    coarse: float = rule(0.15, "of the power elsewhere by random errors, from which advice is given; chosen", 0.08, 0.3)
    rejected: float = rule(0.35, "of the power at other frequencies: another structure; chosen", 0.2, 0.6)
    blocks: int = rule(12, "of a recording, whose levels indicate a free decay; chosen", 8, 20)
    rise: float = rule(1.15, "of a level over the one before, up to which it still falls; chosen", 1.05, 1.3)
    fallen: float = rule(0.5, "of the first level that the last may have; chosen", 0.3, 0.7)
    least: float = rule(0.6, "of the recording that a decay must cover; chosen", 0.4, 0.8)
    spans: int = rule(100, "of a recording, in which the end of the motion is looked for; chosen", 50, 200)
    loud: float = rule(3.0, "level over the noise's, down to which a decay is followed; chosen", 2.0, 5.0)
    beyond: float = rule(1.2, "of the decay's length that is kept; chosen", 1.0, 1.5)
    over_noise: float = rule(2.0, "times the noise; derived: below, a falling level is the noise's", 1.5, 3.0)
    windows: int = rule(60, "of a structure that are evaluated; chosen: more add little", 30, 120)
    windows_track: int = rule(8, "of a vehicle on an unmeasured track; chosen", 5, 16)
    independent: int = rule(3, "windows for a scatter; derived: two have one difference", 3, 5)
    parts: int = rule(40, "of the band, in which powers are compared; chosen", 25, 60)
    followed: float = rule(
        0.1, "of the lowest frequency, deviation of a window that shows its range; chosen", 0.05, 0.2
    )


@dataclass(frozen=True)
class Rules(RuleTable):
    """The rules of every stage, in the order in which they decide."""

    record: RecordRules = RecordRules()
    white_noise: WhiteNoiseRules = WhiteNoiseRules()
    fit: FitRules = FitRules()
    setup: SetupRules = SetupRules()
    screening: ScreeningRules = ScreeningRules()
    evidence: EvidenceRules = EvidenceRules()
    selection: SelectionRules = SelectionRules()
    plausible: PlausibleRules = PlausibleRules()
    acceptance: AcceptanceRules = AcceptanceRules()
    formula: FormulaRules = FormulaRules()
    noise: NoiseRules = NoiseRules()
    verdict: VerdictRules = VerdictRules()
    report: ReportRules = ReportRules()
    component: ComponentRules = ComponentRules()
    ambient: AmbientRules = AmbientRules()
    ambient_window: AmbientWindowRules = WINDOW_RULES


RULES = Rules()
