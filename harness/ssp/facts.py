"""What an SSP wants to know of an FMU beside its variables: default experiment, and the items of its enumerations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lxml import etree

from fmus.description import FmuDescription, describe
from fmus.variable import Variable


@dataclass(frozen=True)
class Facts:
    """An FMU as described, what it says of a run [s], its variables by name, and the items of their enumerations."""

    description: FmuDescription
    stop: float | None
    step: float | None
    variables: Mapping[str, Variable]
    items: Mapping[str, Mapping[str, int]]

    def owner(self, name: str) -> Variable | None:
        """The variable of this name, or the array that has a scalar of it; None where there is neither."""
        array = self.variables.get(name.rpartition("[")[0])
        scalar = array is not None and bool(array.shape) and name in array.scalar_names()
        return self.variables.get(name) or (array if scalar else None)


def read_facts(fmu: Path) -> Facts:
    """The facts of the FMU at `fmu`. Raises ConfigurationError: as fmus.description.describe does."""
    description = describe(fmu)
    # Its XML was checked before: it holds no document type and is not deep.
    parser = etree.XMLParser(resolve_entities=False, load_dtd=False, no_network=True, huge_tree=True)
    root = etree.parse(str(description.folder / "modelDescription.xml"), parser).getroot()
    experiment = root.find("DefaultExperiment")
    stop, step = (None if experiment is None else _number(experiment.get(key)) for key in ("stopTime", "stepSize"))
    types = {one.get("name"): _items(one) for one in root.iterfind("TypeDefinitions/*")}
    items = {}
    for one in root.iterfind("ModelVariables/*"):
        declared = next((part.get("declaredType") for part in (one, *one) if part.get("declaredType")), None)
        if types.get(declared):
            items[one.get("name")] = types[declared]
    return Facts(description, stop, step, {one.name: one for one in description.variables}, items)


def _items(element: Any) -> dict[str, int]:
    """The items of a type: of FMI 1 they count from 1, later versions give each its value."""
    return {
        item.get("name"): int(item.get("value", number)) for number, item in enumerate(element.iter("Item"), start=1)
    }


def _number(text: str | None) -> float | None:
    """A number above zero; None for anything else."""
    try:
        found = float(text or "")
    except ValueError:
        return None
    return found if 0.0 < found < math.inf else None
