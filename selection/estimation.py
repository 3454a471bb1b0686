"""A linear estimation problem: what moves the states, what sensors see through their noise, and what is wanted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from fmus.component import Vector
from observers.modes import growing_modes, mode_name, taking_part, unseen_by_name, unseen_directions
from selection.measures import Plant, augmented
from selection.numerical import EPS

# Of the largest eigenvalue of a covariance, what counts as rounding when one is below zero.
DEFINITE = 1e-12


class EstimationError(ValueError):
    """An estimation that has no answer; each problem names the mode, sensors or states that stand in the way."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("; ".join(problems))
        self.problems = list(problems)


@dataclass(frozen=True)
class Estimation:
    """x' = A x + w, y = C x + v, and the error of z = W x that a filter x^' = A x^ + L (y - C x^) is to keep small.

    A (n, n) [1/s]; C (m, n), a row a sensor; `process` (n, n) and `noise` (m,) are the intensities of the white noises
    w and v, G G' and the squares of H's diagonal in Zhang et al. (Front. Mech. Eng. 2021), Eqs. 1 to 4; W (k, n). An
    intensity is a covariance times seconds. `own` has the place of a sensor's own state, which drives nothing else, or
    None.
    """

    A: Vector
    C: Vector
    process: Vector
    noise: Vector
    W: Vector
    states: tuple[str, ...]
    sensors: tuple[str, ...]
    own: tuple[int | None, ...]

    def on(self, members: Sequence[int]) -> Estimation:
        """The same with these sensors only, in their order, and without the own states of the others."""
        dropped = {place for i, place in enumerate(self.own) if place is not None and i not in members}
        return self._part([j for j in range(len(self.A)) if j not in dropped], list(members))

    def moved(self) -> Estimation:
        """The same without the states that no noise reaches and that die out: a filter knows them without error.

        Exact: no other state drives them, so their errors stay zero, and a column of zeros drives no other.
        """
        reached = np.diag(self.process) > 0.0
        for _ in range(len(self.A)):
            reached = reached | ((self.A != 0.0) @ reached.astype(int) > 0)
        still = np.flatnonzero(~reached)
        if not len(still) or growing_modes(self.A[np.ix_(still, still)]):
            return self
        return self._part(np.flatnonzero(reached).tolist(), range(len(self.C)))

    def _part(self, kept: Sequence[int], members: Sequence[int]) -> Estimation:
        square, rows = np.ix_(kept, kept), list(members)
        places = {j: place for place, j in enumerate(kept)}
        own = (self.own[i] for i in members)
        return replace(
            self,
            A=self.A[square],
            C=self.C[np.ix_(rows, kept)],
            process=self.process[square],
            noise=self.noise[rows],
            W=self.W[:, kept],
            states=tuple(self.states[j] for j in kept),
            sensors=tuple(self.sensors[i] for i in members),
            own=tuple(None if place is None else places.get(place) for place in own),
        )

    def scaled(self, sizes: Vector) -> Estimation:
        """The same with states in units of `sizes` (n,) and sensors in units of their noise, whose intensity is then 1.

        z stays what it is. Raises EstimationError: a size is zero or not finite; the states are named.
        """
        bad = [f"{s} has the size {z:g}" for s, z in zip(self.states, sizes, strict=True) if not 0.0 < z < np.inf]
        if bad:
            raise EstimationError([f"a scaling of the states wants sizes above 0: {', '.join(bad)}"])
        return replace(
            self,
            A=self.A * sizes / sizes[:, None],
            C=self.C * sizes / np.sqrt(self.noise)[:, None],
            process=self.process / np.outer(sizes, sizes),
            noise=np.ones(len(self.noise)),
            W=self.W * sizes,
        )


