"""The commands `crankbench ssp import` and `crankbench ssp export`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from fmus.component import ConfigurationError
from fmus.toolchain import cache_folder
from harness.campaign import Campaign, Case, find_campaign, read_campaign
from harness.ssp.exporting import export_case
from harness.ssp.importing import Clock, import_system
from harness.ssp.writing import Version

app = typer.Typer(help="Bring systems of other tools, and take ours to them: SSP 1.0 and 2.0.", no_args_is_help=True)


@app.command("import")
def import_(
    system: Annotated[Path, typer.Argument(metavar="SYSTEM.ssp", help="An SSP package.")],
    out: Annotated[Path, typer.Option(help="The folder to write the campaign file and its FMUs to.")],
    variant: Annotated[str, typer.Option(help="Which of its system descriptions.")] = "",
    step: Annotated[str, typer.Option(help="Step of the clock, like '1 ms'.")] = "",
    stop: Annotated[str, typer.Option(help="When the run ends, like '5 s'.")] = "",
    start: Annotated[str, typer.Option(help="When it starts.")] = "",
) -> None:
    """Write the campaign of an SSP: a file to run, and to edit."""
    imported = import_system(system, variant, Clock(step, stop, start))
    file = out / imported.file
    if file.exists():
        raise ConfigurationError(f"{file} is there already: give another --out, or remove it")
    imported.write(out)
    read_campaign(file)
    print(*imported.notes, file, sep="\n")


@app.command()
def export(
    campaign: Annotated[str, typer.Argument(help="A campaign file, or the name of a built-in campaign.")],
    out: Annotated[Path, typer.Option(help="The .ssp file to write.")],
    override: Annotated[
        list[str] | None, typer.Option("--set", metavar="PATH=VALUE", help="Override a value of the campaign.")
    ] = None,
    case: Annotated[int, typer.Option(min=1, help="Which case of the campaign, in its order.")] = 1,
    version: Annotated[str, typer.Option("--ssp", metavar="1.0|2.0", help="Version of the standard.")] = "1.0",
    platforms: Annotated[str, typer.Option(help="Of our own FMUs: native, all, or names with commas.")] = "native",
) -> None:
    """Write the system of a case as an SSP: an FMU for each part, the wires, the parameters."""
    if out.suffix != ".ssp":
        raise ConfigurationError(f"--out wants a file that ends in .ssp, got {out}")
    asked = read_campaign(find_campaign(campaign), override or [])
    made = export_case(asked, _case(asked, case), out, _version(version), tuple(platforms.split(",")))
    print(*made.notes, made.path, sep="\n")


def campaign_of(system: str) -> Path:
    """The campaign file of an SSP, written into the cache; what is to be told of it goes to the standard error.

    Raises ConfigurationError: as `import_system` does.
    """
    path = Path(system)
    if not path.is_file():
        raise ConfigurationError(f"no SSP file '{system}'")
    found = import_system(path)
    print(*found.notes, sep="\n", end="\n" if found.notes else "", file=sys.stderr)
    return found.write(cache_folder() / "systems" / found.sha256)


def _case(campaign: Campaign, number: int) -> Case:
    if number > len(campaign.cases):
        raise ConfigurationError(f"--case wants 1 to {len(campaign.cases)}, got {number}")
    return campaign.cases[number - 1]


def _version(text: str) -> Version:
    if text == "1.0":
        return "1.0"
    if text == "2.0":
        return "2.0"
    raise ConfigurationError(f"--ssp wants 1.0 or 2.0, got {text}")
