"""A law, a reader and a metric added by a package of somebody else's; no file of ours is touched."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sprung.benchmarks.sensitivity_cases import RIG
from sprung.model.laws import CATALOGUE
from sprung.model.laws.own import load_laws
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import load_system, parse_system
from sprung.replay import recording
from sprung.replay.writing import write_recording
from sprung.service.cli import main
from sprung.service.core import build_core
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings

READER = '''
import numpy as np
from sprung.model.signals import SampleBlock

def blocks(path, channels, account, time):
    """Rows of float64: time in s, then every channel in the system's order."""
    rows = np.fromfile(path).reshape(-1, 1 + len(channels))
    stamps = np.repeat(np.round(rows[:, 0] * 1e9).astype(np.int64), len(channels))
    which = np.tile(np.arange(len(channels), dtype=np.int32), len(rows))
    account.tally.used += len(rows)
    yield SampleBlock(stamps, which, rows[:, 1:].ravel())
'''
METRIC = """
from prometheus_client.core import GaugeMetricFamily

class Cars:
    def __init__(self, board):
        self.board = board

    def collect(self):
        yield GaugeMetricFamily("other_answer", "Of somebody else", value=42)

    def describe(self):
        return []
"""
LAW = """
import numpy as np
from sprung.model.laws import ElementLaw, ParameterSpec, grid

SQUEAK = ElementLaw(
    name="squeak",
    title="squeak",
    parameters=(ParameterSpec("size", "N", 0.0, 1e6, "amplitude", lambda seen: 20.0),),
    force=lambda motion, p, element: p[0] * np.sin(motion.deflection / 1e-3),
    shapes=lambda seen: grid([20.0]),
    absent=(0.0,),
    looks_like="waves over the deflection",
    confused_with=(),
    sentence="a squeak of {size}",
)
"""
KIND = """
import importlib.util, sys
import numpy as np
from pathlib import Path

whole = importlib.util.find_spec("sprung.model.sensor_kinds")
text = Path(whole.origin).read_text()
line = '    "force": SensorKind("N", 1.0, "force"),\\n'
text = text.replace('"pitch_rate"]', '"pitch_rate", "roll_acceleration"]')
text = text.replace(line, line + '    "roll_acceleration": SensorKind("rad/s^2", 0.01, "acceleration", "roll"),\\n')
Path(sys.argv[1]).write_text(text)
spec = importlib.util.spec_from_file_location(whole.name, sys.argv[1])
module = sys.modules[whole.name] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)

from sprung.model.system import parse_system
system = parse_system(Path(sys.argv[2]).read_text())
A, B, C, D = system.mechanics.matrices()
rate, acceleration = list(system.sensors).index("rate"), list(system.sensors).index("turns")
assert np.allclose(C[acceleration], C[rate] @ A) and np.allclose(D[acceleration], C[rate] @ B) and C[rate].any()
print(system.channels[-1].unit)
"""
SYSTEM = """
name: one
sample_rate: 100
window: 100
bodies: {car: {mass: 400}}
inputs: {road: {kind: displacement, displacement: {csv: z, noise: 1.0e-5}, velocity: {csv: v, noise: 1.0e-4}}}
elements: {strut: {upper: car, lower: road, stiffness: 20000, damping: 1500}}
sensors: {a: {kind: acceleration, body: car, csv: a, noise: 0.01}}
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An installed package, as `pip install --target` leaves it, on the path of this process."""
    folder = tmp_path
    site = folder / "site"
    (site / "other").mkdir(parents=True)
    (site / "other" / "__init__.py").write_text("")
    (site / "other" / "reading.py").write_text(READER)
    (site / "other" / "counting.py").write_text(METRIC)
    info = site / "other-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    points = "[sprung.readers]\nraw8 = other.reading:blocks\n\n[sprung.metrics]\ncars = other.counting:Cars\n"
    (info / "entry_points.txt").write_text(points)
    monkeypatch.syspath_prepend(site)
    recording.added_readers.cache_clear()  # of a process in which recordings were read before
    yield
    recording.added_readers.cache_clear()
    for name in [name for name in sys.modules if name.partition(".")[0] == "other"]:
        del sys.modules[name]


def test_a_reader_of_another_package_is_replayed(
    tmp_path: Path, package: None, capsys: pytest.CaptureFixture[str]
) -> None:
    system = parse_system(SYSTEM)
    t = np.arange(3000) / 100
    rng = np.random.default_rng(1)
    f, phase = rng.uniform(0.5, 10, 40), rng.uniform(0, 6.3, 40)
    z = (3e-3 / f * np.sin(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
    v = (6e-3 * np.pi * np.cos(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
    inputs = np.stack([z, v], axis=1)
    shown = simulate_ride(system, inputs, {"strut.stiffness": 23000.0}, noise=rng).sensors
    noisy = inputs + rng.normal(0, [1e-5, 1e-4], inputs.shape)
    np.column_stack([1.79e9 + t, noisy, shown]).tofile(tmp_path / "ride.raw8")
    (tmp_path / "one.yaml").write_text(SYSTEM)
    main(["replay", str(tmp_path / "ride.raw8"), "--system", str(tmp_path / "one.yaml"), "--json"])
    told = capsys.readouterr()
    summary = json.loads(told.out.splitlines()[-1])["summary"]
    stiffness = next(p for p in summary["parameters"] if p["name"] == "strut.stiffness")
    assert abs(stiffness["value"] - 23000) < 5 * stiffness["std"], told.err


def test_a_metric_of_another_package_is_shown(package: None, engine: Engine, data_dir: Path) -> None:
    core = build_core(Settings(data_dir=data_dir), engine)
    try:
        assert "other_answer 42.0" in core.metrics.render().decode()
    finally:
        core.close()


def test_a_law_from_a_file_is_known_to_the_diagnosis(tmp_path: Path) -> None:
    (tmp_path / "laws.py").write_text(LAW)
    (tmp_path / "one.yaml").write_text(SYSTEM.replace("1500}", "1500, laws: [{squeak: {size: 10}}]}"))
    laws = CATALOGUE + load_laws(tmp_path / "laws.py", ())
    assert "strut.squeak.size" in load_system(tmp_path / "one.yaml", laws).laws[0].names


def test_a_law_from_a_file_is_searched_by_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "laws.py").write_text(LAW)
    (tmp_path / "rig.yaml").write_text(RIG)
    rng, t = np.random.default_rng(4), np.arange(600) / 100
    travel, rate = 5e-3 * np.sin(2 * np.pi * 0.7 * t), 5e-3 * 1.4 * np.pi * np.cos(2 * np.pi * 0.7 * t)
    force = 4.0e4 * travel + 1.5e3 * rate + 60 * np.sin(travel / 1e-3) + rng.normal(0, 1.0, len(t))
    columns = np.column_stack([travel + rng.normal(0, 1e-6, len(t)), force])
    write_recording(tmp_path / "rig.csv", parse_system(RIG).channels, columns, 100.0, 10**18)
    given = ["--system", str(tmp_path / "rig.yaml"), "--laws", str(tmp_path / "laws.py"), "--json"]
    main(["diagnose", str(tmp_path / "rig.csv"), *given])
    told = capsys.readouterr()
    assert [f["effect"] for f in json.loads(told.out.splitlines()[-1])["findings"]] == ["squeak"], told.err


def test_a_sensor_kind_is_a_line_of_one_file(tmp_path: Path) -> None:
    """Of a copy of that file, in a process of its own: the kinds are known before a system is."""
    system = SYSTEM.replace("mass: 400", "mass: 400, roll_inertia: 90")
    system = system.replace("upper: car, lower: road", "upper: car, lower: road, position: [0, 1]")
    rate, turns = "{kind: roll_rate, body: car, csv: r}", "{kind: roll_acceleration, body: car, csv: p, unit: rad/s2}"
    (tmp_path / "one.yaml").write_text(system.replace("0.01}}", f"0.01}}, rate: {rate}, turns: {turns}}}"))
    words = [sys.executable, "-c", KIND, str(tmp_path / "kinds.py"), str(tmp_path / "one.yaml")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()) == (0, ["rad/s^2"]), done.stderr
