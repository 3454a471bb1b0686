"""An FMU as it can be made linear, by the best way that it offers."""

from __future__ import annotations

from fmus.component import ConfigurationError
from fmus.description import FmuDescription, describe
from fmus.exchangefmu import ExchangeFmu
from fmus.initialfmu import InitialFmu
from fmus.modelstructure import ModelStructure, read_structure
from fmus.rungs import DIFFERENCES, DIRECTIONAL, Source


def linear_fmu(source: Source) -> ExchangeFmu | InitialFmu:
    """The FMU as it can be made linear; by Model Exchange where it offers that, else in initialisation.

    Raises ConfigurationError: it gives no derivatives of states in either way; each rung and why it does not hold.
    """
    description = describe(source.path, source.validation)
    structure = read_structure(description)
    if not structure.states and not description.states:
        raise ConfigurationError(f"{source.path}: it cannot be made linear: it has no continuous states")
    if "me" in description.kinds:
        return ExchangeFmu(source)
    lacking = _lacking_in_initialisation(description, structure)
    if lacking:
        raise ConfigurationError(
            f"{source.path}: it cannot be made linear. {DIRECTIONAL}: {lacking}. {DIFFERENCES}: of derivatives of "
            f"Model Exchange, which it does not offer; it offers {', '.join(description.kinds)}"
        )
    return InitialFmu(source, structure)


def _lacking_in_initialisation(description: FmuDescription, structure: ModelStructure) -> str:
    """Why derivatives cannot be asked for in the initialisation of Co-Simulation; empty where they can."""
    if not description.capabilities.get("providesDirectionalDerivative"):
        return "it does not declare directional derivatives"
    if not structure.states:
        return "it lists no derivatives of states"
    known = {v.name: v for v in description.variables}
    for state, derivative in zip(structure.states, structure.derivatives, strict=True):
        if derivative not in known or state not in known or known[state].initial != "exact":
            return f"its state '{state}' cannot be set at the start"
    return ""
