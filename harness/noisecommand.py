"""The command `crankbench noise`: a model's noise from recorded runs, as a table, as JSON, as a file to select by."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TextIO

import typer
from rich.console import Console
from rich.table import Table

from fmus.component import ConfigurationError
from fmus.description import Validation
from harness.runfolder import plain, write_json

# As `harness.processnoise` has it, which takes half a second to import.
By = Literal["published", "density", "likelihood"]
# Columns of a table in a pipe, where there is no terminal to ask.
_WIDE = 160


def noise(
    record: Annotated[Path, typer.Argument(metavar="DIR|RECORD", help="A run folder, a case's, or a signals.parquet.")],
    model: Annotated[str, typer.Option(metavar="MODEL|FMU", help="Whose noise: a model by name, or an FMU.")],
    point: Annotated[
        list[str] | None, typer.Option("--at", metavar="NAME=VALUE,...", help="Where the model is made linear.")
    ] = None,
    parameter_set: Annotated[str | None, typer.Option("--set", help="A named parameter set of the model.")] = None,
    settle: Annotated[bool, typer.Option("--settle", help="Let it come to rest from there first.")] = False,
    about: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE,...", help="What the record rests at where the model does at the point."),
    ] = None,
    part: Annotated[str, typer.Option(help="The part whose signals the model's names stand for.")] = "",
    mapping: Annotated[
        list[str] | None,
        typer.Option("--map", metavar="SIGNAL=RECORDED,...", help="Names that differ; or the file of inspect --like."),
    ] = None,
    after: Annotated[str, typer.Option(help="Rows from this time on.")] = "0 s",
    until: Annotated[str, typer.Option(help="Rows up to this time.")] = "",
    average: Annotated[str, typer.Option(help="Average over this time, or crank angle on a crank clock.")] = "",
    accuracy: Annotated[
        list[str] | None, typer.Option(metavar="SENSOR=SHARE,...", help="Accuracies, like 3 %; 1 % by default.")
    ] = None,
    lags: Annotated[str, typer.Option(metavar="A,B,...", help="States without process noise.")] = "",
    sensors: Annotated[str, typer.Option(metavar="A,B,...", help="What is measured.")] = "",
    by: Annotated[By, typer.Option(help="Which estimate counts.")] = "published",
    skewness: Annotated[float, typer.Option(help="Published: skewness from which the mean counts.")] = 0.5,
    kurtosis: Annotated[float, typer.Option(help="Published: excess kurtosis below which it counts.")] = -1.0,
    out: Annotated[Path | None, typer.Option(metavar="NOISE.json", help="Write the JSON to a file.")] = None,
    validation: Annotated[Validation, typer.Option(help="Rules of the standard that an FMU breaks.")] = "warn",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Estimate a model's process and measurement noise from recorded runs of what it stands for."""
    from harness.operating import Operation
    from harness.processnoise import NoiseWishes, estimate_noise
    from selection.noise import Rule

    if out is not None and out.suffix != ".json":
        raise ConfigurationError(f"--out wants a file that ends in .json, got {out}")
    if not skewness >= 0.0 or not kurtosis < 0.0:
        raise ConfigurationError(
            f"--skewness wants 0 or more and --kurtosis less than 0, got {skewness:g} and {kurtosis:g}"
        )
    operation = Operation(model, point or (), parameter_set, settle, validation, about=about or ())
    found = estimate_noise(
        NoiseWishes(
            record, operation, _split(mapping), part, after, until, average, _split(accuracy), _split([lags]),
            _split([sensors]), by, Rule(skewness, kurtosis),
        )
    )  # fmt: skip
    if as_json:
        print(json.dumps(plain(found), indent=1, ensure_ascii=False))
    else:
        print_noise(found, sys.stdout)
    if out is not None:
        write_json(out, found)
        print(out, file=sys.stderr if as_json else sys.stdout)


def _split(given: Sequence[str] | None) -> list[str]:
    return [part.strip() for text in given or () for part in text.split(",") if part.strip()]


def print_noise(found: Mapping[str, Any], stream: TextIO) -> None:
    """The noise as tables, and as the line that a campaign takes."""
    console = Console(file=stream) if stream.isatty() else Console(file=stream, width=_WIDE)
    heads = ("state", "unit", "mean", "deviation", "skewness", "kurtosis", "rule", "published", "density", "likelihood")
    table = Table(*heads, "taken", box=None, header_style="bold", pad_edge=False)
    for row in found["states"]:
        cells = [row[key] for key in ("mean", "deviation", "skewness", "kurtosis")]
        estimates = [row["published"], row["density"], row["likelihood"], row["process"]]
        words = row["rule"] or row["why"]
        table.add_row(row["name"], row["unit"], *map(_cell, cells), words, *map(_cell, estimates))
    console.print(table, markup=False)
    console.print()
    table = Table("sensor", "unit", "accuracy", "at point", "largest", "noise", box=None, header_style="bold")
    for row in found["sensors"]:
        cells = [row[key] for key in ("accuracy", "at_point", "largest", "noise")]
        table.add_row(row["name"], row["unit"], *map(_cell, cells))
    if found["sensors"]:
        console.print(table, markup=False)
    lines = [
        f"{found['rows']} rows, {found['intervals']} of {found['interval']:g} s; means and deviations over 1 s, "
        f"estimates over the root of 1 s; taken: {found['by']}",
        *(f"held at the point: {name}" for name in [", ".join(found["held"])] if name),
        *(f"not recorded, follows: {name}" for name in [", ".join(found["followed"])] if name),
        *(f"note: {note}" for note in found["notes"]),
        f"process: {_flow(found['process'])}",
        f"noise: {_flow(found['noise'])}",
    ]
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _flow(values: Mapping[str, str]) -> str:
    """A mapping as YAML has it in one line."""
    return "{" + ", ".join(f"{name}: {value}" for name, value in values.items()) + "}"


def add_command(app: typer.Typer) -> None:
    """Put the command into the command line."""
    app.command(name="noise")(noise)
