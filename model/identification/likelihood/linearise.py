"""A window's model linearised at given parameters, with everything weighed by the noise of sensors and inputs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sprung.model.identification.likelihood.band import ComparedBand
from sprung.model.identification.likelihood.compression import Compression
from sprung.model.identification.likelihood.frequency import FrequencyModel, bin_frequencies
from sprung.model.identification.likelihood.gauss_newton import Chord, Linearisation, Transfer, WindowBatch
from sprung.model.identification.likelihood.noise import WindowNoise
from sprung.model.identification.likelihood.sensitivities import WindowSensitivities
from sprung.model.mechanics import FORCE
from sprung.model.sensor_kinds import USUAL_NOISE
from sprung.model.signals import BoolArray, FloatArray
from sprung.model.simulate.drives import drives_of
from sprung.model.simulate.linear import Discrete, ElementValues, LinearSimulator
from sprung.model.simulate.loading import load_terms
from sprung.model.system import System

BAND = 0.3  # share of the sample rate up to which Hermite interpolation errs by less than 4 %
PRIOR_STD = 1.0  # of a log-ratio: a factor e either way; weak beside any informative window
# Of log-ratios about nominal, where a window is linearised; it counts nothing in what the window says.  A vehicle in
# service is within it but for what is failing, while a weak window's own maximum is far off along what it hardly shows.
HELD_STD = 0.2
_RIDGE = 1e-11  # relative, on the normalised free responses
_SHOWN = 1e-6  # relative ridge on free responses that hardly show where drives are lost
_SETTLING = 2  # times that initial states and the motion of lost inputs are made to fit each other
_UNSEEN = 1e-10  # of the largest free response: below is rounding; those that are seen differ by 1e-4, units included


@dataclass(frozen=True, slots=True)
class _Residual:
    """What windows leave at given parameters, with what it takes to say so; whitened, B windows."""

    values: ElementValues
    discrete: Discrete  # of the compressed signals
    forced: Tensor  # states without free responses, (B, T, N)
    transfer: Transfer
    carried: Tensor  # what the noise of the drives brings to the signals, (B, F, R, W/2)
    whiten: Tensor  # (B, F, R, R)
    r: Tensor  # residual before the initial state is chosen, (B, 1, K)
    basis: Tensor  # free responses, normalised, (B, N', K)
    free_scale: Tensor  # what they were divided by, (B, N')
    factor: Tensor  # Cholesky factor of their products, (B, N', N')
    along: Tensor  # products of free responses and residual, (B, N', 1)
    x0: Tensor  # best initial state, (B, N)
    cost: Tensor  # weighted squares with it, (B,)
    left: Tensor  # residual with it, (B, F, R, 1)
    unweighed: Tensor | None  # the same before whitening; None: no drive is lost


class WindowModel:
    """The linear system over windows of a fixed length."""

    def __init__(self, system: System, samples: int) -> None:
        self.system, self.samples = system, samples
        self.simulator = LinearSimulator(system)
        omega = bin_frequencies(samples, system.sample_rate)
        bins = int(np.searchsorted(omega, 2 * np.pi * BAND * system.sample_rate, side="right")) - 1
        self.frequency = FrequencyModel(self.simulator, omega[1 : bins + 1])
        self.band = ComparedBand(samples, bins, self.frequency.jw.dtype)
        self.input_noise = np.array([channel.noise or USUAL_NOISE[channel.unit] for channel in system.inputs])
        self.compression = Compression(system, samples)
        lost = np.array([drive.lost for drive in drives_of(system)], dtype=bool)
        drives = torch.as_tensor(self.frequency.drive_noise())
        self.noise = WindowNoise(drives, torch.as_tensor(lost), self.band.weight)
        self.sensitivities = WindowSensitivities(self.frequency, self.compression, self.band)
        self.blind = self._blind(lost)
        self._taken: dict[bytes, int] = {}
        self.precision = torch.as_tensor(prior_std(system) ** -2)
        self.held = self.precision.clone()  # that of where windows are linearised
        self.held[: len(system.parameters)] = HELD_STD**-2

    def _blind(self, lost: BoolArray) -> Tensor:
        """Parameters (P,) of elements that stand on supports whose drives are `lost` (W/2,): they are not identifiable.

        Whatever spring and damper there are, some motion below gives the force that the vehicle shows.
        """
        s = self.simulator
        on_lost = torch.zeros(len(s.G), dtype=torch.bool)
        if lost.any() and len(s.supports):
            on_lost = (s.G[:, torch.as_tensor(lost)[s.supports // 2]] != 0).any(dim=1)
        return on_lost[s.element_of]

    @property
    def states_count(self) -> int:
        return 2 * self.simulator.H.shape[1]

    def knots(self, windows: FloatArray) -> FloatArray:
        """Knots of the drives, (B, T, W), of windows (B, T, C)."""
        return self.simulator.knots(windows[:, :, : len(self.system.inputs)])

    def batch(self, knots: FloatArray, windows: FloatArray, present: BoolArray) -> WindowBatch:
        """Windows (B, T, C), their knots (B, T, W) at hand, in which exactly the sensors `present` are measured."""
        first = len(self.system.inputs)
        sensors, inputs = windows[:, :, first:][:, :, present], windows[:, :, :first]
        return WindowBatch(torch.as_tensor(knots), torch.as_tensor(sensors), present, torch.as_tensor(inputs))

    def unknowns(self, present: BoolArray) -> int:
        """Numbers of a window that are eliminated: its first state, trends, and the spectra of lost inputs."""
        trends = self.compression.trends(present).shape[2] if self.compression.integrated else 0
        return self.states_count + trends + 2 * self._directions_lost(present)

    def _directions_lost(self, present: BoolArray) -> int:
        """Complex numbers of a window's signals that the motion of lost inputs takes, at nominal values."""
        if not self.noise.lost:
            return 0
        key = present.tobytes()
        if key not in self._taken:
            nothing = torch.zeros(1, 0, present.sum(), dtype=torch.float64)
            values = self.simulator.element_values(torch.zeros(1, len(self.system.parameters), dtype=torch.float64))
            drive = self.transfer(values, WindowBatch(nothing, nothing, present, nothing)).drive
            self._taken[key] = int(self.noise.span(self.noise.carried(drive)).abs().square().sum().round())
        return self._taken[key]

    def _open(self, free: Tensor, data: WindowBatch) -> Tensor:
        """Free responses (B, T, R, N) and what else is unknown of the window, (B, T, R, N')."""
        if not self.compression.integrated:
            return free
        trends = self.compression.trends(data.present)
        return torch.cat([free, trends.expand(len(free), *trends.shape)], dim=3) if trends.shape[2] else free

    def with_lost(self, x: Tensor, data: WindowBatch) -> WindowBatch:
        """Windows whose lost inputs move as their sensors say at log-ratios x (B, P).

        What they say is left out of the likelihood (`whitening`), but the motion of the vehicle, along which it is
        linearised, is that with these inputs: the most likely one of a moderate size, since where sensors hardly show
        it, noise would otherwise make it a wild one.
        """
        if not self.noise.lost:
            return data
        return replace(data, w=self._with_noise(data.w, self._of_lost(self._residual(x, data), data)))

    def _of_lost(self, at: _Residual, data: WindowBatch) -> Tensor:
        """What the spectra of lost drives are more, (B, F, W/2), than in the windows that left a residual."""
        assert at.unweighed is not None
        lost, believed = self.noise.believed(self.frequency.jw.dtype)
        carried = at.carried * believed[:, None]
        whiten = self.noise.by_noise(carried)
        before = self.band.spectra(data.w[:, :, 0::2]) * lost
        shown = at.unweighed + at.transfer.drive @ before.unsqueeze(3)
        return self.noise.estimated(whiten, carried, whiten @ shown) * believed * lost - before

    def _moving(self, carried: Tensor, residual: Tensor, free: Tensor) -> Tensor:
        """First states (B, N') with which windows move while drives are lost: also those that only lost drives show.

        residual (B, F, R, 1) and free responses (B, F, R, N'), as spectra of the signals.
        """
        whiten = self.noise.by_noise(carried * self.noise.believed(self.frequency.jw.dtype)[1][:, None])
        r, (basis, scale) = as_rows(whiten @ residual), normalised(as_rows(whiten @ free))
        products = basis @ basis.mT + _SHOWN * torch.eye(basis.shape[1], dtype=basis.dtype)
        found: Tensor = torch.linalg.solve(products, basis @ r.mT).squeeze(2) / scale
        return found

    def settled(self, x: Tensor, x0: Tensor, data: WindowBatch) -> tuple[Tensor, WindowBatch]:
        """Initial states x0 (B, N) and windows whose lost inputs move as their sensors say, which fit each other.

        Motion of a lost input is estimated as a periodic one, and needs another initial state than none.
        """
        for _ in range(_SETTLING if self.noise.lost else 0):
            data = self.with_lost(x, data)
        return (self._residual(x, data).x0 if self.noise.lost else x0), data

    def _with_noise(self, w: Tensor, noise: Tensor) -> Tensor:
        """Knots (B, T, W) to which what the spectra (B, F, W/2) say is added."""
        w = w.clone()
        w[:, :, 0::2] += self.band.signals(noise)
        w[:, :, 1::2] += self.band.signals(self.frequency.jw[:, None] * noise)
        return w

    def _residual(self, x: Tensor, data: WindowBatch) -> _Residual:
        """The residual at log-ratios x (B, P), its weights, and the best initial state."""
        s = self.simulator
        values = s.element_values(x)
        discrete = self.compressed(s.discretise(values), data)
        forced = s.states(discrete, data.w, x.new_zeros(len(x), discrete.Ad.shape[1]))
        residual = self._signals(data) - forced @ discrete.C.mT - data.w @ discrete.D.mT
        free = self._open(s.free_response(discrete, self.samples), data)

        transfer = self.transfer(values, data)
        carried = self.noise.carried(transfer.drive)
        whiten = self.noise.whitening(carried)
        plain, plain_free = self.band.spectra(residual).unsqueeze(3), self.band.spectra(free)
        white_residual, white_free = whiten @ plain, whiten @ plain_free  # (B, F, R, 1), (B, F, R, N)
        r, basis = as_rows(white_residual), as_rows(white_free)  # (B, 1, K), (B, N, K)
        basis, free_scale = normalised(basis)
        products = basis @ basis.mT
        factor = torch.linalg.cholesky(products + _RIDGE * torch.eye(products.shape[1], dtype=x.dtype))
        along = basis @ r.mT  # (B, N, 1)
        x0_scaled = torch.cholesky_solve(along, factor).squeeze(2)
        x0 = x0_scaled / free_scale
        cost = r.square().sum(dim=(1, 2)) - (along.squeeze(2) * x0_scaled).sum(dim=1)
        initial = x0[:, None, :, None].to(white_free.dtype)
        left = white_residual - white_free @ initial
        unweighed = None
        if self.noise.lost:
            x0 = self._moving(carried, plain, plain_free)
            unweighed = plain - plain_free @ x0[:, None, :, None].to(plain_free.dtype)
        x0 = x0[:, : discrete.Ad.shape[1]]
        return _Residual(
            values,
            discrete,
            forced,
            transfer,
            carried,
            whiten,
            r,
            basis,
            free_scale,
            factor,
            along,
            x0,
            cost,
            left,
            unweighed,
        )

    def linearise(self, x: Tensor, data: WindowBatch) -> Linearisation:
        """Everything at log-ratios x (B, P)."""
        s, at = self.simulator, self._residual(x, data)
        noise = self.noise.estimated(at.whiten, at.carried, at.left)
        if self.noise.lost:
            noise = noise + self._of_lost(at, data)
        moved = self.moved_by(at.values, at.transfer.compliance, noise)
        states = at.forced + s.free_states(at.discrete, at.x0, self.samples)
        J = as_rows(self.sensitivities.by_unknowns(x.shape[1], at.values, at.transfer, at.whiten, states, data, moved))
        across_products = at.basis @ J.mT
        across = torch.cholesky_solve(across_products, at.factor)
        # Of free responses that hardly show, differences of products cancel
        if self.noise.lost or not data.present.all():
            left = J - across.mT @ at.basis
            information, gradient = left @ left.mT, (left @ at.r.mT).squeeze(2)
        else:
            information = J @ J.mT - across_products.mT @ across
            gradient = (J @ at.r.mT - across.mT @ at.along).squeeze(2)
        precision, held = self.precision[: x.shape[1]], self.held[: x.shape[1]]
        covariance = torch.linalg.inv(information + torch.diag(precision))
        holding = torch.linalg.cholesky(information + torch.diag(held))
        step = torch.cholesky_solve((gradient - x * held).unsqueeze(2), holding).squeeze(2)
        return Linearisation(
            at.whiten,
            at.transfer,
            at.basis,
            at.free_scale,
            J,
            at.factor,
            across,
            covariance,
            holding,
            x,
            at.x0,
            at.cost,
            gradient,
            step,
        )

    def chord(self, at: Linearisation, x: Tensor, x0: Tensor, data: WindowBatch) -> Chord:
        """One more step from (x, x0) with the products of `at`."""
        s = self.simulator
        discrete = self._present(s.discretise(s.element_values(x)), data)
        states = s.states(discrete, data.w, x0)
        outputs = states @ discrete.C.mT + data.w @ discrete.D.mT
        error = data.measured - outputs
        spectra = self.band.spectra(error @ self.compression.matrix(data.present).mT)
        r = as_rows(at.whiten @ spectra.unsqueeze(3)).mT  # (B, K, 1)
        along = at.free @ r
        free_part = torch.cholesky_solve(along, at.factor)
        gradient = at.sensitivities @ r - at.across.mT @ along
        step = torch.cholesky_solve(gradient - (x * self.held[: x.shape[1]]).unsqueeze(2), at.holding)
        released = at.covariance @ (gradient - (x * self.precision[: x.shape[1]]).unsqueeze(2))
        cost = r.square().sum(dim=(1, 2)) - (along * free_part).sum(dim=(1, 2))
        x0 = x0 + ((free_part - at.across @ step).squeeze(2) / at.free_scale)[:, : x0.shape[1]]
        error = self.compression.without_trends(error, data.present)
        error = error.square().mean(dim=1).sqrt()
        return Chord(cost, step.squeeze(2), released.squeeze(2), x0, error, r, outputs, states)

    def objective(self, x: Tensor, cost: Tensor) -> Tensor:
        """What an iteration lowers, (B,): weighted squares `cost`, and those of log-ratios x (B, P) that it holds."""
        return cost + (x.square() * self.held[: x.shape[1]]).sum(dim=1)

    def simulated(self, x: Tensor, x0: Tensor, data: WindowBatch) -> tuple[Tensor, Tensor]:
        """States (B, T, N) and what all sensors show of them, (B, T, S)."""
        s = self.simulator
        discrete = s.discretise(s.element_values(x))
        states = s.states(discrete, data.w, x0)
        return states, states @ discrete.C.mT + data.w @ discrete.D.mT

    def moved_by(self, values: ElementValues, compliance: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Response to noise of the drives (B, F, W/2): coordinates (B, F, n), deflections by the supports (B, F, E)."""
        s, kind = self.simulator, compliance.dtype
        support = noise[:, :, s.supports // 2] @ s.G.T.to(kind)
        load = -(self.frequency.dynamic(values) * support) @ s.H.to(kind)
        if len(s.forces):
            load = load + noise[:, :, s.forces // 2] @ s.F.T.to(kind)
        return (compliance @ load.unsqueeze(3)).squeeze(3), support

    def smoothed(
        self, values: ElementValues, compliance: Tensor, noise: Tensor, data: WindowBatch, outputs: Tensor
    ) -> tuple[WindowBatch, Tensor]:
        """Windows and simulated outputs (B, T, S') with drives that are less their noise (B, F, W/2)."""
        s = self.simulator
        motion, _ = self.moved_by(values, compliance, noise)
        shown = (self.frequency.sensing(values) @ motion.unsqueeze(3)).squeeze(3)
        if self.frequency.element_sensors and len(s.supports):
            direct = self.frequency.element_response(values, s.G)
            shown = shown + (direct @ noise[:, :, s.supports // 2].unsqueeze(3)).squeeze(3)
        w = self._with_noise(data.w, noise)
        present = torch.as_tensor(np.flatnonzero(data.present))
        return replace(data, w=w), outputs + self.band.signals(shown[:, :, present])

    def excitation(self, windows: FloatArray) -> FloatArray:
        """Mean power over bins of the strongest input of windows (B, T, C), over that of its noise, (B,).
        Inputs that are NaN do not count.

        About 1 at standstill.  Inputs without a stated noise have that of a usual instrument.
        """
        inputs = windows[:, :, : len(self.input_noise)]
        if not inputs.shape[2]:
            return np.full(len(windows), np.inf)
        power = self.band.spectra(torch.as_tensor(inputs)).abs().square().mean(dim=1).numpy() / self.samples
        return np.asarray(np.nan_to_num(power / self.input_noise**2, nan=0.0).max(axis=1))

    def _signals(self, data: WindowBatch) -> Tensor:
        return data.measured @ self.compression.matrix(data.present).mT

    def _present(self, discrete: Discrete, data: WindowBatch) -> Discrete:
        if data.present.all():
            return discrete
        at = torch.as_tensor(data.present)
        return replace(discrete, C=discrete.C[:, at], D=discrete.D[:, at])

    def compressed(self, discrete: Discrete, data: WindowBatch) -> Discrete:
        Q, discrete = self.compression.matrix(data.present), self._present(discrete, data)
        return replace(discrete, C=Q @ discrete.C, D=Q @ discrete.D)

    def transfer(self, values: ElementValues, data: WindowBatch) -> Transfer:
        """Frequency responses of the compressed signals."""
        s, f = self.simulator, self.frequency
        compliance = _inverse(f.stiffness(values))
        kind = compliance.dtype
        Q = self.compression.rows(data.present, kind)
        plain = not f.element_sensors and values.reach is None
        sensing = Q @ (f.motion_sensing if plain else f.sensing(values))
        per_load = sensing @ compliance
        per_force = -per_load @ s.H.T.to(kind)
        dynamic = self.frequency.dynamic(values)
        drive = per_load.new_zeros(*per_load.shape[:3], s.W // 2)
        if len(s.supports):
            drive[..., s.supports // 2] = (per_force * dynamic.unsqueeze(2)) @ s.G.to(kind)
        if len(s.forces):
            drive[..., s.forces // 2] = per_load @ s.F.to(kind)
        if f.element_sensors:
            drive[..., s.supports // 2] += Q @ f.element_response(values, s.G)
            forces = torch.where((s.kind == FORCE)[:, None], s.L, torch.zeros_like(s.L))
            per_force = per_force + Q @ forces.to(kind)
        return Transfer(compliance, per_load, per_force, drive)


def prior_std(system: System) -> FloatArray:
    """Standard deviations of the priors of all that can be refined, (P + X,): parameters, then loads.

    Weak ones, but for how a load is spread and where it lies, which a window alone determines worse than common sense.
    """
    spread = [PRIOR_STD if term.kind == "load" else term.std for term in load_terms(system)]
    return np.array([*(PRIOR_STD for _ in system.parameters), *spread], dtype=np.float64)


def _inverse(stiffness: Tensor) -> Tensor:
    """Inverse of dynamic stiffnesses (..., n, n); the pseudo-inverse at frequency zero of a body that nothing holds.

    Where a free body would go under a steady force follows from its free response, not by its compliance.
    """
    found, failed = torch.linalg.inv_ex(stiffness)
    if bool(failed.any()):
        found = torch.where((failed != 0)[..., None, None], torch.linalg.pinv(stiffness), found)
    result: Tensor = found
    return result


def normalised(free: Tensor) -> tuple[Tensor, Tensor]:
    """Free responses (B, N, K) brought to length one, and what they were divided by, (B, N).

    What no sensor shows, of a body without any, is rounding, and nothing here; of length one it would drown the others.
    """
    norm = free.square().sum(dim=2).sqrt()
    seen = norm > _UNSEEN * norm.amax(dim=1, keepdim=True)
    scale = torch.where(seen, norm, torch.ones_like(norm))
    unit = free / scale.unsqueeze(2)
    return unit if bool(seen.all()) else torch.where(seen.unsqueeze(2), unit, 0.0), scale


def as_rows(spectra: Tensor) -> Tensor:
    """(B, F, R, X) complex to (B, X, 2 F R) real."""
    B, F, R, X = spectra.shape
    return torch.view_as_real(spectra).permute(0, 3, 1, 2, 4).reshape(B, X, F * R * 2)


def as_spectra(rows: Tensor, like: Tensor) -> Tensor:
    """(B, 2 F R, 1) real, as `as_rows` makes them, back to (B, F, R, 1) complex; `like`: (B, F, R, ...)."""
    B, F, R = like.shape[:3]
    return torch.view_as_complex(rows.reshape(B, F, R, 2).contiguous()).unsqueeze(3)
