"""Windows of a system whose file has laws: maximum likelihood with the non-linear model inside.

Gauss-Newton as in `refinement.refine`, with columns from forward sensitivities along the window's own motion
(`nonlinear.window`).  Beside the linear parameters the laws' values that are not fixed are estimated, as
logarithms of ratios to the file, the loads where they are asked for, and the memories at the first sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from sprung.model.chunks import alike, share
from sprung.model.identification.likelihood.linearise import WindowModel
from sprung.model.identification.measurements.calibration import DeviationSensitivity
from sprung.model.identification.nonlinear.forces import ActiveLaw
from sprung.model.identification.nonlinear.search import ITERATIONS, LawSearch
from sprung.model.identification.nonlinear.window import LawWindows
from sprung.model.identification.refinement.refine import Refined, in_order
from sprung.model.identifier import UnusableWindow
from sprung.model.laws import ElementLaw, SensorLaw, StructureLaw
from sprung.model.laws.in_place import is_linear
from sprung.model.signals import BoolArray, FloatArray, IntArray
from sprung.model.system import System
from sprung.model.work import WorkBudget

_CHUNK = 96  # windows times laws that are processed together: memory grows with both
_PILOT_WINDOWS = 8  # windows that are identified first to start the others, in batches of at least
_MANY = 24  # windows
_FITS = 1.5  # reduced chi-square of a well fitted window, generously
_ENOUGH = 3  # well fitted windows are needed to start the others from their median


def acting_laws(system: System) -> list[ActiveLaw]:
    """The laws that windows are identified with.  Errors: `UnusableWindow` for a law that windows do not support."""
    found = []
    for placed in system.laws:
        law = placed.law
        if isinstance(law, SensorLaw) or is_linear(placed):
            continue  # undone in the signals; part of the mechanics
        if not isinstance(law, ElementLaw) or law.memory > 1 or law.over_time:
            followed = ": what changes over time is tracked" if isinstance(law, ElementLaw) and law.over_time else ""
            raise UnusableWindow(
                f"{placed.location}: windows cannot be identified with {law.name} in place, which diagnose, simulate "
                f"and compare can use; take it out of the file{followed}"
            )
        at = [system.elements.index(name) for name in placed.places]
        for group in [at] if law.where == "pair" else [[e] for e in at]:
            weights = np.zeros(len(system.whole_system.mechanics.stiffness))
            weights[group[0]] = 1.0
            if len(group) == 2:
                weights[group[1]] = -1.0
            free = tuple(i for i, (v, f) in enumerate(zip(placed.values, placed.fixed, strict=True)) if v > 0 and not f)
            found.append(ActiveLaw(placed, law, weights, group[0], free))
    return found


def without_laws(system: System) -> System:
    """The system without the laws along its elements; those of its structure and bodies are part of its mechanics."""
    of_structure = {law.name for law in system.catalogue if isinstance(law, StructureLaw)}
    bare = {
        name: element.model_copy(update={"laws": tuple(law for law in element.laws if set(law) <= of_structure)})
        for name, element in system.file.elements.items()
    }
    return System(
        system.file.model_copy(update={"elements": bare}),
        system.catalogue,
        whole=True,
        as_drawn=True,
        lost=system.lost,
    )


class LawRefiner:
    """Gauss-Newton for one system with laws and one window length; see `refinement.refine.Refiner`."""

    def __init__(
        self, system: System, samples: int | None = None, workers: int = 1, work: WorkBudget | None = None
    ) -> None:
        """work: where it has ended windows are left as they are."""
        self.system, self.workers, self.work = system, workers, work or WorkBudget()
        self.laws, bare = acting_laws(system), without_laws(system)
        self.model = WindowModel(bare, samples or system.window)
        self.calibration = DeviationSensitivity(self.model)
        self._windows: dict[bool, LawWindows] = {}

    def refine(
        self,
        windows: FloatArray,
        start: FloatArray | None = None,
        *,
        iterations: int = ITERATIONS,
        states: bool = False,
        loads: bool = False,
        built: bool = False,  # where laws act bodies are as the file says
        weigh: BoolArray | None = None,
    ) -> Refined:
        """Refine from log-ratios `start` (B, `system.tracked`), those of the file by default; see `Refiner.refine`."""
        P = len(self.system.tracked)
        begin = np.zeros((len(windows), P))
        if start is not None:
            begin[:, : start.shape[1]] = start
        wanted: BoolArray = np.zeros(len(windows), dtype=bool) if weigh is None else np.asarray(weigh)
        present: BoolArray = ~np.asarray(np.isnan(windows[:, :, len(self.system.inputs) :]).any(axis=1))
        model = self._with(loads)

        def search(at: IntArray, warm: bool) -> Refined:
            # forces that leave all bounds are reported as such
            with torch.no_grad(), np.errstate(over="ignore", invalid="ignore"):
                data = self.model.batch(self.model.knots(windows[at]), windows[at], present[at[0]])
                asked = torch.as_tensor(wanted[at]), bool(wanted.any())
                search = LawSearch(model, self.calibration, data, begin[at], *asked, self.work)
                found = search.run(states, warm, iterations)
                return replace(found, excitation=self.model.excitation(windows[at]))

        def refined(of: IntArray, warm: bool) -> Refined:
            pieces = self._pieces(present, of)
            return in_order(share(partial(search, warm=warm), pieces, self.workers), np.concatenate(pieces))

        if start is not None or len(windows) < _MANY:
            found = refined(np.arange(len(windows)), start is not None)
        else:
            found = _from_pilots(begin, refined, P)
        return _badly_fitted_again(begin, found, refined, P)

    def _pieces(self, present: BoolArray, of: IntArray) -> list[IntArray]:
        """Windows `of` in pieces with the same sensors that fit into memory; present: of each window, (B, S)."""
        return [
            np.asarray(part)
            for group in alike(present, of)
            for part in np.array_split(group, max(1, -(-len(group) * len(self.laws) // _CHUNK)))
        ]

    def _with(self, loads: bool) -> LawWindows:
        if loads not in self._windows:
            self._windows[loads] = LawWindows(self.model.system, self.laws, self.model, loads)
        return self._windows[loads]


def _from_pilots(begin: FloatArray, refined: Callable[[IntArray, bool], Refined], P: int) -> Refined:
    """All windows, of which a few pilots determine where the others start, in rows of `begin` (B, P).

    refined: the refinement of some windows, and whether their start is a warm one, near the maximum.
    """
    everything = np.arange(len(begin))
    pilots = np.linspace(0, len(begin) - 1, _PILOT_WINDOWS).astype(int)
    others = np.setdiff1d(everything, pilots)
    first = refined(pilots, False)
    warm = _start_from_well_fitted(begin, others, first, P)
    return in_order([first, refined(others, warm)], np.concatenate([pilots, others]))


def _badly_fitted_again(
    begin: FloatArray, found: Refined, refined: Callable[[IntArray, bool], Refined], P: int
) -> Refined:
    """Windows that do not fit started again from those that do; the better result of each."""
    bad = np.flatnonzero(~_well_fitted(found))
    if not _start_from_well_fitted(begin, bad, found, P) or not len(bad):
        return found
    again = refined(bad, True)
    better = again.chi_square < found.chi_square[bad]
    return found.replaced(bad[better], again.take(np.flatnonzero(better)))


def _well_fitted(found: Refined) -> BoolArray:
    """Whether windows have converged to a good fit, (B,)."""
    return np.asarray(found.converged & (found.chi_square < _FITS))


def _start_from_well_fitted(begin: FloatArray, at: IntArray, found: Refined, P: int) -> bool:
    """Start windows `at` from the median of the well fitted ones; False: there are too few of those."""
    good = _well_fitted(found)
    if good.sum() < _ENOUGH:
        return False
    begin[at] = np.median(found.log_ratio[good, :P], axis=0)
    return True
