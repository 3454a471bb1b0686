"""Checks plain data against a schema and says what is wrong in the house's words, each problem at its place."""

from __future__ import annotations

import difflib
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from fmus.component import Problem
from harness.places import KeyPath, Places
from harness.scenario import TAGGED

Schema = TypeVar("Schema", bound=BaseModel)

# What a pydantic error type means was wanted.
WANTED = {
    "string_type": "text",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a mapping of keys to values",
    "model_type": "a mapping of keys to values",
    "model_attributes_type": "a mapping of keys to values",
    "literal_error": "{expected}",
    "greater_than": "more than {gt}",
    "greater_than_equal": "at least {ge}",
    "less_than": "less than {lt}",
    "less_than_equal": "at most {le}",
    "too_short": "at least {min_length} items",
    "too_long": "at most {max_length} items",
    "string_pattern_mismatch": "a name of letters, digits, '.', '_' and '-'",
}


def validate(
    schema: type[Schema], raw: Any, places: Places, below: KeyPath = ()
) -> tuple[Schema | None, list[Problem]]:
    """The value of `raw` (which stands at `below` in the file) as `schema`, or None and every problem found."""
    try:
        return schema.model_validate(raw, by_alias=True, by_name=False), []
    except ValidationError as error:
        return None, [_problem(schema, detail, places, below) for detail in error.errors(include_url=False)]


def nearest_hint(name: str, known: Iterable[str]) -> str:
    """`; did you mean 'x'?` for the known name nearest to `name`, or nothing where there is none."""
    nearest = difflib.get_close_matches(name, list(known), n=1, cutoff=0.0)
    return f"; did you mean '{nearest[0]}'?" if nearest else ""


def dotted(path: Iterable[str | int]) -> str:
    """A path as it is written in a campaign: `parts.encoder.faults[0].bias`."""
    text = "".join(f"[{token}]" if isinstance(token, int) else f".{token}" for token in path)
    return text.removeprefix(".")


def known_keys(schema: type[BaseModel]) -> list[str]:
    """The keys that a mapping of this schema may have."""
    return [field.alias or name for name, field in schema.model_fields.items()]


def _problem(schema: type[BaseModel], detail: Mapping[str, Any], places: Places, below: KeyPath) -> Problem:
    location = tuple(detail["loc"])
    path = (*below, *(token for token in location if not _is_tag(token)))
    kind, got = detail["type"], detail["input"]
    name, context = dotted(path), detail.get("ctx", {})
    if kind == "extra_forbidden":
        keys = [key for model in _models_at(schema, location[:-1]) for key in known_keys(model)]
        inside = f" in {dotted(path[:-1])}" if path[:-1] else ""
        return places.key_problem(f"unknown key '{path[-1]}'{inside}{nearest_hint(str(path[-1]), keys)}", *path)
    if kind == "missing":
        around = dotted(path[:-1]) or "the file"
        key = f"the key '{path[-1]}'" if isinstance(path[-1], str) else f"at least {path[-1] + 1} items"
        return places.key_problem(f"{around} wants {key}", *path[:-1])
    if kind == "value_error":
        said = str(context["error"])
        return places.problem(f"{name} {said}" if said.startswith("wants ") else f"{name}: {said}", *path)
    if kind in WANTED:
        wanted = WANTED[kind].format(**context)
        return places.problem(f"{name} wants {wanted}, got {_short(got)}", *path)
    return places.problem(f"{name}: {detail['msg']}, got {_short(got)}", *path)


def _short(value: Any) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        return "a mapping of keys to values"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _is_tag(token: str | int) -> bool:
    return isinstance(token, str) and token in TAGGED


def _models_at(schema: type[BaseModel], location: tuple[str | int, ...]) -> list[type[BaseModel]]:
    """The schemas that the mapping at `location` may have."""
    annotations: list[Any] = [schema]
    for token in location:
        if _is_tag(token):
            annotations = [TAGGED[str(token)]]
        else:
            annotations = [inner for one in annotations for inner in _inside(one, token)]
    return [one for annotation in annotations for one in _plain(annotation) if _is_model(one)]


def _inside(annotation: Any, token: str | int) -> Iterator[Any]:
    """What stands at a key or index of a value annotated so."""
    for one in _plain(annotation):
        arguments = typing.get_args(one)
        if _is_model(one):
            for name, field in one.model_fields.items():
                if token in (field.alias, name):
                    yield field.annotation
        elif typing.get_origin(one) is dict:
            yield arguments[1]
        elif typing.get_origin(one) is tuple and isinstance(token, int) and token < len(arguments):
            yield arguments[token]
        elif typing.get_origin(one) is list:
            yield arguments[0]


def _plain(annotation: Any) -> Iterator[Any]:
    """The members of a union, without what Annotated adds."""
    origin = typing.get_origin(annotation)
    if origin is typing.Annotated:
        yield from _plain(typing.get_args(annotation)[0])
    elif origin in (typing.Union, types.UnionType):
        for member in typing.get_args(annotation):
            yield from _plain(member)
    else:
        yield annotation


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)
