"""The command line: `crankbench`, the same as `python -m harness`."""

from __future__ import annotations

import errno
import json
import os
import sys
from dataclasses import asdict
from importlib.metadata import entry_points, version
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from fmus.component import ConfigurationError
from fmus.description import Validation, describe
from harness.analysis import add_commands
from harness.building import Export, build_model, build_with_python
from harness.campaign import built_in_campaigns, describe_campaign, find_campaign, read_campaign
from harness.campaignfile import CampaignFile
from harness.cases import Result, execute
from harness.checking import Checked
from harness.checking import check as check_fmu
from harness.doctor import examine, remove_unpacked
from harness.fmutext import check_lines, inspection_lines, survey_line, words
from harness.metricslist import metric_kinds, metric_lines
from harness.noisecommand import add_command as add_noise
from harness.progress import progress
from harness.recordexport import Format, Units
from harness.recordexport import export as export_records
from harness.runfolder import plain
from harness.ssp.command import app as ssp
from harness.ssp.command import campaign_of
from harness.surveying import Manner, keep, survey
from harness.surveying import as_json as survey_json

# FAILED is a case or a criterion, MISUSED usage or configuration.
FINE, FAILED, MISUSED, INTERRUPTED = 0, 1, 2, 130

# What the system says of a disk that takes no more.
UNWRITABLE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)

