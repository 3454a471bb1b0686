"""The commands about a system at a point: `crankbench linearise` and `crankbench select`.

What they work with takes half a second to import, which no other command is to wait for.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fmus.component import ConfigurationError
from fmus.description import Validation
from fmus.whole import write_whole
from harness.fmutext import table
from harness.runfolder import plain
from harness.surveying import keep
from selection.methods import BY_ERROR, Method, Scaling

if TYPE_CHECKING:
    from fmus.statespace import StateSpace

Target = Annotated[str, typer.Argument(metavar="MODEL|FMU", help="A plant's name, module or module:name, or an FMU.")]
At = Annotated[
    list[str] | None,
    typer.Option("--at", metavar="NAME=VALUE,...", help="States, inputs, parameters at the point: N='2000 rpm'."),
]
ParameterSet = Annotated[str | None, typer.Option("--set", help="A named parameter set of the model.")]
Settle = Annotated[bool, typer.Option("--settle", help="Let it come to rest from there first, inputs held.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Tier = Annotated[Validation, typer.Option(help="Rules of the standard that an FMU breaks: strict, warn or off.")]


def _names(text: str) -> Any:
    return typer.Option(metavar="A,B,...", help=text)


def _values(text: str) -> Any:
    return typer.Option(metavar="SENSOR=VALUE,...", help=text)


def linearise(
    target: Target,
    point: At = None,
    parameter_set: ParameterSet = None,
    settle: Settle = False,
    validation: Tier = "warn",
    as_json: Json = False,
) -> None:
    """Give A, B, C, D of a model or an FMU at an operating point, in SI units, and what gave them."""
    from harness.operating import Operation, operate

    space = operate(Operation(target, point or (), parameter_set, settle, validation)).space
    if as_json:
        print(json.dumps(plain(space.to_json()), indent=1, ensure_ascii=False))
    else:
        print("\n".join(_lines(space)))


def _lines(space: StateSpace) -> list[str]:
    from fmus.statespace import AT_REST, imbalance, scales, si_unit, unrest

    n = len(space.states)
    columns = [*space.states, *space.inputs]
    rows = [*((f"der({s.name})", space.A[i], space.B[i]) for i, s in enumerate(space.states))]
    rows += [(s.name, space.C[i], space.D[i]) for i, s in enumerate(space.outputs)]
    cells = [[name, *(f"{value:.4g}" for value in (*by_x, *by_u))] for name, by_x, by_u in rows]
    points = [f"{s.name} = {v:.6g} {si_unit(s)}".rstrip() for s, v in zip(columns, (*space.x0, *space.u0), strict=True)]
    unsettled = imbalance(space.A, space.rates, scales(space.states)).max(initial=0.0) > AT_REST
    rest = f"no equilibrium: {unrest(space.states, space.A, space.rates)}" if n and unsettled else "an equilibrium"
    return [
        f"rung   {space.rung}: {space.evidence}",
        f"error  {space.error:.2g} of a row",
        f"point  {', '.join(points)}",
        f"rest   {rest}",
        *table(("", *(signal.name for signal in columns)), cells),
    ]


def select_sensors(
    target: Target,
    estimate: Annotated[str, _names("The states to estimate; all where none is named.")] = "",
    most: Annotated[int, typer.Option("--max-sensors", help="Sensors in a set at most.")] = 3,
    method: Annotated[
        Method,
        typer.Option(
            help="By the index, with entries of A and C of this kind; or by the error: h2 is the semidefinite program, "
            "optimal the proven best set of each size."
        ),
    ] = "structural",
    point: At = None,
    parameter_set: ParameterSet = None,
    settle: Settle = False,
    about: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE,...", help="What a reference shows at the point, which counts as rest."),
    ] = None,
    sensors: Annotated[str, _names("States and outputs that may be measured, or patterns.")] = "",
    must: Annotated[str, _names("Sensors that every set has.")] = "",
    forbid: Annotated[str, _names("Sensors that no set has.")] = "",
    cost: Annotated[list[str] | None, _values("What a sensor costs; 1 where nothing is said.")] = None,
    budget: Annotated[float, typer.Option(help="What a set costs at most.")] = math.inf,
    lag: Annotated[
        list[str] | None,
        _values("Time constants; 3 s of a temperature, else 0 s."),
    ] = None,
    noise: Annotated[
        list[str] | None,
        _values("Standard deviation of a sample; 1 % of the nominal value."),
    ] = None,
    measures: Annotated[str | None, typer.Option(help="gramian,kalman or none; both of up to 10000 sets.")] = None,
    by: Annotated[str, typer.Option(help="What to rank by, the first first.")] = "index,error,cost",
    period: Annotated[str, typer.Option(help="Time between samples.")] = "10 ms",
    process: Annotated[
        str, typer.Option(help="What disturbs each state, of its size in a second; or the file of crankbench noise.")
    ] = "0.01",
    disturbance: Annotated[
        list[str] | None,
        typer.Option(metavar="STATE=VALUE,...", help="What disturbs single states: deviation after a second."),
    ] = None,
    scaling: Annotated[Scaling, typer.Option(help="h2: what states are scaled by.")] = "deviation",
    tolerance: Annotated[float | None, typer.Option(help="Numerical: singular values below it are zero.")] = None,
    seed: Annotated[int, typer.Option(help="Structural and coupled: seed of the random entries.")] = 0,
    also: Annotated[
        list[str] | None, typer.Option("--also-at", metavar="NAME=VALUE,...", help="Show the structure there, too.")
    ] = None,
    show_all: Annotated[bool, typer.Option("--all", help="Print all sets.")] = False,
    out: Annotated[Path | None, typer.Option(metavar="TABLE.csv", help="Write all sets as CSV.")] = None,
    page: Annotated[Path | None, typer.Option("--report", metavar="PAGE.html", help="Write a page.")] = None,
    validation: Tier = "warn",
    as_json: Json = False,
) -> None:
    """Rank sets of sensors by how directly they see the states to estimate, or by how well a filter with them does."""
    from harness.operating import Operation
    from harness.optimaltext import optimised_csv, print_optimised, stages_told
    from harness.optimising import Optimised
    from harness.selecting import SHOWN, select
    from harness.selectiontext import csv_text, print_selected, sets_told
    from harness.wishes import Wishes

    for path, suffix, option in ((out, ".csv", "--out"), (page, ".html", "--report")):
        if path is not None and path.suffix != suffix:
            raise ConfigurationError(f"{option} wants a file that ends in {suffix}, got {path}")
    operation = Operation(target, point or (), parameter_set, settle, validation, about=about or ())
    wishes = Wishes(
        _split(estimate),
        most,
        method,
        _split(sensors),
        _split(must),
        _split(forbid),
        _settings(cost),
        _settings(lag),
        _noise(_settings(noise)),
        None if measures is None else [word for word in _split(measures) if word != "none"],
        _split(by),
        period,
        _process(process),
        tolerance,
        seed,
        os.cpu_count() or 1,
        budget,
        _settings(disturbance),
        scaling,
    )
    others = [operation._replace(point=(*operation.point, place)) for place in also or ()]
    stream = sys.stderr if as_json else sys.stdout
    with (stages_told if method in BY_ERROR else sets_told)(stream) as tell:
        selected = select(operation, wishes, others, tell)
    most_shown = None if show_all else SHOWN
    if as_json:
        print(json.dumps(plain(selected.to_json(most_shown)), indent=1, ensure_ascii=False))
    elif isinstance(selected, Optimised):
        print_optimised(selected, most_shown, stream)
    else:
        print_selected(selected, most_shown, stream)
    if out is not None:
        write_whole(out, optimised_csv(selected) if isinstance(selected, Optimised) else csv_text(selected))
        print(out, file=stream)
    if page is not None:
        kept = keep(page, selected.to_json(most_shown))
        print(
            *(entry.load()(kept, page) for entry in entry_points(group="crankbench.selection")), sep="\n", file=stream
        )


def _process(text: str) -> float | dict[str, str]:
    if text.endswith(".json"):
        return _written(text, "process")
    try:
        return float(text)
    except ValueError:
        wanted = "a share of the states' sizes, like 0.01, or a file that ends in .json"
        raise ConfigurationError(f"--process wants {wanted}, got '{text}'") from None


def _noise(given: Sequence[str]) -> list[str]:
    """The settings, those of the files of `crankbench noise` among them before the others."""
    files = [text for text in given if text.endswith(".json")]
    found = [f"{name}={value}" for file in files for name, value in _written(file, "noise").items()]
    return [*found, *(text for text in given if text not in files)]


def _written(file: str, key: str) -> dict[str, str]:
    """What `crankbench noise --out` wrote under a key."""
    path = Path(file)
    if not path.is_file():
        raise ConfigurationError(f"--{key} wants a file of crankbench noise, there is no {path}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ConfigurationError(
            f"--{key}: {path} wants what crankbench noise --out writes, got no JSON: {error}"
        ) from error
    if not isinstance(content, dict) or not isinstance(content.get(key), dict):
        raise ConfigurationError(f"--{key}: {path} has no '{key}' by name; crankbench noise --out writes one")
    return {str(name): str(value) for name, value in content[key].items()}


def _split(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def _settings(given: Sequence[str] | None) -> list[str]:
    return [part for text in given or () for part in _split(text)]


def add_commands(app: Any) -> None:
    """Put both commands into the command line."""
    app.command(name="linearise")(linearise)
    app.command(name="select")(select_sensors)
