"""Reading a system file: all that is wrong with it at once, each with its line and key, in plain words."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from sprung.model.address import TimeKey
from sprung.model.laws.placed import did_you_mean
from sprung.model.schema import Body, Element, Input, Parts, Sensor, Speed, SystemFile, SystemFileError
from sprung.model.text import hidden_character

_ENTRIES: dict[str, TypeAdapter[Any]] = {
    "bodies": TypeAdapter(Body),
    "inputs": TypeAdapter(Input),
    "elements": TypeAdapter(Element),
    "sensors": TypeAdapter(Sensor),
}
_PATTERNS = {
    "mcap": "/topic.field is expected",
    "can": "Message.Signal is expected",
}
MOST_PROBLEMS = 20  # that are listed
DEEPEST = 50  # brackets or indents inside each other; a system file has six
LONGEST_SHOWN = 100  # characters of a value that is wrong
MOST_BYTES = 2_000_000  # a system file has 10 kB
MOST_NODES = 20_000  # names and values, with those that aliases repeat; a vehicle has 600
TOO_MANY = f"more than {MOST_NODES} names and values, with those that aliases repeat"


class _Loader(yaml.SafeLoader):
    """YAML 1.2 floats (1e-5 is a number); keys that occur twice are noted in `problems`."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self.problems: list[tuple[int, str]] = []  # line, key and message
        self.nodes = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """What is too large is not read to its end: that would take seconds."""
        self.nodes += 1
        if self.nodes > MOST_NODES:
            raise yaml.YAMLError(TOO_MANY)
        return super().compose_node(parent, index)

    def fetch_flow_collection_start(self, token: Any) -> None:
        """What is nested without end costs the square of its depth to be looked at."""
        self._not_too_deep(self.flow_level)
        super().fetch_flow_collection_start(token)

    def add_indent(self, column: int) -> Any:
        """The same by indents."""
        self._not_too_deep(len(self.indents))
        return super().add_indent(column)

    def _not_too_deep(self, level: int) -> None:
        if level >= DEEPEST:
            raise yaml.YAMLError(f"line {self.line + 1}: nested more than {DEEPEST} deep")


def _size(node: yaml.Node, known: dict[int, int]) -> int:
    """Nodes of a document as they are once aliases stand for what they name; raises YAMLError when there are too many.

    known: sizes of nodes that were counted; 0 of one that is being counted, so that it holds itself.
    """
    if id(node) in known:
        if not known[id(node)]:
            raise yaml.YAMLError(f"line {node.start_mark.line + 1}: it refers to itself")
        return known[id(node)]
    known[id(node)] = 0
    inside = node.value if isinstance(node, yaml.CollectionNode) else ()
    parts = [part for item in inside for part in (item if isinstance(item, tuple) else (item,))]
    known[id(node)] = size = 1 + sum(_size(part, known) for part in parts)
    if size > MOST_NODES:
        raise yaml.YAMLError(TOO_MANY)
    return size


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)$"),
    list("-+0123456789."),
)


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    seen: set[Any] = set()
    for key, _ in node.value:
        if key.value in seen:
            loader.problems.append((key.start_mark.line + 1, f"{key.value}: this key occurs twice"))
        seen.add(key.value)
    return dict(loader.construct_pairs(node, deep=True))


_Loader.add_constructor("tag:yaml.org,2002:map", _mapping)


def read_system_file(path: str | Path) -> SystemFile:
    """Read and check a system file.

    Errors: `SystemFileError`, one line: file, and of each problem line, key, what is wrong.
    """
    try:
        with Path(path).open("rb") as file:  # a device never ends
            content = file.read(MOST_BYTES + 1)
        if len(content) > MOST_BYTES:
            raise SystemFileError(f"{path}: is no system file: it has more than {MOST_BYTES // 1_000_000} MB")
        text = content.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise SystemFileError(f"{path}: cannot read the system file: {reason}") from None
    return parse_system_file(text, str(path))


