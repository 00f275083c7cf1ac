"""The jacobian of a fit, column by column."""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.fit.tangent import line_load
from sprung.model.diagnosis.fit.whitening import Whitener
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.signals import FloatArray


class JacobianColumns:
    """The Jacobian as whitened real numbers, each column contiguous in memory."""

    def __init__(self, forward: Forward, whitener: Whitener, count: int) -> None:
        grid = forward.part.grid
        band = grid.band
        self.band, self.forward = band, forward
        weighted = whitener.factor * grid.weight[:, None, None]
        shown = forward.sensor_factor[band, :, None]
        self.of_shown = weighted
        along = weighted @ (forward.plant.sensor_of_force[band] * shown)
        self.of_force = np.ascontiguousarray(along.transpose(2, 0, 1))
        size = weighted.shape[0] * weighted.shape[1]
        self.half = size
        self.store = np.zeros((count, 2 * size))

    @property
    def jacobian(self) -> FloatArray:
        """(2 F S, columns)."""
        return self.store.T

    @property
    def whitened(self) -> ComplexArray:
        """All columns as whitened spectra, (F, S, columns)."""
        weight = self.forward.part.grid.weight[:, None, None]
        shape = (self.band.stop, -1, len(self.store))
        spectra = (self.store[:, : self.half] + 1j * self.store[:, self.half :]).T.reshape(shape) / weight
        return np.asarray(spectra, dtype=complex)

    def _add(self, column: int, whitened: ComplexArray) -> None:
        self.store[column, : self.half] += whitened.real.ravel()
        self.store[column, self.half :] += whitened.imag.ravel()

    def add_force(self, column: int, element: int, force: ComplexArray) -> None:
        """Response to a force along an element, (F,)."""
        plant = self.forward.plant
        if plant.floats:
            rest, line = plant.without_line(force[:, None])
            unit = np.eye(len(plant.structure.H))[element]
            motion = np.einsum("k,kpn->pn", line[:, 0], plant.line_motion(unit))
            self._add_polynomial(column, motion, line_load(line) * unit)
            force = rest[:, 0]
        self._add(column, self.of_force[element] * force[self.band, None])

    def _add_polynomial(self, column: int, motion: FloatArray, force: FloatArray | float = 0.0) -> None:
        """Shown sensor signals of a polynomial motion, and of a polynomial force along the elements."""
        plant = self.forward.plant
        still = np.zeros((motion.shape[0], plant.structure.G.shape[1]))
        seen = plant.grid.monomial_spectra @ plant.polynomial_sensors(motion, still, force)
        self.add_shown(column, seen * self.forward.sensor_factor)

    def add_port(self, column: int, port: FloatArray, force: ComplexArray) -> None:
        """Response to a force along a port."""
        for element in np.flatnonzero(port):
            self.add_force(column, int(element), port[element] * force)

    def add_load(self, column: int, load: ComplexArray) -> None:
        """Response to loads on the degrees of freedom, (F, n)."""
        plant, band = self.forward.plant, self.band
        if plant.floats:
            load, line = plant.without_line(load)
            self._add_polynomial(column, plant.polynomial_response(line_load(line)))
        shown = np.einsum("fsn,fn->fs", plant.sensor_of_load[band], load[band]) * self.forward.sensor_factor[band]
        self._add(column, (self.of_shown @ shown[:, :, None])[:, :, 0])

    def add_shown(self, column: int, shown: ComplexArray) -> None:
        """A change of the shown signals, (F, S)."""
        self._add(column, (self.of_shown @ shown[self.band][:, :, None])[:, :, 0])

    def add_free(self, first: int, free: ComplexArray) -> None:
        """Free motions, (F, S, 2n)."""
        whitened = np.ascontiguousarray((self.of_shown @ free[self.band]).transpose(2, 0, 1))
        for i, column in enumerate(whitened):
            self._add(first + i, column)