def estimation_of(plant: Plant, wanted: Sequence[int], states: Sequence[str], sensors: Sequence[str]) -> Estimation:
    """The estimation of the wanted states (places) of a plant with all of its sensors, their own states behind.

    z are the wanted states over their sizes. A sensor of standard deviation sigma at each sample of period h carries
    white noise of intensity sigma^2 h, which in the plant's units is h.
    """
    A, C = augmented(plant, range(len(sensors)))
    n, slow = len(plant.A), [i for i, tau in enumerate(plant.time_constants) if tau > 0.0]
    process = np.zeros((len(A), len(A)))
    process[:n, :n] = np.square(plant.noise.process) * np.eye(n)
    own = tuple(n + slow.index(i) if i in slow else None for i in range(len(sensors)))
    names = (*states, *(f"{sensors[i]} in its sensor" for i in slow))
    return Estimation(
        A, C, process, np.full(len(C), plant.noise.period), np.eye(len(A))[list(wanted)], names, tuple(sensors), own
    )


def refuse_unsound(system: Estimation) -> None:
    """Nothing where the best filter of all sensors exists and errs. Raises EstimationError with every problem found."""
    problems = _indefinite(system)
    if np.isfinite(system.process).all():
        problems += _unmoved(system)
    if not np.any(system.W):
        problems.append("no noise reaches what is wanted: its error dies out with any sensors, or none")
    unseen = unseen_by(system, range(len(system.sensors)))
    if unseen:
        problems.append(f"no sensor sees {unseen}: it does not die out by itself")
    if problems:
        raise EstimationError(problems)


def unseen_by(system: Estimation, members: Sequence[int]) -> str:
    """The modes that do not die out and that a set does not see, with the states that take part; empty: detectable."""
    if not growing_modes(system.A):
        return ""
    seen = system.on(members)
    return unseen_by_name(seen.A, seen.C, seen.states)


def deviations(system: Estimation) -> Vector:
    """Standard deviations of the states that the noise moves, (n,), from A X + X A' + process = 0.

    Raises EstimationError: a mode does not die out, so that they grow without bound.
    """
    growing = growing_modes(system.A)
    if growing:
        raise EstimationError([f"no standard deviations: a mode of {growing[0].real:.3g}/s does not die out"])
    X = solve_continuous_lyapunov(system.A, -system.process)
    return np.asarray(np.sqrt(np.maximum(np.diag(X), 0.0)))


def _indefinite(system: Estimation) -> list[str]:
    """What is wrong with the noises: not finite, not symmetric, below zero; a sensor's zero, too."""
    problems = [
        f"the noise of {name} has the intensity {r:g}, wants more than 0"
        for name, r in zip(system.sensors, system.noise, strict=True)
        if not 0.0 < r < np.inf
    ]
    process = system.process
    if not np.isfinite(process).all():
        return [*problems, "the process noise is not finite"]
    uneven = np.argwhere(np.abs(process - process.T) > DEFINITE * np.abs(process).max(initial=0.0))
    if len(uneven):
        one, other = (system.states[j] for j in uneven[0])
        return [
            *problems,
            f"the process noise wants a symmetric covariance: {one} with {other} is not {other} with {one}",
        ]
    # In units in which every diagonal is one, so that no state's unit hides another's fault.
    size = np.sqrt(np.where(np.diag(process) > 0.0, np.diag(process), 1.0))
    values, vectors = np.linalg.eigh(process / np.outer(size, size))
    if values[0] < -DEFINITE * max(values[-1], -values[0]):
        named = taking_part(vectors[:, 0], system.states)
        problems.append(f"the process noise is indefinite: {values[0]:.3g} of a variance in {named}")
    return problems


def _unmoved(system: Estimation) -> list[str]:
    """Modes on the imaginary axis that no process noise moves: a filter's gain on them would end at zero."""
    least = EPS * len(system.A) * np.linalg.norm(system.A)
    size = np.sqrt(np.where(np.diag(system.process) > 0.0, np.diag(system.process), 1.0))
    rows = system.process / np.outer(size, size)
    return [
        f"no process noise moves {mode_name(mode, vector, system.states)}: its gain would end at zero"
        for mode, vector in unseen_directions(system.A.T, rows)
        if abs(mode.real) <= least and mode.imag >= 0.0
    ]
