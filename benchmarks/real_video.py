"""`sprung bench video --data FOLDER`: real videos of known systems, and the length of their pendulums.

Reads Delfys75 (Castaneda Garcia et al., CVPR 2025) and sets laid out alike: FOLDER/parameters.json holds true values,
`{system: {setting: {parameter: {"mean": value}}}}`, and videos lie in FOLDER/system/setting: `.npy` arrays, folders of
pictures, or films where ffmpeg is installed.  Nothing is downloaded.

What moves is followed by its brightness-weighted centre, and the equation of a pendulum fitted to it by output error:
no network and no label.  Systems that do not swing are read and counted.
"""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import image
from scipy.optimize import least_squares

from sprung.model.signals import FloatArray
from sprung.service.errors import UserError

SOURCE = "https://www.kaggle.com/datasets/jaswar/physical-parameter-prediction"
GRAVITY = 9.80665  # m/s^2
FILMS = (".mp4", ".mov", ".avi", ".mkv")
PICTURES = (".png", ".jpg", ".jpeg")
MOST_FRAMES = 900  # of a video: 15 s at 60 frames a second
HEIGHT = 270  # px that films are brought to
MOVING = 0.3  # of the largest difference from the background: what is less is noise or shadow
LEAST_SWING = 1.5  # px
SUBSTEPS = 2


@dataclass(frozen=True)
class RealVideo:
    """One video, and what is known of it."""

    path: Path
    system: str  # pendulum, torricelli, ...
    setting: str
    truth: dict[str, float]  # by parameter

    def frames(self) -> FloatArray:
        """Brightness (T, H, W) in [0, 1].  Raises UserError for what cannot be read."""
        try:
            if self.path.is_dir():
                found = _pictures(self.path)
            elif self.path.suffix == ".npy":
                found = np.load(self.path, allow_pickle=False, mmap_mode="r")[:MOST_FRAMES]
            else:
                return _film(self.path)
            return _brightness(np.asarray(found))
        except (OSError, ValueError) as error:
            raise UserError(f"{self.path}: {str(error).splitlines()[0]}") from error


def run(data: Path | None = None, *, frame_rate: float = 60.0, system: str | None = None) -> Iterator[dict[str, Any]]:
    """One dict per video: length of a pendulum, its deviation, the true one.

    data: the set's folder; frame_rate: pictures a second (Delfys75: 60); system: only videos of one.
    """
    if data is None:
        raise UserError(f"bench video: give the folder of the videos with --data; Delfys75 is at {SOURCE}")
    if not frame_rate > 0:
        raise UserError(f"bench video: --frame-rate {frame_rate:g}: give pictures a second")
    for video in read_set(data):
        if system is not None and video.system != system:
            continue
        row: dict[str, Any] = {"system": video.system, "setting": video.setting, "video": video.path.name}
        frames = video.frames()
        row |= {"frames": len(frames), "truth": video.truth}
        if "pendulum" in video.system:
            row |= _figures_of(pendulum_length(frames, frame_rate), video.truth)
        yield row


def read_set(folder: Path) -> list[RealVideo]:
    """Every video of a set, in the order of their names.  Raises UserError that says what is missing."""
    place = folder / "parameters.json"
    try:
        known = json.loads(place.read_text())
        truths = {
            (system, setting): {name: float(value["mean"]) for name, value in values.items() if "mean" in value}
            for system, settings in known.items()
            for setting, values in settings.items()
        }
    except OSError:
        raise UserError(f"{place}: is not there; Delfys75 is at {SOURCE}, unpack it into {folder}") from None
    except (ValueError, AttributeError, TypeError) as error:
        raise UserError(f"{place}: should be system, setting, parameter, mean ({error})") from None
    found = []
    for (system, setting), truth in sorted(truths.items()):
        for path in sorted((folder / system / setting).glob("*")):
            if path.is_dir() or path.suffix.lower() in (".npy", *FILMS):
                found.append(RealVideo(path, system, setting, truth))
    if not found:
        raise UserError(f"{folder}: no videos in SYSTEM/SETTING as in parameters.json; Delfys75 is at {SOURCE}")
    return found


