"""A cylinder of Cantera's own parts, to run as fast as Cantera does: walls, valves and tables, no Python inside.

A piston (Wall with a velocity), a loss with a constant coefficient, the heat of the fire, and valves whose flow is
linear in the pressure drop (Valve): Cantera has none that choke. So it does less than `single_cylinder` does.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import NamedTuple

import cantera as ct
import numpy as np
from numpy.typing import NDArray

from benchmarks.cantera_cylinder import gases, space

COEFFICIENT = 300.0  # W/m2/K, of the loss
OPEN = 2e-6  # kg/s/Pa, valves at full lift: fills and empties the cylinder within a few kPa
CHARGE = 5.6e-4  # kg of air, for the heat of the fire
_DEGREE = np.pi / 180.0


class Network(NamedTuple):
    """A network that goes to the end of cycles, the cylinder, and what must be kept alive."""

    net: ct.ReactorNet
    cylinder: ct.IdealGasReactor
    cycle: float  # s
    kept: tuple[object, ...]


def network(p: Mapping[str, float], N: float, tolerance: float, longest: float, cycles: int) -> Network:
    """`cycles` cycles at N [rpm] from -180 deg, to a relative tolerance, with steps of `longest` [deg] at most."""
    known, omega = gases(), N * np.pi / 30.0
    degrees = np.arange(-180.0, 720.0 * cycles + 181.0, 2.0)
    t = (degrees + 180.0) * _DEGREE / omega
    spaces = np.array([space(degree * _DEGREE, p) for degree in degrees])

    def filled(T: float, pressure: float, Y: NDArray[np.float64]) -> ct.Solution:
        known.phase.TPY = T, pressure, Y
        return known.phase

    cylinder = ct.IdealGasReactor(filled(320.0, 1e5, known.air), clone=True)
    cylinder.volume = spaces[0, 0]
    inlet = ct.Reservoir(filled(320.0, 1e5, known.air), clone=True)
    outlet = ct.Reservoir(filled(1000.0, 1.05e5, known.burnt), clone=True)
    wall = ct.Reservoir(filled(p["T_wall"], 1e5, known.air), clone=True)

    def table(values: NDArray[np.float64]) -> ct.Func1:
        return ct.Func1("tabulated-linear", t, values)

    def lift(opens: float, closes: float) -> NDArray[np.float64]:
        share = np.clip((degrees % 720.0 - opens) / (closes - opens), 0.0, 1.0)
        return OPEN * np.sin(np.pi * share) ** 2

    y = np.clip(((degrees + 360.0) % 720.0 - 360.0 - p["burn_0"]) / p["burn_d"], 0.0, 1.0)
    burnt = 1.0 - np.exp(-p["burn_a"] * y ** (p["burn_m"] + 1.0))
    heat = CHARGE / 14.6 * p["q_lhv"] * np.maximum(np.gradient(burnt, t), 0.0)
    walls = (
        ct.Wall(wall, cylinder, A=1.0, velocity=table(-spaces[:, 1] * omega)),
        ct.Wall(cylinder, wall, A=spaces[:, 2].mean(), U=COEFFICIENT),
        ct.Wall(wall, cylinder, A=1.0, Q=table(heat)),
    )
    valves = (ct.Valve(inlet, cylinder, K=1.0), ct.Valve(cylinder, outlet, K=1.0))
    for valve, kind in zip(valves, "ie", strict=True):
        valve.time_function = table(lift(p[f"{kind}vo"], p[f"{kind}vc"]))
    net = ct.ReactorNet([cylinder])
    net.rtol, net.atol = tolerance, 1e-6 * tolerance
    net.max_time_step = longest * _DEGREE / omega
    return Network(net, cylinder, 4.0 * np.pi / omega, (*walls, *valves, inlet, outlet, wall))


def pressures(made: Network, cycles: int, rows: int = 180) -> NDArray[np.float64]:
    """Pressure [Pa] at `rows` instants of each cycle, shape (cycles * rows,)."""
    found = []
    for k in range(1, cycles * rows + 1):
        made.net.advance(k * made.cycle / rows)
        found.append(made.cylinder.phase.P)
    return np.array(found)


def seconds_per_cycle(made: Network, cycles: int) -> float:
    """Processor time for one of `cycles` cycles, with one call to Cantera each; the first is not counted."""
    made.net.advance(made.cycle)
    begin = time.process_time()
    for k in range(2, cycles + 1):
        made.net.advance(k * made.cycle)
    return (time.process_time() - begin) / (cycles - 1)
