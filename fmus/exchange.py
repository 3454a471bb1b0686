"""Model Exchange: an FMU's derivatives integrated by CVODE between communication points, its events handled."""

from __future__ import annotations

import ctypes
import importlib.util
import math
from collections.abc import Callable, Mapping, Sequence
from ctypes import POINTER, addressof, c_char, c_double, c_int, c_int64, c_long, c_size_t, c_ubyte, c_void_p
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from fmus.adapter import Adapter, address, stepping_library
from fmus.clocks import Clock, ClockTable
from fmus.component import ConfigurationError, Native, Problem, Vector
from fmus.model import unknown
from fmus.toolchain import FMI3_PLATFORMS, library_suffix, native_platform

Method = Literal["bdf", "adams"]
_METHODS: Mapping[Method, int] = {"adams": 1, "bdf": 2}
# The functions of SUNDIALS by the fields of the struct Solver in exchange.c, and the library each lies in.
_SOLVER = {
    "context_create": ("core", "SUNContext_Create"),
    "clear_error_handlers": ("core", "SUNContext_ClearErrHandlers"),
    "push_error_handler": ("core", "SUNContext_PushErrHandler"),
    "context_free": ("core", "SUNContext_Free"),
    "vector_new": ("nvecserial", "N_VNew_Serial"),
    "vector_data": ("core", "N_VGetArrayPointer"),
    "vector_destroy": ("core", "N_VDestroy"),
    "matrix_new": ("sunmatrixdense", "SUNDenseMatrix"),
    "matrix_destroy": ("core", "SUNMatDestroy"),
    "linear_solver_new": ("sunlinsoldense", "SUNLinSol_Dense"),
    "linear_solver_free": ("core", "SUNLinSolFree"),
    "create": ("cvode", "CVodeCreate"),
    "init": ("cvode", "CVodeInit"),
    "reinit": ("cvode", "CVodeReInit"),
    "tolerances": ("cvode", "CVodeSVtolerances"),
    "root_init": ("cvode", "CVodeRootInit"),
    "set_linear_solver": ("cvode", "CVodeSetLinearSolver"),
    "set_user_data": ("cvode", "CVodeSetUserData"),
    "set_max_step": ("cvode", "CVodeSetMaxStep"),
    "set_stop_time": ("cvode", "CVodeSetStopTime"),
    "no_inactive_root_warning": ("cvode", "CVodeSetNoInactiveRootWarn"),
    "solve": ("cvode", "CVode"),
    "destroy": ("cvode", "CVodeFree"),
}
# The functions of the standards by the fields of the struct Exchange, where they go by one name in all versions.
_COMMON = {"set_time": "SetTime", "set_states": "SetContinuousStates", "get_states": "GetContinuousStates"}
_BY_VERSION: Mapping[int, Mapping[str, str]] = {
    1: {
        "get_derivatives": "GetDerivatives",
        "get_nominals": "GetNominalContinuousStates",
        "update_states": "EventUpdate",
        "initialise": "Initialize",
    },
    2: {
        "get_derivatives": "GetDerivatives",
        "get_nominals": "GetNominalsOfContinuousStates",
        "enter_event_mode": "EnterEventMode",
        "update_states": "NewDiscreteStates",
        "enter_continuous_mode": "EnterContinuousTimeMode",
    },
    3: {
        "get_derivatives": "GetContinuousStateDerivatives",
        "get_nominals": "GetNominalsOfContinuousStates",
        "enter_event_mode": "EnterEventMode",
        "update_states": "UpdateDiscreteStates",
        "enter_continuous_mode": "EnterContinuousTimeMode",
    },
}


@dataclass(frozen=True)
class Stepping:
    """How the states of a Model Exchange FMU are integrated.

    CVODE with variable order and step, by backward differences (`bdf`, also for stiff models) or by Adams' formulas.
    `tolerance` is relative, and for each state absolute after multiplication with its nominal value. `step` [s] bounds
    the steps of the solver; infinite, it leaves them to their error.
    """

    method: Method = "bdf"
    tolerance: float = 1e-6
    step: float = math.inf


def read_stepping(settings: Mapping[str, Any]) -> Stepping:
    """Stepping from settings named `solver.method`, `solver.tolerance`, `solver.step` [s], the names not prefixed.

    Raises ConfigurationError: there is no such setting, or it cannot have that value; all such problems at once.
    """
    problems = [
        Problem(unknown(f"solver.{name}", [f"solver.{known}" for known in Stepping.__dataclass_fields__], "setting"))
        for name in settings
        if name not in Stepping.__dataclass_fields__
    ]
    method = settings.get("method", "bdf")
    if method not in _METHODS:
        problems.append(Problem(f"solver.method wants one of {', '.join(_METHODS)}, got {method!r}"))
    for name, bound in (("tolerance", 1.0), ("step", math.inf)):
        value = settings.get(name)
        if value is not None and not (isinstance(value, (int, float)) and 0.0 < value < bound):
            problems.append(Problem(f"solver.{name} wants a number above 0 and below {bound:g}, got {value!r}"))
    if problems:
        raise ConfigurationError(problems)
    return Stepping(**settings)


