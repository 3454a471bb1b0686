"""Writes the page on a selection of sensors from the JSON that `crankbench select --report` keeps."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from fmus.whole import write_whole
from reports.optimal import METHODS as BY_ERROR
from reports.optimal import optimal_page
from reports.page import page_of
from reports.setfigures import index_histogram, number_matrix, structure_matrix

TEMPLATES = Path(__file__).parent
METHODS = {
    "structural": "Entries of A and C that are not zero are independent of each other: only the structure counts.",
    "coupled": "Entries of A and C are what the model makes of random states, inputs and parameters: those that come "
    "from one flow stay tied to each other.",
    "exact": "A and C are those of the model at the very equilibrium, to hundreds of digits.",
    "numerical": "A and C are in double precision, ranks by singular values: what counts as zero is a tolerance.",
}


class SelectionError(Exception):
    """A selection that cannot be read: which file, what was wanted, what came."""


def write_page(selection: Path, page: Path) -> Path:
    """The path of the page written about a selection, the JSON file that `crankbench select --report` keeps.

    Raises SelectionError: the file holds no selection.
    """
    content = read_selection(selection)
    if content["method"] in BY_ERROR:
        write_whole(page, optimal_page(content))
        return page
    text = page_of(
        "selection.html.jinja",
        content=content,
        meaning=METHODS.get(content["method"], ""),
        best=best(content),
        hidden=any(row["hidden"] for row in content["sets"]),
        drawings={name: Markup(drawing) for name, drawing in drawings(content).items()},
        points=[content["structure"]["at"], *(other["at"] for other in content["structure"]["others"])],
    )
    write_whole(page, text)
    return page


def read_selection(selection: Path) -> Mapping[str, Any]:
    """What the JSON file of a selection holds. Raises SelectionError: it is none."""
    try:
        content = json.loads(selection.read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError) as error:
        raise SelectionError(f"{selection}: wants the JSON of a selection: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("sets"), list):
        raise SelectionError(f"{selection}: wants an object with the list 'sets'")
    return content


def best(content: Mapping[str, Any]) -> str:
    """The verdict: the sets of the least index, as far as they are shown."""
    known = [row["index"] for row in content["sets"] if row["index"] is not None]
    if not known:
        return "no set sees the estimate"
    least = min(known)
    several = sum(counts.get(str(least), 0) for counts in content["counts"].values())
    names = ", ".join(next(row["sensors"] for row in content["sets"] if row["index"] == least))
    alone = "the only set" if several == 1 else f"one of {several} sets"
    return f"{names}: index {least}, {alone} of {content['considered']}"


def drawings(content: Mapping[str, Any]) -> dict[str, str]:
    """The drawings of a selection as SVG elements: structure, reaches, sees, counts, and pairs where there are any."""
    states = [state["name"] for state in content["states"]]
    sensors = [sensor["name"] for sensor in content["sensors"]]
    every = [content["structure"], *content["structure"]["others"]]
    stacked = np.array([np.concatenate([one["A"], one["C"]]) for one in every], dtype=bool)
    always, sometimes = (np.array(pick(stacked, axis=0)) for pick in (np.all, np.any))
    rows = [*(f"d {name}/dt" for name in states), *sensors]
    drawn = {
        "structure": structure_matrix(rows, states, always, sometimes, "structure"),
        "reaches": number_matrix(sensors, states, _far(content, "reaches", states), "reaches"),
        "sees": number_matrix(sensors, states, _far(content, "sees", states) - 1.0, "sees"),
        "counts": index_histogram(content["counts"], "counts"),
    }
    if content["pairs"] is not None:
        drawn["pairs"] = number_matrix(sensors, sensors, np.array(content["pairs"], dtype=float), "pairs")
    return drawn


def _far(content: Mapping[str, Any], key: str, states: list[str]) -> np.ndarray:
    """A number for each sensor and state, shape (sensors, states); NaN where there is none."""
    rows = [[sensor[key].get(state, np.nan) for state in states] for sensor in content["sensors"]]
    return np.array(rows, dtype=float)