@dataclass(frozen=True)
class SwingFit:
    """What a video says of its pendulum; the deviation is that of a fit whose residual is as coloured as it is."""

    length: float  # m
    length_std: float
    damping: float  # 1/s
    misfit: float  # rms of the residual over that of the path


def pendulum_length(frames: FloatArray, frame_rate: float) -> SwingFit | None:
    """Length of the pendulum in frames (T, H, W); None where nothing swings, or not for a whole period."""
    path = _swing(frames)
    if path is None:
        return None
    time = np.arange(len(path)) / frame_rate
    spectrum = np.abs(np.fft.rfft(path * np.hanning(len(path)), 8 * len(path)))
    frequency = np.fft.rfftfreq(8 * len(path), 1 / frame_rate)
    slowest = 1 / time[-1]
    frequency, spectrum = frequency[frequency >= slowest], spectrum[-int(np.sum(frequency >= slowest)) :]
    first = 2 * math.pi * frequency[int(np.argmax(spectrum))]
    size = float(np.abs(path).max())

    def error(x: FloatArray) -> FloatArray:
        found: FloatArray = _swinging(np.asarray(x)[None], len(path), frame_rate)[0] - path
        return found

    def jacobian(x: FloatArray) -> FloatArray:
        step = 1e-6 * np.maximum(np.abs(x), 1e-2)
        found = _swinging(np.vstack([x, x + np.diag(step)]), len(path), frame_rate)
        return np.asarray((found[1:] - found[0]).T / step)

    slope = float(np.gradient(path, time)[:3].mean())
    starts = []
    for widest in (0.15, 0.5):  # radians: far and long looks like near and short
        radius = size / math.sin(widest)
        begin = [path[0] / radius, slope / radius, first**2, 0.05, radius, 0.0]
        low = [-1.5, -20.0, 0.25 * first**2, -0.5, size / math.sin(1.4), -size]
        high = [1.5, 20.0, 4 * first**2, 5.0, size / math.sin(0.03), size]
        begin = list(np.clip(begin, np.array(low) + 1e-9, np.array(high) - 1e-9))
        scale = np.maximum(np.abs(begin), [0.1, 0.1, 1, 0.1, 1, 1])
        starts.append(least_squares(error, begin, jacobian, bounds=(low, high), x_scale=scale, max_nfev=60))
    best = min(starts, key=lambda found: float(found.cost))
    left = best.fun
    colour = float(np.clip(np.corrcoef(left[:-1], left[1:])[0, 1], 0.0, 0.99))
    variance = float(left @ left) / (len(left) - len(best.x)) * (1 + colour) / (1 - colour)
    covariance = np.linalg.pinv(best.jac.T @ best.jac) * variance
    length = GRAVITY / best.x[2]
    std = length * math.sqrt(covariance[2, 2]) / best.x[2]
    return SwingFit(length, std, float(best.x[3]), float(np.std(left) / np.std(path)))


def _swinging(x: FloatArray, count: int, frame_rate: float) -> FloatArray:
    """Paths (K, T) of pendulums x (K, 6): angle, rate, gravity over length, damping, radius in px, middle in px.

    Runge-Kutta 4, `SUBSTEPS` a frame: off by less than 1e-5 of the swing for periods of ten frames and more.
    """
    angle, rate, stiffness, damping, radius, middle = x.T
    step, y = 1 / (frame_rate * SUBSTEPS), np.stack([angle, rate])

    def rates(at: FloatArray) -> FloatArray:
        return np.stack([at[1], -damping * at[1] - stiffness * np.sin(at[0])])

    path = np.empty((count, len(x)))
    for frame in range(count):
        path[frame] = middle + radius * np.sin(y[0])
        for _ in range(SUBSTEPS):
            a = rates(y)
            b = rates(y + step / 2 * a)
            c = rates(y + step / 2 * b)
            y = y + step / 6 * (a + 2 * b + 2 * c + rates(y + step * c))
    return path.T


