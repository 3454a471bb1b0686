"""The observability index of a model's linearisation at the very point, in arithmetic with hundreds of digits.

Nothing is generic here: the entries of A and C are those at the equilibrium, with all that they have in common, and the
equilibrium itself is found to as many digits. Ranks are decided by what is zero up to half of the digits; what decides
is to be far from that bound on either side, else the digits are doubled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from selection.branch import STATES, Branch
from selection.decimals import ZERO, Decimals, DecimalSpace, Row, Undecided, precision, solve

Indices = NDArray[np.int64]
FEWEST_DIGITS, MOST_DIGITS = 120, 960
# Powers of ten that what decides is to stay away from the bound between zero and not.
MARGIN = 15
_MOST_NEWTON_STEPS = 50


@dataclass(frozen=True)
class Precise:
    """A (n, n) and the outputs' gradients (q, n) to so many digits, states in units of their sizes, A per second."""

    A: list[Row]
    C: list[Row]
    digits: int


@dataclass(frozen=True)
class Decided:
    """Indices of each state, shape (sets, n), 0 where never; and what decided: digits, least not zero, most zero."""

    indices: Indices
    digits: int
    least: Decimal
    most: Decimal


def precise_model(branch: Branch, digits: int) -> Precise:
    """The model's linearisation at the equilibrium next to the branch's point.

    Newton's method from there; a point at rest to all digits is taken as it is.

    Raises ArithmeticError: there is no isolated equilibrium near; ModelError: a derivative is not defined.
    """
    sizes = [Decimal(float(size)) for size in _native_sizes(branch)]
    with precision(digits):
        states = [Decimal(float(value)) for value in branch.arguments[STATES]]
        last = None
        for _ in range(_MOST_NEWTON_STEPS):
            found = branch.differentiate(_leaf(branch, states), Decimals())
            dense = [_dense(row, len(states)) for row in found.A]
            if not any(found.rates):
                break
            try:
                step = solve(dense, found.rates)
            except ArithmeticError as error:
                raise ArithmeticError("there is no isolated equilibrium at the point: A is singular there") from error
            states = [value - change for value, change in zip(states, step, strict=True)]
            size = max(abs(change) / scale for change, scale in zip(step, sizes, strict=True))
            if last is not None and size >= last and size < Decimal(10) ** -(digits * 3 // 4):
                break
            last = size
        else:
            raise ArithmeticError("Newton's method does not come to rest at the point")
        found = branch.differentiate(_leaf(branch, states), Decimals())
        n, zero = len(states), Decimal(10) ** -(digits // 2)
        A = [_scaled(_dense(row, n), sizes, size) for row, size in zip(found.A, sizes, strict=True)]
        C = [_scaled(_dense(row, n), sizes, Decimal(1)) for row in found.C]
        return Precise([_without_dust(row, zero) for row in A], [_without_dust(row, zero) for row in C], digits)


def _native_sizes(branch: Branch) -> NDArray[np.float64]:
    """The sizes of the states in the units that the model declares."""
    return np.array([abs(signal.nominal) or 1.0 for signal in branch.system.states])


def _leaf(branch: Branch, states: Row) -> Callable[[int, int], Decimal]:
    def leaf(argument: int, element: int) -> Decimal:
        return states[element] if argument == STATES else Decimal(float(branch.arguments[argument][element]))

    return leaf


def _dense(row: Mapping[int, Decimal], n: int) -> Row:
    return [row.get(j, ZERO) for j in range(n)]


def _scaled(row: Row, sizes: Sequence[Decimal], own: Decimal) -> Row:
    return [entry * size / own for entry, size in zip(row, sizes, strict=True)]


def _without_dust(row: Row, zero: Decimal) -> Row:
    largest = max(map(abs, row), default=ZERO)
    return [ZERO if abs(entry) < zero * largest else entry for entry in row]


def exact_indices(
    branch: Branch,
    sensors: Sequence[int],
    lags: Sequence[int],
    sets: Sequence[tuple[int, ...]],
    tell: Callable[[int], None] = lambda done: None,
) -> Decided:
    """The least rho at which each set knows each state; `sensors` are places of the system's outputs and, then, states.

    Raises Undecided: even MOST_DIGITS do not tell some number from zero; ArithmeticError, ModelError: as
    `precise_model`.
    """
    digits = FEWEST_DIGITS
    while True:
        model = precise_model(branch, digits)
        try:
            return _decided(model, sensors, lags, sets, tell)
        except Undecided:
            if 2 * digits > MOST_DIGITS:
                raise
            digits *= 2


def _decided(
    model: Precise,
    sensors: Sequence[int],
    lags: Sequence[int],
    sets: Sequence[tuple[int, ...]],
    tell: Callable[[int], None],
) -> Decided:
    n = len(model.A)
    found = np.zeros((len(sets), n), dtype=np.int64)
    least, most = Decimal(1), ZERO
    bound = Decimal(10) ** -(model.digits // 2)
    margin = Decimal(10) ** MARGIN
    with precision(model.digits):
        columns = [[(i, row[j]) for i, row in enumerate(model.A) if row[j]] for j in range(n)]
        gradients = [*model.C, *([Decimal(int(i == j)) for j in range(n)] for i in range(n))]
        powers = [_powers(gradients[place], columns, n) for place in sensors]
        for number, members in enumerate(sets):
            space = DecimalSpace(n, model.digits)
            _fill(space, [powers[m] for m in members], [lags[m] for m in members], found[number])
            least, most = min(least, space.least), max(most, space.most)
            if least < bound * margin or most > bound / margin:
                raise Undecided(
                    f"with {model.digits} digits the smallest number other than zero is {least:.1e} and the largest "
                    f"zero {most:.1e}"
                )
            tell(1)
    return Decided(found, model.digits, least, most)


def _powers(gradient: Row, columns: Sequence[Sequence[tuple[int, Decimal]]], n: int) -> list[Row]:
    """Rows c A^k, k = 0 ... n - 1, each divided by its largest entry."""
    rows, row = [], gradient
    for _ in range(n):
        largest = max(map(abs, row))
        row = [entry / largest if entry else ZERO for entry in row] if largest else row
        rows.append(row)
        row = [sum((row[i] * entry for i, entry in column), ZERO) for column in columns]
    return rows


def _fill(space: DecimalSpace, powers: Sequence[list[Row]], lags: Sequence[int], known: Indices) -> None:
    """Let rho grow until all states are known or no row is new; the least rho of each goes into `known`."""
    last_lag, n = max(lags, default=0), space.n
    for rho in range(1, n + last_lag + 1):
        grew = False
        for rows, lag in zip(powers, lags, strict=True):
            if len(space.rows) < n and 0 <= rho - 1 - lag < n and any(rows[rho - 1 - lag]):
                grew |= space.insert(rows[rho - 1 - lag])
        if not grew and rho > last_lag:
            return
        for place in space.units():
            known[place] = known[place] or rho
        if known.all():
            return
