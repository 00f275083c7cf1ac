"""Look-alikes: other laws that explain a record almost as well as one that was found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sprung.model.diagnosis.component.drifting import with_drift_instead
from sprung.model.diagnosis.force.deviations import moved_in_common
from sprung.model.diagnosis.force.fit import ComponentFit, fitted, refined
from sprung.model.diagnosis.force.lag import LAGS, Lag
from sprung.model.diagnosis.force.low_valve import low_valve
from sprung.model.diagnosis.force.parts import Part
from sprung.model.diagnosis.force.piece import Piece
from sprung.model.diagnosis.force.pieces import INERTIA
from sprung.model.diagnosis.force.ranking import Step, plausible
from sprung.model.diagnosis.selection.evidence import effective_count, level_gain
from sprung.model.signals import FloatArray


@dataclass(frozen=True)
class EquivalentModel:
    """A model with one law replaced by another, or by another form of it."""

    index: int
    fit: ComponentFit
    found: ComponentFit  # the model that was found, on the same samples

    @property
    def effect(self) -> str:
        return self.fit.model.pieces[self.index].effect

    @property
    def moved(self) -> FloatArray:
        """Differences of the values that both models share, in the order of `covariance`."""
        return moved_in_common(self.fit, self.found)


def look_alikes(final: ComponentFit, steps: Sequence[Step], first: int) -> tuple[EquivalentModel, ...]:
    """Look-alikes of the laws of a model, which were found in `steps` and begin at index `first`.

    These are the laws of almost the same evidence.  If the model leaves more than noise it is not exact, and evidence
    ranks approximations, not truths: laws that leave hardly more error are then included.
    """
    task = final.task.thinned(final.task.rules.search)
    here, found = refined(task, final.model), []
    for index, step in enumerate(steps, first):
        valve = low_valve(here, index)
        found += [EquivalentModel(index, valve, here)] if valve is not None and _as_well(valve, here) else []
        drift = with_drift_instead(here, index)
        found += [EquivalentModel(index, drift, here)] if drift is not None and _as_well(drift, here) else []
        near = step.chosen.evidence - task.rules.naming_margin
        for other in (*step.rivals, *step.forms):
            if other.evidence > near or here.leaves_more:
                model = final.model.replaced(index, other.last, other.fit.model.shapes[-1])
                one = EquivalentModel(index, refined(task, model), here)
                found += (
                    [one] if other.evidence > near or (plausible(one.fit, index) and _as_well(one.fit, here)) else []
                )
        early = _early_instead(here, index)
        if early is not None and _as_well(early, here):
            one = EquivalentModel(index, early, here)
            found += [one] if all((other.index, other.effect) != (index, one.effect) for other in found) else []
    return tuple(found)


def _early_instead(fit: ComponentFit, index: int) -> ComponentFit | None:
    """The fit with an inertia in place of a force that comes early, or the reverse; None in place of other laws.

    A damper's force that comes early differs by damping x acceleration for every second, to first order in the time.
    It is tried although an inertance as small as that may not be determined: its motion is differentiated twice.
    """
    task, model, piece = fit.task, fit.model, fit.model.pieces[index]
    if isinstance(piece, Lag) and not piece.filters and model.shapes[index][0] < 0:
        return refined(task, model.replaced(index, INERTIA, ()))
    if piece is not INERTIA or any(isinstance(one, Lag) for one in model.pieces):
        return None
    delay, *_ = LAGS
    early = [(float(time),) for time in delay.grid(task.seen)[:, 0] if time < 0]
    fits = (fitted(task, model.replaced(index, delay, shape)) for shape in early)
    return refined(task, min(fits, key=lambda one: one.error).model)


def gives_way(final: ComponentFit, piece: Part) -> bool:
    """Whether a lag of the force may be a damper that gives way: oil or rubber behind a valve delays its force, too.

    Where the motion is slow beside the lag, both turn the phase of the force alike, and differ in its size by the
    square of that angle; a valve or friction beside them takes up the rest.
    """
    others = [one for one in final.model.pieces if isinstance(one, Piece)]
    return isinstance(piece, Lag) and any(one.dissipates or one.law.knees for one in others)


def _as_well(other: ComponentFit, found: ComponentFit) -> bool:
    rules, task = found.task.rules, found.task
    behind = level_gain(other.error, found.error, effective_count(found.residual[: task.split]))
    if behind < rules.naming_margin or other.at_noise:
        return True
    return found.leaves_more and other.leaves_hardly_more(found)
