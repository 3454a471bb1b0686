"""A controller that hides a location: the input of Proposition 3.1.3, for any relative degree."""

from __future__ import annotations

from dataclasses import replace
from math import comb
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.hybrid import Automaton, Location
from fmus.model import Model, ModelError, Values
from observers.affine import NEGLIGIBLE, advance, fastest_poles, sample_observer
from observers.bank import nominal_automaton, read_thresholds, read_value, sampled_signals, sampled_values, vector
from observers.residuals import design_signatures, residual

Array = NDArray[np.float64]


class Feedback(NamedTuple):
    """u = target r_d + constant - state (x, z): `state` (m, 2n), `target` (m, p), `constant` (m,), `degree` (p,)."""

    state: Array
    target: Array
    constant: Array
    degree: tuple[int, ...]


def evading_feedback(plant: Location, pretended: Location, gain: Array, scales: Array, bandwidth: float) -> Feedback:
    """The input that drives the residual of generator j to a target while the plant is in location i.

    With X = (x, z), x in location i = `plant`, z the generator (6) of j = `pretended` with L = `gain`,

        X' = [[A_i, 0], [L C_i, H_j]] X + [B_i; B_j] u + [E_i; E_j],   r = [-C_i, C_j] X   (Eq. 11-12, zeta = x - z).

    Its first derivative holds the input through C_j B_j - C_i B_i = C_ji B_i + C_j B_ji. Where that is invertible
    this is the Proposition's own case, relative degree 1. Where it vanishes, r is differentiated until an input
    appears: c A^(d-1) B /= 0 at the relative degree d of each output. The inputs chosen make
    (d/dt + bandwidth)^d (r - r_d) = 0.

    Raises ModelError: no input ever appears, or the inputs cannot move the outputs independently.
    """
    n = len(scales)
    weights = np.tile(scales, 2)
    dynamics = np.block([[plant.A, np.zeros((n, n))], [gain @ plant.C, pretended.A - gain @ pretended.C]])
    dynamics = dynamics * weights / weights[:, None]
    entry = np.vstack([plant.B, pretended.B]) / weights[:, None]
    drift = np.concatenate([plant.E, pretended.E]) / weights
    outputs = np.hstack([-plant.C, pretended.C]) * weights
    decoupling, states, constants, targets, degrees = [], [], [], [], []
    for row in outputs:
        derivatives = [row]
        while np.linalg.norm(derivatives[-1] @ entry) <= NEGLIGIBLE * np.linalg.norm(derivatives[-1]) * np.linalg.norm(
            entry
        ):
            if len(derivatives) == 2 * n:
                raise ModelError("no input reaches this residual: it cannot be held within its threshold")
            derivatives.append(derivatives[-1] @ dynamics)
        d = len(derivatives)
        weight = [comb(d, q) * bandwidth ** (d - q) for q in range(d)]
        decoupling.append(derivatives[-1] @ entry)
        states.append(derivatives[-1] @ dynamics + sum(w * one for w, one in zip(weight, derivatives, strict=True)))
        constants.append(
            derivatives[-1] @ drift + sum(weight[q] * float(derivatives[q - 1] @ drift) for q in range(1, d))
        )
        targets.append(weight[0])
        degrees.append(d)
    matrix = np.array(decoupling)
    if np.linalg.matrix_rank(matrix, tol=NEGLIGIBLE * float(np.linalg.norm(matrix))) < len(outputs):
        raise ModelError(f"{matrix.shape[1]} inputs cannot move {len(outputs)} residuals independently")
    inverse = np.linalg.pinv(matrix)
    return Feedback(
        inverse @ np.array(states) / weights, inverse @ np.diag(targets), -inverse @ np.array(constants), tuple(degrees)
    )


