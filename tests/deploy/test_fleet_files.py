"""The examples of the fleet variant: they parse, and name commands, routes and settings that exist."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from typer.main import get_command

from sprung.service.api.scopes import need_of
from sprung.service.cli.app import app
from sprung.service.settings import Settings

FOLDER = Path(__file__).resolve().parents[2] / "deploy" / "fleet"
SCHEMA = Path(__file__).with_name("rayservice.schema.yaml")


def commands(node: Any) -> list[list[str]]:
    """Every list below a key `command` that begins with sprung."""
    if isinstance(node, dict):
        own = node.get("command")
        found = [own] if isinstance(own, list) and own[:1] == ["sprung"] else []
        return found + [one for value in node.values() for one in commands(value)]
    if isinstance(node, list):
        return [one for value in node for one in commands(value)]
    return []


def names(node: Any) -> set[str]:
    """Every key and name that begins with SPRUNG_."""
    if isinstance(node, dict):
        own = {key for key in node if str(key).startswith("SPRUNG_")}
        own |= {node["name"]} if str(node.get("name", "")).startswith("SPRUNG_") else set()
        return own.union(*(names(value) for value in node.values()))
    return set().union(*(names(value) for value in node)) if isinstance(node, list) else set()


@pytest.mark.parametrize("name", ["compose.yaml", "kubernetes.yaml"])
def test_examples_name_what_there_is(name: str) -> None:
    documents = list(yaml.safe_load_all((FOLDER / name).read_text()))
    found = [one for document in documents for one in commands(document)]
    assert len(found) >= 3
    for _, *words in found:
        command: Any = get_command(app)
        while words and hasattr(command, "commands"):
            command = command.commands[words.pop(0)]
        options = {text for parameter in command.params for text in parameter.opts}
        assert [word for word in words if word.startswith("--") and word not in options] == []
    known = {f"SPRUNG_{field.upper()}" for field in Settings.model_fields}
    assert set().union(*(names(document) for document in documents)) <= known


def test_probes_ask_routes_that_need_no_token() -> None:
    text = (FOLDER / "kubernetes.yaml").read_text()
    for path in ("/health/live", "/health/ready"):
        assert path in text
        assert need_of("GET", path).scope == ""


def test_ray_s_head_finds_the_redis_that_the_example_brings() -> None:
    documents = list(yaml.safe_load_all((FOLDER / "kubernetes.yaml").read_text()))
    kinds = {(one["kind"], one["metadata"]["name"]): one["spec"] for one in documents if "spec" in one}
    options = kinds["RayService", "sprung-ingest"]["rayClusterConfig"]["gcsFaultToleranceOptions"]
    name, _, port = options["redisAddress"].partition(":")
    service, pods = kinds["Service", name], kinds["StatefulSet", name]
    assert [str(one["port"]) for one in service["ports"]] == [port]
    [redis] = pods["template"]["spec"]["containers"]
    assert [str(one["containerPort"]) for one in redis["ports"]] == [port]
    assert service["selector"] == pods["selector"]["matchLabels"] == pods["template"]["metadata"]["labels"]
    assert redis["env"][0]["valueFrom"] == options["redisPassword"]["valueFrom"]  # the same secret on both sides
    claims = {claim["metadata"]["name"] for claim in pods["volumeClaimTemplates"]}
    assert {mount["name"] for mount in redis["volumeMounts"]} == claims  # and it outlives the pod


def ray_service() -> Any:
    """The one of the example."""
    return next(d for d in yaml.safe_load_all((FOLDER / "kubernetes.yaml").read_text()) if d["kind"] == "RayService")


def test_the_ray_service_has_the_fields_that_kuberay_takes() -> None:
    jsonschema.validate(ray_service(), yaml.safe_load(SCHEMA.read_text()))


@pytest.mark.parametrize(
    "wrong",
    [
        lambda spec: spec.update(serveConfig=spec.pop("serveConfigV2")),
        lambda spec: spec["rayClusterConfig"].pop("headGroupSpec"),
        lambda spec: spec["rayClusterConfig"].update(enableInTreeAutoscaling="yes"),
        lambda spec: spec["rayClusterConfig"]["headGroupSpec"]["rayStartParams"].update({"num-cpus": 0}),
        lambda spec: spec["rayClusterConfig"]["gcsFaultToleranceOptions"].pop("redisAddress"),
        lambda spec: spec["rayClusterConfig"]["workerGroupSpecs"][0].update(maxReplica=3),
    ],
)
def test_a_ray_service_that_kuberay_would_not_take_is_seen(wrong: Callable[[Any], object]) -> None:
    document = deepcopy(ray_service())
    wrong(document["spec"])
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(document, yaml.safe_load(SCHEMA.read_text()))


def test_the_application_that_ray_imports_is_there() -> None:
    document = ray_service()
    served = yaml.safe_load(document["spec"]["serveConfigV2"])["applications"][0]
    module, _, name = served["import_path"].partition(":")
    imported = __import__(module, fromlist=[name])
    assert callable(getattr(imported, name))


@pytest.mark.filterwarnings("ignore")  # Ray's own, when it is imported
def test_ray_takes_the_configuration_of_its_application() -> None:
    schema = pytest.importorskip("ray.serve.schema")
    document = ray_service()
    config = schema.ServeDeploySchema.model_validate(yaml.safe_load(document["spec"]["serveConfigV2"]))
    assert config.applications[0].args == {"replicas": 32, "least": 2, "cores": 1}
