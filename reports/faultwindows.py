"""When faults act in a case: as its record tells, else as the campaign declares them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from reports.declared import changed, settings_of, si
from reports.folder import Case, Run
from reports.signals import Steps, read_fault_signals


@dataclass(frozen=True)
class Window:
    """A stretch in which a fault is active: of time [s], or of what the figure is drawn over."""

    label: str
    since: float
    until: float


def labelled(windows: Sequence[Window]) -> list[tuple[int, Window]]:
    """The first window of each label, numbered from 0: labels stand one below the other, so that none hides another."""
    first: dict[str, Window] = {}
    for window in windows:
        first.setdefault(window.label, window)
    return list(enumerate(first.values()))


def fault_windows(run: Run, case: Case, begin: float, stop: float) -> tuple[Window, ...]:
    """When faults act between two times [s]: as recorded, else as the campaign declares and the case overrides them."""
    signals = read_fault_signals(run, case)
    windows = list(_recorded_windows(signals, begin, stop))
    told = {name.partition(".")[0] for name in signals}
    for part, spec in (run.campaign.get("parts") or {}).items():
        if part in told:
            continue
        declared = spec.get("faults") if isinstance(spec, Mapping) else None
        for index, fault in enumerate(_overridden(run, case, f"{part}.faults", declared or [])):
            settings = {key: value for key, value in fault.items() if value is not None}
            settings |= changed(run, case, f"{part}.faults.{index}.")
            since, until = (si(settings.pop(key, None), "s") for key in ("from", "to"))
            settings.pop("code", None)
            kind = ", ".join(key if value is True else f"{key} {value}" for key, value in settings.items())
            if since is not None and since < stop:
                windows.append(Window(f"{part}: {kind}", since, stop if until is None else min(until, stop)))
    return tuple(sorted(windows, key=lambda window: window.since))


def _recorded_windows(signals: Mapping[str, Steps], begin: float, stop: float) -> Iterator[Window]:
    """The stretches in which a fault signal stays at one code, each from its first row to the first row after it."""
    for name, steps in signals.items():
        meanings = dict(item.split(": ", 1) for item in steps.column.description.split("; ")[1:])
        stretches = zip(pairwise(steps.edges.tolist()), steps.column.values, strict=True)
        for (since, until), code in stretches:
            if code and since < stop and until > begin:
                meaning = meanings.get(f"{code:g}", f"fault {code:g}")
                yield Window(f"{name.partition('.')[0]}: {meaning}", max(since, begin), min(until, stop))


def _overridden(run: Run, case: Case, path: str, declared: Any) -> list[Mapping[str, Any]]:
    value = settings_of(run, case).get(path, declared)
    return [fault for fault in value if isinstance(fault, Mapping)] if isinstance(value, list) else []
