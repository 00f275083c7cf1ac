"""The drives of a system, its moving supports and forces, from the columns of a window that measure them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.schema import ForceInput, SupportInput
from sprung.model.signals import FloatArray
from sprung.model.simulate.fusion import motion, motion_noise, motion_shares, used
from sprung.model.system import System

UNMEASURED = (1.0, 1e6)  # m and N, of a support and a force whose channels are all lost: more than moves any vehicle
ORDERS = {"displacement": 0, "velocity": 1, "acceleration": 2, "force": 0}  # derivatives that a quantity shows


@dataclass(frozen=True)
class Drive:
    """One moving support or force; nothing is measured of a wheel on a track, nor where all channels are lost."""

    support: bool
    columns: dict[int, int]  # window column by the derivative that it shows
    noise: dict[int, float]  # standard deviation of one sample, likewise, of the channels that are not lost

    @property
    def lost(self) -> bool:
        """Whether it has channels, all of which are lost."""
        return bool(self.columns) and not self.noise

    @property
    def integrated(self) -> int:
        """Number of integrations from the measured quantity to displacement."""
        return used(self.noise)[0] if self.noise else 0

    def noise_at(self, omega: FloatArray, dt: float) -> FloatArray:
        """Noise of the value per sample as a standard deviation over frequency, (F,)."""
        if not self.noise:
            return np.full(len(omega), UNMEASURED[0 if self.support else 1] if self.lost else 0.0)
        return motion_noise(omega, dt, self.noise)

    def shares_at(self, omega: FloatArray, dt: float) -> dict[int, FloatArray]:
        """Share of every measured derivative in the value over frequency, each (F,)."""
        found = motion_shares(omega, dt, self.noise) if self.noise else {}
        return {order: found.get(order, np.zeros(len(omega))) for order in self.columns}


def drives_of(system: System) -> tuple[Drive, ...]:
    """The drives, in the order of the file's inputs."""
    drives = []
    at = 0
    for source in system.file.inputs.values():
        if isinstance(source, ForceInput):
            quantities = ["force"]
        else:
            quantities = list(source.measured) if isinstance(source, SupportInput) else []
        columns = {ORDERS[quantity]: at + i for i, quantity in enumerate(quantities)}
        at += len(columns)
        channels = {order: system.inputs[column] for order, column in columns.items()}
        drives.append(
            Drive(
                support=not isinstance(source, ForceInput),
                columns=columns,
                noise={order: channel.noise for order, channel in channels.items() if channel.name not in system.lost},
            )
        )
    return tuple(drives)


def knots(system: System, windows: FloatArray) -> FloatArray:
    """Values and slopes of all drives at the samples, (B, T, W) = [value, slope, value, slope, ...].

    windows: (B, T, C), of which the inputs' columns are read.  See `model.simulate.fusion` for what becomes of them.
    """
    drives = drives_of(system)
    out = np.empty((*windows.shape[:2], 2 * len(drives)))
    alike: dict[tuple[tuple[int, float], ...], list[int]] = {}
    for i, drive in enumerate(drives):
        alike.setdefault(tuple(sorted(drive.noise.items())), []).append(i)
    for key, members in alike.items():
        orders = [order for order, _ in key]
        if not orders:
            out[:, :, [column for i in members for column in (2 * i, 2 * i + 1)]] = 0.0
            continue
        measured = {
            order: np.moveaxis(windows[:, :, [drives[i].columns[order] for i in members]], 1, 2) for order in orders
        }
        d, v = motion(measured, 1 / system.sample_rate, dict(key))
        first = 2 * np.array(members)
        out[:, :, first], out[:, :, first + 1] = np.moveaxis(d, 2, 1), np.moveaxis(v, 2, 1)
    return out
