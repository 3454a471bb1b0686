"""What is known of an FMU, as text for a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from harness.checking import Checked

VERDICTS = {True: "pass", False: "FAIL", None: "n.a."}


def check_lines(checked: Checked) -> Iterator[str]:
    """A check: a line for each probe with its verdict and evidence, then what was tolerated, then the sum of it."""
    width = max((len(found.name) for found in checked.probes), default=0)
    for found in checked.probes:
        yield f"{VERDICTS[found.passed]}  {found.name:<{width}}  {found.evidence}"
    yield from (f"caution: {caution}" for caution in checked.about.get("cautions", ()))
    yield summary(checked)


def survey_line(checked: Checked, number: int, total: int) -> str:
    """An FMU of a folder in one line."""
    return f"[{number:>{len(str(total))}}/{total}] {checked.fmu}  {summary(checked)}"


def summary(checked: Checked) -> str:
    """How a check ended, in one line."""
    if not checked.runnable:
        return "not runnable: " + "; ".join(checked.reasons)
    passed = sum(found.passed is True for found in checked.probes)
    told = f"runnable, {passed} probes passed"
    return f"{told}, {len(checked.failed)} failed: {', '.join(checked.failed)}" if checked.failed else told


def inspection_lines(content: Mapping[str, Any]) -> Iterator[str]:
    """A description: what the FMU is, its capabilities and variables, and what would stand in the way."""
    for key in ("model_name", "fmi_version", "kinds", "tool", "platforms", "sha256"):
        yield f"{key.replace('_', ' '):<12} {words(content.get(key))}".rstrip()
    declared = content["capabilities"].items()
    yield "declares     " + (words([_capability(name, value) for name, value in declared if value]) or "nothing")
    yield "does not     " + (words([name for name, value in declared if value is False]) or "nothing")
    columns = ("name", "causality", "variability", "type", "unit", "start")
    rows = [[words(variable.get(column)) for column in columns] for variable in content["variables"]]
    yield from table(columns, rows)
    yield from (f"caution: {caution}" for caution in content.get("cautions", ()))
    yield "runnable" if content["runnable"] else "not runnable: " + "; ".join(content["reasons"])


def _capability(name: str, value: Any) -> str:
    return name if value is True else f"{name} = {value}"


def table(head: tuple[str, ...], rows: list[list[str]]) -> Iterator[str]:
    """Rows with their columns aligned."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    for row in (head, *rows):
        yield "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()


def words(value: Any) -> str:
    """A value in words: lists with commas, nothing for None."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {words(item)}" for name, item in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(words(item) for item in value)
    return "" if value is None else str(value)
