"""The kinds of metric told to a reader or a machine: arguments, values with their units, version, definition."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from textwrap import fill
from typing import Any

from harness.arguments import Result
from harness.definitions import Options
from harness.metrics import KINDS, Kind

# Options that every metric has, but the names of the kinds.
SHARED = ("after", "until", "angle", "unit", "only", "description")
_UNITS = {"error": "as the signal, as a difference", "signal": "as the signal"}


def metric_kinds() -> list[dict[str, Any]]:
    """One mapping a kind: `kind, version, definition, meaning, arguments, values`, in the order of KINDS."""
    return [
        {
            "kind": name,
            "version": kind.version,
            "definition": _first_line(kind),
            "meaning": kind.meaning,
            "arguments": list(_arguments(kind)),
            "values": [_value(suffix, result) for suffix, result in kind.results.items()],
        }
        for name, kind in KINDS.items()
    ]


def metric_lines() -> Iterator[str]:
    """The same as text, a paragraph a kind."""
    for entry in metric_kinds():
        yield f"{entry['kind']} (version {entry['version']})"
        yield fill(entry["meaning"], 110, initial_indent="  ", subsequent_indent="  ")
        for argument in entry["arguments"]:
            needed = "" if argument["required"] else " (optional)"
            yield f"  {argument['name']}{needed}: {argument['description']}".rstrip(": ")
        values = ", ".join(f"{value['name'] or 'the value itself'} [{value['unit']}]" for value in entry["values"])
        yield fill(f"gives {values}", 110, initial_indent="  ", subsequent_indent="    ")
        yield ""
    yield "every metric may have: " + ", ".join(SHARED)
    for name in SHARED:
        told = Options.model_fields[name].description or "one line on what it is for"
        yield f"  {name}: {told}"


def _first_line(kind: Kind) -> str:
    return (kind.function.__doc__ or "").split("\n")[0]


def _arguments(kind: Kind) -> Iterator[Mapping[str, Any]]:
    schema = kind.arguments.model_json_schema(by_alias=True)
    long = next((form for form in schema.get("anyOf", []) if "properties" in form), schema)
    fields = kind.arguments.model_fields.items()
    for name, field in sorted(fields, key=lambda item: not item[1].is_required()):
        key = field.alias or name
        found = long["properties"][key]
        yield {
            "name": key,
            "required": field.is_required(),
            "description": field.description or found.get("description", ""),
            "default": None if field.is_required() else field.get_default(call_default_factory=True),
        }


def _value(suffix: str, result: Result) -> Mapping[str, Any]:
    unit = _UNITS.get(result.of, result.own_unit)
    return {"name": f".{suffix}" if suffix else "", "unit": unit, "samples": result.sampled}
