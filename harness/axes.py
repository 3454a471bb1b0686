"""The axes of a campaign as numbers: which cases vary them, their values, and what is wrong with asking for one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, Protocol, TypeVar

from fmus.component import Problem
from fmus.model import unknown
from fmus.units import UnitError, parse_quantity, parse_unit
from harness.places import KeyPath, Places
from harness.reportaxes import AgainstAxis, Power
from harness.reportsection import ReportSection


class Varied(Protocol):
    """A case as far as its experiment and what was varied in it go."""

    @property
    def experiment(self) -> str:
        """The experiment it belongs to."""

    @property
    def values(self) -> Mapping[str, str]:
        """What was varied, by path, as text."""


AnyCase = TypeVar("AnyCase", bound=Varied)


class Numbers(NamedTuple):
    """The values of an axis in the cases that vary it, in the unit of the first of them."""

    unit: str
    values: list[float]


def covered(asked: AgainstAxis, cases: Iterable[AnyCase]) -> list[AnyCase]:
    """The cases that count: of its experiments, and with a value of every axis it asks for."""
    groups = [[path] for _, path, _ in asked.axes()] + ([asked.magnitudes] if isinstance(asked, Power) else [])
    return [
        case
        for case in cases
        if (not asked.experiments or case.experiment in asked.experiments)
        and all(any(path in case.values for path in group) for group in groups)
    ]


def numbers(path: str, cases: Iterable[Varied]) -> Numbers:
    """The values of an axis in cases that vary it. Raises UnitError: one is no number, or of another dimension."""
    unit, values = "", list[float]()
    for case in cases:
        value, written = _number(path, case.values[path])
        unit = unit if values else written
        values.append(_converted(path, value, written, unit))
    return Numbers(unit or "1", values)


def magnitudes(paths: Sequence[str], cases: Sequence[Varied]) -> Numbers:
    """The largest absolute value of those axes that each case varies. Raises UnitError, as `numbers` does."""
    unit, values = "", list[float]()
    for case in cases:
        found = [(path, *_number(path, case.values[path])) for path in paths if path in case.values]
        unit = unit if values else found[0][2]
        values.append(max(abs(_converted(path, value, written, unit)) for path, value, written in found))
    return Numbers(unit or "1", values)


def axis_problems(report: ReportSection, cases: Sequence[Varied], places: Places) -> Iterator[Problem]:
    """Axes that the report asks for and no case varies, or whose values are no numbers of one dimension."""
    for section, entries in report.against_axes().items():
        for index, asked in enumerate(entries):
            at: KeyPath = ("report", section, index)
            counted = [case for case in cases if not asked.experiments or case.experiment in asked.experiments]
            known = list(dict.fromkeys(path for case in counted for path in case.values))
            wanted = [*asked.axes(), *_magnitude_axes(asked)]
            for key, path, kind in wanted:
                if path not in known:
                    yield places.problem(f"report: {unknown(path, known, 'axis')}", *at, *key)
                elif kind == "numbers":
                    try:
                        numbers(path, [case for case in counted if path in case.values])
                    except UnitError as error:
                        yield places.problem(f"report: {error}", *at, *key)
            if all(path in known for _, path, _ in wanted):
                yield from _coverage_problems(asked, counted, places, at)


def _magnitude_axes(asked: AgainstAxis) -> Iterator[tuple[KeyPath, str, str]]:
    if isinstance(asked, Power):
        for index, path in enumerate(asked.magnitudes):
            yield ("magnitude", index), path, "numbers"


def _coverage_problems(asked: AgainstAxis, counted: Sequence[Varied], places: Places, at: KeyPath) -> Iterator[Problem]:
    """Experiments that are named and vary not all of the axes; or none that does."""
    paths = ", ".join(path for _, path, _ in [*asked.axes(), *_magnitude_axes(asked)])
    experiments = {case.experiment for case in covered(asked, counted)}
    for index, experiment in enumerate(asked.experiments):
        if experiment not in experiments:
            message = f"report: {experiment} wants to vary what is drawn against it: {paths}"
            yield places.problem(message, *at, "experiments", index)
    if not experiments and not asked.experiments:
        yield places.problem(f"report: no experiment varies all of {paths}", *at, "against")


def _number(path: str, text: str) -> tuple[float, str]:
    try:
        return parse_quantity(text)
    except UnitError:
        raise UnitError(f"{path} wants to be an axis of numbers, got '{text}'") from None


def _converted(path: str, value: float, written: str, unit: str) -> float:
    source, target = parse_unit(written), parse_unit(unit)
    if not source.same_dimension(target):
        raise UnitError(f"{path} wants values in {unit or '1'} or alike, got {value:g} {written}".rstrip())
    return value if written == unit else target.from_si(source.to_si(value))
