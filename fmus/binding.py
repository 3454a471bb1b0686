"""Give variables of an FMU the units that it does not declare itself."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from fmus.component import ConfigurationError, Problem
from fmus.description import FmuDescription
from fmus.model import unknown
from fmus.units import Unit, UnitError, parse_unit
from fmus.variable import Variable

_ROUNDED = 1e-5  # relative: FMUs write the factors of their units with few digits


def bind_units(description: FmuDescription, units: Mapping[str, str], name: str) -> FmuDescription:
    """The description with `units` for variables that declare none that is known; `name` is what messages call it.

    A unit for a variable that declares the same one is no matter.

    Raises ConfigurationError: no such variable, no such unit, a variable that is no real number, or one that declares
    another unit; all such problems at once.
    """
    variables = {variable.name: variable for variable in description.variables}
    problems: list[Problem] = []
    bound: dict[str, Variable] = {}
    for key, text in units.items():
        variable = variables.get(key)
        if variable is None:
            problems.append(Problem(unknown(key, _bindable(variables) or variables, f"variable of {name}")))
            continue
        try:
            quantity = parse_unit(text)
        except UnitError as error:
            problems.append(Problem(f"{name}.{key}: {error}"))
            continue
        wrong = _refusal(variable, text, quantity)
        if wrong:
            problems.append(Problem(f"{name}.{key} {wrong}"))
        elif variable.quantity is None:
            bound[key] = replace(variable, unit=text.strip() or "1", quantity=quantity)
    if problems:
        raise ConfigurationError(problems)
    if not bound:
        return description
    return replace(description, variables=tuple(bound.get(v.name, v) for v in description.variables))


def _bindable(variables: Mapping[str, Variable]) -> list[str]:
    return [name for name, variable in variables.items() if variable.kind == "real" and variable.quantity is None]


def _refusal(variable: Variable, text: str, quantity: Unit) -> str:
    """What is wrong with a unit for a variable; empty where nothing is."""
    if variable.kind != "real" or not variable.on_bus:
        return f"is of the type {variable.type} and has no unit, got {text}"
    if variable.quantity is not None and not _same(variable.quantity, quantity):
        return f"declares the unit {variable.unit or '1'}, and {text} is bound to it: leave one out"
    return ""


def _same(a: Unit, b: Unit) -> bool:
    factors = math.isclose(a.factor, b.factor, rel_tol=_ROUNDED)
    return a.same_dimension(b) and factors and math.isclose(a.offset, b.offset, rel_tol=_ROUNDED)
