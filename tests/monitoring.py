"""Prometheus and Alertmanager beside a service, on the configuration, rules and dashboards that are shipped."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import socket
import subprocess
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml

DEPLOY = Path(__file__).parents[1] / "deploy"
RULES = yaml.safe_load((DEPLOY / "prometheus" / "sprung.rules.yml").read_text())["groups"][0]["rules"]
SECONDS = 1  # between two scrapes, and two looks at the rules: a demo is shorter than a day


@dataclass(frozen=True, slots=True)
class Query:
    """What a panel, an annotation or a drop-down of a dashboard asks."""

    dashboard: str
    title: str
    expression: str


def made() -> ModuleType:
    """The module that makes the dashboards."""
    spec = importlib.util.spec_from_file_location("make", DEPLOY / "grafana" / "make.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def queries(vehicle: str) -> list[Query]:
    """Every query of every dashboard, about this vehicle and all of its elements."""
    found = []
    for name, build in made().DASHBOARDS.items():
        board = build()
        asked = [(panel["title"], target["expr"]) for panel in board["panels"] for target in panel["targets"]]
        asked += [(note["name"], note["expr"]) for note in board["annotations"]["list"]]
        for variable in board["templating"]["list"]:
            series = re.match(r"label_values\((.*), \w+\)", variable["query"])
            asked += [(variable["name"], series[1])] if series else []
        for title, expression in asked:
            filled = expression.replace("$vehicle", vehicle).replace('="$element"', '=~".*"').replace("$element", ".*")
            found.append(Query(name, title, filled))
    return found


def ask(prometheus: str, query: str) -> list[Any]:
    """What a Prometheus answers to a query; fails where it refuses it."""
    url = f"{prometheus}/api/v1/query?{urllib.parse.urlencode({'query': query})}"
    try:
        with urllib.request.urlopen(url, timeout=30) as answer:
            found = json.load(answer)
    except urllib.error.HTTPError as error:
        raise AssertionError(f"{query}: {error.read().decode()}") from error
    result: list[Any] = found["data"]["result"]
    return result


def free_port() -> int:
    """One that nobody listens on just now."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port: int = free.getsockname()[1]
        return port


@contextmanager
def prometheus(target: str, folder: Path, alertmanager: str | None = None) -> Iterator[str]:
    """The address of a Prometheus that scrapes the target (host:port) and sends its alerts on."""
    config = yaml.safe_load((DEPLOY / "prometheus" / "prometheus.yml").read_text())
    config["global"] = {"scrape_interval": f"{SECONDS}s", "evaluation_interval": f"{SECONDS}s"}
    config["scrape_configs"][0]["static_configs"] = [{"targets": [target]}]
    config["alerting"]["alertmanagers"][0]["static_configs"] = [{"targets": [alertmanager] if alertmanager else []}]
    (folder / "prometheus.yml").write_text(yaml.safe_dump(config))
    shutil.copy(DEPLOY / "prometheus" / "sprung.rules.yml", folder)
    port = free_port()
    command = ["prometheus", f"--config.file={folder}/prometheus.yml", f"--storage.tsdb.path={folder}/tsdb"]
    with _running([*command, f"--web.listen-address=127.0.0.1:{port}"]):
        yield f"http://127.0.0.1:{port}"


@contextmanager
def alertmanager(receiver: str, folder: Path) -> Iterator[str]:
    """Host and port of an Alertmanager whose receivers are all this webhook, and which does not wait for more."""
    config = yaml.safe_load((DEPLOY / "prometheus" / "alertmanager.yml").read_text())
    config["route"] |= {"group_wait": "0s", "group_interval": "1s"}
    for one in config["receivers"]:
        one["webhook_configs"] = [{"url": receiver}]
    (folder / "alertmanager.yml").write_text(yaml.safe_dump(config))
    port = free_port()
    command = ["prometheus-alertmanager", f"--config.file={folder}/alertmanager.yml"]
    command += [f"--storage.path={folder}/alerts", f"--web.listen-address=127.0.0.1:{port}"]
    with _running([*command, "--cluster.listen-address="]):
        yield f"127.0.0.1:{port}"


@contextmanager
def _running(command: list[str]) -> Iterator[None]:
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.terminate()
