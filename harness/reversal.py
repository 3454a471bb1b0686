"""How each part of a system is taken back within an instant, and why one cannot be.

A native part says it by `reversal`. A part written in Python offers two methods, each without arguments and result:
`keep` remembers the state it is in now, in place of what it remembered before, and `restore` goes back to it, as often
as wanted.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

from fmus.component import OK, Component, Reversal, Reversible
from fmus.fmu import FmuComponent
from harness.native import native_reversal

_Call = ctypes.CFUNCTYPE(None)


@runtime_checkable
class Rememberer(Protocol):
    """What a part written in Python offers to be taken back."""

    def keep(self) -> None:
        """Remember the state it is in now."""

    def restore(self) -> None:
        """Go back to the state remembered."""


class Raised(Protocol):
    """Who keeps what a part written in Python raised, since C cannot pass it on."""

    raised: BaseException | None


class WayBack(NamedTuple):
    """How a part is taken back, or None and the reason why not, in words.

    `held` is to be kept as long as C may call what `reversal` names.
    """

    reversal: Reversal | None
    reason: str = ""
    held: object = None


class _PythonPast(ctypes.Structure):
    _fields_ = [("keep", _Call), ("restore", _Call), ("status", ctypes.c_int64)]


def why_not(component: Component) -> str:
    """Why a component cannot be taken back, empty where it can; to be asked before its first step."""
    if isinstance(component, FmuComponent):
        proof = component.proof()
        return "" if proof.holds else proof.evidence
    if isinstance(component, (Reversible, Rememberer)):
        return ""
    return f"{type(component).__name__} has no methods keep and restore"


def reversal_of(component: Component, raises: Raised | None = None) -> WayBack:
    """How a component is taken back, to be asked after `start` and before the first step.

    What `keep` and `restore` of a part written in Python raise is put to `raises`; the status then is FATAL, as it is
    for its steps.
    """
    if isinstance(component, Reversible):
        reversal = component.reversal()
        return WayBack(reversal, "" if reversal else why_not(component) or "it says it cannot be")
    if component.native() is None and isinstance(component, Rememberer):
        state = _python_past(component, raises)
        return WayBack(native_reversal("crankbench_python_keep", "crankbench_python_restore", state), held=state)
    return WayBack(None, why_not(component) or "its steps are in C, and its methods keep and restore in Python")


def _python_past(component: Rememberer, raises: Raised | None) -> _PythonPast:
    def told(function: Callable[[], None]) -> Callable[[], None]:
        def call() -> None:
            try:
                function()
                state.status = OK
            except BaseException as error:
                if raises is not None:
                    raises.raised = error

        return call

    state = _PythonPast(_Call(told(component.keep)), _Call(told(component.restore)), OK)
    return state
