"""Derivatives in exact arithmetic: of every operation, in hundreds of digits and modulo a prime."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fmus.model import ModelError
from selection.decimals import Decimals, DecimalSpace, pi, precision, solve
from selection.residues import RandomFunctions, Residue
from selection.rowspace import Field
from selection.tape import decisions, differentiate, read_tape

X = ca.SX.sym("x", 3)
a, b, c = (X[i] for i in range(3))
# Every operation that a traced model can have; the point is (0.6, 1.7, -0.4).
OPERATIONS = {
    "sum": a + b - c,
    "product": a * b * c,
    "quotient": a / b + 1 / c,
    "negative": -a * 2,
    "square": a * a + b**2,
    "power": a**b + b**1.4 + 2**a,
    "root": ca.sqrt(a) * b,
    "exponential": ca.exp(a) + ca.expm1(c),
    "logarithm": ca.log(a) + ca.log1p(b) + ca.log10(b),
    "sine": ca.sin(b) + ca.cos(c) * ca.tan(a),
    "arc": ca.asin(a) - ca.acos(c) + ca.atan(b) + ca.atan2(c, a) + ca.atan2(a, c),
    "hyperbolic": ca.sinh(a) + ca.cosh(b) - ca.tanh(c),
    "hypotenuse": ca.hypot(a, b),
    "absolute": ca.fabs(c) * a + ca.fabs(b),
    "extremes": ca.fmin(a, b) * ca.fmax(b, c) + ca.fmin(b, a) + ca.fmax(c, b),
    "branches": ca.if_else(a < b, a * b, c / (a - a)) + ca.if_else(ca.logic_and(a > b, c < 0), ca.sqrt(c), c),
    "steps": ca.floor(b) * a + ca.ceil(b) * b + ca.sign(c) * c,
    "logic": ca.if_else(ca.logic_or(a <= b, ca.logic_not(b)), a, b)
    + ca.if_else(a == a, b, 0)
    + ca.if_else(a != b, c, 0),
}
POINT = np.array([0.6, 1.7, -0.4])


def derivatives(expression, arithmetic, leaf):
    tape = read_tape(ca.Function("f", [X], [expression]))
    ((found,),) = differentiate(tape, decisions(tape, [POINT]), leaf, 0, arithmetic)
    return found


@pytest.mark.parametrize("name", OPERATIONS)
def test_derivatives_in_decimals_equal_those_of_casadi(name):
    expression = OPERATIONS[name]
    wanted = ca.Function("f", [X], [expression, ca.jacobian(expression, X)])(POINT)
    with precision(60):
        found = derivatives(expression, Decimals(), lambda argument, element: Decimal(float(POINT[element])))
    # CasADi's doubles carry a few roundings.
    assert float(found.value) == pytest.approx(float(wanted[0]), rel=1e-13)
    slopes = [float(found.slopes.get(j, 0)) for j in range(3)]
    assert slopes == pytest.approx(np.array(wanted[1]).ravel().tolist(), rel=1e-13, abs=1e-13)


RATIONAL = ["sum", "product", "quotient", "negative", "square", "absolute", "extremes", "branches", "steps", "logic"]


@pytest.mark.parametrize("name", RATIONAL)
def test_derivatives_of_rational_operations_modulo_a_prime_are_those_of_fractions(name):
    expression, prime = OPERATIONS[name], Field().prime
    leaves = [Fraction(3, 5), Fraction(17, 10), Fraction(-2, 5)]

    def residue(value: Fraction) -> int:
        return value.numerator * pow(value.denominator, -1, prime) % prime

    modulo = derivatives(expression, RandomFunctions(Field(), 0), lambda _, i: Residue(residue(leaves[i]), prime))
    with precision(80):
        exact = derivatives(
            expression, Decimals(), lambda _, i: Decimal(leaves[i].numerator) / Decimal(leaves[i].denominator)
        )
    for found, wanted in [(modulo.value, exact.value)] + [
        (modulo.slopes.get(j, Residue(0, prime)), exact.slopes.get(j, Decimal(0))) for j in range(3)
    ]:
        # Eighty digits tell the fraction of so small a denominator.
        fraction = Fraction(wanted).limit_denominator(10**9)
        assert abs(Decimal(fraction.numerator) / Decimal(fraction.denominator) - wanted) < Decimal("1e-20")
        assert found.value == residue(fraction)


def test_random_functions_are_functions_and_keep_what_is_rational_in_their_values():
    prime = Field().prime
    arithmetic = RandomFunctions(Field(), 7)
    leaves = [Residue(11, prime), Residue(13, prime), Residue(17, prime)]

    def found(expression):
        return derivatives(expression, arithmetic, lambda _, i: leaves[i])

    root, twice = found(ca.sqrt(a * b)), found(ca.sqrt(b * a) - ca.sqrt(a * b))
    assert not twice.value and not twice.slopes, "one argument, one value"
    # v/(2 w) dw for v = sqrt(w): by a times 2 a, by b times 2 b: both are v.
    assert (root.slopes[0] * leaves[0] - root.slopes[1] * leaves[1]).value == 0
    circle = found(ca.sin(a) ** 2 + ca.cos(a) ** 2)
    assert circle.value.value == 1 and not circle.slopes
    exponential = found(ca.exp(a))
    assert exponential.slopes[0].value == exponential.value.value
    assert found(ca.exp(b)).value.value != exponential.value.value
    power = found(a**1.5)
    assert (power.slopes[0] * leaves[0] - power.value * arithmetic.number(1.5)).value == 0
    assert RandomFunctions(Field(), 8).function("EXP", leaves[0]).value != exponential.value.value


def test_degrees_bound_those_of_the_polynomials_that_a_residue_stands_for():
    arithmetic = RandomFunctions(Field(), 0)
    x, y = arithmetic.draw(), arithmetic.draw()
    assert [(r.top, r.bottom) for r in (x, x + y, x * y, x / y, x / y + y / x, -(x * x))] == [
        (1, 0), (1, 0), (2, 0), (1, 1), (2, 2), (2, 0)
    ]  # fmt: skip
    three = arithmetic.number(0.375)
    assert (three.value * 8 % Field().prime, three.top, three.bottom) == (3, 0, 0)


def test_an_operation_that_is_not_known_is_named():
    tape = read_tape(ca.Function("f", [X], [ca.erf(a)]))
    with pytest.raises(ModelError, match="the operation ERF is not known in exact arithmetic"):
        decisions(tape, [POINT])


def test_what_is_divided_by_zero_on_the_branch_taken_is_not_defined():
    assert derivatives(a / (b - b), RandomFunctions(Field(), 0), lambda _, i: Residue(i + 2, Field().prime)) is None
    with precision(30):
        assert derivatives(ca.sqrt(c), Decimals(), lambda _, i: Decimal(float(POINT[i]))) is None


@settings(deadline=None, max_examples=150)
@given(st.sampled_from(["SIN", "COS", "ATAN", "EXP", "SQRT", "LOG", "ASIN", "ACOS"]), st.floats(-30.0, 30.0))
def test_functions_of_decimals_are_those_of_mathematics(name, x):
    if name in ("SQRT", "LOG"):
        x = abs(x) + 1e-3
    if name in ("ASIN", "ACOS"):
        x = math.tanh(x)
    with precision(50):
        found = float(Decimals().function(name, Decimal(x)))
    wanted = getattr(math, {"LOG": "log"}.get(name, name.lower()))(x)
    # The library's functions are right to an ulp or two of their value.
    assert found == pytest.approx(wanted, rel=1e-15, abs=1e-16)


def test_identities_hold_to_all_digits():
    with precision(200):
        functions = Decimals()
        for text in ("0.3", "2.9", "-17.125", "1e5"):
            x = Decimal(text)
            sin, cos = functions.function("SIN", x), functions.function("COS", x)
            assert abs(sin * sin + cos * cos - 1) < Decimal("1e-197")
            angle = functions.function("ATAN2", sin, cos)
            assert abs(functions.function("SIN", angle) - sin) < Decimal("1e-197")
        # A hundred decimals, from tables.
        assert str(pi()).startswith(
            "3.1415926535897932384626433832795028841971693993751058209749445923078164062862089986280348253421170679"
        )


def test_elimination_in_decimals_solves_to_all_digits_and_refuses_what_is_singular():
    with precision(100):
        matrix = [[Decimal(1) / (i + j + 1) for j in range(8)] for i in range(8)]
        right = [sum(row) for row in matrix]
        # The Hilbert matrix of 8 has a condition of 1e10: as many digits are lost.
        assert all(abs(value - 1) < Decimal("1e-85") for value in solve(matrix, right))
        with pytest.raises(ArithmeticError):
            solve([[Decimal(1), Decimal(2)], [Decimal(2), Decimal(4)]], [Decimal(1), Decimal(1)])


def test_a_space_of_decimals_tells_zero_from_small_and_says_what_it_took_for_which():
    with precision(100):
        third = Decimal(1) / 3
        space = DecimalSpace(3, 100)
        assert space.insert([Decimal(1), third, Decimal(0)])
        # Off by a rounding in the last digit: the same row.
        assert not space.insert([third, third * third, Decimal("1e-90")])
        assert space.most == Decimal("1e-90")
        assert space.insert([third, third * third, Decimal("1e-30")])
        assert space.units() == [2] and space.least == Decimal("1e-30")


def test_decimals_leave_the_precision_of_their_caller_alone():
    with localcontext() as context:
        context.prec = 5
        with precision(80):
            Decimals().function("SIN", Decimal(1))
        assert (Decimal(1) / 3).as_tuple().digits == (3,) * 5
