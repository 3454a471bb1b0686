"""Reads the system structure description of an SSP, with the descriptions and parameter sets that it refers to."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from fmus.component import ConfigurationError
from fmus.model import unknown
from harness.places import Place
from harness.ssp.document import NAMESPACES, child, children, local_name, read_document
from harness.ssp.package import Package, open_package
from harness.ssp.parameters import read_bindings
from harness.ssp.references import Document, Told
from harness.ssp.structure import (
    ANNOTATED,
    ANNOTATION,
    Component,
    Connection,
    Connector,
    DictionaryReference,
    End,
    Structure,
    System,
)
from harness.ssp.vocabulary import Vocabulary, read_transformation

_FMU, _DESCRIPTION, _PACKAGE = (
    "application/x-fmu-sharedlibrary",
    "application/x-ssp-definition",
    "application/x-ssp-package",
)
_KINDS: dict[str, Literal["", "cs", "me"]] = {"any": "", "CoSimulation": "cs", "ModelExchange": "me"}
# What annotations call masters of a fixed step.
_MASTERS = ("FixedStepMaster", "FixedStepAlgorithm")
# References can name one system many times over, so that a small file stands for a large one.
MOST_ELEMENTS = 10_000


def read_structure(path: Path, variant: str = "") -> Structure:
    """What the SSP at `path` says in the system description of this name, SystemStructure.ssd where none is given.

    Raises ConfigurationError: the archive or a document is refused, or does not fit together; every such problem, each
    with document and line.
    """
    package = open_package(path, path.name)
    file = package.description(variant)
    told = Told()
    reader = _open(package, file, told, ((file, ""),))
    if reader is None:
        raise ConfigurationError(told.problems)
    root = reader.root
    system = reader.system(child(root, "ssd:System"))
    experiment = child(root, "ssd:DefaultExperiment")
    start, stop = (None if experiment is None else _number(experiment.get(key)) for key in ("startTime", "stopTime"))
    if told.problems:
        raise ConfigurationError(told.problems)
    return Structure(
        name=root.get("name"),
        description=root.get("description", ""),
        version=root.get("version"),
        system=system,
        sha256=package.sha256,
        start=start,
        stop=stop,
        step=_step(root),
        annotation=_annotation(root),
        notes=tuple(dict.fromkeys(told.notes)),
        variants=tuple(name for name in package.descriptions if name != file.name),
    )


def _open(package: Package, file: Path, told: Told, above: tuple[tuple[Path, str], ...]) -> _Reader | None:
    """The reader of a description; None and its problems where it cannot be read."""
    shown = package.inside(file)
    try:
        root = read_document(file, shown, "ssd")
    except ConfigurationError as error:
        told.problems += error.problems
        return None
    told.notes += [
        f"{shown}: {name} is not looked at"
        for name in ("MetaData", "Signature")
        if child(root, f".//ssc:{name}") is not None
    ]
    return _Reader(Document(package, file, Vocabulary.of(root, "ssd", shown), told), root, above)


@dataclass(frozen=True)
class _Reader:
    """Reads one description; `above` are the systems around, by file and id, which must not come again."""

    document: Document
    root: Any
    above: tuple[tuple[Path, str], ...]

    def tell(self, element: Any, message: str) -> None:
        """Note a problem at an element."""
        self.document.tell(element, message)

    def place(self, element: Any) -> Place:
        """Where an element stands."""
        return self.document.vocabulary.place(element)

    def system(self, element: Any) -> System:
        """A system and all that is in it."""
        name = element.get("name")
        return System(
            name=name,
            connectors=self._connectors(element, name),
            elements=self._elements(element, name),
            connections=tuple(self._connections(element)),
            dictionaries=dict(self._dictionaries(element)),
            assignments=tuple(read_bindings(self.document, element)),
            place=self.place(element),
        )

    def _elements(self, element: Any, owner: str) -> dict[str, Component | DictionaryReference | System]:
        found: dict[str, Component | DictionaryReference | System] = {}
        for inside in children(element, "ssd:Elements/*"):
            name = inside.get("name")
            self.document.told.elements += 1
            if self.document.told.elements > MOST_ELEMENTS:
                wanted = f"wants at most {MOST_ELEMENTS} elements, with those of references"
                raise ConfigurationError(f"{self.document.vocabulary.shown}: {wanted}")
            if name in found:
                self.tell(inside, f"'{name}' is the name of two elements of {owner}")
                continue
            match local_name(inside):
                case "System":
                    found[name] = self.system(inside)
                case "SignalDictionaryReference":
                    connectors = self._connectors(inside, name)
                    found[name] = DictionaryReference(name, inside.get("dictionary"), connectors, self.place(inside))
                case "Component":
                    made = self._component(inside, name)
                    if made is not None:
                        found[name] = made
        return found

    def _component(self, element: Any, name: str) -> Component | System | None:
        """The component, or the system that it stands for."""
        source, media = element.get("source"), element.get("type", _FMU)
        if source is None:
            self.tell(element, f"{name} has no source: there is nothing to run for it")
            return None
        if media not in (_FMU, _DESCRIPTION, _PACKAGE):
            wanted = "an FMU, a system description or a package"
            self.tell(element, f"{name} wants {wanted}, got the type '{media}'")
            return None
        if media != _FMU or source.startswith("#"):
            return self._referenced(element, name, source, media)
        kind = _KINDS.get(element.get("implementation", "any"))
        if kind is None:
            self.tell(element, f"{name} is to be run by {element.get('implementation')}, which is not run here")
            return None
        fmu = self.document.file_of(element, source, name)
        if fmu is None:
            return None
        return Component(
            name=name,
            fmu=fmu,
            source=source,
            kind=kind,
            connectors=self._connectors(element, name),
            assignments=tuple(read_bindings(self.document, element, fmu)),
            place=self.place(element),
            annotation=_annotation(element),
        )

    def _referenced(self, element: Any, name: str, source: str, media: str) -> System | None:
        """The system that a component refers to, with the component's values after its own."""
        location, _, fragment = source.partition("#")
        package, here = self.document.package, self.document.file
        file = self.document.file_of(element, location, name) if location else here
        if file is None:
            return None
        if location and media == _PACKAGE:
            try:
                package = open_package(file, package.inside(file))
                file, fragment = package.description(fragment), ""
            except ConfigurationError as error:
                self.tell(element, f"{name}: {error}")
                return None
        entered = (file, fragment)
        if entered in self.above:
            self.tell(element, f"{name} stands inside of itself: {source}")
            return None
        above = (*self.above, entered)
        reader = replace(self, above=above) if file == here else _open(package, file, self.document.told, above)
        if reader is None:
            return None
        top = child(reader.root, "ssd:System")
        known = {one.get("id"): one for one in [top, *children(top, ".//ssd:System")] if one.get("id")}
        if fragment and fragment not in known:
            self.tell(element, f"{name}: {unknown(fragment, known, 'system with this id')}")
            return None
        system = reader.system(known[fragment] if fragment else top)
        own = tuple(read_bindings(self.document, element))
        return replace(system, name=name, assignments=(*system.assignments, *own))

    def _connectors(self, element: Any, owner: str) -> dict[str, Connector]:
        found: dict[str, Connector] = {}
        for one in children(element, "ssd:Connectors/ssd:Connector"):
            connector = self.document.vocabulary.connector(one, one.get("kind"))
            if connector.name in found:
                self.tell(one, f"'{connector.name}' is the name of two connectors of {owner}")
            found[connector.name] = connector
        return found

    def _connections(self, element: Any) -> Iterator[Connection]:
        for one in children(element, "ssd:Connections/ssd:Connection"):
            suppressed = one.get("suppressUnitConversion") in ("true", "1")
            start, end = _end(one, "start"), _end(one, "end")
            yield Connection(start, end, suppressed, read_transformation(one), self.place(one))

    def _dictionaries(self, element: Any) -> Iterator[tuple[str, Mapping[str, Connector]]]:
        for one in children(element, "ssd:SignalDictionaries/ssd:SignalDictionary"):
            found = self.document.content(one, one, "ssb")
            if found is not None:
                entries = [found.vocabulary.connector(e, "inout") for e in children(found.root, "ssb:DictionaryEntry")]
                yield one.get("name"), {entry.name: entry for entry in entries}