def parse_system_file(text: str, source: str = "system file") -> SystemFile:
    """Check the text of a system file; `source` names it in errors."""
    try:
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            if node is not None:
                _size(node, {})
            raw = loader.construct_document(node) if node is not None else None
        finally:
            loader.dispose()
    except (yaml.YAMLError, RecursionError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise SystemFileError(f"{source}: {_syntax(error)}") from None
    if not isinstance(raw, Mapping):
        raise SystemFileError(f"{source}: a mapping with name, bodies, elements, sensors is expected")
    problems, file = loader.problems + _hidden(node), None
    try:
        file = SystemFile.model_validate(raw)
    except ValidationError as error:
        problems += [_explain(detail, node) for detail in error.errors() if detail["loc"]]
        problems += [_placed(line, node) for line in _references(error, raw)]
    if problems or file is None:
        raise _error(source, problems)
    return file


def _syntax(error: Exception) -> str:
    """Where a text is not YAML, and why."""
    if not isinstance(error, yaml.MarkedYAMLError) or error.problem_mark is None:
        return f"not YAML: {' '.join(str(error).split())[:200]}"
    problem = " ".join(part for part in (error.context, error.problem) if part)
    hint = "; indent with spaces, not with tabs" if "'\\t'" in problem else ""
    return f"line {error.problem_mark.line + 1}: not YAML: {' '.join(problem.split())[:200]}{hint}"


def _hidden(document: yaml.Node | None) -> list[tuple[int, str]]:
    """Names and texts with invisible characters, which would end up on terminals, in logs and on pages."""
    found: list[tuple[int, str]] = []
    seen: set[int] = set()
    left = [document] if document is not None else []
    while left:
        node = left.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, yaml.CollectionNode):
            left += [part for item in node.value for part in (item if isinstance(item, tuple) else (item,))]
        elif character := hidden_character(node.value.removesuffix("\n")):  # what a block of text ends with
            line, text = node.start_mark.line + 1, node.value[:40]
            found.append((line, f"{text!a}: holds an invisible character ({character})"))
    return found


def _error(source: str, problems: list[tuple[int, str]]) -> SystemFileError:
    """All problems, by line, each once."""
    lines = tuple(f"{source}: line {line}: {what}" for line, what in sorted(dict.fromkeys(problems)))
    if len(lines) == 1:
        return SystemFileError(lines[0])
    listed = "; ".join(line.removeprefix(f"{source}: ") for line in lines[:MOST_PROBLEMS])
    more = f"; and {len(lines) - MOST_PROBLEMS} more" if len(lines) > MOST_PROBLEMS else ""
    return SystemFileError(f"{source}: {len(lines)} problems: {listed}{more}", lines)


def _references(error: ValidationError, raw: Mapping[Any, Any]) -> list[str]:
    """`key: what is wrong` of everything that is wrong between the parts, also where single parts are wrong."""
    whole = [detail for detail in error.errors() if not detail["loc"]]
    if whole:
        return [line for detail in whole for line in _plain(detail["msg"]).split("\n")]
    groups = {group: _sound(adapter, raw.get(group)) for group, adapter in _ENTRIES.items()}
    time, speed = (
        _sound(TypeAdapter(kind), {0: raw.get(key)})[0] for key, kind in (("time", TimeKey), ("speed", Speed))
    )
    estimate = raw.get("estimate", SystemFile.model_fields["estimate"].default)
    known = estimate if isinstance(estimate, (list, tuple)) else ()
    return list(Parts(**groups, time=time, speed=speed, estimate=[str(e) for e in known]).problems())


def _sound(adapter: TypeAdapter[Any], group: Any) -> dict[Any, Any]:
    """The entries of a group, None for those that are wrong in themselves."""
    sound: dict[Any, Any] = {}
    for name, entry in group.items() if isinstance(group, Mapping) else ():
        try:
            sound[name] = adapter.validate_python(entry)
        except ValidationError:
            sound[name] = None
    return sound


def _placed(problem: str, node: yaml.Node | None) -> tuple[int, str]:
    """Line, and the problem, of a reference `key: what is wrong`."""
    key = problem.split(": ", 1)[0]
    return _line_of(node, key.split(".")), problem


def _explain(detail: ErrorDetails, node: yaml.Node | None) -> tuple[int, str]:
    """Line, and `key: what is wrong`, of one problem that pydantic found."""
    location = [str(part) for part in detail["loc"]]
    keys = _existing_keys(node, location)
    if detail["type"] == "missing":
        keys = [*keys, location[-1]]
    return _line_of(node, keys), f"{'.'.join(keys)}: {_words(detail, keys)}"


def shortened(text: str) -> str:
    """The beginning of what is too long for a line."""
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]} ..."


