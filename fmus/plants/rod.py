"""The transmission rod between the cylinders and the speed sensor: base excitation in crank angle.

Source: Chauvin, Petit, Rouchon, Corde, Periodic Input Observer Design: Application for Imbalance Diagnosis, SAE 2006,
"Transmission Rod Dynamics Inversion". x_2 is the speed next to the cylinders, x_1 the speed at the rod's end, where it
is measured; ' is d/dalpha by the crank angle, and d/dt = omega_e d/dalpha.

The printed equation

    (x_1 - x_2)'' + 2 xi w (x_1 - x_2)' + w^2 (x_1 - x_2) = 0

is one of the difference alone. With xi > 0 the difference dies out whatever x_2 does: once periodic, the speed measured
would be the speed at the cylinders, and there would be nothing to invert. So says the printed text itself: with its w_0
= x_2'' + 2 xi w x_2' + w^2 x_2 its matrix gives for the coefficients of x_2 those that x_1 has already.

What a rod does is base excitation: the end is an inertia that spring and damper pull after the other end,

    x_1'' = -2 xi w (x_1' - x_2') - w^2 (x_1 - x_2)

with w_0 = 2 xi w x_2' + w^2 x_2, without x_2''. That is this model. Each harmonic passes by

    H(k) = (2 xi w i k + w^2)/(w^2 - k^2 + 2 xi w i k),  k per revolution

and the coefficients of x_2 are those of x_1 over H, or those of w_0 over w^2 + 2 xi w i k. Without a derivative of the
input, with the twist's share q of the speed's change:

    x_1' = q + 2 xi w (x_2 - x_1),  q' = w^2 (x_2 - x_1)

A rod has its frequency in time, and w in crank angle falls with the speed, as 1/N: 125 Hz are of order 5 at 1500 rpm,
2.5 at 3000 rpm. The paper has one w; here it is the parameter `order`, to be given with the speed of a case.
xi is [R], w [I].
"""

from __future__ import annotations

from typing import Any

from fmus.component import Signal
from fmus.model import Model, Values

SPEED = 157.07963267948966  # rad/s, 1500 rpm

INPUTS = (Signal("omega_e", "rad/s", SPEED, "speed next to the cylinders", nominal=100.0),)
STATES = (
    Signal("omega_rod", "rad/s", SPEED, "speed at the end of the rod", nominal=100.0),
    Signal(
        "pull", "rad/s", 0.0, "change of that speed per crank angle by the twist of the rod", nominal=1.0, local=True
    ),
)
PARAMETERS = (
    Signal("xi", "1", 0.15, "damping of the rod [R]", nominal=0.1, minimum=0.0),
    Signal("order", "1", 5.0, "natural frequency, per revolution: 125 Hz at 1500 rpm [I]", minimum=1e-3),
)


def rod_response(k: Any, p: Any) -> Any:
    """The complex gain from `omega_e` to `omega_rod` at k per revolution; `p` has xi and order.

    H = (2 xi w i k + w^2)/(w^2 - k^2 + 2 xi w i k), w the order.
    """
    damped = 2j * p.xi * p.order * k
    return (damped + p.order**2) / (p.order**2 - k**2 + damped)


def _equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    lead = u.omega_e - x.omega_rod
    derivatives = {
        "omega_rod": u.omega_e * (x.pull + 2.0 * p.xi * p.order * lead),
        "pull": u.omega_e * p.order**2 * lead,
    }
    return derivatives, {}


MODEL = Model(
    name="rod",
    description="Transmission rod from the cylinders to the speed sensor, second order in crank angle",
    equations=_equations,
    inputs=INPUTS,
    states=STATES,
    parameters=PARAMETERS,
    # 2 deg at 6000 rpm, 0.15 rad of a rod of order 5: RK4 then misses 5e-6 of a swing per radian of it.
    solver_step=5e-5,
)