def _end(element: Any, side: str) -> End:
    """One end of a connection."""
    indices = element.get(f"{side}Indices", "").split()
    return End(element.get(f"{side}Element", ""), element.get(f"{side}Connector"), tuple(map(int, indices)))


def _number(text: str | None) -> float | None:
    return None if text is None else float(text)


def _step(root: Any) -> float | None:
    """The shortest step [s] that annotations give masters of a fixed step, as OMSimulator's and OSP's do."""
    found = []
    for annotation in root.iter(f"{{{NAMESPACES['ssc']}}}Annotation"):
        for one in annotation.iter():
            if local_name(one) in _MASTERS:
                found += [_positive(one.get(key)) for key in ("stepSize", "baseStepSize")]
    return min((step for step in found if step is not None), default=None)


def _positive(text: str | None) -> float | None:
    try:
        number = float(text or "")
    except ValueError:
        return None
    return number if 0.0 < number < math.inf else None


def _annotation(element: Any) -> Mapping[str, Any]:
    """Our own annotation of an element; empty where it has none, or none that can be read."""
    for one in children(element, "ssd:Annotations/ssc:Annotation"):
        if one.get("type") == ANNOTATION:
            try:
                found = json.loads(one.findtext(ANNOTATED) or "")
            except ValueError:
                return {}
            return found if isinstance(found, dict) else {}
    return {}
