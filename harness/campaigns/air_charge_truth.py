"""The truth of the campaign `air-charge`: engines like set A of `turbo_si`, each part off by up to three per cent.

The observers believe set A. What is to be shown is what a set of sensors is worth where the model is not exact, so the
engine must be another; but like enough that the same engine could have been meant. Set B is not: it has 2.3 L for
1.8 L, which alone makes every air charge wrong by a quarter and would hide what the sensors do. So each parameter is
multiplied by a number drawn evenly from 0.97 to 1.03 [I], about what mean-value models reach on a test bench. Left as
they are: counts, properties of gas and fuel, the coolant's temperature (it is the ambient's), and what only smooths the
equations near zero flow.

The numbers come from `random.Random(engine)`, whose stream Python keeps from version to version.
"""

from __future__ import annotations

import random
from dataclasses import replace

from fmus.plants import turbo_si

ENGINES = (1, 2, 3)
OFF = 0.03
KEPT = (
    *("n_cyl", "n_pipe"),
    *("gamma_a", "R_a", "gamma_e", "R_e", "q_lhv", "AF_s", "mu_e", "k_e"),
    "T_cool",
    *("PI_lin", "dp_lin_af", "dp_lin_ic", "dp_lin_es", "omega_min", "v_lin"),
)


def engine(number: int) -> dict[str, float]:
    """The parameters of an engine that are not those of set A, by name, in their units."""
    draw = random.Random(number)
    return {
        signal.name: float(signal.start) * draw.uniform(1.0 - OFF, 1.0 + OFF)
        for signal in turbo_si.PARAMETERS
        if signal.name not in KEPT
    }


MODEL = replace(turbo_si.MODEL, parameter_sets={f"engine_{number}": engine(number) for number in ENGINES})
