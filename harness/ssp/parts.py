"""The parts of a campaign that an SSP's graph asks for: FMUs, sources for open inputs, sensors for its outputs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from fmus.component import Problem
from harness.places import Places
from harness.quantity import Strict
from harness.scenario import SENSOR, SOURCE, ModelPart, SensorPart, part_kind
from harness.sourcepart import SourcePart
from harness.ssp.busunits import BusUnits
from harness.ssp.carrying import Carried, Carrier, Names
from harness.ssp.graph import Graph, Instance, Node, Route, dotted
from harness.ssp.starts import Starts
from harness.ssp.structure import OUTWARD
from harness.validation import validate

_RESTORED: Mapping[str, type[Strict]] = {SOURCE: SourcePart, SENSOR: SensorPart}


@dataclass
class Built:
    """Parts by name, and the FMUs that they name by their place beside the campaign."""

    parts: dict[str, dict[str, Any]] = field(default_factory=dict)
    fmus: dict[str, Path] = field(default_factory=dict)


class Target(NamedTuple):
    """What takes a value under a name: an input of an FMU or one scalar of it, or an output of the whole system."""

    name: str
    node: Node
    route: Route


def build_parts(graph: Graph, order: Sequence[str]) -> Built:
    """The parts of a graph, in the order of their names in `order` where it has them.

    Problems and what is to be told go to the graph.
    """
    return _Builder(graph).built(order)


class _Builder:
    """Builds the parts of one graph."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.names = Names()
        self.fmus: dict[str, Path] = {}
        self.sources: dict[str, dict[str, Any]] = {}
        self.openings: dict[tuple[Node, str], str] = {}
        self.called = {path: self.names.new("_".join(path)) for path in graph.instances}
        self.given = {path for path, _ in graph.assigned}
        self.restored = {path: part for path, one in graph.instances.items() if (part := self._restored(one))}
        self.targets = {path: list(self._targets(instance)) for path, instance in graph.instances.items()}
        self.outputs = list(self._outputs())
        self._refuse_the_rest()
        routed = [target for targets in self.targets.values() for target in targets] + self.outputs
        self.units = BusUnits(graph, [(target.node, target.route) for target in routed])
        self.starts = Starts(graph, self.units)
        self.carrier = Carrier(graph, self.units, self.names, self.called, frozenset(self.restored))

    def built(self, order: Sequence[str]) -> Built:
        """The parts: sources, FMUs, what connections do, and sensors for the system's outputs."""
        models = {self.called[path]: self._part(instance) for path, instance in self.graph.instances.items()}
        sensors = dict(self._sensors())
        parts = {**self.sources, **models, **self.carrier.parts, **sensors}
        first = [name for name in order if name in parts]
        return Built({name: parts[name] for name in dict.fromkeys((*first, *parts))}, self.fmus)

    def _targets(self, instance: Instance) -> Iterator[Target]:
        """The inputs of an FMU, each with its route: whole arrays where a connection enters them whole."""
        for variable in instance.facts.description.variables:
            if variable.causality != "input" or not variable.on_bus:
                continue
            node = (instance.path, variable.name)
            whole = not variable.shape or any(not hop.target_indices for hop in self.graph.incoming.get(node, ()))
            for name in [variable.name] if whole else variable.scalar_names():
                route = self.graph.route(node, () if whole else _indices(name))
                if route is not None:
                    yield Target(name, node, route)

    def _refuse_the_rest(self) -> None:
        """A problem for each connection to what neither wires nor start values reach."""
        for node, hops in self.graph.incoming.items():
            variable = self.graph.variable(node)
            if variable is None or variable.causality in ("parameter", "structuralParameter"):
                continue
            if variable.causality == "input" and variable.on_bus:
                continue
            what = f"is of the type {variable.type}, its causality is {variable.causality}"
            problem = Problem(f"{dotted(node)} {what}: no wire reaches it", *hops[0].place)
            self.graph.problems.append(problem)

    def _outputs(self) -> Iterator[Target]:
        """The outputs of the whole system that a signal can show."""
        for (path, name), connector in self.graph.connectors.items():
            if path or connector.kind not in OUTWARD:
                continue
            route = self.graph.route((path, name))
            if route is None:
                continue
            variable = self.graph.variable(route.source)
            if not route.hops:
                self.graph.notes.append(f"the output {name} of the system is joined to nothing, and is left out")
            elif variable is not None and (variable.causality != "output" or not variable.on_bus or variable.shape):
                what = "an array" if variable.shape else f"of the causality {variable.causality}, type {variable.type}"
                self.graph.notes.append(f"the output {name} of the system is {what} inside, and is left out")
            else:
                yield Target(name, (path, name), route)

    def _part(self, instance: Instance) -> dict[str, Any]:
        restored = self.restored.get(instance.path, {})
        if restored and part_kind(restored) == SOURCE:
            return restored
        wires = {target.name: self._wired(target, instance) for target in self.targets[instance.path]}
        wired = {name: text for name, text in wires.items() if text is not None}
        if restored:
            return {**restored, "of": wired.get("of", restored["of"])}
        part: dict[str, Any] = {"use": self._file(instance)}
        if instance.component.kind and len(instance.facts.description.kinds) > 1:
            part["kind"] = instance.component.kind
        written = _annotated(instance)
        if written.get("use") in ("source", "sensor"):  # given other values since: no truth, so an observer may read it
            part["role"] = "controller"
        kept = {key: written[key] for key in ("role", "every") if key in written}
        if _fits(ModelPart, {**part, **kept}):
            part |= kept
        units = {
            variable.name: bound.text
            for variable in instance.facts.description.variables
            if variable.kind == "real" and (bound := self.units.bound((instance.path, variable.name))) is not None
        }
        given = {"units": units, "with": self.starts.settings(instance), "wires": wired}
        return {**part, **{key: value for key, value in given.items() if value}}

    def _file(self, instance: Instance) -> str:
        """The place of an FMU beside the campaign."""
        fmu = instance.component.fmu
        name = fmu.name if fmu.suffix == ".fmu" else f"{fmu.name}.fmu"
        wanted = place = Path("resources") / name
        number = 2
        while self.fmus.get(place.as_posix(), fmu) != fmu:
            place, number = wanted.with_stem(f"{wanted.stem}_{number}"), number + 1
        self.fmus[place.as_posix()] = fmu
        for reason in instance.facts.description.reasons:
            self.graph.notes.append(f"{place.as_posix()} does not run here: {reason}")
        return place.as_posix()

    def _restored(self, instance: Instance) -> dict[str, Any] | None:
        """The source or sensor that an FMU was written from; None where it was none, or was given values since."""
        part = _annotated(instance)
        schema = _RESTORED.get(part_kind(dict(part))) if part.get("use") in ("source", "sensor") else None
        return None if schema is None or instance.path in self.given or not _fits(schema, part) else dict(part)

    def _wired(self, target: Target, instance: Instance) -> str | None:
        """What stands for an input under `wires`; None and a problem where no wire can be."""
        hint = f"{self.called[instance.path]}_{target.name}"
        carried = self._carried(target, hint)
        if carried is None:
            return None
        variable = self.graph.variable(target.node)
        assert variable is not None, "an FMU's input is a variable of it"
        is_open = carried.text in self.sources
        if variable.kind != "real" and carried.kind == "real" and not is_open:
            message = f"{'.'.join(target.node[0])}.{target.name} wants {variable.kind} values, got real ones"
            self.carrier.tell(f"{message} from {carried.text}", target.route.hops)
            return None
        if is_open and variable.shape and not target.route.indices and target.name == variable.name:
            message = f"{'.'.join(target.node[0])}.{target.name} is an array, which no source gives: connect its values"
            self.carrier.tell(f"{message} one by one", target.route.hops)
            return None
        return self.carrier.flushed(carried, target.node, target.route, hint)

    def _sensors(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """The sensors that show the system's outputs under their names."""
        for target in self.outputs:
            name = self.names.new(target.name)
            carried = self._carried(target, f"{target.name}_from")
            if carried is None:
                continue
            if carried.keeps_dimension:
                yield name, carried.as_sensor()
            else:
                text = self.carrier.flushed(carried, target.node, target.route, f"{target.name}_from")
                yield name, {"use": "sensor", "of": f"{text}.y"}

    def _carried(self, target: Target, hint: str) -> Carried | None:
        """The signal that comes to a target; where an input is open, the source for it is made."""
        source = target.route.source
        is_open = source[0] not in self.graph.instances or not target.route.hops
        opening = self._opening(target) if is_open else ""
        carried = self.carrier.carried(target.route, target.node, opening, hint)
        if carried is not None and is_open and opening not in self.sources:
            passage = carried.passage if carried.text == opening else None
            self.sources[opening] = (
                self.starts.system_input(source, target.node, passage)
                if target.route.hops
                else self.starts.open_input(
                    source, target.name, self.graph.instances[source[0]].facts.variables[source[1]]
                )
            )
        return carried

    def _opening(self, target: Target) -> str:
        """What the source of an open input is called."""
        path, name = target.route.source
        inside = path in self.graph.instances
        key = (target.route.source, target.name if inside else "")
        if key not in self.openings:
            wanted = f"{self.called[path]}_{target.name}" if inside else "_".join((*filter(None, path), name))
            self.openings[key] = self.names.new(wanted)
        return self.openings[key]


def _annotated(instance: Instance) -> Mapping[str, Any]:
    """The part that an FMU was written from; empty where it was none, or is another FMU now."""
    annotation = instance.component.annotation
    part = annotation.get("part")
    same = annotation.get("sha256") == instance.facts.description.sha256
    return part if same and isinstance(part, dict) else {}


def _fits(schema: type[Strict], part: Mapping[str, Any]) -> bool:
    checked, _ = validate(schema, part, Places())
    return checked is not None


def _indices(name: str) -> tuple[int, ...]:
    """The indices of an array's scalar."""
    return tuple(int(index) for index in name.rpartition("[")[2].rstrip("]").split(","))
