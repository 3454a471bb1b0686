"""The continuous observer told the true location: the lower bound for every observer that must find it."""

from __future__ import annotations

from typing import Annotated, Any

from fmus.component import Signal
from fmus.model import Model
from observers.affine import fastest_poles
from observers.bank import Rule, bank_model, nominal_automaton
from observers.convergence import design_gains


def make(
    plant: str,
    delay: Annotated[float, "s"],
    dwell: Annotated[float, "s"],
    rate: Annotated[float, "1/s"],
    parameters: dict[str, Any] | None = None,
    parameter_set: str | None = None,
    start: dict[str, Any] | None = None,
    sample_time: Annotated[float, "s"] = 1e-3,
) -> Model:
    """Eq. 15 with the location read from the input `true_location`, an identity sensor; same gains as `hybrid`.

    Over (k-1, k] it runs the location of k-1, as the hybrid observer does when it finds every change at once.
    Raises ModelError: demands that no gains meet, unknown names, wrong units.
    """
    automaton = nominal_automaton(plant, parameters, parameter_set)
    gains = design_gains(automaton, rate, dwell, delay, fastest_poles(sample_time))
    count = len(automaton.locations)
    told = Signal("true_location", "1", count, "location of the plant", minimum=1, maximum=count, kind="integer")
    rule = Rule(begin=count, choose=lambda instant, m, u, p: {"location": u.true_location}, inputs=(told,))
    return bank_model(
        "switched", "Switched observer given the true location", automaton, gains, rule, start or {}, sample_time
    )
