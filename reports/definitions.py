"""The metrics of a campaign as they were declared: kind, version, window, what is compared, and in words."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from fmus.units import UnitError, parse_quantity, parse_unit
from reports.folder import Run

# What of a definition, beside the arguments of its kind, a reader is told.
TOLD = ("after", "until", "angle", "unit", "only")

Otherwise = TypeVar("Otherwise", float, str)


@dataclass(frozen=True)
class Definition:
    """A metric as declared: its kind, the pairs (truth, estimate) it compares, the part it speaks of.

    `window` tells two windows apart, `settings` two metrics of one kind that are given different numbers; `after` is in
    s, -inf where the window starts with the record or at a crank angle.
    """

    name: str
    kind: str
    version: str
    pairs: tuple[tuple[str, str], ...]
    part: str
    window: tuple[float | str, ...]
    after: float
    settings: str
    text: str
    meaning: str


def definitions(run: Run) -> dict[str, Definition]:
    """The campaign's metrics by name."""
    found = {}
    for name, raw in (run.campaign.get("metrics") or {}).items():
        options: Mapping[str, Any] = raw if isinstance(raw, Mapping) else {}
        kind = str(options.get("kind") or name)
        pairs = tuple((str(truth), str(estimate)) for truth, estimate in options.get("compares") or ())
        signals = _signals(options.get(kind))
        subject = pairs[0][1] if pairs else signals[-1] if len(signals) > 1 else ""
        rest = [f"{key} {_plain(value)}" for key, value in options.items() if key in TOLD and value is not None]
        edges = [options.get(key) for key in ("after", "until")]
        found[str(name)] = Definition(
            name=str(name),
            kind=kind,
            version=str(options.get("version") or ""),
            pairs=pairs,
            part=subject.split(".")[0],
            window=tuple("" if edge is None else _seconds(edge, str(edge)) for edge in edges),
            after=_seconds(edges[0], -math.inf),
            settings=_settings(options.get(kind)),
            text="; ".join([f"{kind} of {_measured_on(options.get(kind))}", *rest]),
            meaning=str(options.get("description") or options.get("meaning") or ""),
        )
    return found


def _signals(value: Any) -> list[str]:
    if isinstance(value, str):
        return [value] if re.fullmatch(r"[A-Za-z_]\w*\.\S+", value) else []
    items = value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ()
    return [name for item in items for name in _signals(item)]


def _settings(value: Any) -> str:
    """What a metric is given beside signals, as `by range, bound 2 rpm`."""
    if not isinstance(value, Mapping):
        return ""
    told = {key: item for key, item in value.items() if not _signals(item) and key != "scales"}
    return ", ".join(f"{key} {_plain(item)}" for key, item in told.items())


def _seconds(value: Any, otherwise: Otherwise) -> float | Otherwise:
    """A time in s; `otherwise` where it is none."""
    if isinstance(value, (int, float)):
        return float(value)
    try:
        number, unit = parse_quantity(str(value))
        parsed = parse_unit(unit)
    except UnitError:
        return otherwise
    return parsed.to_si(number) if parsed.same_dimension(parse_unit("s")) else otherwise


def _measured_on(value: Any) -> str:
    short = isinstance(value, Mapping) and len(value) == 1
    return _plain(next(iter(value.values()))) if short else _plain(value)


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_plain(item)}" for key, item in value.items())
    if isinstance(value, list) and len(value) == 1:
        return _plain(value[0])
    if isinstance(value, list):
        return "[" + ", ".join(_plain(item) for item in value) + "]"
    return "" if value is None else str(value)
