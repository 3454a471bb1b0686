"""Which states an FMU has, and on what their derivatives and its outputs are declared to depend."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree import ElementTree

from fmus.description import FmuDescription


@dataclass(frozen=True)
class ModelStructure:
    """The structure an FMU declares: its states and their derivatives in the order of its vectors.

    `depends` gives, for a derivative or an output by name, the names of what it depends on, and lacks those that
    declare nothing, which may depend on all.
    """

    states: tuple[str, ...]
    derivatives: tuple[str, ...]
    depends: Mapping[str, frozenset[str]]


def read_structure(description: FmuDescription) -> ModelStructure:
    """What the model description says; empty for FMI 1, which has no such thing.

    States that are arrays, and their derivatives, go by the names of their scalars, `x[1]`.
    """
    root = ElementTree.parse(description.folder / "modelDescription.xml").getroot()
    listed = list(root.find("ModelVariables") or ())
    structure = root.find("ModelStructure")
    if structure is None:
        return ModelStructure((), (), {})
    if description.fmi_version.startswith("3"):
        return _third(description, {v.get("valueReference", ""): v for v in listed}, structure)
    return _second({str(number): v for number, v in enumerate(listed, start=1)}, structure)


def _second(of: Mapping[str, ElementTree.Element], structure: ElementTree.Element) -> ModelStructure:
    states, derivatives = [], []
    for unknown in structure.iterfind("Derivatives/Unknown"):
        derivative = of[unknown.get("index", "")]
        real = derivative.find("Real")
        state = of.get("" if real is None else real.get("derivative", ""))
        derivatives.append(_name(derivative))
        states.append(f"state of {_name(derivative)}" if state is None else _name(state))
    depends = {}
    for kind in ("Derivatives", "Outputs"):
        for unknown in structure.iterfind(f"{kind}/Unknown"):
            on = unknown.get("dependencies")
            if on is not None:
                depends[_name(of[unknown.get("index", "")])] = frozenset(_name(of[k]) for k in on.split() if k in of)
    return ModelStructure(tuple(states), tuple(derivatives), depends)


def _third(
    description: FmuDescription, of: Mapping[str, ElementTree.Element], structure: ElementTree.Element
) -> ModelStructure:
    scalars = {v.name: v.scalar_names() for v in description.variables}

    def names(element: ElementTree.Element) -> list[str]:
        return scalars.get(_name(element), [_name(element)])

    states: list[str] = []
    derivatives: list[str] = []
    for unknown in structure.iterfind("ContinuousStateDerivative"):
        derivative = of[unknown.get("valueReference", "")]
        state = of.get(derivative.get("derivative", ""))
        derivatives += names(derivative)
        states += [f"state of {name}" for name in names(derivative)] if state is None else names(state)
    depends = {}
    for kind in ("ContinuousStateDerivative", "Output"):
        for unknown in structure.iterfind(kind):
            on = unknown.get("dependencies")
            if on is not None:
                known = frozenset(name for k in on.split() if k in of for name in names(of[k]))
                depends.update(dict.fromkeys(names(of[unknown.get("valueReference", "")]), known))
    return ModelStructure(tuple(states), tuple(derivatives), depends)


def _name(element: ElementTree.Element) -> str:
    return str(element.get("name"))
