"""Writes report.html of a run folder: one self-contained page, the verdict first and the provenance last."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from fmus.units import parse_unit
from fmus.whole import write_whole
from reports import figures, numbers, provenance, standing
from reports.curves import draw_curve, read_curves
from reports.definitions import definitions
from reports.errors import Errors, declared_confusions, nearest_rank, pool, samples_of
from reports.folder import Case, Run, RunFolderError, read_run
from reports.histograms import Histogram, declared_histograms, draw_histogram
from reports.interactive import interactive, points_a_trace
from reports.optimal import METHODS as BY_ERROR
from reports.optimal import best_of_all, optimal_drawings
from reports.page import page_of
from reports.powers import draw_power, read_powers
from reports.published import published
from reports.rankings import read_rankings
from reports.scatter import scatter
from reports.selection import METHODS, SelectionError, best, drawings, read_selection
from reports.traces import TRUTH_COLOUR, colours_of, declared_figures, part_colours

TEMPLATES = Path(__file__).parent
# More scenarios than this are drawn by experiment only, more cases than this are listed in metrics.csv only, and a
# signal of more values than this has no confusion matrix drawn.
SCENARIOS_DRAWN, CASES_LISTED, VALUES_DRAWN = 40, 2000, 15


def write_report(folder: Path | str) -> Path:
    """The path of the report.html written into a run folder, whole or not at all.

    Raises RunFolderError: the folder holds no run, or a file of it does not hold what the contract says.
    """
    run = read_run(folder)
    path = run.path / "report.html"
    write_whole(path, render(run))
    return path


def render(run: Run) -> str:
    """The page. Metrics and verdicts are the run's own; only medians and distributions over cases are made here."""
    titles, drawn = standing.observers(run), declared_figures(run)
    errors, confusions = pool(run)
    quantities = standing.quantities(run)
    comparable = [quantity for quantity in quantities if len(quantity.metrics) > 1]
    foremost = [quantity for quantity in comparable if standing.foremost(run, quantity)]
    others = [quantity for quantity in comparable if quantity not in foremost]
    solver, starts = provenance.applied_starts(run)
    plots = [interactive(figure, points_a_trace(drawn)) if figure.panels else None for figure in drawn]
    return page_of(
        "report.html.jinja",
        run=run,
        verdict=verdict(run),
        outcomes=Counter(case.outcome for case in run.cases).most_common(),
        causes=Counter((case.outcome, case.message) for case in run.failed).most_common(),
        labels={case.key: case.label for case in run.cases},
        titles=titles,
        leaderboards=[(quantity, standing.leaderboard(run, quantity)) for quantity in foremost],
        other_leaderboards=[(quantity, standing.leaderboard(run, quantity)) for quantity in others],
        single=[
            (quantity, standing.leaderboard(run, quantity)[0]) for quantity in quantities if len(quantity.metrics) == 1
        ],
        reached=_reached,
        ratio=_ratio,
        heat_maps=[(quantity, Markup(_heat_map(run, quantity, f"heat{n}"))) for n, quantity in enumerate(foremost)]
        if len(standing.scenarios(run)) > 1
        else [],
        curves=[
            (curve, Markup(draw_curve(curve, titles, colours_of(run, list(curve.panels[0].lines)), f"curve{n}")))
            for n, curve in enumerate(read_curves(run))
        ],
        powers=[
            (power, Markup(draw_power(power, titles, colours_of(run, power.observers), f"power{n}")))
            for n, power in enumerate(read_powers(run))
        ],
        rankings=[
            (ranking, Markup(scatter(ranking, titles, f"ranking{n}"))) for n, ranking in enumerate(read_rankings(run))
        ],
        figures=[
            (
                figure,
                Markup(figures.signals(figure, f"figure{n}")) if figure.panels else "",
                _script_json(plot),
                figure.rows,
            )
            for n, (figure, plot) in enumerate(zip(drawn, plots, strict=True))
        ],
        points=points_a_trace(drawn),
        plotly=Markup(get_plotlyjs()) if any(plots) else "",
        declared_histograms=[
            (found, "" if found.problem else Markup(_drawn(run, found, titles, f"histogram{n}")))
            for n, found in enumerate(declared_histograms(run))
        ],
        histograms=_histograms(run, errors),
        confusions=[
            (matrix, Markup(figures.confusion(matrix, f"confusion{n}")) if len(matrix.classes) <= VALUES_DRAWN else "")
            for n, matrix in enumerate([*declared_confusions(run), *confusions])
        ],
        detections=_detections(run),
        delays=_delays(run),
        published=published(run),
        selection=_selection(run),
        cases_listed=run.cases if len(run.cases) <= CASES_LISTED else (),
        metric_names=run.metric_names(),
        definitions=definitions(run),
        facts=provenance.facts(run),
        binaries=provenance.binaries(run),
        orders=provenance.step_orders(run),
        solver=solver,
        starts=starts,
        tolerated=provenance.tolerated(run),
        traces=provenance.traces,
        experiments=run.campaign.get("experiments") or {},
    )


def verdict(run: Run) -> tuple[str, str]:
    """The verdict as (word, class): accepted only where every case ran to its end and every criterion passed."""
    if run.missing or run.criteria is None:
        return "Incomplete", "bad"
    if not run.accepted:
        return "Not accepted", "bad"
    return ("Accepted", "good") if run.criteria else ("No criteria declared", "plain")


