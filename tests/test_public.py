"""What `import sprung` gives: documented examples, and a wheel that gets on with a user's own folders."""

from __future__ import annotations

import doctest
import importlib
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

import sprung
from sprung.benchmarks.sensitivity_cases import QUARTER_CAR as SYSTEM
from sprung.benchmarks.sensitivity_cases import RIG, rig
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import System
from sprung.replay.writing import write_recording
from sprung.service.core import build_core
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.settings import Settings
from sprung.service.sources.feed import feed_file
from tests.served import served
from tests.service_fakes import make_window

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the examples read: twenty seconds of the bundled vehicle, and a test of a damper."""
    folder = tmp_path_factory.mktemp("recorded")
    rng, system = np.random.default_rng(2), sprung.load_system()
    speed = rng.normal(0, 8e-3, (2000, 8)).cumsum(axis=0)
    speed -= np.linspace(0, 1, 2000)[:, None] * speed[-1]
    displacement = cumulative_trapezoid(speed, dx=0.01, axis=0, initial=0)
    inputs = np.stack([displacement, speed], axis=2).reshape(2000, 16)
    values = np.hstack([inputs, simulate_ride(system, inputs, noise=rng).sensors])
    values[:, :16] += rng.normal(0, [c.noise for c in system.inputs], (2000, 16))
    write_recording(folder / "ride.mcap", system.channels, values, 100.0, 1_790_000_000 * 10**9)
    (folder / "rig.yaml").write_text(RIG)
    rig_system = sprung.parse_system(RIG)
    write_recording(folder / "rig.csv", rig_system.channels, rig(rng, 6.0).values, 100.0, 10**18)
    return folder


@pytest.fixture
def documented(recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One's own copy of it, in which the examples run."""
    shutil.copytree(recorded, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", [name for name in sorted(sprung.__all__) if name != "Client"])
def test_the_example_of_a_public_name_runs(name: str, documented: Path) -> None:
    assert examples(getattr(sprung, name), {}) > 0


def test_the_example_of_the_client_runs(engine: Engine, system: System, data_dir: Path) -> None:
    core = build_core(Settings(data_dir=data_dir, min_free_bytes=0), engine)
    core.pipeline.process("m1", [make_window(system, i) for i in range(3)])
    with served(core) as port:
        assert examples(sprung.Client, {"url": f"http://127.0.0.1:{port}"}) > 0


def examples(thing: object, names: dict[str, object]) -> int:
    """Run what a docstring shows; how many lines it tried."""
    tried, runner = 0, doctest.DocTestRunner()
    for test in doctest.DocTestFinder(recurse=False).find(thing, globs=names):
        failed, count = runner.run(test)
        assert not failed
        tried += count
    return tried


def test_the_example_of_the_package_runs() -> None:
    assert examples(sprung, {}) > 0


def modules_with_examples() -> list[str]:
    """Modules of the product whose functions have examples, but for the public ones, which have a test of their own."""
    found = []
    for folder in ("model", "replay", "service"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            if ">>> " in path.read_text(encoding="utf-8"):
                found.append(".".join(("sprung", *path.relative_to(ROOT).with_suffix("").parts)))
    public = {getattr(sprung, name).__module__ for name in sprung.__all__}
    return [name for name in found if name.removesuffix(".__init__") not in public]


@pytest.mark.parametrize("name", modules_with_examples())
def test_the_examples_of_a_module_run(name: str) -> None:
    done = doctest.testmod(importlib.import_module(name))
    assert done.attempted and not done.failed


def test_every_public_name_exists() -> None:
    assert {"diagnose", "identify", "load_system", "simulate", "track"} <= set(sprung.__all__)
    assert all(getattr(sprung, name) is not None for name in sprung.__all__)


def test_a_window_may_be_given_by_channel_names() -> None:
    system = sprung.load_system()
    values = {channel.name: np.zeros(100) for channel in system.channels}
    with pytest.raises(ValueError, match="no such channel"):
        sprung.identify(system, {**values, "wheel": np.zeros(100)})
    with pytest.raises(ValueError, match="differ in length"):
        sprung.identify(system, {**values, "car_1l": np.zeros(99)})
    assert len(sprung.identify(system, values).parameters) == 24


def test_simulated_values_are_named_and_positive() -> None:
    system = sprung.load_system()
    inputs = np.zeros((100, len(system.inputs)))
    with pytest.raises(ValueError, match="no such parameter"):
        sprung.simulate(system, inputs, {"primary.stiffness": 1.0})
    with pytest.raises(ValueError, match="at least 0"):
        sprung.simulate(system, inputs, {"primary_11l.stiffness": -1.0})
    with pytest.raises(ValueError, match="shape"):
        sprung.simulate(system, inputs[:, :3])
    assert np.all(sprung.simulate(system, inputs) == 0)


def test_a_simulation_has_the_laws_of_the_file() -> None:
    plain = sprung.parse_system(SYSTEM)
    rubbing = sprung.parse_system(
        SYSTEM.replace(
            "damping: 2.0e+4}", "damping: 2.0e+4, laws: [{coulomb_friction: {force: 500, smoothing: 1e-3}}]}"
        )
    )
    time = np.arange(400) / plain.sample_rate
    inputs = np.stack([1e-2 * np.sin(8 * time), 8e-2 * np.cos(8 * time)], axis=1)
    free, held = sprung.simulate(plain, inputs), sprung.simulate(rubbing, inputs)
    np.testing.assert_array_equal(held, simulate_ride(rubbing, inputs).sensors)
    assert np.std(held - free) > 0.05 * np.std(free)


def test_recordings_are_read_with_the_time_column_that_the_system_file_names(tmp_path: Path) -> None:
    system = sprung.parse_system(SYSTEM + "time: {column: clock, unit: ms}\n")
    table = tmp_path / "ride.csv"
    rows = [f"{10 * i},{i},{np.sin(0.1 * i)},{np.cos(0.1 * i)},0,0,{np.sin(i)},{np.cos(i)}" for i in range(300)]
    table.write_text("\n".join(["clock,time,d,v,a,b,e,f", *rows]))
    assert len(sprung.load_record(table, system).values) == pytest.approx(300, abs=2)
    start = 1_790_000_000 * 10**9
    times = np.concatenate([block.time for block in sprung.open_recording(table, system, start=start).blocks()])
    assert (times.min(), times.max()) == (start, start + 2_990_000_000)


def test_tracking_is_that_of_the_service(pipeline: Pipeline, documented: Path) -> None:
    engine = pipeline.engine
    tracked = sprung.track(engine.system, sprung.open_recording("ride.mcap", engine.system), engine.identifier)
    fed = feed_file(pipeline, documented / "ride.mcap")
    assert fed.state is not None
    assert tracked.parameters == engine.tracker.report(fed.state)
    assert tracked.windows == fed.windows["used"] + fed.windows["repaired"] == 39


def test_an_installed_wheel_leaves_a_users_own_names_alone(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    build = [*pip, "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", str(tmp_path), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("sprung-*.whl")
    names = {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    assert {name for name in names if not name.endswith(".dist-info")} == {"sprung"}
    fresh = tmp_path / "fresh"
    venv.create(fresh, with_pip=False)
    python = fresh / "bin" / "python"
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    install = [*pip, "--python", str(python), "install", "-q", "--no-deps", "--no-compile", str(wheel)]
    subprocess.run(install, check=True, env=environment)
    (site,) = fresh.glob("lib/python*/site-packages")
    # Libraries of others are lent; `.pth` files there, which install this project for its developers, are not read
    (site / "lent.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    user = tmp_path / "user"
    (user / "model").mkdir(parents=True)
    (user / "model" / "__init__.py").write_text("MINE = True\n")
    (user / "own.py").write_text(
        "import model, sprung\n"
        "assert model.MINE\n"
        f"assert sprung.__file__.startswith({str(site)!r}), sprung.__file__\n"
        "system = sprung.load_system()\n"
        "print(len(system.parameters), sprung.__version__)\n"
    )

    def run(*arguments: str) -> str:
        command = [str(python), *arguments]
        done = subprocess.run(command, cwd=user, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    assert run("own.py").split() == ["24", sprung.__version__]
    for name in ("model", "replay", "service", "benchmarks"):
        assert run("-P", "-c", f"import importlib.util as u; print(u.find_spec({name!r}))") == "None"
