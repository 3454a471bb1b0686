"""The plant's own model run on its inputs alone: what an estimator is worth is what it adds to this."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from fmus.model import Model
from observers.given import Complaints, plant_model, read_believed, read_outputs


def make(
    plant: str | Model,
    start: dict[str, Any] | None = None,
    parameters: dict[str, Any] | None = None,
    parameter_set: str | None = None,
    outputs: list[str] | None = None,
) -> Model:
    """x' = f(x, u), events and all. Arguments as in docs/observers.md.

    Raises ConfigurationError with all that is wrong with them.
    """
    found = Complaints()
    model = plant_model(plant)
    believed = read_believed(model, parameters, parameter_set, start or {}, found)
    chosen = tuple(read_outputs(model, outputs, found))
    found.end()

    def equations(t: Any, x: Any, m: Any, u: Any, p: Any) -> Any:
        derivatives, values = believed.equations(t, x, m, u, p)
        return derivatives, {signal.name: values[signal.name] for signal in chosen}

    return replace(
        believed,
        name="model_alone",
        description=f"The model of {model.name} run on its inputs alone",
        role="observer",
        equations=equations,
        outputs=chosen,
    )