app = typer.Typer(
    help="Test observers against plants that are FMUs.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

app.add_typer(ssp, name="ssp")

Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Tier = Annotated[
    Validation, typer.Option(help="Rules of the standard that it breaks: strict refuses, warn lists, off ignores them.")
]


def main() -> None:
    """Run the command line and exit with FINE, FAILED (a case or a criterion), MISUSED (usage) or INTERRUPTED."""
    try:
        app()
    except ConfigurationError as error:
        for problem in error.problems:
            print(problem, file=sys.stderr)
        sys.exit(MISUSED)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except OSError as error:
        if error.errno not in UNWRITABLE:
            raise
        print(error, file=sys.stderr)
        sys.exit(FAILED)
    except SystemExit as ended:
        # Typer makes an exit with 1 of an interrupt that reaches it.
        if not isinstance(ended.__context__, typer.Abort):
            raise
        sys.exit(INTERRUPTED)


@app.callback(invoke_without_command=True)
def _root(
    show_version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if show_version:
        print(version("crankbench"))
        raise typer.Exit(FINE)


@app.command()
def campaigns(as_json: Json = False) -> None:
    """List the built-in campaigns, with a line on each."""
    found = {name: describe_campaign(file) for name, file in built_in_campaigns().items()}
    if as_json:
        _print_json([{"name": name, "description": text} for name, text in found.items()])
        return
    for name, text in found.items():
        print(f"{name:<{max(map(len, found))}}  {text}".rstrip())


@app.command()
def run(
    campaign: Annotated[str, typer.Argument(help="A campaign file, an .ssp, or the name of a built-in campaign.")],
    out: Annotated[Path | None, typer.Option(help="Run folder; runs/NAME where not given.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Cases at a time.")] = os.cpu_count() or 1,
    fresh: Annotated[bool, typer.Option("--fresh", help="Run finished cases again.")] = False,
    override: Annotated[
        list[str] | None, typer.Option("--set", metavar="PATH=VALUE", help="Override a value of the campaign.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Run a campaign, or what is left of it, and write its report."""
    file = campaign_of(campaign) if campaign.endswith(".ssp") else find_campaign(campaign)
    asked = read_campaign(file, override or [])
    folder = out if out is not None else Path("runs") / asked.name
    if folder.exists() and not folder.is_dir():
        raise ConfigurationError(f"--out wants a folder, got the file {folder}")
    try:
        with progress(sys.stderr if as_json else sys.stdout) as teller:
            finished: Literal["kept", "run again"] = "run again" if fresh else "kept"
            result = execute(asked, folder, jobs, teller.ended, finished, teller.underway)
    except KeyboardInterrupt:
        print(f"interrupted; what was finished is kept in {folder}", file=sys.stderr)
        raise typer.Exit(INTERRUPTED) from None
    reports = write_reports(folder)
    if as_json:
        content = {"folder": folder, "reports": reports, "accepted": result.accepted, "outcomes": result.outcomes}
        _print_json({**content, "criteria": [asdict(verdict) for verdict in result.verdicts]})
    else:
        _print_result(result)
        print(*reports, sep="\n")
    raise typer.Exit(FINE if result.accepted else FAILED)


@app.command()
def report(folder: Annotated[Path, typer.Argument(metavar="DIR", help="A run folder.")]) -> None:
    """Write the report of a run folder again, from its records."""
    if not (folder / "campaign.json").is_file():
        raise ConfigurationError(f"{folder} is no run folder: it holds no campaign.json")
    print(*write_reports(folder), sep="\n")


@app.command()
def compare(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR DIR...", help="Run folders, the base first.")],
    out: Annotated[Path, typer.Option(help="The page to write.")] = Path("comparison.html"),
) -> None:
    """Write one page over several run folders: what changed, and whether the ranking holds."""
    for folder in folders:
        if not (folder / "campaign.json").is_file():
            raise ConfigurationError(f"{folder} is no run folder: it holds no campaign.json")
    if len(folders) < 2:
        raise ConfigurationError(f"compare wants two run folders or more, got {len(folders)}")
    print(*(entry.load()(folders, out) for entry in entry_points(group="crankbench.comparison")), sep="\n")


@app.command()
def export(
    target: Annotated[
        Path, typer.Argument(metavar="DIR|RECORD", help="A run folder, a case's folder in it, or a signals.parquet.")
    ],
    to: Annotated[Format, typer.Option(help="Comma-separated values, or ASAM MDF 4.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder, or file of a single record; beside the records where not given.")
    ] = None,
    units: Annotated[
        Units, typer.Option(help="Units of the values: as declared, or SI as in the record.")
    ] = "declared",
    as_json: Json = False,
) -> None:
    """Write records in a format of other tools, a file a case."""
    written = []
    for path in export_records(target, to, out, units):
        written.append(path)
        if not as_json:
            print(path, flush=True)
    if as_json:
        _print_json({"files": written})


@app.command()
def build(
    model: Annotated[str, typer.Argument(help="A plant's name like driveline, or module or module:name.")],
    out: Annotated[Path, typer.Option(help="The .fmu file to write.")],
    fmi: Annotated[int, typer.Option(min=2, max=3, help="FMI version: 2 or 3.")] = 2,
    platforms: Annotated[str, typer.Option(help="native, all, or names with commas.")] = "native",
    parameter_set: Annotated[str | None, typer.Option("--set", help="A named parameter set of the model.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--with", metavar="NAME=VALUE", help="A start value, like k='1500 N.m/rad'.")
    ] = None,
    python: Annotated[bool, typer.Option("--python", help="Python inside, by PythonFMU: slow, needs Python.")] = False,
) -> None:
    """Export a plant or an observer as an FMU."""
    export = Export(out, fmi, tuple(platforms.split(",")), parameter_set, tuple(settings or ()))
    print(build_with_python(model, export) if python else build_model(model, export))


@app.command()
def inspect(
    fmu: Annotated[Path, typer.Argument(help="An FMU file.")],
    like: Annotated[
        str | None, typer.Option(metavar="MODEL", help="Propose which of its variables are this model's signals.")
    ] = None,
    validation: Tier = "warn",
    as_json: Json = False,
) -> None:
    """Show what an FMU is, its variables, units and capabilities, and what would stand in the way."""
    if not fmu.is_file():
        raise ConfigurationError(f"no FMU file '{fmu}'")
    description = describe(fmu, validation)
    content, proposed = description.to_json(), []
    if like is not None:
        from harness.likeness import find_likeness, likeness_lines

        found = find_likeness(description, like)
        content, proposed = {**content, "like": found.to_json()}, likeness_lines(found)
    if as_json:
        _print_json(content)
    else:
        print(*inspection_lines(content), *proposed, sep="\n")


@app.command()
def check(
    fmu: Annotated[Path, typer.Argument(metavar="FMU|FOLDER", help="An FMU file, or a folder to look for them in.")],
    page: Annotated[
        Path | None, typer.Option("--report", metavar="PAGE.html", help="Write what a folder's FMUs do as a page.")
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="FMUs at a time.")] = os.cpu_count() or 1,
    seconds: Annotated[float, typer.Option(min=0.1, help="How long a probe may take.")] = 60.0,
    validation: Tier = "warn",
    as_json: Json = False,
) -> None:
    """Put probes to an FMU, or to all in a folder: does it do what it says? Each runs in a process of its own."""
    if fmu.is_dir():
        _check_folder(fmu, page, Manner(jobs, seconds, validation), as_json)
        return
    if page is not None:
        raise ConfigurationError(f"--report wants a folder of FMUs, got {fmu}")
    if not fmu.is_file():
        raise ConfigurationError(f"no FMU file '{fmu}'")
    checked = check_fmu(fmu, seconds, validation)
    if as_json:
        _print_json(checked.to_json())
    elif checked.runnable:
        print(*check_lines(checked), sep="\n")
    if not checked.runnable:
        print(*(f"{fmu}: {reason}" for reason in checked.reasons), sep="\n", file=sys.stderr)
        raise typer.Exit(MISUSED)
    raise typer.Exit(FAILED if checked.failed else FINE)


def _check_folder(folder: Path, page: Path | None, manner: Manner, as_json: bool) -> None:
    if page is not None and page.suffix != ".html":
        raise ConfigurationError(f"--report wants a file that ends in .html, got {page}")
    stream = sys.stderr if as_json else sys.stdout

    def tell(checked: Checked, number: int, total: int) -> None:
        print(survey_line(checked, number, total), file=stream, flush=True)

    try:
        checked = survey(folder, manner, tell)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise typer.Exit(INTERRUPTED) from None
    content = survey_json(folder, checked, manner)
    if as_json:
        _print_json(content)
    if page is not None:
        kept = keep(page, content)
        pages = [entry.load()(kept, page) for entry in entry_points(group="crankbench.compatibility")]
        print(*pages, sep="\n", file=stream)
    raise typer.Exit(FINE if all(one.runnable and not one.failed for one in checked) else FAILED)


add_commands(app)
add_noise(app)


@app.command()
def doctor(
    as_json: Json = False,
    clean: Annotated[bool, typer.Option("--clean", help="Remove the unpacked FMUs from the cache first.")] = False,
) -> None:
    """Show the compiler, versions and cache, and what is missing."""
    removed = {"removed": f"{remove_unpacked()} unpacked FMUs"} if clean else {}
    findings = {**removed, **examine()}
    if as_json:
        _print_json(findings)
    else:
        for name, value in findings.items():
            print(f"{name:<12} {words(value)}")
    if findings["problems"]:
        raise typer.Exit(MISUSED)


@app.command()
def metrics(as_json: Json = False) -> None:
    """List the kinds of metric: what each is given, its values with their units, its version and definition."""
    if as_json:
        _print_json(metric_kinds())
    else:
        print(*metric_lines(), sep="\n")


@app.command()
def schema() -> None:
    """Print the JSON Schema of campaign files, for editors."""
    print(schema_text(), end="")


def schema_text() -> str:
    """The JSON Schema of campaign files, as docs/campaign.schema.json has it."""
    generated = CampaignFile.model_json_schema(by_alias=True)
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "crankbench campaign"}
    return json.dumps({**generated, **head}, indent=2, ensure_ascii=False) + "\n"


def write_reports(folder: Path) -> list[Path]:
    """The reports that the entry points in group `crankbench.report` write about a run folder."""
    return [entry.load()(folder) for entry in entry_points(group="crankbench.report")]


def _print_result(result: Result) -> None:
    failed = {label: ended for label, ended in result.outcomes.items() if ended not in ("ok", "warning")}
    print(f"{len(result.outcomes) - len(failed)} of {len(result.outcomes)} cases ran to their end")
    for verdict in result.verdicts:
        name = f"{verdict.experiment}: {verdict.text}" if verdict.experiment else verdict.text
        print(f"{'pass' if verdict.passed else 'FAIL'}  {name}" + (f"  ({verdict.reason})" if verdict.reason else ""))


def _print_json(content: Any) -> None:
    print(json.dumps(plain(content), indent=1, ensure_ascii=False))
