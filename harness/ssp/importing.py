"""From an SSP to a campaign file that runs: one part for each FMU, source and transformation, and the clock."""

from __future__ import annotations

import io
import re
import shutil
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from fmus.component import ConfigurationError, Problem
from fmus.units import UnitError
from fmus.whole import write_whole
from harness.places import Places
from harness.quantity import Measure, read_measure
from harness.scenario import Coupling
from harness.ssp.graph import Graph, flatten
from harness.ssp.parts import build_parts
from harness.ssp.reading import read_structure
from harness.ssp.structure import Structure
from harness.validation import validate

_WIDTH = 110


class Clock(NamedTuple):
    """What a user asks of the clock, like `10 ms`; what is empty is taken from the SSP."""

    step: str = ""
    stop: str = ""
    start: str = ""


@dataclass(frozen=True)
class Imported:
    """A campaign as YAML, the FMUs that it names by their place beside it, and what is to be told of it.

    `sha256` is that of the SSP.
    """

    file: str
    text: str
    fmus: Mapping[str, Path]
    notes: tuple[str, ...]
    sha256: str

    def write(self, folder: Path) -> Path:
        """The campaign file, written into a folder with its FMUs."""
        for name, source in self.fmus.items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)
        write_whole(folder / self.file, self.text)
        return folder / self.file


def import_system(path: Path, variant: str = "", clock: Clock = Clock()) -> Imported:  # noqa: B008 - a NamedTuple
    """The campaign of the SSP at `path`, of its default system description or of the variant of this name.

    Raises ConfigurationError: the SSP is refused, or holds what no campaign can: every such thing, with its place.
    """
    structure = read_structure(path, variant)
    graph = flatten(structure.system)
    order = structure.annotation.get("parts")
    built = build_parts(graph, order if isinstance(order, list) else ())
    notes = [*structure.notes, *graph.notes]
    problems = list(graph.problems)
    times = _clock(structure, graph, clock, problems, notes)
    if structure.variants:
        names = ", ".join(name.removesuffix(".ssd") for name in structure.variants)
        notes.append(f"it holds variants, which --variant takes: {names}")
    if not graph.instances and not problems:
        problems.append(Problem(f"{structure.system.name} holds nothing that runs", *structure.system.place))
    if problems:
        raise ConfigurationError(list(dict.fromkeys(problems)))
    name = re.sub(r"[^\w.-]", "_", structure.name, flags=re.ASCII).lstrip("_.-") or "system"
    heads = {"campaign": name, "description": structure.description, "clock": {"time": times}}
    rest = {"coupling": _coupling(structure), "parts": built.parts}
    document = {key: value for key, value in {**heads, **rest}.items() if value}
    notes = list(dict.fromkeys(notes))
    origin = f"From {path.name} (SSP {structure.version}, SHA-256 {structure.sha256})"
    head = f"{origin}, system description '{structure.name}'."
    return Imported(f"{name}.yaml", _yaml(document, [head, *notes]), built.fmus, tuple(notes), structure.sha256)


def _coupling(structure: Structure) -> dict[str, Any]:
    """The coupling that an SSP of ours was written with; empty for any other."""
    given = structure.annotation.get("coupling")
    checked, _ = validate(Coupling, given, Places()) if isinstance(given, dict) else (None, [])
    return {} if checked is None else checked.model_dump(mode="json", exclude_unset=True)


def _clock(
    structure: Structure, graph: Graph, asked: Clock, problems: list[Problem], notes: list[str]
) -> dict[str, str]:
    """The keys of the clock; what the SSP leaves open is taken from its FMUs, and told."""
    known = {"start": structure.start or 0.0, "stop": structure.stop, "step": structure.annotation.get("step")}
    if known["step"] is None and not asked.step and structure.step is not None:
        known["step"] = structure.step
        notes.append(f"the step is that of a master in its annotations, {structure.step:g} s: an SSP gives none itself")
    of_fmus = [instance.facts for instance in graph.instances.values()]
    steps = [one.step for one in of_fmus if one.step is not None]
    stops = [one.stop for one in of_fmus if one.stop is not None]
    if known["stop"] is None and not asked.stop and stops:
        known["stop"] = max(stops)
        notes.append(f"the stop is the latest default of its FMUs, {max(stops):g} s: it gives none itself")
    if known["step"] is None and not asked.step and steps:
        known["step"] = min(steps)
        notes.append(f"the step is the shortest default of its FMUs, {min(steps):g} s: an SSP gives none itself")
    times = {}
    for key in ("step", "stop", "start"):
        value = known[key]
        text = getattr(asked, key) or (value if isinstance(value, str) else "")
        if text:
            try:
                measure = read_measure(text)
                measure.si("s")
            except (ValueError, UnitError) as error:
                problems.append(Problem(f"--{key} wants a time: {error}"))
                continue
            times[key] = str(measure)
        elif isinstance(value, (int, float)):
            times[key] = str(Measure(float(value), "s"))
        else:
            problems.append(Problem(f"neither the SSP nor its FMUs say a {key}: give one, like --{key} '10 ms'"))
    return times


def _yaml(document: Mapping[str, Any], head: list[str]) -> str:
    """The document as YAML under comments; what fits on a line stands on one."""
    yaml = YAML()
    yaml.width, yaml.allow_unicode = 10_000, True
    top = CommentedMap()
    for key, value in document.items():
        top[key] = _block({name: _part(part) for name, part in value.items()}) if key == "parts" else _inline(value)
    stream = io.StringIO()
    yaml.dump(top, stream)
    return "".join(f"# {line}\n" for text in head for line in _folded(text)) + stream.getvalue()


def _part(part: Mapping[str, Any]) -> CommentedMap:
    if len(str(part)) < _WIDTH:
        return _inline(part)
    return _block({key: _block(value) if _is_long(value) else _inline(value) for key, value in part.items()})


def _is_long(value: Any) -> bool:
    return isinstance(value, Mapping) and len(str(value)) >= _WIDTH


def _block(values: Mapping[str, Any]) -> CommentedMap:
    made = CommentedMap(values)
    made.fa.set_block_style()
    return made


def _inline(value: Any) -> Any:
    if isinstance(value, Mapping):
        made = CommentedMap({key: _inline(one) for key, one in value.items()})
        made.fa.set_flow_style()
        return made
    if isinstance(value, (list, tuple)):
        listed = CommentedSeq(_inline(one) for one in value)
        listed.fa.set_flow_style()
        return listed
    return value


def _folded(text: str) -> list[str]:
    """The lines of a comment: none is long, and none breaks out of it."""
    text = "".join(letter if letter.isprintable() else " " for letter in text)
    return textwrap.wrap(text, _WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
