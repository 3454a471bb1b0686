"""Numbers modulo a prime that stand for the states, inputs and parameters of a model, and for what it makes of them.

A model is made of sums, products and quotients, which residues follow exactly, and of functions that are not rational:
roots, powers, exponentials, sines. Such a function takes a random value at each argument, the same at the same one; its
derivative is what follows from that value (y v/x for v = x^y, v/(2 x) for a root, v for an exponential), and sine and
cosine keep the sum of their squares. So what cancels in the model for every value of its states, inputs and parameters
cancels here, and what is zero here for a random draw is zero for all of them but by a chance that is bounded.
"""

from __future__ import annotations

import random
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from selection.branch import DISCRETE, STATES, TIME, Branch
from selection.rowspace import Field, Residues


class Residue:
    """A residue, with bounds on the degrees of numerator and denominator of what it stands for."""

    __slots__ = ("bottom", "prime", "top", "value")

    def __init__(self, value: int, prime: int, top: int = 0, bottom: int = 0) -> None:
        self.value, self.prime, self.top, self.bottom = value % prime, prime, top, bottom

    def _sum(self, value: int, other: Residue) -> Residue:
        top = max(self.top + other.bottom, other.top + self.bottom)
        return Residue(value, self.prime, top, self.bottom + other.bottom)

    def __add__(self, other: Residue) -> Residue:
        return self._sum(self.value + other.value, other)

    def __sub__(self, other: Residue) -> Residue:
        return self._sum(self.value - other.value, other)

    def __neg__(self) -> Residue:
        return Residue(-self.value, self.prime, self.top, self.bottom)

    def __mul__(self, other: Residue) -> Residue:
        return Residue(self.value * other.value, self.prime, self.top + other.top, self.bottom + other.bottom)

    def __truediv__(self, other: Residue) -> Residue:
        if not other.value:
            raise ZeroDivisionError("division by what is zero modulo the prime")
        value = self.value * pow(other.value, -1, self.prime)
        return Residue(value, self.prime, self.top + other.bottom, self.bottom + other.top)

    def __bool__(self) -> bool:
        return self.value != 0

    def __repr__(self) -> str:
        return f"Residue({self.value})"


class RandomFunctions:
    """Arithmetic of residues in which functions that are not rational have random values, drawn from a seed."""

    def __init__(self, field: Field, seed: int) -> None:
        self.prime = field.prime
        self._random = random.Random(seed)
        self._drawn: dict[tuple[str, tuple[int, ...]], Residue] = {}

    def number(self, value: float) -> Residue:
        """The double, which is a whole number over a power of two, exactly. Raises OverflowError: it is not finite."""
        fraction = Fraction(value)
        return Residue(fraction.numerator * pow(fraction.denominator, -1, self.prime), self.prime)

    def draw(self) -> Residue:
        """A new random number other than zero."""
        return Residue(self._random.randrange(1, self.prime), self.prime, 1)

    def function(self, name: str, *arguments: Residue) -> Residue:
        """The value of the function there; sine and cosine by the tangent of half the argument, a random number."""
        if name in ("SIN", "COS"):
            t, one = self._value("HALF", arguments), self.number(1.0)
            return (t + t if name == "SIN" else one - t * t) / (one + t * t)
        return self._value(name, arguments)

    def _value(self, name: str, arguments: tuple[Residue, ...]) -> Residue:
        key = name, tuple(argument.value for argument in arguments)
        if key not in self._drawn:
            self._drawn[key] = self.draw()
        return self._drawn[key]


class Generic(NamedTuple):
    """A model's A (n, n) and its outputs' gradients (q, n) for a random draw, and a bound on the degree of entries.

    All entries can be brought over one denominator; `degree` bounds that of the numerators then.
    """

    A: Residues
    C: Residues
    degree: int


def generic_model(branch: Branch, field: Field, seed: int) -> Generic:
    """The model's derivatives at a random point, along this branch.

    States, inputs and parameters are random, but those inputs and parameters that are 0, which are switched off, stay
    0; time and discrete states stay as they are.

    Raises ModelError: a derivative is not defined on this branch.
    """
    arithmetic = RandomFunctions(field, seed)
    drawn: dict[tuple[int, int], Residue] = {}

    def leaf(argument: int, element: int) -> Residue:
        value = float(branch.arguments[argument][element])
        if argument in (TIME, DISCRETE) or (argument != STATES and value == 0.0):
            return arithmetic.number(value)
        return drawn.setdefault((argument, element), arithmetic.draw())

    found = branch.differentiate(leaf, arithmetic)
    tops, bottoms = [0], [0]
    matrices = []
    for rows in (found.A, found.C):
        matrix = np.zeros((len(rows), len(found.A)), dtype=np.uint64)
        for i, row in enumerate(rows):
            for j, entry in row.items():
                matrix[i, j] = entry.value
                tops.append(entry.top)
                bottoms.append(entry.bottom)
        matrices.append(matrix)
    return Generic(matrices[0], matrices[1], max(tops) + sum(bottoms))