class _Solver(ctypes.Structure):
    _fields_ = tuple((name, c_void_p) for name in _SOLVER)


class _Exchange(ctypes.Structure):
    _fields_ = (
        ("slave", c_void_p),
        ("solver", POINTER(_Solver)),
        ("version", c_int),
        ("method", c_int),
        ("tolerance", c_double),
        ("max_step", c_double),
        ("states", c_size_t),
        ("indicators", c_size_t),
        *((name, c_void_p) for name in (*_COMMON, "get_derivatives", "get_indicators", "get_nominals")),
        *((name, c_void_p) for name in ("completed_step", "enter_event_mode", "update_states")),
        *((name, c_void_p) for name in ("enter_continuous_mode", "initialise")),
        ("clocks", ClockTable),
        ("last_inputs", c_void_p),
        ("inputs", c_size_t),
        ("values", c_void_p),
        ("domains", c_void_p),
        *((name, c_void_p) for name in ("context", "vector", "tolerances", "matrix", "linear", "memory")),
        *((name, c_double) for name in ("time", "next_event", "last_event")),
        *((name, c_int) for name in ("next_event_defined", "restart", "status", "not_finite")),
        ("crowd", c_long),
        ("events", c_int64),
        ("steps", c_int64),
        ("complaint", c_char * 256),
    )


def solver_missing() -> str:
    """Why Model Exchange cannot be stepped here; empty where it can."""
    try:
        _solver()
    except ConfigurationError as error:
        return str(error)
    return ""


@cache
def _solver() -> _Solver:
    """The functions of SUNDIALS. Raises ConfigurationError: FMPy brings none for this platform."""
    specification = importlib.util.find_spec("fmpy")
    assert specification is not None and specification.origin is not None
    platform = FMI3_PLATFORMS.get(native_platform(), native_platform())
    folder = Path(specification.origin).parent / "sundials" / platform
    libraries = {}
    for part in ("core", "nvecserial", "sunmatrixdense", "sunlinsoldense", "cvode"):
        path = folder / f"sundials_{part}{library_suffix()}"
        try:
            libraries[part] = ctypes.CDLL(str(path))
        except OSError as error:
            raise ConfigurationError(
                f"Model Exchange is stepped by the CVODE that comes with FMPy, which has none for {platform}"
            ) from error
    return _Solver(**{field: address(getattr(libraries[part], name)) for field, (part, name) in _SOLVER.items()})


class Exchange:
    """The C side of Model Exchange for one instance: its solver, where it stands, and its next event.

    `function` gives the address of a function of the FMU's library by its name without the prefix.

    Raises ConfigurationError: a function is missing, or the solver.
    """

    def __init__(
        self,
        version: int,
        function: Callable[[str], int],
        adapter: Adapter,
        stepping: Stepping,
        clocks: Sequence[Clock],
        completes: bool,
    ) -> None:
        names = {**_COMMON, **_BY_VERSION[version], "get_indicators": "GetEventIndicators"}
        if completes:
            names["completed_step"] = "CompletedIntegratorStep"
        self._state = _Exchange(
            slave=adapter.self,
            solver=ctypes.pointer(_solver()),
            version=version,
            method=_METHODS[stepping.method],
            tolerance=stepping.tolerance,
            max_step=stepping.step if math.isfinite(stepping.step) else 0.0,
            **{field: function(name) for field, name in names.items()},
        )
        self._kept = self._state.clocks.fill(clocks, function)
        library = stepping_library()
        self._start, self._release = library.exchange_start, library.exchange_release
        self._start.argtypes, self._release.argtypes = (c_void_p, c_double, c_void_p, c_void_p), (c_void_p,)
        self._release.restype = None
        self.step = library.exchange_step
        self.step.argtypes = (c_void_p, c_double, c_double, c_void_p, c_void_p)
        self.self = addressof(self._state)

    def start(self, t0: float, states: int, indicators: int, u: Vector, y: Vector) -> int:
        """From event mode after initialisation to continuous time at t0 [s]: the status; outputs are put into y.

        `states` and `indicators` are the numbers of continuous states and event indicators; of FMI 1 the FMU is
        initialised too.
        """
        self._u, self._z, self._domains = (
            (c_double * max(len(u), 1))(),
            (c_double * max(indicators, 1))(),
            (c_ubyte * max(indicators, 1))(),
        )
        self._state.states, self._state.indicators, self._state.inputs = states, indicators, len(u)
        self._state.last_inputs = addressof(self._u)
        self._state.values, self._state.domains = addressof(self._z), addressof(self._domains)
        return int(self._start(self.self, t0, u.ctypes.data, y.ctypes.data))

    def native(self) -> Native:
        """The step and what it works on."""
        return Native(address(self.step), self.self)

    @property
    def events(self) -> int:
        """How many events were handled since the start, the initial one included."""
        return int(self._state.events)

    @property
    def steps(self) -> int:
        """How many steps the solver made since the start."""
        return int(self._state.steps)

    def release(self) -> None:
        """Let go of the solver's memory."""
        self._release(self.self)
