"""One variable of an FMU: its type, its start value, and what its unit means in SI units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fmus.component import ConfigurationError, Kind
from fmus.units import Unit, UnitError, parse_unit

_KINDS: dict[str, Kind] = {"Real": "real", "Float64": "real", "Float32": "real", "Boolean": "boolean"}
_OFF_BUS = frozenset({"String", "Binary", "Clock"})
_NAME_MATCHES = 1e-9  # relative difference of factors up to which a unit's name means what it means in fmus.units


@dataclass(frozen=True)
class Variable:
    """One variable of an FMU; an array of FMI 3 is one variable with a `shape`.

    `unit` is the name the FMU gives, `quantity` what it means: None where the FMU declares none that is known.
    `minimum`, `maximum`, `nominal` and the `start` values, row-major, are in `unit`; `start` is empty where the FMU
    gives none. `dimensions` are the shape, with the names of structural parameters where those say it. `clocked` ones
    have a value only while a clock ticks; an `alias` is another name of a variable.
    """

    name: str
    reference: int
    type: str
    causality: str
    variability: str
    initial: str
    description: str = ""
    unit: str = ""
    quantity: Unit | None = None
    start: tuple[float | str, ...] = ()
    minimum: float = -math.inf
    maximum: float = math.inf
    nominal: float = 1.0
    shape: tuple[int, ...] = ()
    dimensions: tuple[int | str, ...] = ()
    clocked: bool = False
    alias: bool = False

    @property
    def kind(self) -> Kind:
        """How the bus is to read its doubles."""
        return _KINDS.get(self.type, "integer")

    @property
    def size(self) -> int:
        """Number of scalars."""
        return math.prod(self.shape)

    @property
    def on_bus(self) -> bool:
        """True for numbers that may be read at any step under their first name."""
        return self.type not in _OFF_BUS and not self.clocked and not self.alias

    @property
    def settable(self) -> bool:
        """True when its start value may be set before initialisation."""
        if self.causality == "independent" or self.variability == "constant":
            return False
        if self.clocked or self.alias or self.type in ("Binary", "Clock"):
            return False
        return self.causality in ("parameter", "structuralParameter", "input") or self.initial in ("exact", "approx")

    @property
    def structural(self) -> bool:
        """True for what sizes of arrays hang on; it is set before all others."""
        return self.causality == "structuralParameter"

    def scalar_names(self) -> list[str]:
        """Names of the scalars, row-major, indices from 1."""
        if not self.shape:
            return [self.name]
        dimensions = [range(1, n + 1) for n in self.shape]
        indices: list[tuple[int, ...]] = [()]
        for dimension in dimensions:
            indices = [(*index, i) for index in indices for i in dimension]
        return [f"{self.name}[{','.join(map(str, index))}]" for index in indices]


def read_variable(v: Any, units: Mapping[str, Any], relative: bool) -> Variable:
    """The variable FMPy read as `v`, with FMPy's base units by name; a `relative` one is a difference.

    Of FMI 1, which has no `initial`, a start value may be set wherever one is given.

    Raises ConfigurationError: it has another number of start values than its shape has places, or what should be a
    number is none.
    """
    declared = v.declaredType
    unit = v.unit or (declared.unit if declared is not None else None) or ""
    quantity = Unit() if _KINDS.get(v.type) != "real" else _quantity(unit, units, relative)

    return Variable(
        name=v.name,
        reference=v.valueReference,
        type=v.type,
        causality=v.causality or "local",
        variability=v.variability or "",
        initial=v.initial or ("exact" if v.start is not None and v.causality != "input" else ""),
        description=v.description or "",
        unit=unit,
        quantity=quantity,
        start=_start(v),
        minimum=_bound(v, "min", -math.inf),
        maximum=_bound(v, "max", math.inf),
        nominal=_bound(v, "nominal", 1.0),
        shape=tuple(v.shape or ()),
        dimensions=tuple(d.start if d.start is not None else d.variable.name for d in v.dimensions),
        clocked=bool(v.clocks),
        alias=v.alias is not None,
    )


def _bound(v: Any, name: str, default: float) -> float:
    text = getattr(v, name) or getattr(v.declaredType, name, None)
    return default if text in (None, "") else _number(v.name, text)


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise ConfigurationError(f"{name} wants numbers, got '{text[:60]}'") from error


def _quantity(name: str, units: Mapping[str, Any], relative: bool) -> Unit | None:
    """What a unit means by the FMU's own definition, else by its name; None where neither says."""
    base = units.get(name)
    try:
        known = parse_unit(name) if name else None
    except UnitError:
        known = None
    if base is None:
        found = known
    else:
        found = Unit(
            (base.kg, base.m, base.s, base.A, base.K, base.mol, base.cd, base.rad),
            float(base.factor),
            float(base.offset),
        )
        if known is not None and _same(known, found):
            found = known
    return Unit(found.exponents, found.factor) if found is not None and relative else found


def _same(a: Unit, b: Unit) -> bool:
    return (
        a.same_dimension(b)
        and math.isclose(a.factor, b.factor, rel_tol=_NAME_MATCHES)
        and math.isclose(a.offset, b.offset, rel_tol=_NAME_MATCHES)
    )


def _start(v: Any) -> tuple[float | str, ...]:
    if v.start is None:
        return ()
    if v.type in _OFF_BUS:
        return (v.start,) if v.type == "String" and not v.shape else ()
    words = v.start.split()
    values = [{"true": 1.0, "false": 0.0}.get(word) if v.type == "Boolean" else None for word in words]
    numbers = [_number(v.name, word) if value is None else value for word, value in zip(words, values, strict=True)]
    size = math.prod(v.shape or ())
    if len(numbers) not in (1, size):
        raise ConfigurationError(f"{v.name} wants {size} start values, got {len(numbers)}")
    return tuple(numbers * size if len(numbers) == 1 else numbers)
