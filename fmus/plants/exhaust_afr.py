"""From four cylinders to the air-fuel sensor: exhaust pulses, a mixing manifold, a turbine, a pipe, two lags.

Source: Chauvin, Petit, Rouchon, Corde, Periodic Input Observer Design: Application for Imbalance Diagnosis, SAE 2006,
"Air Fuel Ratio Sensor Inversion". It has the sensor as two first-order lags and says of the way to it that the
cylinders' flows mix in the manifold and pass the turbocharger; the equations of that way are chosen here.

    exhaust of cylinder i   W_i = m_exh_i omega_e f(theta - theta_i),  theta_i firing TDC: 0, 180, 360, 540 deg for
                            cylinders 1, 3, 4, 2
                            f = (1 - cos(2 pi (phi - EVO)/L))/L over L = EVC - EVO, 0 elsewhere; its integral is 1
    composition             z = 1/(1 + AFR), mass of fuel over that of the gas: what adds up where gases mix
    manifold                m' = sum W_i - W_turb,  m_fuel' = sum W_i z_i - W_turb z,  z = m_fuel/m
                            p_em = m R_e T_exh/V_em: the gas keeps the temperature of the exhaust
    turbine                 W_turb by `fmus.turbocharger.turbine_flow` between p_em and p_t, none backwards
    pipe to the sensor      CELLS cells of equal mass m_c = p_t V_pipe/(CELLS R_e T_exh):
                            m_c z_j' = W_turb (z_(j-1) - z_j),  z_0 = z of the manifold
    sensor                  tau_1 x_1' = w - x_1,  tau_2 x_2' = x_1 - x_2,  w = 1/z_CELLS - 1, in units of AFR

AFR mixes through z. With A = AFR the balances above give

    dA/dt = (R T/(p V)) sum W_i (1 + A)/(1 + A_i) (A_i - A)

The usual dA/dt = (R T/(p V)) sum W_i (A_i - A) lacks the factor: the two agree to first order about a uniform AFR, and
beyond it a rich cylinder, which brings more fuel, pulls more than a lean one.

f is exact for samples: where theta is held over steps of d and L is n steps, n >= 2, the samples in a cycle add up to
d sum f = 1 - (1/n) sum cos(2 pi j/n + c) = 1, whatever the offset c to the valves' angles.

Mass and fuel are conserved (fuel as long as T_exh, and with it the mass in the pipe, stays). States that are
compositions are deviations from that of `afr_start`, so that everything starts in equilibrium with that one parameter.

Parameters: [R] read in a source, [C] computed, [I] chosen. The time constants are the paper's; the turbine's are those
of the TCSISimTestbed's 1.8 L engine (see `turbo_si`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fmus.component import Signal
from fmus.model import Model, Values
from fmus.turbocharger import turbine_flow

FIRING_ORDER = (1, 3, 4, 2)
CELLS = 10
CYCLE = 4.0 * np.pi  # rad
FIRING = {cylinder: k * CYCLE / 4.0 for k, cylinder in enumerate(FIRING_ORDER)}  # rad, firing TDC by cylinder
CYLINDERS = tuple(sorted(FIRING))

INPUTS = (
    Signal("theta", "rad", 0.0, "crank angle, 0 at firing TDC of cylinder 1", nominal=CYCLE),
    Signal("omega_e", "rad/s", 50.0 * np.pi, "engine speed", nominal=100.0, minimum=0.0),
    *(Signal(f"afr_{i}", "1", 20.0, f"air over fuel by mass, cylinder {i}", 10.0, minimum=0.0) for i in CYLINDERS),
    *(Signal(f"m_exh_{i}", "kg", 6e-4, f"mass that cylinder {i} exhausts in a cycle", 1e-4, 0.0) for i in CYLINDERS),
    Signal("T_exh", "K", 800.0, "temperature of the exhaust", nominal=1000.0, minimum=100.0),
)
STATES = (
    Signal("m_em", "kg", 1.036203e-3, "mass in the manifold", nominal=1e-3, minimum=1e-9),
    Signal("fuel_em", "kg", 0.0, "fuel in the manifold beyond that of afr_start", nominal=1e-6, local=True),
    Signal("z_pipe", "1", 0.0, "fuel fraction in the pipe less that of afr_start", 1e-3, shape=(CELLS,), local=True),
    Signal("x_1", "1", 0.0, "AFR between the sensor's lags less afr_start", nominal=1.0, local=True),
    Signal("x_2", "1", 0.0, "AFR after the sensor's lags less afr_start", nominal=1.0, local=True),
)
OUTPUTS = (
    Signal("afr_manifold", "1", 20.0, "air over fuel by mass in the manifold", nominal=10.0),
    Signal("afr_turbine", "1", 20.0, "air over fuel by mass that reaches the sensor", nominal=10.0),
    Signal("afr_lag", "1", 20.0, "AFR between the sensor's two lags", nominal=10.0),
    Signal("afr_sensor", "1", 20.0, "AFR that the sensor shows", nominal=10.0),
    Signal("p_em", "Pa", 1.201995e5, "pressure in the manifold", nominal=1e5),
    Signal("W_exh", "kg/s", 0.0, "flow out of the cylinders", nominal=0.01),
    Signal("W_turb", "kg/s", 0.03, "flow through the turbine", nominal=0.01),
    Signal("m_fuel", "kg", 4.934298e-5, "fuel in the manifold", nominal=1e-4),
    Signal("m_pipe", "kg", 2.262931e-4, "mass in the pipe to the sensor", nominal=1e-4),
    Signal("m_fuel_pipe", "kg", 1.077586e-5, "fuel in the pipe to the sensor", nominal=1e-5),
)
SENSORS = ("afr_sensor", "p_em")
PARAMETERS = (
    Signal("EVO", "rad", np.radians(135.0), "exhaust valve opens, after firing TDC [I]"),
    Signal("EVC", "rad", np.radians(375.0), "exhaust valve closes, after firing TDC; EVC - EVO from 0 to a cycle [I]"),
    Signal("R_e", "J/kg/K", 290.0, "exhaust, gas constant [R]", nominal=290.0, minimum=1.0),
    Signal("V_em", "m3", 2.0e-3, "volume of the manifold, of 1.6 to 2.5 L [R]", nominal=1e-3, minimum=1e-6),
    Signal("k_1", "1", 0.017, "turbine, flow coefficient, kg.K^0.5/(s.kPa) [R]", nominal=0.01, minimum=1e-9),
    Signal("k_2", "1", 1.4, "turbine, exponent of the flow [R]", minimum=1.0, maximum=2.0),
    Signal("PI_lin", "1", 0.99, "turbine, pressure ratio from which the flow is linear [I]", minimum=0.5, maximum=1.0),
    Signal("p_t", "Pa", 1.05e5, "pressure after the turbine [I]", nominal=1e5, minimum=1e3),
    Signal("V_pipe", "m3", 0.5e-3, "volume from manifold to sensor, 0.3 m of 45 mm [I]", nominal=1e-3, minimum=1e-6),
    Signal("tau_1", "s", 0.025, "sensor, first time constant [R]", nominal=0.01, minimum=1e-4),
    Signal("tau_2", "s", 0.020, "sensor, second time constant [R]", nominal=0.01, minimum=1e-4),
    Signal("afr_start", "1", 20.0, "AFR of all gas at the start, and that the sensor shows [I]", 10.0, minimum=0.0),
    Signal("afr_most", "1", 1000.0, "AFR above which it is not told apart from air alone [I]", 100.0, minimum=1.0),
)


def fuel_fraction(afr: Any) -> Any:
    """Mass of fuel over that of the gas it came with, 1/(1 + AFR)."""
    return 1.0 / (1.0 + afr)


def air_fuel_ratio(z: Any, most: Any) -> Any:
    """AFR [1] of a fuel fraction, 1/z - 1, not above `most`."""
    return 1.0 / np.maximum(z, fuel_fraction(most)) - 1.0


def exhaust_profile(theta: Any, p: Any) -> Any:
    """Share of its exhaust [1/rad] that leaves a cylinder per crank angle, theta [rad] after its firing TDC.

    f = (1 - cos(2 pi phi/L))/L for 0 <= phi < L, 0 elsewhere in the cycle; phi = theta - EVO, L = EVC - EVO. `p` has
    EVO and EVC [rad].
    """
    width = p.EVC - p.EVO
    phi = theta - p.EVO
    phi = phi - CYCLE * np.floor(phi / CYCLE)
    return np.where(phi < width, (1.0 - np.cos(2.0 * np.pi * phi / width)) / width, 0.0)


def cell_mass(T_exh: Any, p: Any) -> Any:
    """Mass [kg] in one cell of the pipe: p_t V_pipe/(CELLS R_e T_exh)."""
    return p.p_t * p.V_pipe / (CELLS * p.R_e * T_exh)


def outflow(m_em: Any, T_exh: Any, p: Any) -> tuple[Any, Any]:
    """Pressure p_em [Pa] of a mass m_em [kg] in the manifold at T_exh [K], and the flow W_turb [kg/s] it drives."""
    p_em = m_em * p.R_e * T_exh / p.V_em
    return p_em, np.maximum(turbine_flow(p_em, T_exh, p.p_t, T_exh, p), 0.0)


def _equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    z_start = fuel_fraction(p.afr_start)
    flows = {
        i: u[f"m_exh_{i}"] * np.maximum(u.omega_e, 0.0) * exhaust_profile(u.theta - FIRING[i], p) for i in CYLINDERS
    }
    W_exh = sum(flows.values())
    fuel = sum(flows[i] * (fuel_fraction(np.maximum(u[f"afr_{i}"], 0.0)) - z_start) for i in CYLINDERS)

    p_em, W_turb = outflow(x.m_em, u.T_exh, p)
    z_em = x.fuel_em / x.m_em
    m_cell = cell_mass(u.T_exh, p)
    before = [z_em, *x.z_pipe[:-1]]
    pipe = [W_turb / m_cell * (z_before - z) for z_before, z in zip(before, x.z_pipe, strict=True)]

    w = air_fuel_ratio(z_start + x.z_pipe[-1], p.afr_most)
    derivatives = {
        "m_em": W_exh - W_turb,
        "fuel_em": fuel - W_turb * z_em,
        "z_pipe": np.array(pipe),
        "x_1": (w - p.afr_start - x.x_1) / p.tau_1,
        "x_2": (x.x_1 - x.x_2) / p.tau_2,
    }
    outputs = {
        "afr_manifold": air_fuel_ratio(z_start + z_em, p.afr_most),
        "afr_turbine": w,
        "afr_lag": p.afr_start + x.x_1,
        "afr_sensor": p.afr_start + x.x_2,
        "p_em": p_em,
        "W_exh": W_exh,
        "W_turb": W_turb,
        "m_fuel": x.fuel_em + z_start * x.m_em,
        "m_pipe": CELLS * m_cell,
        "m_fuel_pipe": m_cell * (CELLS * z_start + sum(x.z_pipe)),
    }
    return derivatives, outputs


MODEL = Model(
    name="exhaust_afr",
    description="Air-fuel ratio from four cylinders' exhaust through manifold, turbine and pipe to a lagging sensor",
    equations=_equations,
    inputs=INPUTS,
    states=STATES,
    outputs=OUTPUTS,
    parameters=PARAMETERS,
    # A cell of the pipe takes 0.2 ms at 6000 rpm, and RK4 is stable up to 2.785 of that: docs/exhaust_afr.md.
    solver_step=1e-4,
)
