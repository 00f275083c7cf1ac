"""Pictures of a comparison: time and spectra of the worst sensors, and the elements' force loops."""

from __future__ import annotations

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from scipy import signal

from sprung.model.schema import ElementSensor
from sprung.model.signals import FloatArray
from sprung.service.report import ink
from sprung.service.report.recordings import Comparison

SHOWN = 4  # sensors
LOOPS = 4  # elements
EXCERPT = 600  # samples drawn in time


def signals_figure(found: Comparison) -> Figure:
    """Rows: the sensors that fit worst; left an excerpt in time, right the spectra of signal, simulation and error."""
    nrmse = np.nan_to_num(found.nrmse, nan=-1.0)
    worst = [int(i) for i in np.argsort(-nrmse)[:SHOWN] if nrmse[i] >= 0]
    units = [c.unit for c in found.system.channels[len(found.system.inputs) :]]
    with rc_context(ink.RC):
        figure = ink.new_figure(10.5, 2.6 * max(len(worst), 1))
        grid = figure.subplots(max(len(worst), 1), 2, squeeze=False, gridspec_kw={"width_ratios": [1.5, 1]})
        for sensor, (left, right) in zip(worst, grid, strict=False):
            measured, simulated = found.measured[:, sensor], found.simulated[:, sensor]
            lines = [
                (measured, ink.MEASURED, found.names[0]),
                (simulated, ink.AFTER, found.names[1]),
                (measured - simulated, ink.BEFORE, "error"),
            ]
            rows = ink.excerpt(measured - simulated, EXCERPT)
            for values, colour, label in lines:
                left.plot(found.time[rows], values[rows], color=colour, lw=1.0, label=label)
                f, power = signal.welch(np.nan_to_num(values), found.system.sample_rate, nperseg=min(1024, len(values)))
                right.loglog(f[1:], np.sqrt(power[1:]) + 1e-300, color=colour, lw=1.0)
            left.set_title(f"{found.system.sensors[sensor]} [{units[sensor]}]: error {100 * nrmse[sensor]:.1f} %")
            right.set_title("amplitude density")
        grid[0][0].legend(loc="upper right", ncols=3, fontsize=8)
        grid[-1][0].set_xlabel("time [s]")
        grid[-1][1].set_xlabel("frequency [Hz]")
    return figure


def loops_figure(found: Comparison) -> Figure | None:
    """Force over deflection and over rate of the elements with laws, or of the largest forces; None without a ride."""
    if found.ride is None:
        return None
    ride, system = found.ride, found.system
    with_laws = [name for law in system.laws for name in law.places if name in system.elements]
    size = np.sqrt(np.mean(ride.force**2, axis=0))
    ranked = [system.elements[i] for i in np.argsort(-size)]
    chosen = list(dict.fromkeys([*with_laws, *ranked]))[:LOOPS]
    with rc_context(ink.RC):
        figure = ink.new_figure(10.5, 2.6 * len(chosen))
        for row, (name, axes) in enumerate(zip(chosen, figure.subplots(len(chosen), 2, squeeze=False), strict=True)):
            at = system.elements.index(name)
            measured = _measured_force(found, name)
            for column, (ax, motion, unit) in enumerate(
                zip(axes, (ride.deflection[:, at], ride.rate[:, at]), ("deflection [mm]", "rate [mm/s]"), strict=True)
            ):
                if measured is not None:
                    ax.plot(1e3 * motion, measured, ",", color=ink.MEASURED, label="measured")
                ax.plot(1e3 * motion, ride.force[:, at], color=ink.AFTER, lw=0.7, label="simulated")
                if column == 0:
                    ax.set_title(f"{name}: force [N]")
                if row == len(chosen) - 1:
                    ax.set_xlabel(unit)
        figure.axes[0].legend(loc="upper left", fontsize=8)
    return figure


def _measured_force(found: Comparison, element: str) -> FloatArray | None:
    for i, (_, sensor) in enumerate(found.system.file.sensors.items()):
        if isinstance(sensor, ElementSensor) and sensor.kind == "force" and sensor.element == element:
            measured: FloatArray = found.measured[:, i]
            return measured
    return None
