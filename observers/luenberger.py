"""One Luenberger observer for one chosen location: what is lost by not following the plant's locations."""

from __future__ import annotations

from typing import Annotated, Any

from fmus.model import Model, ModelError
from observers.affine import fastest_poles
from observers.bank import Rule, bank_model, nominal_automaton
from observers.convergence import design_gains


def make(
    plant: str,
    location: int,
    delay: Annotated[float, "s"],
    dwell: Annotated[float, "s"],
    rate: Annotated[float, "1/s"],
    parameters: dict[str, Any] | None = None,
    parameter_set: str | None = None,
    start: dict[str, Any] | None = None,
    sample_time: Annotated[float, "s"] = 1e-3,
) -> Model:
    """x' = A_l x + B_l u + E_l + G_l (y - C_l x) with l = `location` throughout; G_l is the hybrid observer's.

    `delay` Delta, `dwell` D and `rate` mu as in Proposition 3.3.1, so that gains compare like with like.
    Raises ModelError: no such location, demands that no gains meet, unknown names, wrong units.
    """
    automaton = nominal_automaton(plant, parameters, parameter_set)
    if not 1 <= location <= len(automaton.locations):
        raise ModelError(f"location wants 1 to {len(automaton.locations)}, got {location}")
    gains = design_gains(automaton, rate, dwell, delay, fastest_poles(sample_time))
    rule = Rule(begin=location, choose=lambda instant, m, u, p: {})
    return bank_model(
        "luenberger", f"Luenberger observer for location {location}", automaton, gains, rule, start or {}, sample_time
    )
