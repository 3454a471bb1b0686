"""The C side of taking an FMU's instance back: what it needs of the library, and which derivatives it asks for."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Container
from ctypes import addressof, c_double, c_int, c_size_t, c_uint32, c_void_p
from typing import Any

from fmus.adapter import Adapter, Conversion, Place, address, scale, stepping_library
from fmus.clocks import EventMode
from fmus.component import Reversal
from fmus.exchange import Exchange


class _Past(ctypes.Structure):
    _fields_ = (
        *((name, c_void_p) for name in ("slave", "exchange", "event_mode")),
        ("version", c_int),
        *((name, c_void_p) for name in ("get_state", "set_state", "free_state", "state", "beside", "derive")),
        *((name, c_void_p) for name in ("knowns", "unknowns", "inputs", "outputs")),
        *((name, c_size_t) for name in ("n_knowns", "n_unknowns", "n_outputs")),
        *((name, c_void_p) for name in ("seed", "found")),
    )


class Past:
    """One kept state of the instance that an adapter steps, and the way back to it; from now on the FMU is told so.

    `function` gives the address of a function of the FMU's library by its name without the prefix.

    Raises ConfigurationError: the library lacks one.
    """

    def __init__(
        self, version: int, function: Callable[[str], int], adapter: Adapter, beside: Exchange | EventMode | None
    ) -> None:
        self._adapter, self._function = adapter, function
        word = "State" if version == 3 else "state"
        self._state = _Past(
            slave=adapter.self,
            exchange=beside.self if isinstance(beside, Exchange) else None,
            event_mode=beside.self if isinstance(beside, EventMode) else None,
            version=version,
            **{f"{name.lower()}_state": function(f"{name}FMU{word}") for name in ("Get", "Set", "Free")},
        )
        library = stepping_library()
        self._forget = library.fmu_forget
        self._forget.argtypes, self._forget.restype = (c_void_p,), None
        self._keep, self._restore, self._derive = library.fmu_keep, library.fmu_restore, library.fmu_derivative
        self._memory: list[Any] = []
        adapter.table.reversible = 1

    def reversal(self, knowns: Container[str] = (), unknowns: Container[str] = ()) -> Reversal:
        """What C calls; the derivatives are of the outputs named in `unknowns` by the inputs named in `knowns`.

        Other outputs and inputs count as without any. Where none is left on either side there is no derivative.
        """
        inputs = [place for place in self._adapter.carried if place[0].name in knowns]
        outputs = [place for place in self._adapter.fetched if place[0].name in unknowns]
        derivable = bool(inputs and outputs)
        if derivable:
            self._enter(inputs, outputs)
        derivative = address(self._derive) if derivable else 0
        return Reversal(address(self._keep), address(self._restore), derivative, addressof(self._state))

    def forget(self) -> None:
        """Free the state kept, as far as the status of the instance allows."""
        self._forget(addressof(self._state))

    def _enter(self, inputs: list[Place], outputs: list[Place]) -> None:
        state, self._memory = self._state, []

        def hold(array: Any) -> int:
            self._memory.append(array)
            return addressof(array)

        state.derive = self._function("GetDirectionalDerivative")
        for places, of, references, count, buffer in (
            (inputs, "inputs", "knowns", "n_knowns", "seed"),
            (outputs, "outputs", "unknowns", "n_unknowns", "found"),
        ):
            n = len(places)
            conversions = (Conversion * n)(*(Conversion(place, scale(v)[0], 0.0) for v, place in places))
            setattr(state, of, hold(conversions))
            setattr(state, references, hold((c_uint32 * n)(*(v.reference for v, _ in places))))
            setattr(state, buffer, hold((c_double * n)()))
            setattr(state, count, n)
        state.n_outputs = sum(v.size for v, _ in self._adapter.fetched)
