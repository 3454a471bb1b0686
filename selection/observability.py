"""How many differentiations a set of sensors is away from a subset of states.

With x' = A x and y = C x the rows C, C A, ..., C A^(rho-1) are the observability matrix O_rho. A state x_j is known
from y and its first rho - 1 derivatives exactly where the unit vector e_j lies in the row space of O_rho. For the
states x_1, n_1 of them, and the others x_2: rank O_rho - rank O_rho,2 is the dimension of what the row space has in
common with the span of x_1, so rank O_rho = n_1 + rank O_rho,2 exactly where it holds all of x_1's unit vectors. The
index of x_1, the least such rho (Andersson, Frisk, Eriksson, IFAC 2005, Definitions 1 to 3), is then the largest among
the indices of its states, and one pass over rho gives those of all subsets of states at once.

A sensor with a time constant, tau y' = x_T - y, adds a state. Its rows span e_y, and then row by row what the sensor
without delay would give, since y + tau y' is x_T. So it is that sensor, one differentiation later, whatever tau is, and
the state added is known at once: a lag of 1, and nothing to augment. `selection.numerical` augments as the paper does.

Four methods differ in what the entries of A and C are taken to be:

structural   Independent of each other: only the zero and non-zero structure counts. Residues drawn at random.
coupled      What the model makes of random states, inputs and parameters on its branch: entries that come from one flow
             stay tied. Functions that are not rational are random functions (`selection.residues`).
exact        Those of the model at the very equilibrium, to hundreds of digits: what holds at equilibria alone counts.
numerical    Those in double precision, and ranks by singular values with a tolerance.

The first three are exact but for the chance, or the margin, that they state.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmus.linearmodel import LinearModel
from fmus.statespace import StateSpace, scales
from selection.branch import Branch
from selection.exact import exact_indices
from selection.methods import ByIndex
from selection.numerical import EPS, hidden_states, numerical_indices, scaled
from selection.residues import generic_model
from selection.rowspace import Field, Rows, spanned_units
from selection.structure import Structure, error_probability, free_rows

Indices = NDArray[np.int64]
Sets = Sequence[tuple[int, ...]]
Told = Callable[[int], None]


@dataclass(frozen=True)
class Measured:
    """A system at a point and the sensors that may be put on it.

    `sensors` names outputs or states of the space; those with a time constant [s] above 0 add a state. `model` is there
    where the equations are, else there is an FMU, and `structure` is what was seen of it.
    """

    space: StateSpace
    sensors: tuple[str, ...]
    time_constants: tuple[float, ...]
    structure: Structure
    model: LinearModel | None = None

    @property
    def lags(self) -> list[int]:
        """1 for a sensor with a time constant, else 0."""
        return [int(tau > 0.0) for tau in self.time_constants]

    @property
    def places(self) -> list[int]:
        """Rows of the sensors in the outputs and, below them, the states of the space."""
        names = [s.name for s in (*self.space.outputs, *self.space.states)]
        return [names.index(name) for name in self.sensors]


@dataclass(frozen=True)
class Options:
    """The field and the seed of random entries, the tolerance of singular values, and how many threads may work."""

    field: Field = dataclasses.field(default_factory=Field)
    seed: int = 0
    tolerance: float | None = None
    threads: int = 1


@dataclass(frozen=True)
class Seen:
    """Of each set: the index of the wanted states and of the whole state, 0 where never, and what is never seen.

    `whole` counts the sensors' own states too, which are known at once. `hidden` gives the states that take part in
    what a set never sees. `evidence` says what the method stands on: tolerance, chance of error, digits. `states`
    (sets, n) are the indices of each state alone; None by the numerical method, which asks for the subset only.
    """

    index: Indices
    whole: Indices
    states: Indices | None
    hidden: Callable[[int], list[int]]
    evidence: dict[str, Any]


def observe(
    measured: Measured,
    wanted: Sequence[int],
    sets: Sets,
    method: ByIndex,
    options: Options | None = None,
    tell: Told = lambda done: None,
) -> Seen:
    """What each set of sensors (their places) sees of the wanted states (their places) by a method.

    Raises ValueError: the method wants a model's equations, or the scaling is singular; Undecided, ArithmeticError:
    the exact method cannot tell zero from small, or finds no isolated equilibrium.
    """
    chosen = options or Options()
    if method == "numerical":
        return _numerical(measured, wanted, sets, chosen.tolerance, tell)
    if method == "structural":
        return _generic(measured, structural_rows(measured, chosen), 1, wanted, sets, chosen, tell)
    if method == "coupled":
        model = generic_model(_branch(measured, method), chosen.field, chosen.seed)
        gradients = np.concatenate([model.C, np.eye(len(model.A), dtype=np.uint64)])[measured.places]
        rows = Rows(model.A, gradients, np.array(measured.lags))
        return _generic(measured, rows, model.degree, wanted, sets, chosen, tell)
    found = exact_indices(_branch(measured, method), measured.places, measured.lags, sets, tell)
    digits = {
        "digits": found.digits,
        "least_other_than_zero": f"{found.least:.1e}",
        "largest_zero": f"{found.most:.1e}",
    }
    return _seen(found.indices, wanted, digits)


def structural_rows(measured: Measured, options: Options) -> Rows:
    """Random residues where the structure has entries."""
    n = len(measured.space.states)
    gradients = np.concatenate([measured.structure.C, np.eye(n, dtype=bool)])[measured.places]
    return free_rows(measured.structure.A, gradients, measured.lags, options.field, options.seed)


def subset_index(indices: Indices, states: Sequence[int]) -> Indices:
    """The index of a subset of states from those of each state (sets, n), shape (sets,); 0 where one is never known."""
    wanted = indices[:, list(states)]
    return np.where((wanted == 0).any(axis=1), 0, wanted.max(axis=1, initial=1))


def _branch(measured: Measured, method: ByIndex) -> Branch:
    if measured.model is None:
        raise ValueError(f"the method {method} wants the equations of a model; an FMU gives numbers only")
    return Branch(measured.model, measured.space.x0, measured.space.u0)


def _generic(
    measured: Measured, rows: Rows, degree: int, wanted: Sequence[int], sets: Sets, options: Options, tell: Told
) -> Seen:
    indices = spanned_units(rows, sets, options.field, tell, options.threads)
    chance = error_probability(len(rows.A), len(sets), measured.lags, degree, options.field)
    return _seen(
        indices,
        wanted,
        {"prime": f"2^{options.field.bits} - 1", "seed": options.seed, "error_probability": chance},
    )


def _seen(indices: Indices, wanted: Sequence[int], evidence: dict[str, Any]) -> Seen:
    whole = subset_index(indices, range(indices.shape[1]))
    index = subset_index(indices, wanted)
    return Seen(index, whole, indices, lambda i: [int(j) for j in np.flatnonzero(indices[i] == 0)], evidence)


def _numerical(measured: Measured, wanted: Sequence[int], sets: Sets, tolerance: float | None, tell: Told) -> Seen:
    space = measured.space
    sizes = scales(space.states)
    gradients = np.concatenate([space.C, np.eye(len(space.states))])[measured.places]
    if not (np.isfinite(sizes).all() and (sizes > 0.0).all()):
        bad = next(s for s, size in zip(space.states, sizes, strict=True) if not 0.0 < size < np.inf)
        raise ValueError(f"the scaling is singular: {bad.name} has the nominal value {bad.nominal:g}")
    system = scaled(space.A, gradients, np.array(measured.time_constants), sizes)
    found = numerical_indices(system, sets, wanted, tolerance, tell)
    told = tolerance if tolerance is not None else f"{EPS:.3g} times the larger side of each matrix"
    return Seen(
        found.subset, found.whole, None, lambda i: hidden_states(system, sets[i], tolerance), {"tolerance": told}
    )
