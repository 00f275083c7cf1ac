"""What is shipped: package data, locks, image, dashboards and rules agree with the code."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from setuptools import find_packages

from sprung.model.signals import Tally
from sprung.model.system import System
from sprung.service.monitoring.board import Board
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.observability.metrics import Metrics
from tests.service_fakes import make_window

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
# not in this registry; test_deploy asks for them
OF_THE_SERVICE = ("sprung_bus_", "sprung_feed_", "sprung_queue_", "sprung_build_", "sprung_fleet_")
SUFFIXES = ("_bucket", "_sum", "_count", "_total")


def locked(name: str) -> dict[str, str]:
    lines = (ROOT / name).read_text().splitlines()
    pairs = (line.split("==") for line in lines if line and not line.startswith("#"))
    return {canonicalize_name(package): version for package, version in pairs}


def test_every_folder_with_modules_is_installed() -> None:
    found = set(find_packages(str(ROOT), include=PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]))
    folders = {
        "sprung." + path.parent.relative_to(ROOT).as_posix().replace("/", ".")
        for top in ("model", "replay", "service", "benchmarks")
        for path in (ROOT / top).rglob("*.py")
    }
    assert folders <= found


def test_files_that_are_no_modules_are_package_data() -> None:
    data = PROJECT["tool"]["setuptools"]["package-data"]
    for top in ("model", "replay", "service", "benchmarks"):
        shipped = {path for pattern in data.get(f"sprung.{top}", []) for path in (ROOT / top).glob(pattern)}
        tracked = subprocess.run(
            ["git", "ls-files", top], cwd=ROOT, capture_output=True, text=True, check=False
        ).stdout.split()
        left_out = [p for p in tracked if not p.endswith(".py") and ROOT / p not in shipped and (ROOT / p).exists()]
        assert left_out == []


def test_the_lock_satisfies_the_bounds_and_every_dependency_has_both() -> None:
    versions = locked("requirements.lock")
    for line in PROJECT["project"]["dependencies"]:
        requirement = Requirement(line)
        assert any(s.operator in ("<", "==") for s in requirement.specifier), f"{line} has no upper bound"
        assert requirement.specifier.contains(versions[canonicalize_name(requirement.name)]), line
    developer = locked("requirements-dev.lock")
    for line in PROJECT["project"]["optional-dependencies"]["dev"]:
        requirement = Requirement(line)
        assert requirement.specifier.contains(developer[canonicalize_name(requirement.name)]), line


def test_the_command_in_pyproject_exists() -> None:
    module, _, function = PROJECT["project"]["scripts"]["sprung"].partition(":")
    assert callable(getattr(import_module(module), function))


def test_commands_of_the_readme_are_targets_of_the_makefile() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    used = set(re.findall(r"make ([a-z-]+)", (ROOT / "README.md").read_text()))
    assert {"demo", "test"} <= used <= targets
    assert "make test" in (ROOT / ".ci" / "run").read_text()


def test_bundled_data_is_small() -> None:
    assert sum(path.stat().st_size for path in (ROOT / "tests" / "data").rglob("*") if path.is_file()) < 20e6


@pytest.fixture
def metric_names(engine: Engine, system: System, pipeline: Pipeline) -> set[str]:
    """Names in a registry that has seen a vehicle."""
    board = Board(engine, 10)
    metrics = Metrics(board, 10)
    board.on_batch(batch := pipeline.process("a", [make_window(system, i) for i in range(70)]))
    board.on_batch(pipeline.process("a", [make_window(system, 100, outcome="dropped")]))
    metrics.observe(batch.seconds)
    metrics.count_frames("file", Tally(), Tally(used=3))
    return {line.split("{")[0].split(" ")[0] for line in metrics.render().decode().splitlines() if line[0] != "#"}


def test_the_metrics_of_the_contract_exist(metric_names: set[str]) -> None:
    assert {
        "sprung_stiffness_newtons_per_meter",
        "sprung_damping_newton_seconds_per_meter",
        "sprung_parameter_ratio",
        "sprung_parameter_ratio_stddev",
        "sprung_fit_nrmse",
        "sprung_windows_total",
        "sprung_frames_total",
        "sprung_identify_duration_seconds_bucket",
        "sprung_alarms_active",
        "sprung_last_window_timestamp_seconds",
    } <= metric_names


def test_dashboards_and_rules_ask_only_for_metrics_that_exist(metric_names: set[str]) -> None:
    asked: dict[str, set[str]] = {}
    for path in (ROOT / "deploy" / "grafana" / "dashboards").glob("*.json"):
        dashboard = json.loads(path.read_text())
        texts = [t["expr"] for panel in dashboard["panels"] for t in panel["targets"]]
        texts += [v["query"] for v in dashboard.get("templating", {}).get("list", []) if v["type"] == "query"]
        asked[path.name] = {name for text in texts for name in re.findall(r"sprung_\w+", text)}
    rules = yaml.safe_load((ROOT / "deploy" / "prometheus" / "sprung.rules.yml").read_text())
    texts = [rule["expr"] for group in rules["groups"] for rule in group["rules"]]
    asked["rules"] = {name for text in texts for name in re.findall(r"sprung_\w+", text)}
    assert all(asked.values())
    asked = {where: {n for n in names if not n.startswith(OF_THE_SERVICE)} for where, names in asked.items()}
    for where, names in asked.items():
        assert names <= metric_names, where


@pytest.mark.skipif(shutil.which("promtool") is None, reason="needs promtool, of the package prometheus")
def test_alerting_rules_fire_as_their_tests_say() -> None:
    folder = ROOT / "deploy" / "prometheus"
    done = subprocess.run(
        ["promtool", "test", "rules", *sorted(path.name for path in folder.glob("*.test.yml"))],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_series_per_parameter_stay_within_the_budget_of_vehicles(
    engine: Engine, system: System, pipeline: Pipeline
) -> None:
    board = Board(engine, 10)
    for vehicle in ("a", "b", "c"):
        board.on_batch(pipeline.process(vehicle, [make_window(system, 0)]))
    text = Metrics(board, 2).render().decode()
    assert 'sprung_fit_nrmse{sensor="car_1l",vehicle="c"}' in text
    assert 'sprung_fit_nrmse{sensor="car_1l",vehicle="b"}' in text
    assert 'sprung_fit_nrmse{sensor="car_1l",vehicle="a"}' not in text
    assert 'sprung_windows_total{outcome="used",vehicle="a"} 1.0' in text


def dockerfile() -> list[tuple[str, str]]:
    """Instructions of the Dockerfile in order, lines joined."""
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    lines = (line.strip() for line in text.splitlines())
    pairs = (line.split(None, 1) for line in lines if line and not line.startswith("#"))
    return [(word, rest) for word, rest in pairs]


def test_the_image_runs_as_nobody_special_and_says_how_it_is() -> None:
    words = [word for word, _ in dockerfile()]
    assert words.count("FROM") == 2
    last = dockerfile()[len(words) - 1 - words[::-1].index("FROM") :]
    assert [rest for word, rest in last if word == "USER"] == ["sprung"]
    assert any(word == "HEALTHCHECK" for word, _ in last)
    assert json.loads(next(rest for word, rest in last if word == "CMD")) == ["sprung", "serve"]
    compose = yaml.safe_load((ROOT / "deploy" / "docker-compose.yaml").read_text())
    assert compose["services"]["sprung"]["read_only"] is True


def test_every_file_that_the_image_copies_is_let_through(tmp_path: Path) -> None:
    let_through = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    for word, rest in dockerfile():
        if word == "COPY" and not rest.startswith("--from"):
            *sources, _ = rest.split()
            assert {source.removeprefix("./") for source in sources} <= let_through


@pytest.mark.slow
def test_the_steps_of_the_image_make_a_service_that_answers(tmp_path: Path) -> None:
    """No container engine: the first stage's steps run in a clean folder, then CMD and HEALTHCHECK on its result."""
    source, prefix, home = tmp_path / "src", tmp_path / "opt", tmp_path / "home"
    source.mkdir()
    home.mkdir()
    environment = {name: os.environ[name] for name in ("PATH", "HOME", "LANG", "PIP_CONFIG_FILE") if name in os.environ}
    environment |= {name: value for name, value in os.environ.items() if name.startswith("PIP_")}
    environment["TORCH_INDEX"] = os.environ.get("TORCH_INDEX", "https://pypi.org/simple")
    stage = 0
    command: list[str] = []
    check: list[str] = []
    for word, rest in dockerfile():
        stage += word == "FROM"
        if stage == 1 and word == "COPY":
            *names, target = rest.split()
            for name in names:
                path = ROOT / name
                if path.is_dir():
                    shutil.copytree(path, source / target, ignore=shutil.ignore_patterns("__pycache__"))
                else:
                    shutil.copy(path, source / path.name)
        elif stage == 1 and word == "RUN":
            step = rest.replace("/opt/sprung", str(prefix)).replace("python3 -m venv", f"{sys.executable} -m venv")
            done = subprocess.run(
                ["bash", "-ec", step], cwd=source, env=environment, capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, f"{step}\n{done.stdout}\n{done.stderr}"
        elif stage == 2 and word == "ENV":
            for pair in shlex.split(rest):
                name, _, value = pair.partition("=")
                if name != "PATH":
                    environment[name] = value.replace("/var/lib/sprung", str(home))
        elif stage == 2 and word == "HEALTHCHECK":
            check = json.loads(rest[rest.index("[") :])
        elif stage == 2 and word == "CMD":
            command = json.loads(rest)
    environment |= {"PATH": f"{prefix}/bin:{environment['PATH']}", "SPRUNG_HOST": "127.0.0.1", "SPRUNG_PORT": "18743"}
    with subprocess.Popen(command, cwd=home, env=environment) as process:
        try:
            for _ in range(600):  # a refusal comes at once: the service may need many on a busy machine
                healthy = subprocess.run(check, env=environment, cwd=home, capture_output=True, check=False).returncode
                if healthy == 0 or process.poll() is not None:
                    break
            assert healthy == 0
        finally:
            process.terminate()
        assert process.wait(30) == 0


@pytest.mark.parametrize("lock", ["requirements", "requirements-dev", "requirements-fleet"])
def test_the_lock_with_hashes_is_the_lock(lock: str) -> None:
    def pinned(name: str) -> list[str]:
        lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
        found = [line.split()[0].lower().partition("==") for line in lines if "==" in line and not line.startswith("#")]
        return sorted(f"{re.sub('[-_.]+', '-', package)}=={version}" for package, _, version in found)

    plain = [line for line in pinned(f"{lock}.lock") if not line.startswith("torch==")]
    assert pinned(f"{lock}.hashes.lock") == plain, "run `make lock`"
    assert (ROOT / f"{lock}.hashes.lock").read_text(encoding="utf-8").count("--hash=sha256:") >= len(plain)
