"""Writes the page on what the FMUs of a folder do: one row an FMU, one cell a probe, from the JSON of a check."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fmus.whole import write_whole
from reports.page import page_of

TEMPLATES = Path(__file__).parent
KINDS = ("cs", "me")
MARKS = {True: ("good", "pass"), False: ("bad", "fail"), None: ("none", "n.a.")}


class SurveyError(Exception):
    """A survey that cannot be read: which file, what was wanted, what came."""


def write_page(survey: Path, page: Path) -> Path:
    """The path of the page written about a survey, the JSON file that `crankbench check FOLDER --report` keeps.

    Raises SurveyError: the file holds no survey.
    """
    content = _read(survey)
    rows = [_row(fmu, content["probes"]) for fmu in content["fmus"]]
    text = page_of(
        "compatibility.html.jinja",
        content=content,
        rows=rows,
        runnable=sum(row["runnable"] for row in rows),
        clean=sum(row["runnable"] and not row["failed"] for row in rows),
        failures=Counter(name for row in rows for name in row["failed"]).most_common(),
        tools=_tools(rows),
    )
    write_whole(page, text)
    return page


def _read(survey: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(survey.read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError) as error:
        raise SurveyError(f"{survey}: wants the JSON of a check of a folder: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("fmus"), list):
        raise SurveyError(f"{survey}: wants an object with the list 'fmus'")
    return content


def _row(fmu: Mapping[str, Any], names: list[str]) -> dict[str, Any]:
    """What the table shows of an FMU; the cells in the order of the probes."""
    found = {probe["name"]: probe for probe in fmu.get("probes", ())}
    cells = []
    for name in names:
        # A second kind's probes have it in front of their names.
        put = [probe for asked, probe in found.items() if asked in (name, *(f"{kind}_{name}" for kind in KINDS))]
        verdicts = [probe["passed"] for probe in put]
        worst = False if False in verdicts else True if True in verdicts else None
        evidence = [f"{probe['kind']}: {probe['evidence']}" if len(put) > 1 else probe["evidence"] for probe in put]
        texts = [MARKS[verdict][1] for verdict in verdicts] or [MARKS[None][1]]
        text = texts[0] if len(set(texts)) == 1 else " / ".join(texts)
        cells.append({"name": name, "mark": MARKS[worst][0], "text": text, "evidence": "; ".join(evidence)})
    return {
        "fmu": fmu["fmu"],
        "tool": fmu.get("tool", ""),
        "fmi_version": fmu.get("fmi_version", ""),
        "kinds": ", ".join(fmu.get("kinds", ())),
        "platforms": ", ".join(fmu.get("platforms", ())),
        "runnable": bool(fmu["runnable"]),
        "reasons": "; ".join(fmu.get("reasons", ())),
        "cautions": fmu.get("cautions", ()),
        "sha256": fmu.get("sha256", ""),
        "cells": cells,
        "failed": [cell["name"] for cell in cells if cell["mark"] == "bad"],
        "timing": next((cell["evidence"] for cell in cells if cell["name"] == "timing"), ""),
    }


def _tools(rows: list[dict[str, Any]]) -> list[tuple[str, int, int, int]]:
    """By tool: FMUs, those that run, and those that pass every probe."""
    tools: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        tools.setdefault(row["tool"] or "not said", []).append(row)
    return [
        (tool, len(own), sum(row["runnable"] for row in own), sum(row["runnable"] and not row["failed"] for row in own))
        for tool, own in sorted(tools.items())
    ]
