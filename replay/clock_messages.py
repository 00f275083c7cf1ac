"""Messages to the user about the clock of a recording, once it is cut into windows."""

from __future__ import annotations

from datetime import UTC, datetime

from sprung.replay.windowing import Windower

STRAY = {  # what `StreamAccount.reasons` calls samples that belong to no window, and the message to users
    "late": "too late",
    "stray time stamp": "at times of which no others are",
    "too many samples for their time": "at nearly the same time",
}
LONGEST_PAUSE = 30 * 86_400.0  # s; a longer pause within one recording is a clock that was wrong


def remarks(windower: Windower, windows: int) -> list[str]:
    """One line each; none when the clock ran on and windows could be made.  `windows`: how many came of it."""
    lines = []
    back = [jump for jump in windower.account.jumps if jump.seconds < 0]
    ahead = [jump for jump in windower.account.jumps if jump.seconds > LONGEST_PAUSE]
    for jumps, verb in ((back, "steps back"), (ahead, "leaps ahead")):
        if jumps:
            times = f"{len(jumps)} times, first " if len(jumps) > 1 else ""
            lines.append(f"the clock {verb} {times}by {_span(jumps[0].seconds)}, to {_iso(jumps[0].at)}")
    if not windows:
        lines.append(_none(windower))
    return lines


def pauses(windower: Windower) -> list[str]:
    """One line where nothing came for a while, or the clock leapt ahead; nothing that was recorded is missing."""
    found = [jump for jump in windower.account.jumps if 0 < jump.seconds <= LONGEST_PAUSE]
    if not found:
        return []
    longest = max(found, key=lambda jump: jump.seconds)
    times = "once" if len(found) == 1 else f"{len(found)} times"
    which = "" if len(found) == 1 else "the longest "
    return [
        f"nothing for more than {windower.pause:g} s, {times}: {which}{_span(longest.seconds)} until {_iso(longest.at)}"
    ]


def _none(windower: Windower) -> str:
    """Why no window could be made at all."""
    needed = windower.window / windower.sample_rate
    stretches = len(windower.account.jumps) + 1
    among = "" if stretches == 1 else f" without a jump of the clock, among {stretches},"
    lost = ", ".join(
        f"{windower.account.reasons[name]} samples {words}"
        for name, words in STRAY.items()
        if windower.account.reasons[name]
    )
    return (
        f"no window can be made of {windower.account.samples} samples: a window needs {needed:.3g} s, "
        f"their longest stretch{among} is {windower.account.longest:.3g} s{', ' + lost if lost else ''}"
    )


def _span(seconds: float) -> str:
    size = abs(seconds)
    for limit, unit, name in ((120.0, 1.0, "s"), (7_200.0, 60.0, "min"), (172_800.0, 3600.0, "h")):
        if size < limit:
            return f"{size / unit:.3g} {name}"
    days = size / 86_400.0
    return f"{days:.4g} days" if days < 1000.0 else f"{days / 365.25:.4g} years"


def _iso(time: int) -> str:
    return datetime.fromtimestamp(time / 1e9, tz=UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
