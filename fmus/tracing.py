"""Trace a model's NumPy functions into CasADi expressions, refusing what would silently go wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from fmus.component import Signal
from fmus.model import FlatModel, Model, ModelError


class TraceError(ModelError):
    """A model whose functions do what cannot be traced into C."""


class Symbol:
    """A scalar symbol that behaves as a NumPy scalar: arithmetic, comparison, NumPy functions.

    What cannot be traced raises ModelError: `math.*` and `float()` (no number yet), `if`, `and`,
    `or` and `not` (no truth value yet).
    """

    __slots__ = ("sx",)
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, sx: Any) -> None:
        self.sx = ca.SX(sx)

    def __float__(self) -> float:
        raise ModelError(
            "a symbol has no number: math.* functions and float() cannot be traced; use the NumPy function, "
            "like np.sin for math.sin"
        )

    __int__ = __index__ = __complex__ = __float__

    def __bool__(self) -> bool:
        raise ModelError(
            "a symbol has no truth value: if, and, or, not, min and max cannot be traced; use np.where, "
            "np.logical_and, np.minimum, np.maximum"
        )

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        function = _UFUNCS.get(ufunc.__name__)
        if method != "__call__" or function is None or options.get("out") is not None:
            raise ModelError(f"np.{ufunc.__name__} cannot be traced; known are {', '.join(sorted(_UFUNCS))}")
        return _elementwise(function, inputs)

    def __array_function__(self, function: Any, types: Any, args: Any, options: Any) -> Any:
        known = _FUNCTIONS.get(function.__name__)
        if known is None:
            raise ModelError(f"np.{function.__name__} cannot be traced; known are {', '.join(sorted(_FUNCTIONS))}")
        return known(*args, **options)

    def __repr__(self) -> str:
        return f"Symbol({self.sx})"


def _sx(value: Any) -> Any:
    if isinstance(value, Symbol):
        return value.sx
    if isinstance(value, (bool, np.bool_)):
        return ca.SX(float(value))
    try:
        return ca.SX(float(value))
    except (TypeError, ValueError):
        raise ModelError(f"wants a number or a symbol, got {value!r}") from None


def _elementwise(function: Callable[..., Any], arguments: Sequence[Any]) -> Any:
    """`function` on every element after broadcasting; a Symbol for scalars, an object array otherwise."""
    arrays = []
    for argument in arguments:
        array = np.empty((), dtype=object)
        if isinstance(argument, (np.ndarray, list, tuple)):
            array = np.asarray(argument, dtype=object)
        else:
            array[()] = argument
        arrays.append(array)
    shape = np.broadcast_shapes(*(array.shape for array in arrays))
    if shape == ():
        return Symbol(function(*(_sx(array[()]) for array in arrays)))
    broadcast = [np.broadcast_to(array, shape) for array in arrays]
    result = np.empty(shape, dtype=object)
    for index in np.ndindex(*shape):
        result[index] = Symbol(function(*(_sx(array[index]) for array in broadcast)))
    return result


_UFUNCS: dict[str, Callable[..., Any]] = {
    "add": lambda a, b: a + b,
    "subtract": lambda a, b: a - b,
    "multiply": lambda a, b: a * b,
    "divide": lambda a, b: a / b,
    "negative": lambda a: -a,
    "positive": lambda a: a,
    "power": lambda a, b: a**b,
    "float_power": lambda a, b: a**b,
    "square": lambda a: a * a,
    "remainder": lambda a, b: a - b * ca.floor(a / b),
    "absolute": ca.fabs,
    "fabs": ca.fabs,
    "sign": ca.sign,
    "floor": ca.floor,
    "ceil": ca.ceil,
    "rint": lambda a: _round_half_even(a),
    "sqrt": ca.sqrt,
    "exp": ca.exp,
    "expm1": ca.expm1,
    "log": ca.log,
    "log1p": ca.log1p,
    "log10": ca.log10,
    "sin": ca.sin,
    "cos": ca.cos,
    "tan": ca.tan,
    "arcsin": ca.asin,
    "arccos": ca.acos,
    "arctan": ca.atan,
    "arctan2": ca.atan2,
    "sinh": ca.sinh,
    "cosh": ca.cosh,
    "tanh": ca.tanh,
    "hypot": ca.hypot,
    "minimum": ca.fmin,
    "maximum": ca.fmax,
    "fmin": ca.fmin,
    "fmax": ca.fmax,
    "less": lambda a, b: a < b,
    "less_equal": lambda a, b: a <= b,
    "greater": lambda a, b: a > b,
    "greater_equal": lambda a, b: a >= b,
    "equal": lambda a, b: a == b,
    "not_equal": lambda a, b: a != b,
    "logical_and": ca.logic_and,
    "logical_or": ca.logic_or,
    "logical_not": ca.logic_not,
    "bitwise_and": ca.logic_and,
    "bitwise_or": ca.logic_or,
    "invert": ca.logic_not,
}


def _round_half_even(a: Any) -> Any:
    down = ca.floor(a)
    rest = a - down
    odd = down - 2 * ca.floor(down / 2)
    return ca.if_else(rest > 0.5, down + 1, ca.if_else(rest < 0.5, down, down + odd))


def _where(condition: Any, a: Any, b: Any) -> Any:
    return _elementwise(lambda c, x, y: ca.if_else(c, x, y), (condition, a, b))


def _clip(a: Any, a_min: Any = None, a_max: Any = None, **options: Any) -> Any:
    low, high = options.get("min", a_min), options.get("max", a_max)
    if low is not None:
        a = _elementwise(ca.fmax, (a, low))
    if high is not None:
        a = _elementwise(ca.fmin, (a, high))
    return a


def _select(conditions: Sequence[Any], choices: Sequence[Any], default: Any = 0.0) -> Any:
    chosen = default
    for condition, choice in zip(reversed(conditions), reversed(choices), strict=True):
        chosen = _where(condition, choice, chosen)
    return chosen


def _interp(x: Any, xp: Any, fp: Any) -> Any:
    """Piecewise linear through (xp, fp), held outside, as np.interp."""
    result: Any = fp[0]
    for k in range(len(xp) - 1):
        line = fp[k] + (fp[k + 1] - fp[k]) / (xp[k + 1] - xp[k]) * (x - xp[k])
        result = _where(x > xp[k], line, result)
    return _where(x >= xp[-1], fp[-1], result)


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "where": _where,
    "clip": _clip,
    "select": _select,
    "interp": _interp,
    "round": lambda a, decimals=0: _elementwise(lambda v: _round_half_even(v * 10.0**decimals) / 10.0**decimals, (a,)),
}


def _operator(name: str, reflected: bool = False) -> Callable[[Any, Any], Any]:
    function = _UFUNCS[name]

    def apply(self: Any, other: Any) -> Any:
        return _elementwise(function, (other, self) if reflected else (self, other))

    return apply


for _name, _ufunc in {"add": "add", "sub": "subtract", "mul": "multiply", "truediv": "divide", "pow": "power",
                      "mod": "remainder", "and": "bitwise_and", "or": "bitwise_or"}.items():  # fmt: skip
    setattr(Symbol, f"__{_name}__", _operator(_ufunc))
    setattr(Symbol, f"__r{_name}__", _operator(_ufunc, reflected=True))
for _name, _ufunc in {"lt": "less", "le": "less_equal", "gt": "greater", "ge": "greater_equal",
                      "eq": "equal", "ne": "not_equal"}.items():  # fmt: skip
    setattr(Symbol, f"__{_name}__", _operator(_ufunc))
for _name, _ufunc in {"neg": "negative", "pos": "positive", "abs": "absolute", "invert": "invert"}.items():
    setattr(Symbol, f"__{_name}__", lambda self, _f=_UFUNCS[_ufunc]: _elementwise(_f, (self,)))
for _name in ("sqrt", "exp", "expm1", "log", "log1p", "log10", "sin", "cos", "tan", "arcsin", "arccos", "arctan",
              "sinh", "cosh", "tanh", "floor", "ceil", "rint", "sign", "fabs", "square"):  # fmt: skip
    # NumPy calls these methods for the elements of an object array.
    setattr(Symbol, _name, lambda self, _f=_UFUNCS[_name]: _elementwise(_f, (self,)))


@dataclass(frozen=True)
class Traced:
    """A model as CasADi functions of flat vectors.

    `equations`  (t, x, m, u, p) -> (x', y)
    `indicators` (t, x, m, u, p) -> z
    `transition` (t, x, m, u, p, above) -> (x+, m+)
    `sample`     (t, x, m, u, p) -> (x+, m+); of a model with a kernel only what depends on what
    `kernel`     (t, x, m, u, p) -> values, for each function that the kernel calls
    """

    model: Model
    equations: ca.Function
    indicators: ca.Function
    transition: ca.Function
    sample: ca.Function
    kernel: Mapping[str, ca.Function]


def _size(signals: Sequence[Signal]) -> int:
    return sum(signal.size for signal in signals)


def _symbols(name: str, size: int) -> tuple[Any, list[Symbol]]:
    vector = ca.SX.sym(name, size)
    return vector, [Symbol(vector[i]) for i in range(size)]


def _column(values: Sequence[Any]) -> Any:
    return ca.vertcat(*(_sx(value) for value in values)) if values else ca.SX(0, 1)


def trace(model: Model) -> Traced:
    """The CasADi functions of `model`.

    Raises TraceError: a function uses what cannot be traced, or gives not what was declared.
    """
    flat = FlatModel(model)
    t, (t_symbol,) = _symbols("t", 1)
    x, x_symbols = _symbols("x", _size(model.states))
    m, m_symbols = _symbols("m", _size(model.discrete))
    u, u_symbols = _symbols("u", _size(model.inputs))
    p, p_symbols = _symbols("p", _size(model.parameters))
    above, above_symbols = _symbols("above", len(model.indicator_names))
    inputs = (t, x, m, u, p)
    arguments = (t_symbol, x_symbols, m_symbols, u_symbols, p_symbols)
    names = ["t", "x", "m", "u", "p"]

    derivatives, outputs = _traced(model, "equations", flat.derivatives_and_outputs, arguments)
    z = _traced(model, "indicators", flat.indicators, arguments)
    x_event, m_event = _traced(model, "transition", flat.transition, (*arguments, above_symbols))
    kernel: dict[str, ca.Function] = {}
    if model.kernel is None:
        x_sample, m_sample = _traced(model, "sample", flat.sample, arguments)
    else:
        everything = Symbol(ca.sum1(ca.vertcat(x, m, u)))
        x_sample, m_sample = [everything] * len(x_symbols), [everything] * len(m_symbols)
        for name in model.kernel.functions:
            values = _traced(model, name, partial(flat.kernel_function, name), arguments)
            kernel[name] = ca.Function(name, inputs, [_column(values)], names, ["values"])
    return Traced(
        model,
        ca.Function("equations", inputs, [_column(derivatives), _column(outputs)], names, ["dx", "y"]),
        ca.Function("indicators", inputs, [_column(z)], names, ["z"]),
        ca.Function(
            "transition", (*inputs, above), [_column(x_event), _column(m_event)], [*names, "above"], ["xn", "mn"]
        ),
        ca.Function("sample", inputs, [_column(x_sample), _column(m_sample)], names, ["xn", "mn"]),
        kernel,
    )


def _traced(model: Model, what: str, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    try:
        return function(*arguments)
    except ModelError as error:
        raise TraceError(f"{model.name}.{what}: {error}") from error
    except (TypeError, ValueError, np.linalg.LinAlgError) as error:
        raise TraceError(f"{model.name}.{what} cannot be traced: {error}") from error
