"""Partial derivatives that an FMU gives, held against differences of its own values."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_double, c_size_t, c_uint32
from typing import TYPE_CHECKING, NamedTuple
from xml.etree import ElementTree

import numpy as np

from fmus.component import Vector
from fmus.description import FmuDescription
from fmus.variable import Variable

if TYPE_CHECKING:
    from fmus.fmu import FmuComponent

# Scaled by nominal values, relative where the derivative is above one: what tools that solve equations to 1e-6 reach
# by the largest of the differences, with room; wrong derivatives are off by far more.
TOLERANCE = 1e-3
DIFFERENCES = (1e-3, 1e-5, 1e-7)  # of a variable's value or its nominal value, the larger
TRANSPOSED = 1e-9  # relative: adjoint and directional derivatives are the same sums in another order
MOST_KNOWNS, MOST_UNKNOWNS = 40, 200


class Pairs(NamedTuple):
    """Real scalars whose derivatives are asked for: `unknowns` with respect to `knowns`."""

    unknowns: Sequence[Variable]
    knowns: Sequence[Variable]


class Compared(NamedTuple):
    """A derivative of the FMU and the nearest difference quotient, and how far apart, by the tolerance."""

    unknown: str
    known: str
    given: float
    difference: float
    off: float


def pairs(description: FmuDescription) -> Pairs:
    """What may be asked for in initialisation: calculated outputs and state derivatives with respect to inputs and to
    states with an exact start value."""
    plain = [v for v in description.variables if v.type in ("Real", "Float64") and not v.shape and not v.alias]
    plain = [v for v in plain if not v.clocked]
    derivatives, states = _states(description)
    knowns = [v for v in plain if v.causality == "input" and v.variability == "continuous"]
    knowns += [v for v in plain if v.name in states and v.initial == "exact"]
    continuous = [v for v in plain if v.variability == "continuous" and v.initial != "exact"]
    unknowns = [v for v in continuous if v.causality == "output" or v.name in derivatives]
    return Pairs(unknowns[:MOST_UNKNOWNS], knowns[:MOST_KNOWNS])


def _states(description: FmuDescription) -> tuple[frozenset[str], frozenset[str]]:
    """Names of the state derivatives that the model's structure lists, and of their states."""
    root = ElementTree.parse(description.folder / "modelDescription.xml").getroot()
    variables = list(root.find("ModelVariables") or ())
    structure = root.find("ModelStructure")
    if structure is None:
        return frozenset(), frozenset()
    if description.fmi_version.startswith("3"):
        of = {v.get("valueReference"): v for v in variables}
        listed = [of.get(unknown.get("valueReference")) for unknown in structure.iterfind("ContinuousStateDerivative")]
        found = [(v, of.get(v.get("derivative"))) for v in listed if v is not None]
    else:
        numbered = {str(number): v for number, v in enumerate(variables, start=1)}
        listed = [numbered.get(unknown.get("index", "")) for unknown in structure.iterfind("Derivatives/Unknown")]
        reals = [(v, v.find("Real")) for v in listed if v is not None]
        found = [(v, numbered.get(real.get("derivative", ""))) for v, real in reals if real is not None]
    names = [(str(v.get("name")), str(state.get("name"))) for v, state in found if state is not None]
    return frozenset(name for name, _ in names), frozenset(state for _, state in names)


class Questioned:
    """A component whose instance stands in initialisation, where values may be set and got back at once."""

    def __init__(self, component: FmuComponent, t0: float, u: Vector) -> None:
        self._slave, self._time = component.slave, t0
        self._third = component.fmi_version.startswith("3")
        self._u = np.ascontiguousarray(u, dtype=float)
        self._slave.begin(t0, component.starts, self._u)

    def get(self, variables: Sequence[Variable]) -> Vector:
        """Values, in the FMU's own units, shape (variables,)."""
        values = (c_double * len(variables))()
        name, counts = ("GetFloat64", (c_size_t(len(variables)),)) if self._third else ("GetReal", ())
        self._slave.call(self._time, name, _references(variables), c_size_t(len(variables)), values, *counts)
        return np.array(values)

    def set(self, variable: Variable, value: float) -> None:
        """Set one value, in the FMU's own unit."""
        values = (c_double * 1)(value)
        name, counts = ("SetFloat64", (c_size_t(1),)) if self._third else ("SetReal", ())
        self._slave.call(self._time, name, _references([variable]), c_size_t(1), values, *counts)

    def directional(self, unknowns: Sequence[Variable], known: Variable) -> Vector:
        """Derivatives of the unknowns with respect to one known, shape (unknowns,)."""
        return self._derivative("GetDirectionalDerivative", unknowns, [known], len(unknowns))

    def adjoint(self, unknown: Variable, knowns: Sequence[Variable]) -> Vector:
        """Derivatives of one unknown with respect to the knowns, shape (knowns,)."""
        return self._derivative("GetAdjointDerivative", [unknown], knowns, len(knowns))

    def _derivative(self, name: str, unknowns: Sequence[Variable], knowns: Sequence[Variable], wanted: int) -> Vector:
        seed, found = (c_double * 1)(1.0), (c_double * wanted)()
        tail = (seed, c_size_t(1), found, c_size_t(wanted)) if self._third else (seed, found)
        ends = (_references(unknowns), c_size_t(len(unknowns)), _references(knowns), c_size_t(len(knowns)))
        self._slave.call(self._time, name, *ends, *tail)
        return np.array(found)


def _references(variables: Sequence[Variable]) -> object:
    return (c_uint32 * len(variables))(*(variable.reference for variable in variables))


def compare(asked: Questioned, pairs: Pairs) -> list[Compared]:
    """Every derivative beside the difference quotient nearest to it: central or one-sided, of several widths."""
    found = []
    nominals = np.array([abs(v.nominal) or 1.0 for v in pairs.unknowns])
    for known in pairs.knowns:
        given = asked.directional(pairs.unknowns, known)
        quotients = _quotients(asked, pairs.unknowns, known)
        scale = (abs(known.nominal) or 1.0) / nominals
        off = np.abs(quotients - given) * scale / np.maximum(1.0, np.abs(quotients) * scale) / TOLERANCE
        off = np.where(np.isfinite(off), off, np.inf)
        best = off.argmin(axis=0)
        for i, unknown in enumerate(pairs.unknowns):
            nearest = float(quotients[best[i], i])
            found.append(Compared(unknown.name, known.name, float(given[i]), nearest, float(off[best[i], i])))
    return found


def _quotients(asked: Questioned, unknowns: Sequence[Variable], known: Variable) -> Vector:
    """Difference quotients with respect to one known, shape (quotients, unknowns); kept inside the known's range."""
    (value,) = asked.get([known])
    here = asked.get(unknowns)
    found = []
    for share in DIFFERENCES:
        width = share * max(abs(value), abs(known.nominal))
        sides = []
        for end in (min(value + width, known.maximum), max(value - width, known.minimum)):
            asked.set(known, end)
            sides.append((end, asked.get(unknowns)))
        asked.set(known, value)
        (above, up), (below, down) = sides
        if above > below:
            found.append((up - down) / (above - below))
        found += [(side - here) / (end - value) for end, side in sides if end != value]
    return np.array(found)
