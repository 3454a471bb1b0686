"""Where a model comes to rest: the states at which every derivative is zero, inputs and parameters held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.integrate import Radau

from fmus.component import Signal, Vector
from fmus.jacobians import Matrix, Point

# In units of the nominal values: a correction from which Newton's method is tried, and one that counts as solved. It
# goes on until rounding keeps the correction from shrinking, which for a well-scaled model is far below the second.
NEAR, SOLVED = 1e-3, 1e-9
NEWTON_STEPS = 30
TOLERANCE = 1e-4  # relative, of the integration: it only has to stay on the way
HORIZON = 1e9  # s


class Declared(Protocol):
    """What a system says of itself."""

    @property
    def name(self) -> str:
        """What it is called."""

    @property
    def states(self) -> Sequence[Signal]:
        """Its continuous states."""

    @property
    def outputs(self) -> Sequence[Signal]:
        """Its outputs."""


class Sloping(Protocol):
    """A system to first order at a point."""

    @property
    def A(self) -> Matrix:
        """dx'/dx, (nx, nx)."""


class Evaluated(Protocol):
    """What is asked of a system to find where it rests; `fmus.jacobians.Jacobians` has it of a model."""

    @property
    def model(self) -> Declared:
        """The system's signals, in the units of its values."""

    def values(self, at: Point) -> tuple[Vector, Vector]:
        """x' and y at a point."""

    def at(self, at: Point) -> Sloping:
        """The system to first order there."""


class SteadyError(ValueError):
    """A model that comes to no rest, with the state that is in the way."""


@dataclass(frozen=True)
class Steady:
    """An equilibrium: where it is, what the model shows there, and how well its equations are met.

    `residual` is the largest |x'|/nominal [1/s], that of the state `worst`; `correction` is the largest |dx|/nominal by
    which Newton's method would move on. `after` is the time [s] that the model took to come near.
    """

    point: Point
    states: Mapping[str, float]
    outputs: Mapping[str, float]
    residual: float
    worst: str
    correction: float
    after: float


class _Newton(NamedTuple):
    """Where Newton's method stands: z, dz/dt [1/s] and the next step in z, None where the Jacobian is singular."""

    z: Vector
    rates: Vector
    correction: Vector | None

    @property
    def size(self) -> float:
        return np.inf if self.correction is None else float(np.abs(self.correction).max())


class _Scaled:
    """A model with all but its states held; the states z = x/nominal."""

    def __init__(self, jacobians: Evaluated, start: Point) -> None:
        states = jacobians.model.states
        self.jacobians, self.start = jacobians, start
        self.names = [name for signal in states for name in signal.scalar_names()]
        self.nominal = np.array([signal.nominal for signal in states for _ in range(signal.size)])

    def at(self, z: Vector) -> Point:
        return self.start._replace(x=z * self.nominal)

    def rates(self, z: Vector) -> Vector:
        """dz/dt, 1/s."""
        return self.jacobians.values(self.at(z))[0] / self.nominal

    def jacobian(self, z: Vector) -> Matrix:
        """The derivatives of dz/dt with respect to z, 1/s."""
        return self.jacobians.at(self.at(z)).A * self.nominal / self.nominal[:, None]

    def newton(self, z: Vector) -> _Newton:
        rates, matrix = self.rates(z), self.jacobian(z)
        if not np.isfinite(matrix).all() or np.linalg.matrix_rank(matrix) < len(z):
            return _Newton(z, rates, None)
        return _Newton(z, rates, np.asarray(np.linalg.solve(matrix, -rates), dtype=np.float64))

    def solved(self, near: _Newton) -> _Newton:
        """Newton's method until its correction no longer halves: the best that it came by."""
        best = near
        for _ in range(NEWTON_STEPS):
            if best.correction is None:
                break
            following = self.newton(best.z + best.correction)
            if not following.size < 0.5 * best.size:
                break
            best = following
        return best


