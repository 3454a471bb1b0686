"""What elements of a system description refer to by URI, or hold inside: files of the package, documents in them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from fmus.archive import unpack
from fmus.component import ConfigurationError, Problem
from harness.ssp.document import ROOTS, check_element, child, local_name, read_document
from harness.ssp.package import Package, resource
from harness.ssp.vocabulary import Vocabulary

_MEDIA = {
    "ssv": "application/x-ssp-parameter-set",
    "ssm": "application/x-ssp-parameter-mapping",
    "ssb": "application/x-ssp-signal-dictionary",
}


@dataclass
class Told:
    """What is wrong, what nothing is made of, and how many elements there are, over all documents read."""

    problems: list[Problem] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    elements: int = 0


class Content(NamedTuple):
    """The top element of a document that is referred to or held, and the words to read it with."""

    root: Any
    vocabulary: Vocabulary


@dataclass(frozen=True)
class Document:
    """A system description in its package; problems with its elements go to `told`."""

    package: Package
    file: Path
    vocabulary: Vocabulary
    told: Told

    def tell(self, element: Any, message: str) -> None:
        """Note a problem at an element."""
        self.told.problems.append(Problem(message, *self.vocabulary.place(element)))

    def file_of(self, element: Any, uri: str, name: str) -> Path | None:
        """The file that an element called `name` refers to; None and a problem where there is none."""
        try:
            return resource(uri, self.file.parent, self.package.folder)
        except ConfigurationError as error:
            self.tell(element, f"{name}: {error}")
            return None

    def content(self, element: Any, around: Any | None, kind: str, fmu: Path | None = None) -> Content | None:
        """The document that an element refers to by `source`, else the one that stands in `around`.

        `kind` is as ROOTS has it; `fmu` is that of the component it belongs to, in which files can be named, too. None
        and problems where there is no such document, or it is refused.
        """
        name, media = local_name(element), element.get("type", _MEDIA[kind])
        if media != _MEDIA[kind]:
            self.tell(element, f"{name} wants the type {_MEDIA[kind]}, got '{media}'")
            return None
        source = element.get("source")
        inline = None if around is None else child(around, f"{kind}:{ROOTS[kind]}")
        if (source is None) == (inline is None):
            both = "neither" if source is None else "both"
            self.tell(element, f"{name} wants a source or {kind}:{ROOTS[kind]} inside, got {both}")
            return None
        try:
            if source is None:
                check_element(inline, self.vocabulary.shown, kind)
                return Content(inline, Vocabulary.of(inline, kind, self.vocabulary.shown))
            file, shown = self._located(element, source, fmu)
            root = read_document(file, shown, kind)
            return Content(root, Vocabulary.of(root, kind, shown))
        except ConfigurationError as error:
            for problem in error.problems:
                if problem.file:
                    self.told.problems.append(problem)
                else:
                    self.tell(element, f"{name}: {problem}")
            return None

    def _located(self, element: Any, source: str, fmu: Path | None) -> tuple[Path, str]:
        """The file of a source, and what messages call it. Raises ConfigurationError: there is none."""
        if element.get("sourceBase") != "component":
            file = resource(source, self.file.parent, self.package.folder)
            return file, self.package.inside(file)
        if fmu is None:
            raise ConfigurationError("has the sourceBase 'component', and stands in no FMU's component")
        inside = unpack(fmu).folder.resolve()
        file = resource(source, inside, inside)
        return file, f"{self.package.inside(fmu)}/{file.relative_to(inside).as_posix()}"