def make(
    plant: str,
    hide: int,
    pretend: int,
    delay: Annotated[float, "s"],
    threshold: dict[str, Any] | str,
    bandwidth: Annotated[float, "1/s"],
    entry_error: float = 1.0,
    since: Annotated[float, "s"] = 0.0,
    until: Annotated[float, "s"] = 1e9,
    target: str | None = None,
    parameters: dict[str, Any] | None = None,
    parameter_set: str | None = None,
    start: dict[str, Any] | None = None,
    sample_time: Annotated[float, "s"] = 1e-3,
) -> Model:
    """Keeps the signature of location `pretend` true while the plant is in location `hide`, for `since` <= t < `until`.

    It knows the plant's states and location, as a controller may, and copies the location observer's generator, so
    `delay`, `threshold`, `entry_error`, `parameters` and `start` must be the observer's. `target` is the residual
    it holds, a text in the unit of y, 0 where absent. Outside location `hide` and outside the time window the
    inputs `*_requested` pass through unchanged.

    Outputs: the plant's inputs, acting over (k, k+1]; the same `*_applied` over (k-1, k], which an observer is wired
    to; the residuals r; and `evading`.

    Raises ModelError: two locations that are the same or indistinguishable, or a residual that no input reaches.
    """
    automaton = nominal_automaton(plant, parameters, parameter_set)
    count = len(automaton.locations)
    for name, number in (("hide", hide), ("pretend", pretend)):
        if not 1 <= number <= count:
            raise ModelError(f"{name} wants a location from 1 to {count}, got {number}")
    limits = read_thresholds(threshold, automaton)
    signatures = design_signatures(automaton, delay, limits, entry_error, fastest_poles(sample_time))
    signature = next(one for one in signatures if pretend in one.locations)
    if hide in signature.locations:
        raise ModelError(f"locations {hide} and {pretend} share their signature: there is nothing to hide")
    hidden = automaton.locations[hide - 1]
    feedback = evading_feedback(hidden, signature.location, signature.gain, automaton.scales, bandwidth)
    goal = np.array([read_value(target or f"0 {signal.unit}", signal.unit, "target") for signal in automaton.outputs])
    if np.any(np.abs(goal) > np.array(limits)):
        raise ModelError(f"target wants a residual within the threshold {limits}, got {goal}")
    generator = sample_observer(signature.location, signature.gain, sample_time)
    return _model(automaton, hide, feedback, goal, (signature.location.C, generator), (since, until), sample_time)


def _model(
    automaton: Automaton,
    hide: int,
    feedback: Feedback,
    goal: Array,
    pretended: tuple[Array, Any],
    window: tuple[float, float],
    sample_time: float,
) -> Model:
    states = [signal.name for signal in automaton.states]
    commands = [signal.name for signal in automaton.inputs]
    outputs = [signal.name for signal in automaton.outputs]
    output_matrices = np.stack([location.C for location in automaton.locations])
    arrays = {
        "output": output_matrices,
        "pretended_output": pretended[0],
        "feedback_state": feedback.state,
        "feedback_constant": feedback.constant + feedback.target @ goal,
    }

    def sample(t: Any, x: Values, m: Values, u: Values, p: Values) -> dict[str, Any]:
        state = vector([u[name] for name in states])
        y = vector([0.0] * len(outputs))
        for number in range(len(output_matrices)):
            y = y + np.where(np.abs(u.location - (number + 1)) < 0.5, 1.0, 0.0) * (p.output[number] @ state)
        applied = vector([m[name] for name in commands])
        (one,) = sampled_values("generator", p, 1, len(outputs))
        z = advance(one, m.z, applied, m.y_before, y)
        evading = np.where(np.abs(u.location - p.hide) < 0.5, 1.0, 0.0)
        evading = evading * np.where(t >= p.since, 1.0, 0.0) * np.where(t < p.until, 1.0, 0.0)
        command = p.feedback_constant - p.feedback_state @ np.concatenate([state, z])
        requested = [u[f"{name}_requested"] for name in commands]
        given = [np.where(evading > 0.5, own, asked) for own, asked in zip(command, requested, strict=True)]
        updated = dict(zip(commands, given, strict=True))
        updated |= {f"{name}_applied": value for name, value in zip(commands, applied, strict=True)}
        updated |= {f"r_{name}": value for name, value in zip(outputs, residual(p.pretended_output, z, y), strict=True)}
        return updated | {"z": z, "y_before": y, "evading": evading}

    return Model(
        name="evasion",
        description="Input that keeps a wrong location's residual within its threshold (Proposition 3.1.3)",
        role="controller",
        equations=lambda t, x, m, u, p: ({}, {}),
        inputs=(
            *automaton.states,
            Signal("location", "1", hide, "location of the plant", kind="integer"),
            *(replace(signal, name=f"{signal.name}_requested") for signal in automaton.inputs),
        ),
        discrete=(
            *automaton.inputs,
            *(replace(signal, name=f"{signal.name}_applied") for signal in automaton.inputs),
            *(replace(signal, name=f"r_{signal.name}", description="residual held") for signal in automaton.outputs),
            Signal("evading", "1", 0, "1 while the input is its own", kind="boolean"),
            Signal("z", "1", np.zeros(len(states)), "generator state", shape=(len(states),), local=True),
            Signal("y_before", "1", np.zeros(len(outputs)), "y at the last sample", shape=(len(outputs),), local=True),
        ),
        parameters=(
            Signal("sample_time", "s", sample_time, "step the matrices are made for"),
            Signal("since", "s", window[0], "begin of the evasion"),
            Signal("until", "s", window[1], "end of the evasion"),
            Signal("hide", "1", float(hide), "location to hide"),
            *(Signal(name, "1", value, shape=value.shape) for name, value in arrays.items()),
            *sampled_signals("generator", [pretended[1]]),
        ),
        sample=sample,
        sample_time="sample_time",
    )
