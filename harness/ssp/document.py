"""One XML document of an SSP: read within limits, held against the schemas of the standard."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from lxml import etree

from fmus.component import ConfigurationError, Problem
from fmus.modelxml import checked_xml

_STANDARD = "http://ssp-standard.org/SSP1/SystemStructure"
NAMESPACES = {
    "ssc": f"{_STANDARD}Common",
    "ssd": f"{_STANDARD}Description",
    "ssv": f"{_STANDARD}ParameterValues",
    "ssm": f"{_STANDARD}ParameterMapping",
    "ssb": f"{_STANDARD}SignalDictionary",
}
# The documents of the standard: what each is called, and the element at its top.
ROOTS = {
    "ssd": "SystemStructureDescription",
    "ssv": "ParameterSet",
    "ssm": "ParameterMapping",
    "ssb": "SignalDictionary",
}
_NAMESPACE = re.compile(r"\{[^}]*\}")
_MOST_TOLD = 20


def read_document(file: Path, shown: str, kind: str) -> Any:
    """The top element of a document of one of the ROOTS, which messages call `shown`.

    Raises ConfigurationError: it is no safe XML, or breaks its schema, with every line that does. The schemas are those
    of SSP 2.0, which take what 1.0 has.
    """
    checked_xml(file, shown)
    parser = etree.XMLParser(
        resolve_entities=False, load_dtd=False, no_network=True, remove_comments=True, remove_pis=True
    )
    try:
        root = etree.parse(str(file), parser).getroot()
    except etree.XMLSyntaxError as error:
        raise ConfigurationError(Problem(f"is not XML: {error.msg}", shown, error.lineno or 0)) from error
    check_element(root, shown, kind)
    return root


def check_element(root: Any, shown: str, kind: str) -> None:
    """Nothing, where an element is what stands at the top of a document of this kind, and fits its schema.

    Raises ConfigurationError: with every line that does not.
    """
    wanted = f"{{{NAMESPACES[kind]}}}{ROOTS[kind]}"
    if root.tag != wanted:
        raise ConfigurationError(
            Problem(f"wants the element {ROOTS[kind]} of SSP, got {root.tag}", shown, root.sourceline)
        )
    schema = _schema(kind)
    if not schema.validate(root):
        problems = [Problem(_NAMESPACE.sub("", entry.message), shown, entry.line) for entry in schema.error_log]
        raise ConfigurationError(problems[:_MOST_TOLD])


def children(element: Any, path: str) -> Iterator[Any]:
    """The elements below one, by a path like `ssd:Connectors/ssd:Connector`."""
    yield from element.iterfind(path, NAMESPACES)


def child(element: Any, path: str) -> Any | None:
    """The first element below one, by a path; None where there is none."""
    return element.find(path, NAMESPACES)


def local_name(element: Any) -> str:
    """The name of an element without its namespace."""
    return str(etree.QName(element).localname)


@cache
def _schema(kind: str) -> Any:
    names = {"ssd": "Description", "ssv": "ParameterValues", "ssm": "ParameterMapping", "ssb": "SignalDictionary"}
    return etree.XMLSchema(file=str(Path(__file__).parent / "schemas" / f"SystemStructure{names[kind]}.xsd"))
