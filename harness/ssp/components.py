"""The parts of a wired case as components of an SSP: each an FMU, with its connectors and parameters."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from fmus.component import Component as Part
from fmus.component import Kind, Signal
from fmus.export import build_fmu
from fmus.fmu import FmuComponent
from fmus.model import Model
from fmus.units import Unit, parse_unit, spelling
from fmus.variable import Variable
from harness.campaign import Case
from harness.clock import TimeGrid
from harness.findings import Findings
from harness.places import Place
from harness.points import Points
from harness.resolve import resolve
from harness.scenario import ModelPart, SensorPart
from harness.sensor import SensorComponent
from harness.source import SourceComponent
from harness.sourcepart import FiledTable, SourcePart
from harness.ssp.sensormodel import sensor_model
from harness.ssp.sourcemodel import Inexpressible, source_model
from harness.ssp.starts import number_with_unit
from harness.ssp.structure import Assignment, Component, Connector, NamedUnit, Value
from harness.ssp.writing import Version
from harness.system import Slot, System

_PLACE = Place()
# The types of SSP 1.0 for those of FMI 3.0; enumerations are left to the FMUs.
_TYPES = {"Float64": "Real", "Float32": "Real"} | {
    f"{sign}Int{bits}": "Integer" for sign in ("", "U") for bits in (8, 16, 32, 64)
}


class Shown(NamedTuple):
    """The unit and the kind of numbers that a source or a sensor gives its value in."""

    unit: str
    kind: Kind


@dataclass
class Components:
    """Makes the components of one wired case; FMUs are built into the folder `scratch`."""

    case: Case
    system: System
    version: Version
    platforms: tuple[str, ...]
    scratch: Path
    found: Findings
    notes: list[str] = field(default_factory=list)
    _names: dict[str, Unit] = field(default_factory=dict)
    _known: dict[str, Mapping[str, Variable]] = field(default_factory=dict)

    def component(self, slot: Slot) -> Component | None:
        """The component of a part; None and its problems where it cannot be exported."""
        spec, here, part = self.case.scenario.parts[slot.name], self.found.at("parts", slot.name), slot.component
        grid = self.system.grid
        assert isinstance(grid, TimeGrid), "only what steps in time is exported"
        try:
            match spec, part:
                case SourcePart(), SourceComponent():
                    model = source_model(slot.name, spec, part, grid.start, *self.shown[slot.name])
                    if isinstance(part.given, Points) and part.given.ends == "error":
                        self.notes.append(
                            f"{slot.name} holds its ends outside of {part.given.span}, where it has none here"
                        )
                    return self._element(slot, _written_out(spec, part), model)
                case SensorPart(), SensorComponent():
                    read = self._text(*self._source(slot.name))
                    model = sensor_model(slot.name, part, grid.step, read, self.shown[slot.name].unit)
                    written = spec.model_dump(mode="json", by_alias=True, exclude_unset=True)
                    return self._element(slot, written, model)
                case ModelPart(), FmuComponent():
                    return self._fmu(slot, spec, part, here)
                case ModelPart(), _:
                    here.at("use").tell(f"{slot.name} is Python, {spec.use}: models in equations and FMUs are exported")
                case _:
                    here.tell(f"{slot.name} is a {spec.use}, which is not exported")
        except Inexpressible as error:
            here.tell(f"{slot.name} {error}")
        return None

    def unit(self, part: str, signal: str) -> NamedUnit | None:
        """The unit that a signal's number is in, in the FMU that is exported; None where it declares none."""
        variable = self._variables(part).get(signal)
        if variable is not None:
            return self._of_variable(variable)
        if part not in self.shown:  # what cannot be exported: told elsewhere
            return None
        text = self.shown[part].unit if signal == "value" else self._text(*self._source(part))
        return self._named(text, parse_unit(text))

    @cached_property
    def shown(self) -> Mapping[str, Shown]:
        """How sources and sensors give their values: as the inputs they feed want them where those agree, else as own.

        So no connection of theirs wants a conversion, which not every importer makes.
        """
        found: dict[str, Shown] = {}
        for slot in self.system.parts:
            spec = self.case.scenario.parts.get(slot.name)
            if not isinstance(spec, SourcePart | SensorPart):
                continue
            fed = [
                variable
                for one in self.system.wires
                if one.source == slot.name and (variable := self._variables(one.part).get(one.input)) is not None
            ]
            kinds, units = {variable.kind for variable in fed}, {variable.quantity for variable in fed}
            given = slot.component.outputs[0]
            kind = fed[0].kind if isinstance(spec, SourcePart) and len(kinds) == 1 else given.kind
            (unit,) = units if len(units) == 1 else (None,)
            text = spelling(unit, fed[0].unit) if unit is not None and kind == "real" else None
            found[slot.name] = Shown("1" if kind != "real" else text or given.unit or "1", kind)
        return found

    def variable(self, part: str, signal: str) -> Variable | None:
        """The variable of a third party's or a model's FMU that a signal is, or is a scalar of; None for an element."""
        return self._variables(part).get(signal)

    def _variables(self, part: str) -> Mapping[str, Variable]:
        if part not in self._known:
            component = self.system.components[part]
            listed = component.description.variables if isinstance(component, FmuComponent) else ()
            self._known[part] = {scalar: one for one in listed if one.on_bus for scalar in one.scalar_names()}
        return self._known[part]

    def _source(self, part: str) -> tuple[str, str]:
        """Part and signal that a sensor reads."""
        entering = next(one for one in self.system.wires if one.part == part)
        return entering.source, entering.output

    def _text(self, part: str, signal: str) -> str:
        """The unit of a signal as this project writes it; of SI where it has no name for it."""
        named = self.unit(part, signal)
        if named is None or named.meaning is None:
            return "1"
        return spelling(named.meaning, named.name) or named.meaning.si_name()

    def _of_variable(self, variable: Variable) -> NamedUnit | None:
        if variable.kind != "real" or variable.quantity is None:
            return None
        return self._named(variable.unit or variable.quantity.si_name(), variable.quantity)

    def _named(self, name: str, unit: Unit) -> NamedUnit:
        """A unit by a name that means no other in this description."""
        free, number = name, 2
        while self._names.setdefault(free, unit) != unit:
            free, number = f"{name}_{number}", number + 1
        return NamedUnit(free, unit)

    def _element(self, slot: Slot, written: Mapping[str, Any], model: Model) -> Component:
        fmu = build_fmu(model, self.scratch / f"{slot.name}.fmu", 2, self.platforms)
        connectors = {
            signal.name: Connector(signal.name, kind, _PLACE, _type_of(signal), self._of_element(slot, signal))
            for kind, signals in (("input", model.inputs), ("output", model.outputs))
            for signal in signals
        }
        return self._component(slot, fmu, connectors, (), written)

    def _of_element(self, slot: Slot, signal: Signal) -> NamedUnit | None:
        return self.unit(slot.name, signal.name) if signal.kind == "real" else None

    def _fmu(self, slot: Slot, spec: ModelPart, part: FmuComponent, here: Findings) -> Component | None:
        """The component of an FMU, or of a model's FMU, which is built with the start values it was given."""
        written: dict[str, Any] = {} if part.role == "plant" else {"role": part.role}
        path: Path | None = here.folder / spec.use
        changed = {
            variable: values for variable, values in part.starts if values != (variable.start or (0.0,) * variable.size)
        }
        model = None
        if not spec.use.endswith(".fmu"):
            resolved = resolve(
                spec, slot.name, slot.pace.step, Findings(self.case.places), self.case.scenario.validation
            )
            assert resolved is not None and resolved.model is not None, "it was wired, and what is native has a model"
            resolved.component.close()
            model = resolved.model
            starts = {
                name: value
                for variable, values in changed.items()
                for name, value in zip(variable.scalar_names(), values, strict=True)
                if not isinstance(value, str)
            }
            path = build_fmu(model, self.scratch / f"{slot.name}.fmu", 2, self.platforms, starts)
        if slot.pace.period > 1:
            if model is None or model.states or not model.sample_time:
                here.at("every").add("wants no value to be exported: an SSP steps all its FMUs together")
                return None
            self.notes.append(f"{slot.name} samples every {spec.every} itself: it is stepped as often as all others")
            written["every"] = str(spec.every)
        if part.description.kind == "me":
            self.notes.append(f"{slot.name} is run by Model Exchange; its solver is the importer's")
        connectors = self._connectors(slot, part, here)
        assignments = [self._assignment(slot.name, variable, values, here) for variable, values in changed.items()]
        assert path is not None, "a path or a model is given"
        return self._component(slot, path, connectors, tuple(one for one in assignments if one is not None), written)

    def _connectors(self, slot: Slot, part: FmuComponent, here: Findings) -> dict[str, Connector]:
        """The inputs and outputs of an FMU on the bus; an array is one connector."""
        found = {}
        for signal in (*part.inputs, *part.outputs):
            variable = self._variables(slot.name)[signal.name]
            if variable.shape and self.version == "1.0":
                here.tell(f"{slot.name}.{variable.name} is an array, which SSP 1.0 has none of: export SSP 2.0")
                return {}
            unit = self.unit(slot.name, signal.name)
            kind = self._type(variable)
            found[variable.name] = Connector(
                variable.name, variable.causality, _PLACE, kind, unit, sizes=variable.shape
            )
        return found

    def _type(self, variable: Variable) -> str:
        if variable.type == "Enumeration":
            return ""
        return variable.type if self.version == "2.0" else _TYPES.get(variable.type, variable.type)

    def _assignment(
        self, part: str, variable: Variable, values: tuple[float | str, ...], here: Findings
    ) -> Assignment | None:
        if variable.shape and self.version == "1.0":
            here.at("with").tell(f"{part}.{variable.name} is an array, which SSP 1.0 has none of: export SSP 2.0")
            return None
        value = Value(self._type(variable) or "Integer", values, _PLACE, self._of_variable(variable))
        return Assignment(variable.name, value)

    def _component(
        self,
        slot: Slot,
        fmu: Path,
        connectors: Mapping[str, Connector],
        assignments: tuple[Assignment, ...],
        written: Mapping[str, Any],
    ) -> Component:
        with fmu.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        annotation = {"part": written, "sha256": sha256} if written else {}
        kind = _kind(slot.component)
        source = f"resources/{slot.name}.fmu"
        return Component(slot.name, fmu, source, kind, connectors, assignments, _PLACE, annotation)


def _written_out(spec: SourcePart, source: SourceComponent) -> dict[str, Any]:
    """The part of a campaign that a source is, with the points of a file in it: the file does not go along."""
    written = spec.model_dump(mode="json", by_alias=True, exclude_unset=True)
    if isinstance(spec.table, FiledTable) and isinstance(source.given, Points):
        points, unit = source.given, parse_unit(spec.unit).si_name()
        written["table"] = {
            "time": [f"{time!r} s" for time in points.times.tolist()],
            "value": [number_with_unit(value, unit) for value in points.values.tolist()],
            "between": points.between,
            "ends": points.ends,
        }
    return written


def _kind(part: Part) -> Any:
    """How an FMU is to be run, where it offers more than one way and one was asked for."""
    if isinstance(part, FmuComponent) and part.description.kind == "me":
        return "me"
    return "cs"


def _type_of(signal: Signal) -> str:
    return {"real": "Real", "integer": "Integer", "boolean": "Boolean"}[signal.kind]
