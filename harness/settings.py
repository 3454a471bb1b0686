"""What stands under `with`, as the part wants it: quantities in SI by variable name, or arguments of a `make`."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from fmus.component import Signal
from fmus.model import unknown
from harness.findings import Findings
from harness.quantity import Measure, read_measure

_LIST = re.compile(r"\s*\[(?P<numbers>[^\]]*)\]\s*(?P<unit>.*)$")


def read_settings(signals: Iterable[Signal], settings: Mapping[str, Any], found: Findings) -> dict[str, float] | None:
    """Settings in SI by scalar name; each key a signal or a scalar of an array, each value a quantity or several.

    None and the problems in `found` where one is of no signal, of another dimension or of another shape.
    """
    before = len(found.problems)
    whole = {signal.name: signal for signal in signals}
    scalars = {
        name: Signal(name, signal.unit) for signal in whole.values() if signal.shape for name in signal.scalar_names()
    }
    values: dict[str, float] = {}
    for key, raw in settings.items():
        signal = whole.get(key) or scalars.get(key)
        if signal is None:
            found.at(key).add(unknown(key, whole, "parameter or start value"))
        else:
            values |= zip(signal.scalar_names(), _numbers(raw, signal, found.at(key)), strict=False)
    return values if len(found.problems) == before else None


def _numbers(raw: Any, signal: Signal, found: Findings) -> list[float]:
    """The scalars of a signal, row-major, in SI."""
    measures = read_measures(raw, found)
    if measures is None:
        return []
    if len(measures) == 1 and not isinstance(raw, (list, tuple)):
        measures = measures * signal.size
    if len(measures) != signal.size:
        found.add(f"wants {signal.size} values, shape {signal.shape}, got {len(measures)}")
        return []
    return [found.value(measure, signal.unit) for measure in measures]


def read_measures(raw: Any, found: Findings) -> list[Measure] | None:
    """The quantities of `5 N.m`, 5, true, `[4, 5] N.m` or nested lists of those, row-major; None where it is none."""
    if isinstance(raw, bool):
        return [Measure(float(raw), "")]
    if isinstance(raw, (list, tuple)) and not isinstance(raw, Measure):
        rows = [read_measures(value, found) for value in raw]
        return (
            None
            if any(row is None for row in rows)
            else [measure for row in rows if row is not None for measure in row]
        )
    match = _LIST.match(raw) if isinstance(raw, str) else None
    try:
        if match:
            return [read_measure(f"{number} {match['unit']}") for number in match["numbers"].split(",")]
        return [read_measure(raw)]
    except ValueError as error:
        found.add(str(error))
        return None


def read_arguments(
    make: Callable[..., Any], settings: Mapping[str, Any], step: float | None, found: Findings
) -> dict[str, Any] | None:
    """The arguments of a `make`, each converted as it is annotated; `sample_time` is `step` [s] unless it is given.

    A `step` of None leaves `sample_time` to its default.

    None and the problems in `found` where one is unknown, missing or does not fit.
    """
    before = len(found.problems)
    parameters = inspect.signature(make).parameters
    hints = get_type_hints(make, include_extras=True)
    named = [name for name, p in parameters.items() if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)]
    open_ended = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    arguments: dict[str, Any] = {"sample_time": step} if step is not None and "sample_time" in named else {}
    for key, raw in settings.items():
        if key in named:
            arguments[key] = _argument(raw, hints.get(key, Any), found.at(key))
        elif open_ended:
            arguments[key] = raw
        else:
            found.at(key).add(unknown(key, named, "argument"))
    for name in named:
        if parameters[name].default is inspect.Parameter.empty and name not in settings and name not in arguments:
            found.at(name).add(f"wants a value; write `with: {{{name}: ...}}`")
    return arguments if len(found.problems) == before else None


def _argument(raw: Any, hint: Any, found: Findings) -> Any:
    """A setting as an annotation asks for it: in SI where it names a unit, else a plain number, else as written."""
    unit, numeric = _annotation(hint)
    if raw is None or (unit is None and numeric is None):
        return raw
    if numeric is int and isinstance(raw, int) and not isinstance(raw, bool):
        return raw
    measures = read_measures(raw, found)
    if measures is None:
        return raw
    values = [found.value(measure, unit or "1") for measure in measures]
    if numeric is int:
        if any(value != round(value) for value in values):
            found.add(f"wants an integer, got {raw}")
        values = [round(value) for value in values]
    listed = isinstance(raw, (list, tuple)) or (isinstance(raw, str) and _LIST.match(raw))
    return values if listed else values[0]


def _annotation(hint: Any) -> tuple[str | None, type | None]:
    """The unit an annotation names, and the kind of number it is; None where it says nothing."""
    if get_origin(hint) is Annotated:
        inner, *extras = get_args(hint)
        unit = next((extra for extra in extras if isinstance(extra, str)), None)
        return unit, _annotation(inner)[1] or float
    if hint in (int, float):
        return None, hint
    for member in get_args(hint) if get_origin(hint) is not None and get_origin(hint) is not dict else ():
        unit, numeric = _annotation(member)
        if unit is not None:
            return unit, numeric
    return None, None
