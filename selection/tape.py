"""A traced model as a list of elementary steps, and its derivatives in any arithmetic along one branch."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import casadi as ca
import numpy as np

from fmus.component import Vector
from fmus.model import ModelError

_NAMES = {getattr(ca, name): name.removeprefix("OP_") for name in dir(ca) if name.startswith("OP_")}


class Step(NamedTuple):
    """One operation on places of the work memory; inputs and outputs have (argument, element) as their other side."""

    operation: str
    sources: tuple[int, ...]
    target: tuple[int, ...]
    constant: float


@dataclass(frozen=True)
class Tape:
    """The steps of a function of vectors, the size of their memory, and the sizes of the results."""

    steps: tuple[Step, ...]
    memory: int
    results: tuple[int, ...]


class Arithmetic(Protocol):
    """Numbers of some kind, which have the operators + - * / and a truth value, false for zero."""

    def number(self, value: float) -> Any:
        """A number of this kind equal to a double."""

    def function(self, name: str, *arguments: Any) -> Any:
        """SQRT, EXP, LOG, SIN, COS, ASIN, ACOS, ATAN of one number, POW and ATAN2 of two."""


class Dual(NamedTuple):
    """A value and its derivatives with respect to the states by place; states of no influence are left out."""

    value: Any
    slopes: Mapping[int, Any]


def read_tape(function: ca.Function) -> Tape:
    """The steps of a CasADi function of symbols SX."""
    steps = []
    for k in range(function.n_instructions()):
        operation = _NAMES[function.instruction_id(k)]
        constant = function.instruction_constant(k) if operation == "CONST" else 0.0
        sources, target = function.instruction_input(k), function.instruction_output(k)
        steps.append(Step(operation, tuple(sources), tuple(target), constant))
    return Tape(tuple(steps), function.sz_w(), tuple(function.size1_out(i) for i in range(function.n_out())))


def decisions(tape: Tape, arguments: Sequence[Vector]) -> list[float]:
    """The results of all steps on floats, which say what comparisons, roundings and extremes decide at this point.

    Of an extreme it is which of the two is taken, 0 or 1, of an absolute value the sign.

    Raises ModelError: an operation that is not known here.
    """
    work = [0.0] * tape.memory
    found = []
    for step in tape.steps:
        if step.operation == "OUTPUT":
            found.append(0.0)
            continue
        if step.operation == "INPUT":
            argument, element = step.sources
            value = float(arguments[argument][element])
        elif step.operation == "CONST":
            value = step.constant
        else:
            value = _on_floats(step.operation, *(work[source] for source in step.sources))
        decided = value
        if step.operation in ("FMIN", "FMAX"):
            decided = float(value != work[step.sources[0]])
        elif step.operation == "FABS":
            decided = 1.0 if work[step.sources[0]] >= 0.0 else -1.0
        work[step.target[0]] = value
        found.append(decided)
    return found


_COMPARED: dict[str, Callable[..., float]] = {
    "LT": lambda a, b: float(a < b),
    "LE": lambda a, b: float(a <= b),
    "EQ": lambda a, b: float(a == b),
    "NE": lambda a, b: float(a != b),
    "AND": lambda a, b: float(bool(a) and bool(b)),
    "OR": lambda a, b: float(bool(a) or bool(b)),
    "NOT": lambda a: float(not a),
    "SIGN": lambda a: float(np.sign(a)),
    "FLOOR": lambda a: float(np.floor(a)),
    "CEIL": lambda a: float(np.ceil(a)),
}
_ON_FLOATS: dict[str, Callable[..., Any]] = {
    **_COMPARED,
    "ADD": np.add,
    "SUB": np.subtract,
    "MUL": np.multiply,
    "DIV": np.divide,
    "INV": lambda a: np.divide(1.0, a),
    "NEG": np.negative,
    "SQ": np.square,
    "TWICE": lambda a: 2.0 * a,
    "ASSIGN": lambda a: a,
    "POW": np.power,
    "CONSTPOW": np.power,
    "SQRT": np.sqrt,
    "EXP": np.exp,
    "LOG": np.log,
    "SIN": np.sin,
    "COS": np.cos,
    "TAN": np.tan,
    "ASIN": np.arcsin,
    "ACOS": np.arccos,
    "ATAN": np.arctan,
    "SINH": np.sinh,
    "COSH": np.cosh,
    "TANH": np.tanh,
    "LOG1P": np.log1p,
    "EXPM1": np.expm1,
    "FABS": np.abs,
    "ATAN2": np.arctan2,
    "HYPOT": np.hypot,
    "FMIN": np.fmin,
    "FMAX": np.fmax,
    "IF_ELSE_ZERO": lambda condition, a: a if condition else 0.0,
}


def _on_floats(operation: str, *values: float) -> float:
    if operation not in _ON_FLOATS:
        raise ModelError(f"the operation {operation} is not known in exact arithmetic")
    with np.errstate(all="ignore"):  # a branch that is not taken may divide by zero
        return float(_ON_FLOATS[operation](*(np.float64(value) for value in values)))


def differentiate(
    tape: Tape, decided: Sequence[float], leaf: Callable[[int, int], Any], states: int, arithmetic: Arithmetic
) -> list[list[Dual | None]]:
    """The results with their derivatives with respect to argument number `states`, along the branch decided.

    `leaf` gives the number that stands for an element of an argument. A result is None where it is not defined, as
    after a division by zero on the branch that is taken.
    """
    work: list[Dual | None] = [None] * tape.memory
    zero, one = arithmetic.number(0.0), arithmetic.number(1.0)
    found: list[list[Dual | None]] = [[Dual(zero, {}) for _ in range(size)] for size in tape.results]
    for step, choice in zip(tape.steps, decided, strict=True):
        if step.operation == "OUTPUT":
            result, element = step.target
            found[result][element] = work[step.sources[0]]
            continue
        if step.operation == "INPUT":
            argument, element = step.sources
            made: Dual | None = Dual(leaf(argument, element), {element: one} if argument == states else {})
        elif step.operation == "CONST":
            made = Dual(arithmetic.number(step.constant), {}) if math.isfinite(step.constant) else None
        else:
            made = _applied(step.operation, [work[source] for source in step.sources], choice, arithmetic)
        work[step.target[0]] = made
    return found


def _applied(operation: str, operands: Sequence[Dual | None], choice: float, arithmetic: Arithmetic) -> Dual | None:
    """The step on duals; None where it is not defined."""
    if operation in _COMPARED:
        return Dual(arithmetic.number(choice), {}) if math.isfinite(choice) else None
    if operation == "IF_ELSE_ZERO":
        condition, value = operands
        if condition is None:
            return None
        return value if condition.value else Dual(arithmetic.number(0.0), {})
    if operation in ("FMIN", "FMAX"):
        return operands[int(choice)]
    known = [operand for operand in operands if operand is not None]
    if len(known) < len(operands):
        return None
    try:
        return _smooth(operation, known, choice, arithmetic)
    except ArithmeticError:
        return None


def _smooth(operation: str, operands: Sequence[Dual], choice: float, arithmetic: Arithmetic) -> Dual:
    one = arithmetic.number(1.0)
    if len(operands) == 1:
        ((x, dx),) = operands
        if operation in ("NEG", "ASSIGN", "TWICE", "FABS"):
            factor = {"NEG": -one, "ASSIGN": one, "TWICE": one + one}.get(operation, arithmetic.number(choice))
            return Dual(factor * x, _combined([(factor, dx)]))
        value, slope = _unary(operation, x, one, arithmetic.function)
        return Dual(value, _combined([(slope, dx)]) if dx else {})
    (x, dx), (y, dy) = operands
    if operation == "ADD":
        return Dual(x + y, _combined([(one, dx), (one, dy)]))
    if operation == "SUB":
        return Dual(x - y, _combined([(one, dx), (-one, dy)]))
    if operation == "MUL":
        return Dual(x * y, _combined([(y, dx), (x, dy)]))
    if operation == "DIV":
        value = x / y
        return Dual(value, _combined([(one / y, dx), (-value / y, dy)]))
    if operation in ("POW", "CONSTPOW"):
        value = arithmetic.function("POW", x, y)
        terms = [(value * y / x, dx)] if dx else []
        return Dual(value, _combined(terms + ([(value * arithmetic.function("LOG", x), dy)] if dy else [])))
    square = x * x + y * y
    if operation == "HYPOT":
        value = arithmetic.function("SQRT", square)
        return Dual(value, _combined([(value * x / square, dx), (value * y / square, dy)]))
    if operation == "ATAN2":
        return Dual(arithmetic.function("ATAN2", x, y), _combined([(y / square, dx), (-x / square, dy)]))
    raise ModelError(f"the operation {operation} is not known in exact arithmetic")


def _unary(operation: str, x: Any, one: Any, function: Callable[..., Any]) -> tuple[Any, Any]:
    """The value of a smooth function of one number, and its derivative."""
    if operation in ("SINH", "COSH", "TANH"):
        e = function("EXP", x)
        sinh, cosh = (e - one / e) / (one + one), (e + one / e) / (one + one)
        tanh = sinh / cosh
        return {"SINH": (sinh, cosh), "COSH": (cosh, sinh), "TANH": (tanh, one - tanh * tanh)}[operation]
    if operation in ("SIN", "COS", "TAN"):
        sin, cos = function("SIN", x), function("COS", x)
        if operation == "TAN":
            return sin / cos, one / (cos * cos)
        return (sin, cos) if operation == "SIN" else (cos, -sin)
    if operation in ("ASIN", "ACOS"):
        slope = one / function("SQRT", one - x * x)
        return function(operation, x), slope if operation == "ASIN" else -slope
    if operation == "INV":
        value = one / x
        return value, -value * value
    if operation == "SQ":
        return x * x, x + x
    if operation == "SQRT":
        value = function("SQRT", x)
        return value, value / (x + x)
    if operation == "LOG1P":
        return function("LOG", one + x), one / (one + x)
    value = function(operation.removesuffix("M1"), x)
    if operation == "EXPM1":
        return value - one, value
    return value, {"EXP": lambda: value, "LOG": lambda: one / x, "ATAN": lambda: one / (one + x * x)}[operation]()


def _combined(terms: Sequence[tuple[Any, Mapping[int, Any]]]) -> dict[int, Any]:
    """The sum of factors times slopes, without what is zero."""
    found: dict[int, Any] = {}
    for factor, slopes in terms:
        for place, slope in slopes.items():
            term = factor * slope
            found[place] = found[place] + term if place in found else term
    return {place: slope for place, slope in found.items() if slope}
