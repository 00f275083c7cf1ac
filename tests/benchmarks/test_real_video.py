"""Videos of known systems: a stand-in is drawn, read in every layout, and its pendulum's length found."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib import image
from scipy.integrate import solve_ivp

from sprung.benchmarks import real_video
from sprung.service.errors import UserError

RATE, LENGTH, DAMPING = 30.0, 0.9, 0.08


def drawn(length: float = LENGTH, amplitude: float = 0.6, frames: int = 110, seed: int = 0) -> np.ndarray:
    """A dark bob before a bright, uneven wall, with noise: (T, 48, 64) bytes."""
    time = np.arange(frames) / RATE
    stiffness = real_video.GRAVITY / length
    angle = solve_ivp(
        lambda _, y: [y[1], -DAMPING * y[1] - stiffness * np.sin(y[0])], (0, time[-1]), [amplitude, 0.0],
        t_eval=time, rtol=1e-8,
    ).y[0]  # fmt: skip
    rows, columns = np.indices((48, 64))
    column, row = 32 + 34 * np.sin(angle), 4 + 34 * np.cos(angle)
    distance = np.hypot(columns - column[:, None, None], rows - row[:, None, None])
    bob = np.clip(4.5 - distance, 0, 1)
    wall = 0.8 + 0.1 * columns / 64
    noise = 0.02 * np.random.default_rng(seed).normal(size=bob.shape)
    return np.round(255 * np.clip(wall * (1 - 0.9 * bob) + noise, 0, 1)).astype(np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    truth = {
        "pendulum": {"90cm": {"length": {"mean": LENGTH, "std": 0.001}}},
        "led": {"fast": {"decay": {"mean": 2.0}}},
    }
    (tmp_path / "parameters.json").write_text(json.dumps(truth))
    (tmp_path / "pendulum" / "90cm").mkdir(parents=True)
    (tmp_path / "led" / "fast").mkdir(parents=True)
    np.save(tmp_path / "pendulum" / "90cm" / "1.npy", drawn())
    np.save(tmp_path / "led" / "fast" / "1.npy", np.full((20, 8, 8), 7, np.uint8))
    return tmp_path


def test_the_length_is_found_within_its_deviation(folder: Path) -> None:
    led, pendulum = real_video.run(folder, frame_rate=RATE)
    assert (led["system"], led["frames"], led["truth"]) == ("led", 20, {"decay": 2.0})
    assert pendulum["true_length"] == LENGTH
    assert abs(pendulum["relative_error"]) < 0.02
    assert abs(pendulum["length"] - LENGTH) < 4 * pendulum["std"]
    assert pendulum["damping"] == pytest.approx(DAMPING, abs=0.03)


def test_another_length_is_another_answer() -> None:
    fit = real_video.pendulum_length(drawn(0.45, 0.4) / 255.0, RATE)
    assert fit is not None
    assert fit.length == pytest.approx(0.45, rel=0.02)


@pytest.mark.parametrize("shape", ["colours last", "colours first", "pictures", "numbers"])
def test_every_layout_is_read_alike(tmp_path: Path, shape: str) -> None:
    frames = drawn(frames=12)
    path = tmp_path / "video.npy"
    if shape == "pictures":
        path = tmp_path / "video"
        path.mkdir()
        for number, frame in enumerate(frames):
            image.imsave(path / f"{number:03d}.png", np.stack([frame] * 3, axis=-1))
    elif shape == "numbers":
        np.save(path, frames / 255.0)
    else:
        axis = -1 if shape == "colours last" else 1
        np.save(path, np.stack([frames] * 3, axis=axis))
    found = real_video.RealVideo(path, "pendulum", "x", {}).frames()
    np.testing.assert_allclose(found, frames / 255.0, atol=1e-6)


def test_a_still_is_no_pendulum() -> None:
    noise = np.random.default_rng(1).normal(size=(40, 24, 24))
    assert real_video.pendulum_length(0.5 + 0.02 * noise, RATE) is None


def test_without_the_set_it_is_said_where_it_is(tmp_path: Path) -> None:
    for data in (None, tmp_path):
        with pytest.raises(UserError, match=r"kaggle\.com/datasets/jaswar"):
            list(real_video.run(data))


@pytest.mark.parametrize("content", ["[]", "{", '{"pendulum": {"90cm": {"length": 0.9}}}'])
def test_wrong_parameters_are_one_line(tmp_path: Path, content: str) -> None:
    (tmp_path / "parameters.json").write_text(content)
    with pytest.raises(UserError, match=r"parameters\.json") as caught:
        list(real_video.run(tmp_path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "array", [np.zeros((20, 3)), np.zeros((2, 8, 8)), np.full((20, 8, 8), np.nan), np.zeros((20, 8, 8, 2))]
)
def test_arrays_that_are_no_video_are_refused(tmp_path: Path, array: np.ndarray) -> None:
    np.save(tmp_path / "x.npy", array)
    with pytest.raises(UserError, match=r"x\.npy"):
        real_video.RealVideo(tmp_path / "x.npy", "pendulum", "x", {}).frames()