def _selection(run: Run) -> dict[str, Any] | None:
    """The selection that the run holds, and its drawings; None where it holds none. Raises RunFolderError."""
    path = run.path / "selection.json"
    if not path.is_file():
        return None
    try:
        content = read_selection(path)
        if content["method"] in BY_ERROR:
            found = {name: Markup(drawing) for name, drawing in optimal_drawings(content).items()}
            meaning = BY_ERROR[content["method"]]
            return {"content": content, "meaning": meaning, "best": best_of_all(content), "drawn": found}
        drawn = {name: Markup(drawing) for name, drawing in drawings(content).items()}
        return {"content": content, "meaning": METHODS[content["method"]], "best": best(content), "drawn": drawn}
    except SelectionError as error:
        raise RunFolderError(str(error)) from error
    except (KeyError, TypeError, ValueError) as error:
        raise RunFolderError(f"{path}: is not what a selection wants: {error!r}") from error


def _heat_map(run: Run, quantity: standing.Quantity, name: str) -> str:
    groups = standing.scenarios(run)
    if len(groups) > SCENARIOS_DRAWN:
        groups = {}
        for case in run.cases:
            groups.setdefault(case.experiment or "all cases", []).append(case)
    titles = standing.observers(run)
    values = np.array(
        [
            [
                standing.standing(run, metric, observer, quantity.higher_is_better, cases).median
                for observer, metric in quantity.metrics.items()
            ]
            for cases in groups.values()
        ]
    )
    label = f"median [{quantity.unit}]" if quantity.unit != "1" else "median"
    columns = [titles.get(observer, observer) for observer in quantity.metrics]
    return figures.heat_map(list(groups), columns, values, label, name)


def _drawn(run: Run, found: Histogram, titles: Mapping[str, str], name: str) -> str:
    parts = [errors.estimate.partition(".")[0] for errors in found.panels]
    return draw_histogram(found, titles, colours_of(run, parts), name)


def _histograms(run: Run, errors: Sequence[Errors]) -> list[tuple[str, Sequence[Errors], Markup]]:
    titles, colours = standing.observers(run), part_colours(run)
    by_truth: dict[str, list[Errors]] = {}
    for pooled in errors:
        by_truth.setdefault(pooled.pair.truth, []).append(pooled)
    drawn: list[tuple[str, Sequence[Errors], Markup]] = []
    for number, (truth, group) in enumerate(by_truth.items()):
        parts = [pooled.pair.estimate.split(".")[0] for pooled in group]
        named = [titles.get(part, part) for part in parts]
        inked = [colours.get(part, TRUTH_COLOUR) for part in parts]
        drawn.append((truth, group, Markup(figures.error_histograms(group, named, inked, f"errors{number}"))))
    return drawn


def _detections(run: Run) -> list[dict[str, Any]]:
    rows = []
    for name in _detection_names(run):
        per_hour = f"{name}.false_alarms_per_hour"
        rate = per_hour if per_hour in run.metric_names() else f"{name}.false_alarms_per_min"
        for scenario, cases in standing.scenarios(run).items():
            pooled = samples_of(run, f"{name}.delay", cases)
            if any(f"{name}.changes" in case.metrics or f"{name}.delay" in case.samples for case in cases):
                rows.append(
                    {
                        "metric": name,
                        "scenario": scenario,
                        "cases": len(cases),
                        "failed": sum(not case.complete for case in cases),
                        "changes": len(pooled),
                        "missed": int(np.isinf(pooled).sum()),
                        "median": nearest_rank(pooled, 0.5),
                        "p95": nearest_rank(pooled, 0.95),
                        "unit": standing.unit_of(run, f"{name}.delay"),
                        "alarms": _mean(cases, rate),
                        "alarms_unit": standing.unit_of(run, rate),
                        "accuracy": _mean(cases, f"{name}.accuracy"),
                    }
                )
    return rows


def _delays(run: Run) -> Markup | str:
    found = {name: samples_of(run, f"{name}.delay") for name in _detection_names(run)}
    found = {name: samples for name, samples in found.items() if len(samples)}
    if not found:
        return ""
    unit = standing.unit_of(run, f"{next(iter(found))}.delay")
    found = {name: samples * _in(standing.unit_of(run, f"{name}.delay"), unit) for name, samples in found.items()}
    parts = {name: standing.observer_of(run, name) for name in found}
    titles, colours = standing.observers(run), part_colours(run)
    shared = Counter(parts.values())
    named = {name: titles[part] if part and shared[part] == 1 else name for name, part in parts.items()}
    inked = {name: colours[part] for name, part in parts.items() if part in colours}
    return Markup(figures.delays(found, unit, named, inked, "delays"))


def _in(unit: str, wanted: str) -> float:
    """What a value in one unit is multiplied by to be in another of its dimension."""
    return parse_unit(unit).factor / parse_unit(wanted).factor


def _detection_names(run: Run) -> list[str]:
    sampled = {name for case in run.cases for name in case.samples if name.endswith(".delay")}
    return [name for name in definitions(run) if f"{name}.delay" in sampled]


def _mean(cases: Iterable[Case], metric: str) -> float:
    values = [case.metrics[metric].value for case in cases if metric in case.metrics]
    return float(np.mean(values)) if values else math.nan


def _reached(value: float, row: standing.Standing) -> str:
    return "failed" if math.isinf(value) and row.failed else numbers.short(value)


def _ratio(row: standing.Standing, best: standing.Standing) -> str:
    usable = math.isfinite(row.median) and math.isfinite(best.median) and best.median > 0 and row.median > 0
    return f"{numbers.short(row.median / best.median, 3)}" if usable else "-"


def _script_json(plot: dict[str, Any] | None) -> Markup:
    return (
        Markup(json.dumps(plot, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")) if plot else Markup("")
    )
