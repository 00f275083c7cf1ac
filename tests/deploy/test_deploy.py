"""Dashboards and rules: made by code, every query answered by a real Prometheus that scrapes a running service."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import uvicorn
import yaml

from sprung.model.signals import Tally
from sprung.model.system import System
from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from sprung.service.sources.live import FeedStatus
from tests.monitoring import DEPLOY, RULES, ask, made, prometheus, queries
from tests.service_fakes import make_window

MKDOCS = shutil.which("mkdocs", path=str(Path(sys.executable).parent))  # CI does not activate its environment
MAY_BE_EMPTY = {"Alarms"}  # an annotation: alarms that opened within the last minute


def test_committed_dashboards_are_what_the_code_makes() -> None:
    make = made()
    kept = {path.name for path in (DEPLOY / "grafana" / "dashboards").glob("*.json")}
    assert kept == set(make.DASHBOARDS)
    for name in kept:
        assert (DEPLOY / "grafana" / "dashboards" / name).read_text() == make.text(name), "run deploy/grafana/make.py"


def test_panels_do_not_lie_on_each_other_and_the_fleet_leads_to_vehicles() -> None:
    for name, build in made().DASHBOARDS.items():
        taken: set[tuple[int, int]] = set()
        for panel in build()["panels"]:
            at = panel["gridPos"]
            cells = {(at["x"] + i, at["y"] + j) for i in range(at["w"]) for j in range(at["h"])}
            assert not cells & taken and at["x"] + at["w"] <= 24, (name, panel["title"])
            taken |= cells
    assert "/d/sprung-vehicle?var-vehicle=" in made().text("fleet.json")


def test_every_rule_is_tested_firing_and_not_firing() -> None:
    files = (DEPLOY / "prometheus").glob("*.test.yml")
    tests = [test for path in files for test in yaml.safe_load(path.read_text())["tests"]]
    cases = [case for test in tests for case in test["alert_rule_test"]]
    for rule in RULES:
        fired = {bool(case["exp_alerts"]) for case in cases if case["alertname"] == rule["alert"]}
        assert fired == {True, False}, rule["alert"]
    silent = [case["eval_time"] for case in cases if case["alertname"] == "SprungVehicleSilent" and case["exp_alerts"]]
    assert max(int(text.removesuffix("m")) for text in silent) > 24 * 60


def test_compose_tells_somebody_and_has_no_usual_password() -> None:
    services = yaml.safe_load((DEPLOY / "docker-compose.yaml").read_text())["services"]
    assert "alertmanager" in services and all(":" in service["image"] for service in services.values())
    assert "?" in services["grafana"]["environment"]["GF_SECURITY_ADMIN_PASSWORD"]
    assert all("mem_limit" in service for service in services.values())
    fleet = yaml.safe_load((DEPLOY / "fleet" / "compose.yaml").read_text())["services"]
    assert all("mem_limit" in service for service in fleet.values())


def test_images_of_others_are_pinned_by_digest() -> None:
    compose = yaml.safe_load((DEPLOY / "docker-compose.yaml").read_text())
    names = [part["image"] for part in compose["services"].values() if "build" not in part]
    dockerfile = (DEPLOY.parent / "Dockerfile").read_text()
    names += re.findall(r"^ARG BASE=(.*)$", dockerfile, re.MULTILINE)
    names += [name for name in re.findall(r"^FROM (\S+)", dockerfile, re.MULTILINE) if name != "${BASE}"]
    for path in (DEPLOY / "fleet").glob("*.yaml"):
        others = re.findall(r"^ *image: (\S+)", path.read_text(), re.MULTILINE)
        names += [name for name in others if not name.startswith("sprung-fleet:")]
    assert len(names) >= 8
    assert [name for name in names if not re.search(r":[\w.-]+@sha256:[0-9a-f]{64}$", name)] == []


@pytest.mark.skipif(shutil.which("amtool") is None, reason="needs amtool, of the package prometheus-alertmanager")
def test_the_configuration_of_alertmanager_is_one() -> None:
    command = ["amtool", "check-config", str(DEPLOY / "prometheus" / "alertmanager.yml")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


class Bus:
    """A live feed as the service lists it."""

    def status(self) -> FeedStatus:
        return FeedStatus("socketcan:can0", "a", "receiving", "", 0.01, 0, 0, 0, 0, 1)


@pytest.fixture
def core(engine: Engine, data_dir: Path) -> Core:
    built = build_core(Settings(data_dir=data_dir), engine)
    built.feeds.append(Bus())  # type: ignore[arg-type]
    return built


@pytest.fixture
def judge(core: Core, system: System, tmp_path: Path) -> Iterator[str]:
    """The address of a Prometheus that has scraped an alarmed vehicle for a while."""
    server = uvicorn.Server(uvicorn.Config(create_app(core), port=0, log_level="warning", lifespan="on"))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        thread.join(0.05)
    with prometheus(f"127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}", tmp_path) as address:
        replay(core, system)
        yield address
    server.should_exit = True
    thread.join(20)


def replay(core: Core, system: System) -> None:
    """A vehicle that changes while it is scraped; some windows are dropped, some messages corrupt."""
    count = core.tally_counter("file")
    for step in range(10):
        level = 0.0 if step < 5 else 0.3
        windows = [make_window(system, 20 * step + i, level) for i in range(18)]
        windows += [make_window(system, 20 * step + 18 + i, level, "dropped") for i in range(2)]
        core.metrics.observe(core.pipeline.process("a", windows).seconds)
        count(Tally(used=100 * step, corrupt=step))
        time.sleep(1.0)


@pytest.mark.skipif(shutil.which("prometheus") is None, reason="needs prometheus, of the package of that name")
def test_every_query_of_panels_variables_and_rules_is_answered(judge: str) -> None:
    asked = [query for query in queries("a") if query.title not in MAY_BE_EMPTY]
    assert [query for query in asked if not ask(judge, query.expression)] == []
    for rule in RULES:
        ask(judge, rule["expr"])
        for metric in re.findall(r"sprung_\w+", rule["expr"]):
            assert ask(judge, metric), (rule["alert"], metric)
    assert {alert["metric"]["alertname"] for alert in ask(judge, "ALERTS")} >= {"SprungSuspensionChanged"}


@pytest.mark.skipif(MKDOCS is None, reason="needs mkdocs, as `make docs` installs it")
def test_the_site_of_the_documents_asks_no_other_host(tmp_path: Path) -> None:
    root = DEPLOY.parent
    assert MKDOCS is not None
    command = [MKDOCS, "build", "--quiet", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    first = (tmp_path / "site" / "index.html").read_text()
    assert [path.stem for path in (root / "docs").rglob("*.md") if f"{path.stem}.html" not in first] == ["README"]
    assert {page.stem for page in pages} >= {path.stem for path in (root / "docs").glob("*.md")}
    for page in pages:
        loaded = re.findall(r"<(?:script|img|iframe)[^>]* src=\"([^\"]+)\"", page.read_text())
        loaded += re.findall(r"<link[^>]* rel=\"stylesheet\"[^>]* href=\"([^\"]+)\"", page.read_text())
        loaded += re.findall(r"<link[^>]* href=\"([^\"]+)\"[^>]* rel=\"stylesheet\"", page.read_text())
        assert not [link for link in loaded if link.startswith(("http", "//"))], page
