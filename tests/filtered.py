"""Observers stepped as FMUs by signal name, and the small plants that they are tried on."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fmus.component import Signal
from fmus.export import cached_fmu
from fmus.fmu import FmuComponent, load_fmu
from fmus.model import FlatModel, Model
from fmus.units import parse_unit

# A damped mass on a spring that is pushed and drifts: x' = v, v' = -4 x - 0.5 v + d + push, d' = -0.1 d.
SPRING = Model(
    name="spring",
    description="a damped mass on a spring, with a force that drifts",
    equations=lambda t, x, m, u, p: (
        {"x": x.v, "v": -p.k * x.x - 0.5 * x.v + x.d + u.push, "d": -0.1 * x.d},
        {"gauge": x.v + 0.5 * x.d, "energy": 0.5 * x.v**2},
    ),
    inputs=(Signal("push", "m/s2"),),
    states=(Signal("x", "m", nominal=2.0), Signal("v", "m/s", nominal=0.5), Signal("d", "m/s2", nominal=0.1)),
    outputs=(Signal("gauge", "m/s"), Signal("energy", "m2/s2")),
    parameters=(Signal("k", "1/s2", 4.0),),
)
SPRING_A = np.array([[0.0, 1.0, 0.0], [-4.0, -0.5, 1.0], [0.0, 0.0, -0.1]])
SPRING_C = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.5]])

# A tank that drains through an orifice into one that leaks, h = level: h' = q - c sqrt(h).
TANKS = Model(
    name="tanks",
    description="two tanks, the one draining into the other",
    equations=lambda t, x, m, u, p: (
        {
            "upper": u.q - p.c * np.sqrt(np.maximum(x.upper, 1e-6)),
            "lower": p.c * np.sqrt(np.maximum(x.upper, 1e-6)) - p.c * np.sqrt(np.maximum(x.lower, 1e-6)),
        },
        {"outflow": p.c * np.sqrt(np.maximum(x.lower, 1e-6))},
    ),
    inputs=(Signal("q", "m/s", 0.1, minimum=0.0, maximum=0.3),),
    states=(Signal("upper", "m", 1.0), Signal("lower", "m", 1.0)),
    outputs=(Signal("outflow", "m/s"),),
    parameters=(Signal("c", "1", 0.1),),
)

# A position that only its speed is measured of, and a temperature in degrees.
CART = Model(
    name="cart",
    description="a cart with a motor that grows warm",
    equations=lambda t, x, m, u, p: ({"place": x.speed, "speed": u.push, "heat": 0.1 * (20.0 - x.heat)}, {}),
    inputs=(Signal("push", "m/s2"),),
    states=(Signal("place", "m"), Signal("speed", "m/s"), Signal("heat", "degC", 20.0, nominal=10.0)),
)


class Filter:
    """The FMU of a model in steps of h [s]; values by name, in the model's units."""

    def __init__(self, model: Model, h: float, fmi: int = 2, **starts: float) -> None:
        self.model, self.h = model, h
        self.component: FmuComponent = load_fmu(cached_fmu(model, fmi), starts=starts, name=model.name)
        self.names = [signal.name for signal in self.component.outputs]
        declared = (*model.states, *model.discrete, *model.outputs)
        units = {name: signal.unit for signal in declared for name in signal.scalar_names()}
        self.units = [parse_unit(units[name]) for name in self.names]
        self.input_units = [parse_unit(signal.unit) for signal in model.inputs]
        self.start()

    def start(self) -> dict[str, float]:
        """Begin anew at 0 s with the inputs' start values."""
        self.k = 0
        return self._read(self.component.start(0.0, self._inputs({})))

    def __call__(self, **inputs: float) -> dict[str, float]:
        y = self.component.step(self.k * self.h, self.h, self._inputs(inputs))
        self.k += 1
        return self._read(y)

    def _inputs(self, given: Mapping[str, float]) -> np.ndarray:
        values = {signal.name: float(signal.start) for signal in self.model.inputs} | dict(given)
        return np.array([unit.to_si(v) for unit, v in zip(self.input_units, values.values(), strict=True)])

    def _read(self, y: np.ndarray) -> dict[str, float]:
        return {name: unit.from_si(v) for name, unit, v in zip(self.names, self.units, y.tolist(), strict=True)}


class TwinFilter:
    """The same by the model's own Python source: a flow [x, u, h] between samplings, then `sample` on floats."""

    def __init__(self, model: Model, h: float, flow) -> None:
        self.model, self.h, self.flow, self.flat = model, h, flow, FlatModel(model)
        self.x, self.m, self.p = (
            np.concatenate([s.scalar_starts() for s in group] or [np.zeros(0)])
            for group in (model.states, model.discrete, model.parameters)
        )
        self.k = 0

    def __call__(self, **inputs: float) -> dict[str, float]:
        u = [inputs.get(signal.name, float(signal.start)) for signal in self.model.inputs]
        self.k += 1
        x = self.flow(self.x, u, self.h)
        arguments = [float(v) for v in self.m], u, [float(v) for v in self.p]
        found = self.flat.sample(self.k * self.h, [float(v) for v in x], *arguments)
        self.x, self.m = (np.array(part, dtype=float) for part in found)
        signals = [n for group in (self.model.states, self.model.discrete) for s in group for n in s.scalar_names()]
        return dict(zip(signals, [*self.x, *self.m], strict=True))