def _swing(frames: FloatArray) -> FloatArray | None:
    """Where what moves is along its main direction (T,), px about its mean; None where nothing does."""
    moving = np.abs(frames - np.median(frames, axis=0))
    moving[moving < MOVING * np.quantile(moving.max((1, 2)), 0.9)] = 0.0
    weight = moving.sum((1, 2))
    seen = weight > 0
    if seen.mean() < 0.5:
        return None
    rows, columns = np.indices(frames.shape[1:])
    centre = np.stack([(moving * grid).sum((1, 2)) for grid in (columns, rows)], axis=1)
    centre[seen] /= weight[seen, None]
    at = np.arange(len(frames))
    for axis in (0, 1):  # a frame without any difference: the background was where it is
        centre[~seen, axis] = np.interp(at[~seen], at[seen], centre[seen, axis])
    centre -= centre.mean(0)
    _, sizes, directions = np.linalg.svd(centre, full_matrices=False)
    if sizes[0] < LEAST_SWING * math.sqrt(len(frames)):
        return None
    return np.asarray(centre @ directions[0])


def _figures_of(fit: SwingFit | None, truth: dict[str, float]) -> dict[str, Any]:
    if fit is None:
        return {"length": None, "why": "nothing swings"}
    true = next((value for name, value in truth.items() if "length" in name), None)
    error = None if true is None else round(fit.length / true - 1, 4)
    return {
        "length": round(fit.length, 4), "std": round(fit.length_std, 4), "damping": round(fit.damping, 4),
        "misfit": round(fit.misfit, 4), "true_length": true, "relative_error": error,
    }  # fmt: skip


def _pictures(folder: Path) -> FloatArray:
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)[:MOST_FRAMES]
    if not paths:
        raise ValueError(f"no pictures ({' '.join(PICTURES)})")
    return np.stack([image.imread(path) for path in paths])


def _film(path: Path) -> FloatArray:
    """Frames by ffmpeg, `HEIGHT` high and grey."""
    program = shutil.which("ffmpeg")
    if program is None:
        raise UserError(f"{path}: films need ffmpeg; or turn it into pictures in a folder, or a .npy array")
    command = [program, "-v", "error", "-i", str(path), "-frames:v", str(MOST_FRAMES), "-vf", f"scale=-2:{HEIGHT}"]
    done = subprocess.run([*command, "-f", "yuv4mpegpipe", "-pix_fmt", "gray", "-strict", "-1", "-"],
                          capture_output=True, check=False)  # fmt: skip
    if done.returncode or not done.stdout.startswith(b"YUV4MPEG2"):
        raise UserError(f"{path}: {done.stderr.decode(errors='replace').strip().splitlines()[-1:] or 'no film'}")
    head, _, rest = done.stdout.partition(b"\n")
    size = {part[:1]: part[1:] for part in head.split()[1:]}
    width, height = int(size[b"W"]), int(size[b"H"])
    step = len(b"FRAME\n") + width * height
    count = len(rest) // step
    frames = np.frombuffer(rest[: count * step], np.uint8).reshape(count, step)[:, len(b"FRAME\n") :]
    return frames.reshape(count, height, width) / 255.0


def _brightness(found: np.ndarray[Any, Any]) -> FloatArray:
    """Arrays as videos are kept, (T, H, W), (T, H, W, C) or (T, C, H, W), of bytes or in [0, 1]."""
    values = found / 255.0 if found.dtype == np.uint8 else np.asarray(found, dtype=float)
    if values.ndim == 4:
        channels = -1 if values.shape[-1] in (1, 3, 4) else 1
        if values.shape[channels] not in (1, 3, 4):
            raise ValueError(f"an array of shape {found.shape}; a video is (T, H, W), with or without colours")
        values = np.moveaxis(values, channels, -1)[..., :3].mean(-1)
    if values.ndim != 3 or len(values) < 10:
        raise ValueError(f"an array of shape {found.shape}; a video is (T, H, W), at least ten pictures long")
    if not np.isfinite(values).all():
        raise ValueError("numbers that are not finite")
    return values
