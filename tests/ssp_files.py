"""SSP packages written by hand, from a few words of XML."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

STANDARD = "http://ssp-standard.org/SSP1/SystemStructure"
NAMESPACES = " ".join(
    f'xmlns:{prefix}="{STANDARD}{name}"'
    for prefix, name in (
        ("ssd", "Description"),
        ("ssc", "Common"),
        ("ssv", "ParameterValues"),
        ("ssm", "ParameterMapping"),
        ("ssb", "SignalDictionary"),
    )
)


def package(path: Path, description: str, files: Mapping[str, Path | str | bytes] | None = None) -> Path:
    """An SSP at `path` with this default description, and files by their place in it."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("SystemStructure.ssd", description)
        for name, content in (files or {}).items():
            archive.writestr(name, content.read_bytes() if isinstance(content, Path) else content)
    return path


def description(
    system: str, *, version: str = "1.0", name: str = "test", extra: str = '<ssd:DefaultExperiment stopTime="1"/>'
) -> str:
    """A system description around a system; `extra` is what follows it: enumerations, units, the experiment."""
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<ssd:SystemStructureDescription {NAMESPACES} version="{version}" '
        f'name="{name}">\n{system}\n{extra}\n</ssd:SystemStructureDescription>'
    )


def system(
    elements: str = "",
    connections: str = "",
    connectors: str = "",
    bindings: str = "",
    rest: str = "",
    name: str = "top",
) -> str:
    """A system; where it holds nothing of a kind, the element for that kind is left out."""
    inside = [
        f"<ssd:Connectors>{connectors}</ssd:Connectors>" if connectors else "",
        f"<ssd:ParameterBindings>{bindings}</ssd:ParameterBindings>" if bindings else "",
        f"<ssd:Elements>{elements}</ssd:Elements>" if elements else "",
        f"<ssd:Connections>{connections}</ssd:Connections>" if connections else "",
        rest,
    ]
    return f'<ssd:System name="{name}">' + "\n".join(one for one in inside if one) + "</ssd:System>"


def component(name: str, source: str, connectors: str = "", bindings: str = "", attributes: str = "") -> str:
    """A component."""
    inside = f"<ssd:Connectors>{connectors}</ssd:Connectors>" if connectors else ""
    inside += f"<ssd:ParameterBindings>{bindings}</ssd:ParameterBindings>" if bindings else ""
    return f'<ssd:Component name="{name}" source="{source}" {attributes}>{inside}</ssd:Component>\n'


def connector(name: str, kind: str, of_type: str = "<ssc:Real/>") -> str:
    """A connector."""
    return f'<ssd:Connector name="{name}" kind="{kind}">{of_type}</ssd:Connector>\n'


def connection(start: str, end: str, inside: str = "", attributes: str = "") -> str:
    """A connection between `element.connector`, or `connector` of the system itself, with what stands inside of it."""
    ends = ""
    for side, text in (("start", start), ("end", end)):
        element, _, name = text.partition(".")
        ends += f'{side}Element="{element}" {side}Connector="{name}" ' if name else f'{side}Connector="{element}" '
    return f"<ssd:Connection {ends}{attributes}>{inside}</ssd:Connection>\n"


def values(*parameters: str, units: str = "", name: str = "set", version: str = "1.0") -> str:
    """A parameter set of `name="type:value"` or `name="Real:value unit"`."""
    made = ""
    for one in parameters:
        key, _, rest = one.partition("=")
        kind, _, value = rest.partition(":")
        number, _, unit = value.partition(" ") if kind in ("Real", "Float64") and units else (value, "", "")
        attribute = f' unit="{unit}"' if unit else ""
        made += f'<ssv:Parameter name="{key}"><ssv:{kind} value="{number}"{attribute}/></ssv:Parameter>'
    return (
        f'<ssv:ParameterSet {NAMESPACES} version="{version}" name="{name}"><ssv:Parameters>{made}</ssv:Parameters>'
        f"{f'<ssv:Units>{units}</ssv:Units>' if units else ''}</ssv:ParameterSet>"
    )


def binding(inline: str = "", source: str = "", prefix: str = "", mapping: str = "") -> str:
    """A parameter binding with its set inside or by source; `mapping` is a mapping inside, or its source in quotes."""
    attributes = (f'source="{source}" ' if source else "") + (f'prefix="{prefix}"' if prefix else "")
    inside = f"<ssd:ParameterValues>{inline}</ssd:ParameterValues>" if inline else ""
    if mapping.startswith('"'):
        inside += f"<ssd:ParameterMapping source={mapping}/>"
    elif mapping:
        inside += f"<ssd:ParameterMapping>{mapping}</ssd:ParameterMapping>"
    return f"<ssd:ParameterBinding {attributes}>{inside}</ssd:ParameterBinding>\n"


def mapping(**targets: str) -> str:
    """A parameter mapping by target: each the name of its source, and a transformation behind it where there is one."""
    entries = ""
    for target, text in targets.items():
        source, _, inside = text.partition(" ")
        entries += f'<ssm:MappingEntry source="{source}" target="{target}">{inside}</ssm:MappingEntry>'
    return f'<ssm:ParameterMapping {NAMESPACES} version="1.0">{entries}</ssm:ParameterMapping>'


def unit(name: str, **base: float) -> str:
    """A unit definition."""
    attributes = " ".join(f'{key}="{one}"' for key, one in base.items())
    return f'<ssc:Unit name="{name}"><ssc:BaseUnit {attributes}/></ssc:Unit>'