def _words(detail: ErrorDetails, keys: list[str]) -> str:
    """What is wrong, in plain words."""
    given, limits = detail["input"], detail.get("ctx", {})
    value = f", not {shortened(repr(given))}" if isinstance(given, (str, int, float)) else ""
    match detail["type"]:
        case "too_long" if "field_type" in limits and limits["field_type"] == "Dictionary":
            return f"at most {limits['max_length']} are possible"
        case "missing":
            return "this key is missing"
        case "extra_forbidden":
            known = _all_keys()
            return "this key has no place here" if keys[-1] in known else f"unknown key{did_you_mean(keys[-1], known)}"
        case "union_tag_not_found":
            return "kind: this key is missing"
        case "union_tag_invalid":
            known = str(limits["expected_tags"]).replace("'", "").split(", ")
            near = did_you_mean(limits["tag"], known)
            return f"kind {limits['tag']!r} is unknown here; known are {', '.join(known)}{near}"
        case "literal_error":
            known = str(limits["expected"]).replace("'", "").replace(" or ", ", ").split(", ")
            return f"one of {', '.join(known)} is expected{value}{did_you_mean(str(given), known)}"
        case "greater_than" | "greater_than_equal" | "less_than" | "less_than_equal" as kind:
            words = kind.replace("_equal", "_or_equal_to").replace("than_or", "than or").replace("_", " ")
            return f"must be {words} {next(iter(limits.values())):g}{value}"
        case "finite_number":
            return f"a finite number is expected{value}"
        case "string_pattern_mismatch" if keys[-1] in _PATTERNS:
            return f"{_PATTERNS[keys[-1]]}{value}"
        case "string_pattern_mismatch":
            return f"a name of letters, digits, _ and -, beginning with a letter, is expected{value}"
        case "string_too_short" | "too_short":
            return "must not be empty"
        case "string_type":
            return f"text is expected{value}"
        case "int_parsing" | "int_type" | "int_from_float":
            return f"a whole number is expected{value}"
        case "float_parsing" | "float_type":
            return f"a number is expected{value}"
        case "bool_parsing" | "bool_type":
            return f"true or false is expected{value}"
        case "model_type" | "model_attributes_type" | "dict_type":
            scalar = keys and keys[-1] in ("stiffness", "damping", "mass", "speed")
            return f"a {'number or a ' if scalar else ''}mapping is expected{value}"
        case "tuple_type":
            return f"a list is expected{value}"
    return _plain(detail["msg"])


def _plain(message: str) -> str:
    return message.removeprefix("Value error, ")


def _all_keys() -> list[str]:
    """Every key that the format has anywhere."""
    schema = SystemFile.model_json_schema()
    kinds = [schema, *schema["$defs"].values()]
    return sorted({key for kind in kinds for key in kind.get("properties", ())})


def _existing_keys(node: yaml.Node | None, location: list[str]) -> list[str]:
    """Drop the parts of a pydantic location (union tags, validators) that are not keys of the file."""
    keys: list[str] = []
    for part in location:
        child = _child(node, part)
        if child is None:
            continue
        keys.append(part)
        node = child[1]
    return keys


def _child(node: yaml.Node | None, key: str) -> tuple[yaml.Node, yaml.Node] | None:
    if isinstance(node, yaml.MappingNode):
        for name, value in reversed(node.value):  # of a repeated key the last one counts
            if name.value == key:
                return name, value
    if isinstance(node, yaml.SequenceNode) and key.isdigit() and int(key) < len(node.value):
        return node.value[int(key)], node.value[int(key)]
    return None


def _line_of(node: yaml.Node | None, keys: list[str]) -> int:
    line = node.start_mark.line if node is not None else 0
    for key in keys:
        child = _child(node, key)
        if child is None:
            break
        line, node = child[0].start_mark.line, child[1]
    return line + 1


def written(file: SystemFile) -> str:
    """The text of a system file; read again it is the same file."""
    return yaml.safe_dump(
        file.model_dump(mode="json", exclude_unset=True, exclude_none=True), sort_keys=False, width=110
    )


def json_schema() -> dict[str, Any]:
    """JSON Schema of the format, for editors that complete and check while typing."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Sprung system file",
        **{key: value for key, value in SystemFile.model_json_schema().items() if key != "title"},
    }
