"""The modelling language: a model is its declared signals and a few functions written with NumPy.

The same functions run on floats (the Python source as its own oracle) and on symbols (the
exporter traces them into C), so they use NumPy functions and `np.where` instead of `math.*`
and `if`. Values inside the functions are in the units the signals declare.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from fmus.component import Role, Signal

Equations = Callable[[Any, "Values", "Values", "Values", "Values"], tuple[Mapping[str, Any], Mapping[str, Any]]]
Named = Callable[[Any, "Values", "Values", "Values", "Values"], Mapping[str, Any]]
Arguments = tuple["Values", "Values", "Values", "Values"]
Transition = Callable[[Any, "Values", "Values", "Values", "Values", "Values"], Mapping[str, Any]]


class ModelError(ValueError):
    """A model that contradicts its own declarations, or that cannot be traced."""


class Values:
    """Values of the declared signals by name: `x.omega_c`, or `p["gain[1,2]"]` for a scalar of an array."""

    __slots__ = ("_kind", "_values")

    def __init__(self, signals: Sequence[Signal], flat: Sequence[Any], kind: str) -> None:
        self._kind = kind
        self._values: dict[str, Any] = {}
        offset = 0
        for signal in signals:
            if not signal.shape:
                self._values[signal.name] = flat[offset]
                offset += 1
                continue
            scalars = flat[offset : offset + signal.size]
            offset += signal.size
            self._values.update(zip(signal.scalar_names(), scalars, strict=True))
            array = np.empty(signal.size, dtype=object)
            array[:] = scalars
            if all(isinstance(value, float) for value in scalars):
                array = array.astype(float)
            self._values[signal.name] = array.reshape(signal.shape)

    def __getitem__(self, name: str) -> Any:
        try:
            return self._values[name]
        except KeyError:
            raise ModelError(unknown(name, self._values, self._kind)) from None

    def __getattr__(self, name: str) -> Any:
        return self[name]


def unknown(name: str, known: Iterable[str], kind: str) -> str:
    """The message for a name nobody declared, with the nearest declared one."""
    names = list(known)
    nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.0)
    hint = f"; did you mean '{nearest[0]}'?" if nearest else ""
    return f"no {kind} is named '{name}'{hint}"


def _nothing(t: Any, x: Values, m: Values, u: Values, p: Values) -> Mapping[str, Any]:
    return {}


@dataclass(frozen=True)
class Kernel:
    """`sample` in C, for loops over matrices that would be too long as unrolled expressions; its twin is in NumPy.

    `source` is C text that stands after fmus/runtime/solve.c and defines

        static int kernel_sample(Instance *instance, double *xn, double *mn)

    which gives all of x+ and m+ and returns OK, or what `fail` returns. It may call what the runtime has, and for each
    of `functions`, written as `sample` is but with whatever results: model_NAME, its scalars in order, and
    model_NAME_jacobian, their derivatives by x, row-major, both with the arguments of model_derivatives.
    Each new value is taken to depend on every state and input.
    """

    source: str
    functions: Mapping[str, Named] = field(default_factory=dict)


@dataclass(frozen=True)
class Model:
    """A plant, observer or controller in equations.

    x' = f(t, x, m, u, p),  y = g(t, x, m, u, p)            `equations` returns (x', y) by name
    z  = h(t, x, m, u, p)                                   `indicators`: an event where one crosses zero
    (m+, x+) = transition(t, x, m, u, p, above)             after an event and at initialisation
    m+ = sample(t, x, m, u, p)  at t = k `sample_time`      discrete-time part

    x are `states`, m `discrete` states (constant between events), u `inputs`, y `outputs`,
    p `parameters`. `above.name` is 1 where the indicator is positive and 0 where it is negative;
    at z = 0 the sign of dz/dt decides. `transition` and `sample` return only what changes.
    A sampled model updates at the end of a step with that step's inputs, so an estimate in m is
    x(k|k). `sample_time` names the parameter that holds the period, in s; a period of 0 stands for each communication
    step, as on a clock in crank angle, and is for Co-Simulation only.
    A model whose sampling is too long to be traced gives a `kernel`, too: the exported FMU runs that.
    Discrete states that `transition` assigns are computed at initialisation; others begin at
    their start value. The solver settings are the exported FMU's defaults.
    """

    name: str
    description: str
    equations: Equations
    role: Role = "plant"
    inputs: tuple[Signal, ...] = ()
    states: tuple[Signal, ...] = ()
    outputs: tuple[Signal, ...] = ()
    parameters: tuple[Signal, ...] = ()
    discrete: tuple[Signal, ...] = ()
    indicator_names: tuple[str, ...] = ()
    indicators: Named = _nothing
    transition: Transition | None = None
    sample: Named | None = None
    sample_time: str = ""
    kernel: Kernel | None = None
    parameter_sets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    solver_method: Literal["rk4", "rodas4"] = "rk4"
    solver_step: float = 1e-3  # s
    solver_tolerance: float = 0.0  # 1, RODAS4 only; 0 fixes the step

    def __post_init__(self) -> None:
        seen: set[str] = set()
        for signal in self.signals:
            if signal.name in seen or signal.name == "time":
                raise ModelError(f"{self.name}: '{signal.name}' is declared twice")
            seen.add(signal.name)
        if (self.sample is None) != (not self.sample_time):
            raise ModelError(f"{self.name}: sample and sample_time go together")
        if self.kernel is not None and self.sample is None:
            raise ModelError(f"{self.name}: a kernel wants its twin, sample")
        if self.sample_time:
            period = next((signal for signal in self.parameters if signal.name == self.sample_time), None)
            if period is None:
                raise ModelError(f"{self.name}: sample_time names no parameter: '{self.sample_time}'")
            if period.unit != "s" or period.shape:
                raise ModelError(f"{self.name}: '{period.name}' is the sample time and wants to be a scalar in s")
        for name, values in self.parameter_sets.items():
            for key in values:
                if key not in {signal.name for signal in self.parameters}:
                    known = [signal.name for signal in self.parameters]
                    raise ModelError(f"{self.name}, set {name}: {unknown(key, known, 'parameter')}")

    @property
    def signals(self) -> tuple[Signal, ...]:
        """All declared signals."""
        return self.states + self.discrete + self.inputs + self.outputs + self.parameters


class FlatModel:
    """The functions of a model on flat vectors, for floats and symbols alike.

    x, m, u, p are sequences of scalars in declared order, arrays row-major.
    """

    def __init__(self, model: Model) -> None:
        self.model = model

    def _values(self, x: Sequence[Any], m: Sequence[Any], u: Sequence[Any], p: Sequence[Any]) -> Arguments:
        model = self.model
        return (
            Values(model.states, x, "state"),
            Values(model.discrete, m, "discrete state"),
            Values(model.inputs, u, "input"),
            Values(model.parameters, p, "parameter"),
        )

    def _flatten(self, signals: Sequence[Signal], values: Mapping[str, Any], kind: str) -> list[Any]:
        declared = [signal.name for signal in signals]
        for name in values:
            if name not in declared:
                raise ModelError(f"{self.model.name}: {unknown(name, declared, kind)}")
        flat: list[Any] = []
        for signal in signals:
            if signal.name not in values:
                raise ModelError(f"{self.model.name}: the equations give no {kind} '{signal.name}'")
            flat += _scalars(signal, values[signal.name])
        return flat

    def derivatives_and_outputs(self, t: Any, x: Any, m: Any, u: Any, p: Any) -> tuple[list[Any], list[Any]]:
        """x' (nx scalars) and y (ny scalars)."""
        derivatives, outputs = self.model.equations(t, *self._values(x, m, u, p))
        return (
            self._flatten(self.model.states, derivatives, "derivative of the state"),
            self._flatten(self.model.outputs, outputs, "output"),
        )

    def indicators(self, t: Any, x: Any, m: Any, u: Any, p: Any) -> list[Any]:
        """z, in the order of `indicator_names`."""
        values = self.model.indicators(t, *self._values(x, m, u, p))
        return self._flatten([Signal(name) for name in self.model.indicator_names], values, "event indicator")

    def transition(self, t: Any, x: Any, m: Any, u: Any, p: Any, above: Any) -> tuple[list[Any], list[Any]]:
        """x+ and m+ after an event; what the model does not mention is unchanged."""
        if self.model.transition is None:
            return list(x), list(m)
        signs = Values([Signal(name) for name in self.model.indicator_names], above, "event indicator")
        values = self.model.transition(t, *self._values(x, m, u, p), signs)
        return self._update(values, x, m)

    def sample(self, t: Any, x: Any, m: Any, u: Any, p: Any) -> tuple[list[Any], list[Any]]:
        """x+ and m+ after a sampling instant; what the model does not mention is unchanged."""
        if self.model.sample is None:
            return list(x), list(m)
        return self._update(self.model.sample(t, *self._values(x, m, u, p)), x, m)

    def kernel_function(self, name: str, t: Any, x: Any, m: Any, u: Any, p: Any) -> list[Any]:
        """The scalars of one of the functions that the kernel calls, in the order they are given."""
        assert self.model.kernel is not None, "asked of models with a kernel only"
        values = self.model.kernel.functions[name](t, *self._values(x, m, u, p))
        return [scalar for value in values.values() for scalar in np.asarray(value, dtype=object).ravel()]

    def _update(self, values: Mapping[str, Any], x: Any, m: Any) -> tuple[list[Any], list[Any]]:
        model = self.model
        declared = [signal.name for signal in model.states + model.discrete]
        for name in values:
            if name not in declared:
                raise ModelError(f"{model.name}: {unknown(name, declared, 'state or discrete state')}")
        updated = []
        for signals, old in ((model.states, x), (model.discrete, m)):
            new = list(old)
            offset = 0
            for signal in signals:
                if signal.name in values:
                    new[offset : offset + signal.size] = _scalars(signal, values[signal.name])
                offset += signal.size
            updated.append(new)
        return updated[0], updated[1]


def _scalars(signal: Signal, value: Any) -> list[Any]:
    if not signal.shape:
        return [value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value]
    array = np.asarray(value, dtype=object)
    if array.shape != signal.shape:
        raise ModelError(f"'{signal.name}' wants shape {signal.shape}, got {array.shape}")
    return list(array.ravel())
