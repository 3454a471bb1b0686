"""The problems found so far, each at its key of the campaign file; and quantities read with them."""

from __future__ import annotations

from pathlib import Path

from fmus.component import Problem
from fmus.units import UnitError, parse_unit
from harness.places import KeyPath, Places
from harness.quantity import Measure


class Findings:
    """Collects problems. `at` gives the same collection one key deeper."""

    def __init__(self, places: Places, path: KeyPath = (), problems: list[Problem] | None = None) -> None:
        self.places, self.path = places, path
        self.problems: list[Problem] = [] if problems is None else problems

    def at(self, *keys: str | int) -> Findings:
        """The same collection, speaking of a deeper key."""
        return Findings(self.places, self.path + keys, self.problems)

    @property
    def name(self) -> str:
        """The key as messages have it: `encoder.noise.std`."""
        path = self.path[1:] if self.path[:1] == ("parts",) else self.path
        return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path).removeprefix(".")

    @property
    def folder(self) -> Path:
        """The folder that relative paths in the file start from."""
        return Path(self.places.file).parent

    def add(self, message: str) -> None:
        """Note a problem with this key, whose name leads the message."""
        self.tell(f"{self.name} {message}" if message.startswith("wants ") else f"{self.name}: {message}")

    def tell(self, message: str) -> None:
        """Note a problem at this key in words of its own."""
        self.problems.append(self.places.problem(message, *self.path))

    def value(self, measure: Measure, unit: str) -> float:
        """A measure in SI; 0 and a problem where it does not fit `unit`."""
        try:
            return measure.si(unit)
        except UnitError as error:
            self.add(str(error))
            return 0.0

    def difference(self, measure: Measure | None, unit: str) -> float:
        """A measure of a difference, like a deviation or a resolution, in SI: 0.5 degC is 0.5 K. None is 0."""
        if measure is None:
            return 0.0
        try:
            measure.si(unit)
            return parse_unit(measure.unit).factor * measure.value
        except UnitError as error:
            self.add(str(error))
            return 0.0
