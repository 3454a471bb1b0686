"""Reads YAML 1.2 so that every key and value keeps its file, line and column."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from fmus.component import ConfigurationError, Problem

KeyPath = tuple[str | int, ...]
MOST_VALUES = 100_000


class Place(NamedTuple):
    """A point in a file; lines and columns count from 1, 0 means not known."""

    file: str = ""
    line: int = 0
    column: int = 0


class Move(NamedTuple):
    """A value at `path` that was written at `place`, and asked for at `key`."""

    path: KeyPath
    place: Place
    key: Place


@dataclass(frozen=True)
class Places:
    """Where the keys and values of a document stand, by their path like ("parts", "plant", "with", "k")."""

    file: str = ""
    values: Mapping[KeyPath, Place] = field(default_factory=dict)
    keys: Mapping[KeyPath, Place] = field(default_factory=dict)

    def of(self, path: Sequence[str | int], among: Mapping[KeyPath, Place] | None = None) -> Place:
        """The place of the value at `path`, or of the nearest value around it."""
        for length in range(len(path), -1, -1):
            for table in (among, self.values):
                if table is not None and tuple(path[:length]) in table:
                    return table[tuple(path[:length])]
        return Place(self.file)

    def problem(self, message: str, *path: str | int) -> Problem:
        """A Problem at the value of `path`."""
        return Problem(message, *self.of(path))

    def key_problem(self, message: str, *path: str | int) -> Problem:
        """A Problem at the key that ends `path`."""
        return Problem(message, *self.of(path, self.keys))

    def mirrored(self, source: KeyPath, target: KeyPath) -> Places:
        """The same places, with what stands below `source` found below `target` too."""
        tables = []
        for table in (self.values, self.keys):
            inside = {path[len(source) :]: spot for path, spot in table.items() if path[: len(source)] == source}
            replaced = {path[0] for path in inside if path}
            kept = {path: spot for path, spot in table.items() if not _is_below(path, target, replaced)}
            tables.append(kept | {(*target, *path): spot for path, spot in inside.items() if path})
        return Places(self.file, *tables)

    def moved(self, moves: Sequence[Move]) -> Places:
        """The same places, but what is at the path of each move, and below, was written elsewhere."""
        values, keys = dict(self.values), dict(self.keys)
        for path, place, key in moves:
            for table in (values, keys):
                if path in table:
                    for known in [known for known in table if known[: len(path)] == path]:
                        del table[known]
            for made in (path[:length] for length in range(1, len(path))):
                values.setdefault(made, key)
                keys.setdefault(made, key)
            values[path], keys[path] = place, key
        return Places(self.file, values, keys)


def _is_below(path: KeyPath, target: KeyPath, names: set[str | int]) -> bool:
    depth = len(target)
    return len(path) > depth and path[:depth] == target and path[depth] in names


def read_yaml(text: str, file: str = "") -> tuple[Any, Places]:
    """The plain value of a YAML 1.2 text and the places of everything in it.

    Raises ConfigurationError: not YAML (at the place where reading stopped), or any keys given twice (all of them).
    """
    try:
        root = YAML(typ="safe", pure=True).compose(text)
    except MarkedYAMLError as error:
        raise ConfigurationError(_syntax_problem(error, text, file)) from None
    except YAMLError as error:
        raise ConfigurationError(Problem(f"not YAML: {' '.join(str(error).split())}", file)) from None
    reader = _Reader(file)
    value = reader.read(root, (), ()) if root is not None else None
    if reader.problems:
        raise ConfigurationError(reader.problems)
    return value, Places(file, reader.values, reader.keys)


def read_yaml_file(path: Path) -> tuple[Any, Places]:
    """`read_yaml` of a file. Raises ConfigurationError also where it cannot be read."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(Problem(f"cannot be read: {error.strerror}", str(path))) from None
    except UnicodeDecodeError as error:
        raise ConfigurationError(Problem(f"wants UTF-8, got byte {error.start} that is not", str(path))) from None
    return read_yaml(text, str(path))


def _syntax_problem(error: MarkedYAMLError, text: str, file: str) -> Problem:
    mark = error.problem_mark or error.context_mark
    said = ", ".join(str(part) for part in (error.context, error.problem) if part)
    line = mark.line + 1 if mark else 0
    before = text.splitlines()[mark.line][: mark.column].rstrip() if mark and mark.line < len(text.splitlines()) else ""
    hint = '; a list with one unit is written in quotes: "[1, 2] rad"' if before.endswith("]") else ""
    return Problem(f"not YAML: {said}{hint}", file, line, mark.column + 1 if mark else 0)


class _Reader:
    """Walks the nodes once; recursion and runaway aliases are refused."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.values: dict[KeyPath, Place] = {}
        self.keys: dict[KeyPath, Place] = {}
        self.problems: list[Problem] = []

    def place(self, node: Node) -> Place:
        return Place(self.file, node.start_mark.line + 1, node.start_mark.column + 1)

    def complain(self, node: Node, message: str) -> None:
        self.problems.append(Problem(message, *self.place(node)))

    def read(self, node: Node, path: KeyPath, above: tuple[int, ...]) -> Any:
        if id(node) in above:
            self.complain(node, "an alias wants something finite, got a value that holds itself")
            return None
        if len(self.values) > MOST_VALUES:
            message = f"wants at most {MOST_VALUES} values, counting aliases as written out"
            raise ConfigurationError(Problem(message, self.file))
        self.values[path] = self.place(node)
        inside = (*above, id(node))
        if isinstance(node, MappingNode):
            return self.mapping(node, path, inside)
        if isinstance(node, SequenceNode):
            return [self.read(item, (*path, index), inside) for index, item in enumerate(node.value)]
        if isinstance(node, ScalarNode):
            return self.scalar(node)
        raise TypeError(f"a YAML node is a mapping, sequence or scalar, got {type(node).__name__}")

    def mapping(self, node: MappingNode, path: KeyPath, inside: tuple[int, ...]) -> dict[str, Any]:
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, ScalarNode):
                self.complain(key_node, "a key wants text, got a list or mapping")
                continue
            key = str(key_node.value)
            if str(key_node.tag) == "tag:yaml.org,2002:merge":
                self.complain(key_node, "'<<' is not part of YAML 1.2; write the keys out")
            elif key in result:
                first = self.keys[(*path, key)]
                self.complain(key_node, f"the key '{key}' is given twice, first in line {first.line}")
            else:
                self.keys[(*path, key)] = self.place(key_node)
                result[key] = self.read(value_node, (*path, key), inside)
        return result

    def scalar(self, node: ScalarNode) -> Any:
        tag, text = str(node.tag).removeprefix("tag:yaml.org,2002:"), str(node.value)
        match tag:
            case "str" | "timestamp":
                return text
            case "null":
                return None
            case "bool":
                return text.lower() == "true"
            case "int" | "float":
                try:
                    return _number(text)
                except ValueError:
                    self.complain(node, f"wants a number, got '{text}'")
                    return None
        self.complain(node, f"the tag '{node.tag}' means nothing here; leave it out")
        return None


def _number(text: str) -> int | float:
    digits = text.replace("_", "").lower()
    if digits.lstrip("+-").startswith(("0x", "0o")):
        return int(digits, 0)
    try:
        return int(digits)
    except ValueError:
        return float(digits.replace(".inf", "inf").replace(".nan", "nan"))
