"""Numbers that decide whether a window without measured inputs is informative, and whether it is explained."""

from __future__ import annotations

from dataclasses import dataclass

from sprung.model.rule import rule


@dataclass(frozen=True)
class AmbientWindowRules:
    """Band, information and adequacy of windows."""

    lowest: float = rule(0.75, "of the lowest mode, where the band begins; chosen: half its resonance", 0.6, 0.9)
    highest: float = rule(0.36, "of the sample rate, where it ends; derived: anti-aliasing filters", 0.3, 0.4)
    periods: float = rule(4.0, "of the band's lower edge in a window; chosen: leakage of tapers", 3.0, 6.0)
    excess: float = rule(4.0, "power over noise, below which a sensor is uninformative; chosen", 2.0, 8.0)
    octaves: float = rule(1.0, "of band, below which a window is uninformative; chosen", 0.7, 1.5)
    groups: int = rule(12, "of bins, the same; chosen: more than there are levels", 8, 20)
    identifiable: float = rule(0.3, "deviation of a log-ratio that is identified; chosen: a third of a prior", 0.2, 0.5)
    sigmas: float = rule(6.0, "of chi-square, beyond which a window does not fit; derived: no chance", 4.0, 8.0)
    inaccuracy: float = rule(0.3, "of chi-square, at least the same; chosen: a track is no model", 0.2, 0.5)
    below: float = rule(0.5, "of the lowest mode, where bins without taper begin; chosen: its flank", 0.35, 0.7)
    above: float = rule(2.0, "times the highest mode, where they end; chosen: its flank", 1.5, 3.0)
    nyquist: float = rule(0.4, "of the sample rate, the same; derived: anti-aliasing filters", 0.36, 0.44)
    bins: int = rule(12, "of them at least; chosen: more than there are levels", 8, 20)
    parts: int = rule(8, "of the band, in which a fit is judged; chosen: a mode's width", 5, 12)
    misjudged: float = rule(1e-4, "chance of a good fit that counts as bad; chosen: one window in 10 000", 1e-5, 1e-3)
    usual: float = rule(2.5, "deviations of the worst part of a good fit; derived: of 8 normal ones", 2.0, 3.0)
    slowest: float = rule(8.0, "m/s; derived: below, wheels are too far apart in time for a window", 6.0, 12.0)


WINDOW_RULES = AmbientWindowRules()
