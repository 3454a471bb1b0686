"""What a campaign declares of one case: its parts and clock, the experiment's settings and the values on top."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fmus.units import UnitError, parse_quantity, parse_unit
from reports.folder import Case, Run
from reports.signals import same_dimension


def changed(run: Run, case: Case, prefix: str) -> dict[str, Any]:
    """What the experiment and the case set below a path like `clock.crank.`, by the rest of the path."""
    settings = {**settings_of(run, case), **case.values}
    return {path.removeprefix(prefix): value for path, value in settings.items() if path.startswith(prefix)}


def settings_of(run: Run, case: Case) -> Mapping[str, Any]:
    """What the experiment of a case sets, by path."""
    return _experiment(run, case).get("set") or {}


def part_of(run: Run, case: Case, name: str) -> Mapping[str, Any]:
    """A part as the campaign or the experiment declares it, with what is set of it; empty where there is none."""
    spec = {**(run.campaign.get("parts") or {}), **(_experiment(run, case).get("parts") or {})}.get(name)
    return {**spec, **changed(run, case, f"{name}.")} if isinstance(spec, Mapping) else {}


def crank_clock(run: Run, case: Case) -> Mapping[str, Any]:
    """The crank clock of a case as declared; empty where its clock is one of time."""
    clock = (run.campaign.get("clock") or {}).get("crank")
    return {**clock, **changed(run, case, "clock.crank.")} if isinstance(clock, Mapping) else {}


def si(raw: Any, unit: str) -> float | None:
    """A written quantity in SI; None where it is none of the dimension of `unit`."""
    if raw is None:
        return None
    try:
        number, written = parse_quantity(str(raw))
        return parse_unit(written or unit).to_si(number) if same_dimension(written or unit, unit) else None
    except UnitError:
        return None


def degrees(raw: Any) -> float | None:
    """A written angle in degrees, to the last bit where it is written in them; None where it is none."""
    try:
        number, unit = parse_quantity(str(raw))
        return number * (parse_unit(unit).factor / parse_unit("deg").factor) if same_dimension(unit, "deg") else None
    except UnitError:
        return None


def _experiment(run: Run, case: Case) -> Mapping[str, Any]:
    return (run.campaign.get("experiments") or {}).get(case.experiment) or {}