def steady_state(jacobians: Evaluated, start: Point, most_steps: int = 5000) -> Steady:
    """The stable equilibrium that a model settles to from `start`, its discrete states, inputs, parameters, time held.

    The model goes its own way to rest by an implicit method (Radau IIA, order 5), whose steps grow as it slows down,
    until Newton's method with the exact Jacobian solves f(x) = 0 from there. So of several equilibria it is the one
    that the plant itself would reach, and one that is not stable is passed.

    Raises SteadyError: it does not settle within `most_steps` steps, a state is free (the Jacobian is singular), the
    equilibrium is not stable, or lies outside of a state's range; the state in the way is named.
    """
    model = _Scaled(jacobians, start)
    if not model.names:
        raise SteadyError(f"{jacobians.model.name} has no continuous state that could come to rest")
    here = model.newton(start.x / model.nominal)
    if not np.isfinite(here.rates).all():
        worst = model.names[int(np.flatnonzero(~np.isfinite(here.rates))[0])]
        raise SteadyError(f"{jacobians.model.name} cannot start here: the derivative of {worst} is not finite")
    way = Radau(
        lambda t, z: model.rates(z), 0.0, here.z, HORIZON, rtol=TOLERANCE, atol=TOLERANCE / 100.0,
        jac=lambda t, z: model.jacobian(z),
    )  # fmt: skip
    unstable = False
    for _ in range(most_steps):
        if here.size < NEAR:
            found = model.solved(here)
            if found.size < SOLVED:
                if np.linalg.eigvals(model.jacobian(found.z)).real.max() < 0.0:
                    return _result(model, found, way.t)
                unstable = True
        if way.status != "running":
            break
        way.step()
        here = model.newton(way.y)
    raise SteadyError(_reason(model, here, way.t, unstable))


def _result(model: _Scaled, found: _Newton, after: float) -> Steady:
    declared, at = model.jacobians.model, model.at(found.z)
    bounds = [(signal.minimum, signal.maximum) for signal in declared.states for _ in range(signal.size)]
    for name, value, (low, high) in zip(model.names, at.x, bounds, strict=True):
        if not low <= value <= high:
            raise SteadyError(
                f"{declared.name} comes to rest with {name} = {value:.6g}, outside its range {low:.6g} to {high:.6g}"
            )
    outputs = [name for signal in declared.outputs for name in signal.scalar_names()]
    worst = int(np.abs(found.rates).argmax())
    return Steady(
        point=at,
        states=dict(zip(model.names, map(float, at.x), strict=True)),
        outputs=dict(zip(outputs, map(float, model.jacobians.values(at)[1]), strict=True)),
        residual=float(np.abs(found.rates[worst])),
        worst=model.names[worst],
        correction=found.size,
        after=after,
    )


def _reason(model: _Scaled, here: _Newton, after: float, unstable: bool) -> str:
    """Why there is no equilibrium to give, with the state in the way."""
    name = model.jacobians.model.name
    if unstable and here.size < NEAR:
        growth, vectors = np.linalg.eig(model.jacobian(here.z))
        worst = model.names[int(np.abs(vectors[:, growth.real.argmax()]).argmax())]
        return f"{name} rests on an equilibrium that is not stable: {worst} leaves it at {growth.real.max():.3g} 1/s"
    rate = float(np.abs(here.rates).max())
    worst = model.names[int(np.abs(here.rates).argmax())]
    moving = f"{worst} has the largest residual: {rate * model.nominal[model.names.index(worst)]:.3g} a second"
    if here.correction is None:
        free = model.names[int(np.abs(np.linalg.svd(model.jacobian(here.z))[2][-1]).argmax())]
        return (
            f"{name} has no single equilibrium here: {free} is free (singular Jacobian) after {after:.3g} s; {moving}"
        )
    return f"{name} has not settled after {after:.3g} s; {moving}"
