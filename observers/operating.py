"""Operating points: where a plant settles with its inputs, or with one of them sought that settles a signal."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from fmus.component import Signal
from fmus.jacobians import Jacobians, Point, point
from fmus.model import ModelError
from fmus.steady import Steady, SteadyError, steady_state

# Values of an input that are tried to see between which of them a signal passes what is wanted of it.
TRIED = 25
# Of the range of the input that is sought.
TOLERANCE = 1e-10


class Sought(NamedTuple):
    """The input `by`, within its range, is to settle the output `name` at `wanted`."""

    by: Signal
    name: str
    wanted: float


class OperatingPoints:
    """The operating points of a model; what was tried for one is kept for the next."""

    def __init__(self, derivatives: Jacobians) -> None:
        self._derivatives = derivatives
        self._tried: dict[tuple[object, ...], list[_Tried]] = {}

    def at(self, values: Mapping[str, float], sought: Sought | None = None) -> Point:
        """Where the model settles with these values; with states among them, the point that they name as it is.

        Raises SteadyError: it does not settle; ModelError: no value of the input sought, or more than one, does.
        """
        model = self._derivatives.model
        if sought is not None:
            return self._settled({**values, sought.by.name: self._seek(values, sought)}).point
        if any(signal.name in values for signal in model.states):
            return point(model, values)
        return self._settled(values).point

    def _settled(self, values: Mapping[str, float], near: Steady | None = None) -> Steady:
        """Where the model settles, coming from its start or from a point near."""
        start = point(self._derivatives.model, values)
        return steady_state(self._derivatives, start if near is None else start._replace(x=near.point.x))

    def _seek(self, values: Mapping[str, float], sought: Sought) -> float:
        by, name, wanted = sought
        tried = self._along(values, by)
        pairs = [
            (one, other)
            for one, other in itertools.pairwise(tried)
            if (one.shows(name) - wanted) * (other.shows(name) - wanted) <= 0.0 and other.shows(name) != wanted
        ]
        if len(pairs) != 1:
            places = ", ".join(f"{one.value:g} to {other.value:g}" for one, other in pairs)
            shown = [one.shows(name) for one in tried]
            told = f"one each in {places}" if pairs else f"none, it settles at {min(shown):.6g} to {max(shown):.6g}"
            raise ModelError(f"wants one value of {by.name} that settles {name} at {wanted:g}; there is {told}")
        near = list(pairs[0])

        def missed(value: float) -> float:
            nearest = min(near, key=lambda tried: abs(tried.value - value))
            near.append(_Tried(value, self._settled({**values, by.name: value}, nearest.steady)))
            return near[-1].shows(name) - wanted

        return float(brentq(missed, near[0].value, near[1].value, xtol=TOLERANCE * (by.maximum - by.minimum)))

    def _along(self, values: Mapping[str, float], by: Signal) -> list[_Tried]:
        """Values of the input over its range, and where the model settles; where it does not they are left out."""
        key = (by.name, *sorted((k, v) for k, v in values.items() if k != by.name))
        if key not in self._tried:
            if not np.isfinite([by.minimum, by.maximum]).all():
                raise ModelError(f"{by.name} wants a range from a minimum to a maximum to be sought in")
            found: list[_Tried] = []
            reason = ""
            for value in np.linspace(by.minimum, by.maximum, TRIED).tolist():
                try:
                    steady = self._settled({**values, by.name: value}, found[-1].steady if found else None)
                except SteadyError as error:
                    reason = str(error)
                    continue
                found.append(_Tried(value, steady))
            if len(found) < 2:
                raise ModelError(f"settles nowhere from {by.name} = {by.minimum:g} to {by.maximum:g}: {reason}")
            self._tried[key] = found
        return self._tried[key]


class _Tried(NamedTuple):
    """A value of the input sought, and where the model settles with it."""

    value: float
    steady: Steady

    def shows(self, name: str) -> float:
        """The output called `name`."""
        return self.steady.outputs[name]
