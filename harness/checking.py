"""Puts every probe to an FMU, in processes that may crash, hang or eat memory, and says what was found."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from fmus import probe
from fmus.component import ConfigurationError
from fmus.description import FmuKind, Validation, describe
from fmus.interview import Answer, Subject, subject
from harness.worker import Limits, Outcome, Worker

# A probe is given at most so many seconds' worth of steps, by the median step measured first.
BUDGET = 1.0
FEWEST_STEPS = 4


class Question(NamedTuple):
    """A probe, what it is called, and the capability it stands for; empty where every FMU must pass it."""

    name: str
    ask: Callable[..., Answer]
    capability: str = ""


FIRST = Question("load", probe.load)
PACE = Question("timing", probe.pace)
RUN = Question("deterministic", probe.trajectory)
WRITTEN = Question("serialise", probe.serialise, "canSerializeFMUstate")
QUESTIONS = (
    Question("finite", probe.finite),
    RUN,
    Question("instantiate_twice", probe.instantiate_twice),
    Question("reset", probe.reset),
    Question("rollback", probe.rollback, "canGetAndSetFMUstate"),
    WRITTEN,
    Question("serialise_new_process", probe.serialise_elsewhere, "canSerializeFMUstate"),
    Question("directional_derivative", probe.directional_derivative, "providesDirectionalDerivative"),
    Question("adjoint_derivative", probe.adjoint_derivative, "providesAdjointDerivatives"),
    Question("variable_step", probe.variable_step, "canHandleVariableCommunicationStepSize"),
)
KINDS: tuple[FmuKind, ...] = ("cs", "me")
NAMES = (FIRST.name, PACE.name, *(question.name for question in QUESTIONS), "flags")


@dataclass(frozen=True)
class Probed:
    """What came of a probe: `passed` is None where it does not apply; `declared` is what the FMU's flag says of it.

    `kind` is how the FMU was run. An FMU of two kinds is asked in both; the second kind's names have it in front.
    """

    name: str
    passed: bool | None
    evidence: str
    declared: bool | None = None
    observed: bool | None = None
    kind: str = ""


@dataclass(frozen=True)
class Checked:
    """An FMU as it was checked. `about` is its description; `unreadable` says why there is none."""

    fmu: str
    runnable: bool
    reasons: tuple[str, ...]
    probes: tuple[Probed, ...] = ()
    about: Mapping[str, Any] = field(default_factory=dict)
    unreadable: bool = False

    @property
    def failed(self) -> list[str]:
        """Names of the probes that it failed."""
        return [found.name for found in self.probes if found.passed is False]

    def to_json(self) -> dict[str, Any]:
        """As `crankbench check --json` prints it."""
        about = {key: value for key, value in self.about.items() if key not in ("variables", "capabilities")}
        return {**about, **{key: value for key, value in asdict(self).items() if key != "about"}}


def check(
    path: Path, seconds: float, validation: Validation = "warn", stopped: Callable[[], bool] = lambda: False
) -> Checked:
    """What becomes of each probe put to the FMU at `path`, each within so many seconds of wall time [s].

    What cannot be read or run here is `runnable: false` with the reasons; nothing is raised for it. Raises
    InterruptedError where `stopped` became true meanwhile; no process is left then.
    """
    worker = Worker()
    try:
        return _Check(worker, Limits(seconds, seconds), path, validation, stopped).all()
    finally:
        worker.close()


def described(path: Path, validation: Validation) -> dict[str, Any]:
    """The FMU's description as `crankbench inspect --json` has it."""
    return describe(path, validation).to_json()


def capabilities_as(path: Path, validation: Validation, kind: FmuKind) -> tuple[Mapping[str, Any], Subject]:
    """What an FMU declares of itself in a kind, and how it is to be stepped."""
    return describe(path, validation).run_as(kind).capabilities, subject(path, validation, kind)


