"""The paper's engine as a structure, typed in from its Sections 2.2 and 4, and the plant with the paper's sensors."""

from __future__ import annotations

from functools import cache
from itertools import combinations

import numpy as np

from fmus.linearmodel import LinearModel
from fmus.plants.turbo_si import MODEL, PARAMETER_SETS, SENSORS, STATES
from fmus.sensing import TEMPERATURE_LAG
from fmus.statespace import at, linearised, settle
from selection.branch import Branch
from selection.observability import Measured
from selection.structure import branch_structure

STATE_NAMES = tuple(signal.name for signal in STATES)
ESTIMATE = ("p_im", "T_im", "p_em")
WANTED = tuple(STATE_NAMES.index(name) for name in ESTIMATE)
LAGS = [int(name.startswith("T_")) for name in SENSORS]
# Equations e1 to e13 and the flows, as the paper lists what they depend on; inputs left out.
_EQUATIONS = {
    "p_af T_af": "p_af T_af p_comp omega_tc",
    "p_comp T_comp": "p_af T_af p_comp T_comp p_ic omega_tc",
    "p_ic T_ic": "p_comp T_comp p_ic T_ic p_im",
    "p_im T_im": "p_ic T_ic T_im p_im p_em",
    "p_em T_em": "p_im T_im p_em T_em p_t",
    "p_t T_t": "p_em T_em p_t T_t omega_tc",
    "omega_tc": "p_af T_af p_comp p_em T_em p_t omega_tc",
}
_FLOWS = {
    "W_af": "p_af",
    "W_comp": "p_af T_af p_comp omega_tc",
    "W_ic": "p_comp T_comp p_ic",
    "W_th": "p_im p_ic T_ic",
}
# Section 4: at low throttle pressure ratio the states before the throttle do not depend on p_im. A choked flow does not
# depend on it either.
_CHOKED_OUT = {"p_ic", "T_ic", "W_th"}
# Table 1, as published: sensors and index.
TABLE_1 = {
    ("p_im", "T_im", "p_em"): 2,
    ("p_ic", "p_im", "T_im"): 3,
    ("p_im", "T_im", "W_th"): 3,
    ("p_im", "p_em", "T_em"): 3,
    ("p_im", "p_em", "p_t"): 4,
    ("T_im", "p_em", "T_em"): 4,
}
# Points with the throttle open and choked, inputs in SI.
OPEN = {"alpha": 0.2, "N": 2500.0 * np.pi / 30.0}
CHOKED = {"alpha": 0.08, "N": 1500.0 * np.pi / 30.0}


def paper_structure(choked: bool) -> tuple[np.ndarray, np.ndarray]:
    """The zero and non-zero structure of A (13, 13) and of the gradients of the 17 sensors (17, 13)."""
    on = {name: set(text.split()) for names, text in _EQUATIONS.items() for name in names.split()}
    on |= {name: set(text.split()) for name, text in _FLOWS.items()}
    if choked:
        on = {name: depends - {"p_im"} if name in _CHOKED_OUT else depends for name, depends in on.items()}
    A = np.array([[column in on[row] for column in STATE_NAMES] for row in STATE_NAMES])
    flows = np.array([[column in on[row] for column in STATE_NAMES] for row in _FLOWS])
    return A, np.concatenate([np.eye(13, dtype=bool), flows])


def sets_of(*sizes: int) -> list[tuple[int, ...]]:
    """All sets of so many of the 17 sensors."""
    return [members for size in sizes for members in combinations(range(len(SENSORS)), size)]


def places(names: tuple[str, ...]) -> tuple[int, ...]:
    """Places of sensors, in their order."""
    return tuple(sorted(SENSORS.index(name) for name in names))


@cache
def measured(throttle: str, richness: float = 1.0, parameter_set: str = "") -> Measured:
    """The plant with the paper's sensors, at rest with the throttle `open` or `choked`."""
    system = LinearModel(MODEL, PARAMETER_SETS.get(parameter_set))
    u = at(system.inputs, {**{"open": OPEN, "choked": CHOKED}[throttle], "lambda": richness})
    x = settle(system, at(system.states, {}), u)
    space = linearised(system, x, u)
    taus = tuple(TEMPERATURE_LAG * lag for lag in LAGS)
    return Measured(space, SENSORS, taus, branch_structure(Branch(system, x, u)), system)
