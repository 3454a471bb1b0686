"""Arithmetic with hundreds of digits: elementary functions, and row spaces in which zero is told from small."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from decimal import ROUND_HALF_EVEN, Context, Decimal, DivisionByZero, InvalidOperation, localcontext
from functools import cache
from typing import Any

Row = list[Decimal]
ZERO, ONE, TWO = Decimal(0), Decimal(1), Decimal(2)


def precision(digits: int) -> Any:
    """A context manager in which decimals have so many digits, and what is not defined raises ArithmeticError."""
    context = Context(prec=digits, rounding=ROUND_HALF_EVEN, Emin=-999999, Emax=999999)
    context.traps[InvalidOperation] = context.traps[DivisionByZero] = True
    return localcontext(context)


class Decimals:
    """Arithmetic of decimals at the precision of the context it is called in."""

    def number(self, value: float) -> Decimal:
        """The double, exactly."""
        return Decimal(value)

    def function(self, name: str, *arguments: Decimal) -> Decimal:
        """The function to the precision of the context. Raises ArithmeticError: it is not defined there."""
        if name == "POW":
            x, y = arguments
            return x**y
        return _FUNCTIONS[name](*arguments)


def _guarded(function: Callable[..., Decimal]) -> Callable[..., Decimal]:
    """The function computed with more digits than the context has, and rounded."""

    def apply(*arguments: Decimal) -> Decimal:
        with localcontext() as context:
            # Reducing an argument costs as many digits as it has before its point.
            context.prec += 10 + max(0, *(argument.adjusted() + 1 for argument in arguments))
            found = function(*arguments)
        return +found

    return apply


def pi() -> Decimal:
    """The number to the precision of the context."""
    with localcontext() as context:
        context.prec += 10
        digits = context.prec
    return +_pi(digits)


@cache
def _pi(digits: int) -> Decimal:
    """By Machin's formula: 16 atan(1/5) - 4 atan(1/239)."""
    with precision(digits + 5):
        return 16 * _atan_series(ONE / 5) - 4 * _atan_series(ONE / 239)


def _series(first: Decimal, ratio: Callable[[int], Decimal]) -> Decimal:
    """The sum of terms, each the last one times `ratio`(its number), until they no longer count."""
    total, term, k = first, first, 0
    while True:
        k += 1
        term *= ratio(k)
        before, total = total, total + term
        if before == total:
            return total


def _atan_series(x: Decimal) -> Decimal:
    square = -x * x
    return _series(x, lambda k: square * (2 * k - 1) / (2 * k + 1))


def _sin(x: Decimal) -> Decimal:
    x %= TWO * pi()
    square = -x * x
    return _series(x, lambda k: square / (2 * k * (2 * k + 1))) if x else ZERO


def _cos(x: Decimal) -> Decimal:
    x %= TWO * pi()
    square = -x * x
    return _series(ONE, lambda k: square / (2 * k * (2 * k - 1)))


def _atan(x: Decimal) -> Decimal:
    if x == ZERO:
        return ZERO
    if abs(x) > ONE:
        return (pi() / 2).copy_sign(x) - _atan(ONE / x)
    # Twice half the angle: tan(a/2) = x/(1 + sqrt(1 + x^2)), until the series goes fast.
    halvings = 0
    while abs(x) > Decimal("0.1"):
        x = x / (ONE + (ONE + x * x).sqrt())
        halvings += 1
    return _atan_series(x) * 2**halvings


def _asin(x: Decimal) -> Decimal:
    if abs(x) == ONE:
        return (pi() / 2).copy_sign(x)
    return _atan(x / (ONE - x * x).sqrt())


def _atan2(y: Decimal, x: Decimal) -> Decimal:
    if x > ZERO:
        return _atan(y / x)
    if x < ZERO:
        return _atan(y / x) + pi().copy_sign(y)
    return (pi() / 2).copy_sign(y) if y else ZERO


_FUNCTIONS: dict[str, Callable[..., Decimal]] = {
    "SQRT": lambda x: x.sqrt(),
    "EXP": lambda x: x.exp(),
    "LOG": lambda x: x.ln(),
    "SIN": _guarded(_sin),
    "COS": _guarded(_cos),
    "ATAN": _guarded(_atan),
    "ASIN": _guarded(_asin),
    "ACOS": _guarded(lambda x: pi() / 2 - _asin(x)),
    "ATAN2": _guarded(_atan2),
}


class Undecided(ArithmeticError):
    """A number is neither clearly zero nor clearly not."""


class DecimalSpace:
    """The row space of rows of decimals of size about 1, by its reduced echelon basis.

    What is below 10^-(half of the digits) in size is zero. `least` is the smallest number that was taken for one other
    than zero and decided something, `most` the largest that was taken for zero.
    """

    def __init__(self, n: int, digits: int) -> None:
        self.n = n
        self._zero = Decimal(10) ** -(digits // 2)
        self.rows: dict[int, Row] = {}
        self.least, self.most = ONE, ZERO

    def insert(self, row: Sequence[Decimal]) -> bool:
        """One more row: whether it was not in the space."""
        rest = list(row)
        for first, basis in self.rows.items():
            factor = rest[first]
            if factor:
                rest = [a - factor * b if b else a for a, b in zip(rest, basis, strict=True)]
                rest[first] = ZERO
        sizes = [abs(a) for a in rest]
        largest = max(sizes)
        if self._is_zero(largest):
            return False
        self.least = min(self.least, largest)
        first = sizes.index(largest)
        rest = self._cleaned([a / rest[first] for a in rest])
        for place, basis in self.rows.items():
            factor = basis[first]
            if factor:
                self.rows[place] = self._cleaned([a - factor * b if b else a for a, b in zip(basis, rest, strict=True)])
                self.rows[place][first] = ZERO
        self.rows[first] = rest
        return True

    def units(self) -> list[int]:
        """The unit vectors in the space, by place."""
        return [first for first, row in self.rows.items() if sum(1 for a in row if a) == 1]

    def _is_zero(self, size: Decimal) -> bool:
        if size < self._zero:
            self.most = max(self.most, size)
            return True
        return False

    def _cleaned(self, row: Row) -> Row:
        cleaned = [ZERO if a and self._is_zero(abs(a)) else a for a in row]
        self.least = min(self.least, *(abs(a) for a in cleaned if a))
        return cleaned


def solve(matrix: Sequence[Sequence[Decimal]], right: Sequence[Decimal]) -> Row:
    """x of matrix x = right, by elimination with the largest pivot. Raises ArithmeticError: it is singular."""
    n = len(matrix)
    rows = [[*row, b] for row, b in zip(matrix, right, strict=True)]
    for column in range(n):
        pivot = max(range(column, n), key=lambda i: abs(rows[i][column]))
        rows[column], rows[pivot] = rows[pivot], rows[column]
        top = rows[column]
        for i in range(n):
            if i != column and rows[i][column]:
                factor = rows[i][column] / top[column]
                rows[i] = [a - factor * b for a, b in zip(rows[i], top, strict=True)]
    return [rows[i][n] / rows[i][i] for i in range(n)]