class _Check:
    """The course of one check; a probe that did not pass leaves no process for the next."""

    def __init__(
        self, worker: Worker, limits: Limits, path: Path, validation: Validation, stopped: Callable[[], bool]
    ) -> None:
        self._worker, self._limits, self._path, self._validation = worker, limits, path, validation
        self._stopped = stopped
        self._kept: dict[str, bytes] = {}
        self._capabilities: Mapping[str, Any] = {}

    def all(self) -> Checked:
        """The whole check."""
        read = self._call(described, self._path, self._validation)
        if read.kind != "result":
            return Checked(str(self._path), False, _reasons(read, self._path), unreadable=True)
        self._about: dict[str, Any] = read.value
        runnable, reasons = bool(self._about["runnable"]), tuple(self._about["reasons"])
        if not runnable:
            untried = tuple(Probed(name, None, "not asked: it cannot be run here") for name in NAMES)
            return Checked(str(self._path), False, reasons, untried, self._about)
        found: list[Probed] = []
        for kind in (kind for kind in KINDS if kind in self._about["kinds"]):
            head = f"{kind}_" if found else ""
            found += [replace(one, name=head + one.name, kind=kind) for one in self._run_as(kind)]
        return Checked(str(self._path), True, reasons, tuple(found), self._about)

    def _run_as(self, kind: FmuKind) -> list[Probed]:
        """Every probe in one kind."""
        read = self._call(capabilities_as, self._path, self._validation, kind)
        if read.kind != "result":
            return [Probed(FIRST.name, False, _failure(read))]
        self._capabilities, subject = read.value
        found = [self._put(FIRST, subject)]
        if not found[0].passed:
            return found + [Probed(name, None, "not asked: it does not start") for name in NAMES[1:]]
        found.append(self._put(PACE, subject))
        subject = self._affordable(subject)
        found += [self._put(question, subject) for question in QUESTIONS]
        return [*found, flags(found)]

    def _put(self, question: Question, subject: Subject) -> Probed:
        declared = self._declared(question)
        if question.ask is probe.serialise_elsewhere:
            self._worker.close()
            if not self._kept.get(WRITTEN.name):
                return Probed(question.name, None, "there is no state in bytes to restore", declared)
            outcome = self._call(question.ask, subject, self._kept[WRITTEN.name])
        else:
            outcome = self._call(question.ask, subject)
        answer: Answer = outcome.value if outcome.kind == "result" else Answer(False, _failure(outcome))
        if question is RUN and answer.passed:
            answer = self._elsewhere(answer, subject)
        if answer.passed is not True:
            self._worker.close()
        self._kept[question.name] = answer.kept
        if declared is False and question.capability and answer.passed is not None:
            told = "not declared, works all the same" if answer.passed else "not declared, and does not work"
            return Probed(question.name, None, f"{told}: {answer.evidence}", declared, answer.passed)
        return Probed(question.name, answer.passed, answer.evidence, declared, answer.passed)

    def _elsewhere(self, answer: Answer, subject: Subject) -> Answer:
        """The answer to the same runs in another process."""
        self._worker.close()
        outcome = self._call(probe.trajectory, subject)
        if outcome.kind != "result":
            return Answer(False, f"a run in another process: {_failure(outcome)}")
        if outcome.value.kept != answer.kept:
            return Answer(False, f"{answer.evidence}, but a run in another process differs from them")
        return answer._replace(evidence=f"{answer.evidence}, and with one in another process")

    def _affordable(self, subject: Subject) -> Subject:
        """The subject with as many steps as a probe has time for."""
        step = float(self._kept[PACE.name] or BUDGET)
        return replace(subject, steps=max(FEWEST_STEPS, min(subject.steps, int(BUDGET / max(step, 1e-9)))))

    def _declared(self, question: Question) -> bool | None:
        value = self._capabilities.get(question.capability)
        return None if not question.capability or value is None else bool(value)

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Outcome:
        return self._worker.call(function, *arguments, limits=self._limits, stopped=self._stopped)


def flags(found: list[Probed]) -> Probed:
    """The probe of the flags: does the FMU do what it declares? What it does undeclared is told, and no failure."""
    told, broken = [], []
    for one in found:
        if one.declared is None:
            continue
        seen = {True: "works", False: "does not work", None: "not seen"}[one.observed]
        told.append(f"{one.name} {'declared' if one.declared else 'not declared'}, {seen}")
        if one.declared and one.observed is False:
            broken.append(one.name)
    if not told:
        return Probed("flags", None, "it declares no capability that is probed")
    return Probed("flags", not broken, "; ".join(told))


def _reasons(outcome: Outcome, path: Path) -> tuple[str, ...]:
    if isinstance(outcome.error, ConfigurationError):
        return tuple(str(problem).removeprefix(f"{path}: ") for problem in outcome.error.problems)
    return (f"reading it: {_failure(outcome)}",)


def _failure(outcome: Outcome) -> str:
    """What ended a call that gave no result, in one line."""
    if outcome.kind == "error":
        return str(outcome.error) or type(outcome.error).__name__
    doing = f" while it was doing {outcome.stage}" if outcome.stage else ""
    said = outcome.output.partition("Fatal Python error:")[0].strip().splitlines()
    return f"{outcome.kind}{doing}: {outcome.message}" + (f"; it printed: {said[-1][:200]}" if said else "")
