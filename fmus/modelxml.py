"""Refuse XML that is unsafe or that no model can be read from, before anything builds a tree of it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from fmus.component import ConfigurationError, Problem

MOST_BYTES = 1 << 30
MOST_DEPTH = 64
MOST_ELEMENTS = 20_000_000
MOST_SCALARS = 1_000_000  # of all variables together, arrays counted by their places

# What is read with the model description where it is there.
_BUILD = "sources/buildDescription.xml"
_TOKENS = {"1": "guid", "2": "guid", "3": "instantiationToken"}
_OLD_TYPES = frozenset({"Real", "Integer", "Boolean", "String"})
_TYPES = {
    "1": _OLD_TYPES,
    "2": _OLD_TYPES,
    "3": frozenset(
        {"Float32", "Float64", "Boolean", "String", "Binary", "Enumeration", "Clock"}
        | {f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)}
    ),
}
_REFERENCES = range(1 << 32)
_FILE_NAME = re.compile(r"[^\s./\\:][^/\\:\x00-\x1f]{0,199}")
_MOST_TOLD = 20


@dataclass
class _Variable:
    """What tells a variable's place in the FMU apart from another's; `sizes` of an array."""

    name: str
    reference: str | None
    line: int
    type: str = ""
    causality: str = ""
    constant: bool = False
    alias: bool = False
    start: str | None = None
    sizes: list[tuple[str | None, str | None]] = field(default_factory=list)

    @property
    def given(self) -> bool:
        """True where a value of its own is set from outside."""
        return self.causality in ("input", "parameter", "structuralParameter")


def checked_description(folder: Path) -> None:
    """Nothing, where the XML of the FMU unpacked at `folder` may be read.

    Read event by event, so that neither depth, size nor entities cost anything. Refused are: no modelDescription.xml;
    what is no XML; a document type, and with it every entity; an unknown FMI version; no guid (FMI 3:
    instantiationToken); a variable without a type that its version has; value references that are missing, no numbers
    of 32 bits, or taken twice (in FMI 3 by any two variables, in FMI 1 and 2 by two of one type that would be given
    values of their own, since aliases share one); a modelIdentifier that is no file's name, so that it could lead
    elsewhere; arrays of more scalars than `MOST_SCALARS`.

    Raises ConfigurationError: with all of these that were found.
    """
    file = folder / "modelDescription.xml"
    if not file.is_file():
        raise ConfigurationError("wants a modelDescription.xml at the top of the archive, found none")
    found = _Reader("modelDescription.xml").read(file)
    if (folder / _BUILD).is_file():
        _Reader(_BUILD).read(folder / _BUILD)
    problems = [*_head_problems(found.root, found.attributes)]
    if not problems:
        problems += _type_problems(found.variables, found.attributes["fmiVersion"])
        problems += _reference_problems(found.variables, found.attributes["fmiVersion"])
        problems += _size_problems(found.variables)
        problems += _identifier_problems(found.identifiers)
    if problems:
        told = problems[:_MOST_TOLD]
        more = [f"and {len(problems) - len(told)} more of these"] if len(problems) > len(told) else []
        raise ConfigurationError([Problem(f"modelDescription.xml: {problem}") for problem in (*told, *more)])


def checked_xml(file: Path, name: str) -> None:
    """Nothing, where a tree may be built of the XML in `file`, which messages call `name`.

    Read event by event, so that neither depth, size nor entities cost anything. Raises ConfigurationError: what is no
    XML, a document type, and with it every entity, too many elements or too deep ones.
    """
    _Reader(name).read(file)


class _Reader:
    """Reads one XML file event by event, and notes of a model description what identifies it and its variables."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.root = ""
        self.attributes: Mapping[str, str] = {}
        self.variables: list[_Variable] = []
        self.identifiers: list[str] = []
        self._path: list[str] = []
        self._elements = 0
        self._parser = expat.ParserCreate()
        self._parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
        self._parser.StartDoctypeDeclHandler = self._refuse_doctype
        self._parser.EntityDeclHandler = self._refuse_doctype
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end

    def read(self, file: Path) -> _Reader:
        """The reader itself, having read the file. Raises ConfigurationError."""
        if file.stat().st_size > MOST_BYTES:
            raise self._refused(f"has {file.stat().st_size} bytes, at most {MOST_BYTES} are read")
        try:
            with file.open("rb") as content:
                self._parser.ParseFile(content)
        except expat.ExpatError as error:
            raise self._refused(f"is not XML: {error}") from error
        except (LookupError, ValueError) as error:  # of its encoding
            raise self._refused(f"is in an encoding that cannot be read: {error}") from error
        return self

    def _refuse_doctype(self, *_: object) -> None:
        raise self._refused("declares a document type or entities, which is refused")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._path.append(tag)
        self._elements += 1
        if len(self._path) > MOST_DEPTH:
            raise self._refused(f"has elements nested more than {MOST_DEPTH} deep")
        if self._elements > MOST_ELEMENTS:
            raise self._refused(f"has more than {MOST_ELEMENTS} elements")
        depth = len(self._path)
        if depth == 1:
            self.root, self.attributes = tag, attributes
        if depth <= 2 and "modelIdentifier" in attributes:
            self.identifiers.append(attributes["modelIdentifier"])
        elif depth == 3 and self._path[1] == "ModelVariables" and "name" in attributes:
            self.variables.append(_variable(tag, attributes, self._parser.CurrentLineNumber))
        elif depth == 4 and self._path[1] == "ModelVariables" and self.variables:
            _note(self.variables[-1], tag, attributes)

    def _end(self, _tag: str) -> None:
        self._path.pop()

    def _refused(self, why: str) -> ConfigurationError:
        return ConfigurationError(f"{self.name} {why}")


