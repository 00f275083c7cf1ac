"""Channels that contradict each other, and which exchange or reversed sign ends the contradiction.

Accelerometers of one rigid body outnumber its motions, and displacement and velocity of a support are one motion: what
such channels read satisfies linear relations, whatever springs, dampers and loads are.  A relation is a row over the
channels; with the Gram matrix G of the channels' spectra, its violation with channels exchanged or reversed (a signed
permutation P) is r P G P' r', so that all candidates cost one small product each.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch

from sprung.model.identification.likelihood.linearise import as_rows
from sprung.model.identification.measurements.calibration import DeviationSensitivity
from sprung.model.signals import BoolArray, FloatArray, IntArray, MeasurementFault

CONTRADICTED = 2.0  # mean square of a relation in units of its noise, at least
SIZEABLE = 0.06**2  # of the power of the channels in it, at least: gains that are off leave less
ENDED = 0.1  # of the violation beyond noise that may remain


@dataclass(frozen=True, slots=True)
class Rearrangement:
    """One channel with its sign reversed, or two exchanged."""

    columns: tuple[int, ...]

    @classmethod
    def of(cls, fault: MeasurementFault, names: list[str]) -> Rearrangement | None:
        """That of a reversed channel or of two exchanged ones; None where several were named, one of which it is."""
        columns = tuple(names.index(name) for name in fault.channel.split("|"))
        return cls(columns) if len(columns) == (1 if fault.kind == "inverted" else 2) else None

    def undone(self, windows: FloatArray) -> FloatArray:
        """Windows (..., C) as they would be without it."""
        out, columns = windows.copy(), list(self.columns)
        out[..., columns] = -windows[..., columns] if len(columns) == 1 else windows[..., columns[::-1]]
        return out

    def fault(self, names: list[str]) -> MeasurementFault:
        """In terms of the channels, whose names are given in their order."""
        if len(self.columns) == 1:
            return MeasurementFault(names[self.columns[0]], "inverted", -1.0)
        return MeasurementFault("|".join(names[c] for c in self.columns), "swapped", 0.0)


def rearrangements(alike: IntArray) -> tuple[Rearrangement, ...]:
    """Every reversed sign, and every exchange of two channels of one number in `alike`, (C,)."""
    pairs = [pair for pair in combinations(range(len(alike)), 2) if alike[pair[0]] == alike[pair[1]]]
    return tuple(Rearrangement(columns) for columns in [*((c,) for c in range(len(alike))), *pairs])


@dataclass(frozen=True, slots=True)
class _Relations:
    """X linear relations between C channels, and B windows of these."""

    rows: FloatArray  # in units of noise, (X, C)
    gram: FloatArray  # products of the channels' spectra, (B, C, C)
    freedom: FloatArray  # numbers that a relation is compared in, (X,)

    def violation(self, rows: FloatArray) -> FloatArray:
        """Squares that rows (X, C) leave, in units of noise, (B, X)."""
        return np.asarray(np.einsum("bxc,xc->bx", rows @ self.gram, rows))

    @property
    def violated(self) -> BoolArray:
        """Which are violated by more than noise and gains, (B, X)."""
        violation = self.violation(self.rows)
        power = np.einsum("bcc->bc", self.gram) @ (self.rows**2).T
        return np.asarray((violation > CONTRADICTED * self.freedom) & (violation > SIZEABLE * power))


class Contradictions:
    """Of the channels of one system, in windows of one length."""

    def __init__(self, calibration: DeviationSensitivity, alike: IntArray) -> None:
        """alike: number (C,) of the channels' unit; channels of one number, or of one support, may be exchanged."""
        self.calibration = calibration
        self.inputs = calibration.inputs
        self.candidates = rearrangements(alike)

    def contradicted(self, windows: FloatArray) -> BoolArray:
        """Whether channels contradict each other in windows (B, T, C), shape (B,)."""
        found = np.zeros(len(windows), dtype=bool)
        there = np.asarray(~np.isnan(windows).any(axis=1))
        for alike in np.unique(there, axis=0):
            at = np.flatnonzero((there == alike).all(axis=1))
            found[at] = self._relations(windows[at], alike[self.inputs :]).violated.any(axis=1)
        return found

    def ended_by(self, window: FloatArray) -> tuple[Rearrangement, ...]:
        """What ends the contradictions of a window (T, C): none where there is none, or nothing does."""
        (present,) = self._present(window[None])
        relations = self._relations(window[None], present)
        (violated,) = relations.violated
        if not violated.any():
            return ()
        noise = float(relations.freedom.sum())
        enough = noise + ENDED * (float(relations.violation(relations.rows).sum()) - noise)
        concerned = np.flatnonzero((relations.rows[violated] != 0).any(axis=0))
        absent = self.inputs + np.flatnonzero(~present)
        ends = tuple(
            c
            for c in self.candidates
            if np.isin(c.columns, concerned).any()
            and not np.isin(c.columns, absent).any()
            and relations.violation(c.undone(relations.rows)).sum() < enough
        )
        return ends + tuple(c for c in self._crossed(relations, violated) if self._left(c.undone(window)) < enough)

    def _crossed(self, relations: _Relations, violated: BoolArray) -> list[Rearrangement]:
        """Exchanges of two quantities of one support whose relation is violated: they are of different units."""
        inputs = [np.flatnonzero(row[: self.inputs]).tolist() for row in relations.rows[violated]]
        return [Rearrangement(pair) for columns in inputs for pair in combinations(columns, 2)]

    def _left(self, window: FloatArray) -> float:
        """What channels of a window (T, C) contradict each other by, in units of noise."""
        relations = self._relations(window[None], self._present(window[None])[0])
        return float(relations.violation(relations.rows).sum())

    def _present(self, windows: FloatArray) -> BoolArray:
        return np.asarray(~np.isnan(windows[:, :, self.inputs :]).any(axis=1))

    def _relations(self, windows: FloatArray, present: BoolArray) -> _Relations:
        """Of sensors that are `present`, (S,), and of inputs of one support none of which is lost in any window."""
        redundancy, first = self.calibration.redundancy, self.inputs
        sensors = first + np.flatnonzero(present)
        of_sensors, of_inputs = self.calibration.dropped(present).numpy(), redundancy.relations(first)
        lost = np.isnan(windows[:, :, :first]).any(axis=(0, 1))
        if lost.any():
            of_inputs = of_inputs[~(of_inputs[:, lost] != 0).any(axis=1)]
            windows = np.concatenate([np.where(lost, 0.0, windows[:, :, :first]), windows[:, :, first:]], axis=2)
        rows = np.zeros((len(of_sensors) + len(of_inputs), windows.shape[2]))
        gram = np.zeros((len(windows), windows.shape[2], windows.shape[2]))
        freedom = np.zeros(len(rows))
        if len(of_sensors):
            rows[: len(of_sensors), sensors] = of_sensors
            spectra = as_rows(self.calibration.bins(torch.as_tensor(windows[:, :, sensors])).unsqueeze(2))
            gram[:, sensors[:, None], sensors] = (spectra @ spectra.mT).numpy()
            freedom[: len(of_sensors)] = spectra.shape[2]
        if len(of_inputs):
            rows[len(of_sensors) :, :first] = of_inputs
            parts = redundancy.parts(windows[:, :, :first], self.calibration.bins)
            gram[:, :first, :first] = parts @ parts.transpose(0, 2, 1)
            freedom[len(of_sensors) :] = parts.shape[2] / 2  # of two measurements half is left
        return _Relations(rows, gram, freedom)
