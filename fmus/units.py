"""Units as FMI has them: exponents of the SI base units and rad, a factor and an offset to SI."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


@dataclass(frozen=True)
class Unit:
    """SI value = factor * value + offset; `exponents` in the order of BASE."""

    exponents: tuple[int, ...] = (0,) * len(BASE)
    factor: float = 1.0
    offset: float = 0.0

    def to_si(self, value: float) -> float:
        """`value` given in this unit, in SI."""
        return self.factor * value + self.offset

    def from_si(self, value: float) -> float:
        """`value` given in SI, in this unit."""
        return (value - self.offset) / self.factor

    def same_dimension(self, other: Unit) -> bool:
        """True when values can be converted into one another."""
        return self.exponents == other.exponents

    def si_name(self) -> str:
        """The SI unit of this dimension, written in base units and N, J, W, Pa where they fit."""
        return _SI_NAMES.get(self.exponents) or _base_name(self.exponents)


class UnitError(ValueError):
    """A unit nobody knows, or one that does not fit."""


def _unit(factor: float = 1.0, offset: float = 0.0, **exponents: int) -> Unit:
    return Unit(tuple(exponents.get(base, 0) for base in BASE), factor, offset)


_SYMBOLS: dict[str, Unit] = {
    "1": _unit(),
    "%": _unit(0.01),
    "ppm": _unit(1e-6),
    "g": _unit(1e-3, kg=1),
    "t": _unit(1e3, kg=1),
    "m": _unit(m=1),
    "s": _unit(s=1),
    "min": _unit(60.0, s=1),
    "h": _unit(3600.0, s=1),
    "A": _unit(A=1),
    "K": _unit(K=1),
    "degC": _unit(1.0, 273.15, K=1),
    "mol": _unit(mol=1),
    "cd": _unit(cd=1),
    "rad": _unit(rad=1),
    "deg": _unit(math.pi / 180, rad=1),
    "rev": _unit(2 * math.pi, rad=1),
    "rpm": _unit(2 * math.pi / 60, rad=1, s=-1),
    "Hz": _unit(s=-1),
    "N": _unit(kg=1, m=1, s=-2),
    "Pa": _unit(kg=1, m=-1, s=-2),
    "bar": _unit(1e5, kg=1, m=-1, s=-2),
    "J": _unit(kg=1, m=2, s=-2),
    "W": _unit(kg=1, m=2, s=-3),
    "V": _unit(kg=1, m=2, s=-3, A=-1),
    "L": _unit(1e-3, m=3),
    "l": _unit(1e-3, m=3),
}
_PREFIXES = {"u": 1e-6, "m": 1e-3, "c": 1e-2, "d": 0.1, "h": 100.0, "k": 1e3, "M": 1e6, "G": 1e9}
_PREFIXED = frozenset(["g", "m", "s", "A", "K", "mol", "N", "Pa", "bar", "J", "W", "V", "L", "l", "Hz", "rad"])
_SI_NAMES = {
    unit.exponents: name
    for name, unit in {
        **_SYMBOLS,
        "kg": _unit(kg=1),
        "rad/s": _unit(rad=1, s=-1),
        "N.m": _unit(kg=1, m=2, s=-2),
    }.items()
    if unit.factor == 1.0 and unit.offset == 0.0 and name not in ("Hz", "J")
}
_SI_NAMES |= {
    _unit(kg=1, m=2, s=-2, rad=-1).exponents: "N.m/rad",
    _unit(kg=1, m=2, s=-1, rad=-1).exponents: "N.m.s/rad",
    _unit(kg=1, m=2, s=-2, rad=-2).exponents: "N.m/rad2",
}
_ROUNDED = 1e-5
_TERM = re.compile(r"(?P<symbol>%|1|[A-Za-z]+)(?:\^?(?P<power>[+-]?\d+))?$")


def _base_name(exponents: tuple[int, ...]) -> str:
    above = [base + (str(e) if e > 1 else "") for base, e in zip(BASE, exponents, strict=True) if e > 0]
    below = [base + (str(-e) if e < -1 else "") for base, e in zip(BASE, exponents, strict=True) if e < 0]
    return "/".join([".".join(above) or "1", *below])


def _symbol(text: str) -> Unit:
    if text in _SYMBOLS:
        return _SYMBOLS[text]
    prefix, rest = text[:1], text[1:]
    if prefix in _PREFIXES and rest in _PREFIXED:
        unit = _SYMBOLS[rest]
        return Unit(unit.exponents, unit.factor * _PREFIXES[prefix])
    raise UnitError(f"unknown unit '{text}'")


def parse_unit(text: str) -> Unit:
    """The unit written as a product like `N.m.s/rad`, `kg.m2`, `1/s`, `degC`, `%` or `rpm`.

    Dots or stars multiply, each slash divides by the one term after it, digits are powers.

    Raises UnitError: a symbol is unknown, or the text is not a product of units.
    """
    stripped = text.strip()
    if not stripped:
        return _unit()
    pieces = re.split(r"([./*])", stripped.replace(" ", "."))
    exponents, factor, offset = [0] * len(BASE), 1.0, 0.0
    operators = [".", *pieces[1::2]]
    for operator, piece in zip(operators, pieces[::2], strict=True):
        match = _TERM.match(piece)
        if not match:
            raise UnitError(f"cannot read '{piece}' in unit '{text}'")
        unit = _symbol(match["symbol"])
        power = int(match["power"] or 1) * (-1 if operator == "/" else 1)
        if unit.offset and (len(pieces) > 1 or power != 1):
            raise UnitError(f"'{piece}' has an offset and cannot be part of '{text}'")
        exponents = [e + power * f for e, f in zip(exponents, unit.exponents, strict=True)]
        factor *= unit.factor**power
        offset = unit.offset
    return Unit(tuple(exponents), factor, offset)


def spelling(unit: Unit, name: str = "") -> str | None:
    """How this language writes a unit: `name` where that means it, else the shortest known; None where it cannot.

    A factor that agrees to five digits counts, since other tools write theirs with few.
    """
    prefixed = [prefix + symbol for prefix in _PREFIXES for symbol in sorted(_PREFIXED)]
    for text in (name, unit.si_name(), *_SYMBOLS, *prefixed):
        try:
            known = parse_unit(text)
        except UnitError:
            continue
        alike = unit.same_dimension(known) and math.isclose(unit.factor, known.factor, rel_tol=_ROUNDED)
        if text and alike and math.isclose(unit.offset, known.offset, rel_tol=_ROUNDED):
            return text
    return None


def difference_unit(text: str) -> str:
    """The unit of a difference of two quantities: their unit, or the one without its offset."""
    unit = parse_unit(text)
    return (spelling(Unit(unit.exponents, unit.factor)) or unit.si_name()) if unit.offset else text


def product_unit(one: str, other: str) -> str:
    """The unit of a product of two differences."""
    factors = [unit for unit in (difference_unit(one), difference_unit(other)) if unit not in ("", "1")]
    return ".".join(factors) or "1"


def convert(value: float, from_unit: str, to_unit: str) -> float:
    """`value` converted between two units of one dimension. Raises UnitError naming both."""
    source, target = parse_unit(from_unit), parse_unit(to_unit)
    if not source.same_dimension(target):
        raise UnitError(f"wants {to_unit}, got {from_unit}")
    return target.from_si(source.to_si(value))


_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*)$")


def parse_quantity(text: str) -> tuple[float, str]:
    """The number and the unit of a text like `1500 N.m/rad`; the unit is empty where none stands.

    Raises UnitError: no number at the front, or the unit is unknown.
    """
    match = _QUANTITY.match(text)
    if not match:
        raise UnitError(f"'{text}' wants a number with a unit, like '1 ms'")
    parse_unit(match[2])
    return float(match[1]), match[2].strip()