def _variable(tag: str, attributes: Mapping[str, str], line: int) -> _Variable:
    return _Variable(
        name=attributes["name"],
        reference=attributes.get("valueReference"),
        line=line,
        type="" if tag == "ScalarVariable" else tag,
        causality=attributes.get("causality", "local"),
        constant=attributes.get("variability") == "constant",
        alias=attributes.get("alias", "noAlias") != "noAlias",
        start=attributes.get("start"),
    )


def _note(variable: _Variable, tag: str, attributes: Mapping[str, str]) -> None:
    """What an element inside of a variable says of it."""
    if tag == "Dimension":
        variable.sizes.append((attributes.get("start"), attributes.get("valueReference")))
    elif tag in ("Real", "Integer", "Boolean", "String", "Enumeration") and not variable.type:
        # FMI 1 and 2 keep enumerations among the integers.
        variable.type = "Integer" if tag == "Enumeration" else tag
        variable.start = attributes.get("start")


def _head_problems(root: str, attributes: Mapping[str, str]) -> Iterable[str]:
    if root != "fmiModelDescription":
        yield f"wants the element fmiModelDescription, got {root}"
        return
    version = attributes.get("fmiVersion")
    if version is None:
        yield "wants an fmiVersion of 1.0, 2.0 or 3.0, got none"
        return
    if version not in ("1.0", "2.0") and not version.startswith("3."):
        yield f"wants an fmiVersion of 1.0, 2.0 or 3.0, got '{version}'"
        return
    token = _TOKENS[version[0]]
    if token not in attributes:
        yield f"has no {token}, by which the binary would know that it belongs to this description"


def _type_problems(variables: Iterable[_Variable], version: str) -> Iterable[str]:
    known = _TYPES[version[0]]
    for variable in variables:
        if variable.type not in known:
            got = f"'{variable.type}'" if variable.type else "none"
            yield f"{variable.name} (line {variable.line}) wants a type of FMI {version[0]}, got {got}"


def _identifier_problems(identifiers: Iterable[str]) -> Iterable[str]:
    for identifier in dict.fromkeys(identifiers):
        if not _FILE_NAME.fullmatch(identifier):
            yield f"wants a modelIdentifier that can name the binary, got '{identifier[:100]}'"


def _reference_problems(variables: Iterable[_Variable], version: str) -> Iterable[str]:
    taken: dict[tuple[str, int], list[_Variable]] = {}
    for variable in variables:
        reference = _whole(variable.reference)
        if variable.reference is None:
            yield f"{variable.name} (line {variable.line}) has no valueReference"
        elif reference is None or reference not in _REFERENCES:
            yield (
                f"{variable.name} (line {variable.line}) wants a valueReference from 0 to {_REFERENCES[-1]}, "
                f"got '{variable.reference}'"
            )
        elif not variable.alias:
            taken.setdefault(("" if version[0] == "3" else variable.type, reference), []).append(variable)
    for (_, reference), group in taken.items():
        if len(group) > 1 and (version[0] == "3" or _clash(group)):
            names = ", ".join(variable.name for variable in group[:_MOST_TOLD])
            yield f"the valueReference {reference} is that of several variables: {names}"


def _clash(group: list[_Variable]) -> bool:
    """True where variables that share one place would be given values of their own, so that they are no aliases."""
    started = [variable for variable in group if variable.start is not None and not variable.constant]
    given = sum(variable.given for variable in group)
    return given > 1 or (given == 1 and len(started) > 1) or len({variable.start for variable in started}) > 1


def _size_problems(variables: list[_Variable]) -> Iterable[str]:
    starts = {_whole(v.reference): v.start for v in variables if v.start is not None}
    total = len(variables)
    for variable in variables:
        sizes = []
        for start, reference in variable.sizes:
            text = start if start is not None else starts.get(_whole(reference))
            size = _whole(text)
            if size is None or size < 0:
                yield f"{variable.name} (line {variable.line}) wants a size for each dimension, got '{text}'"
                break
            sizes.append(size)
        else:
            total += math.prod(sizes) if sizes else 0
    if total > MOST_SCALARS:
        yield f"has {total} scalars in its arrays and variables, at most {MOST_SCALARS} are taken"


def _whole(text: str | None) -> int | None:
    """A number of digits only, as XML Schema has it; None for anything else."""
    stripped = (text or "").strip()
    return int(stripped) if stripped.isascii() and stripped.isdigit() and len(stripped) < 20 else None
