"""Compressor and turbine against their published maps, and within the laws of thermodynamics beyond them."""

from __future__ import annotations

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from fmus.gas import Gas
from fmus.plants.turbo_si import PARAMETERS
from fmus.tracing import Symbol
from fmus.turbocharger import compressor, turbine, turbine_flow, turbine_pressure

P = SimpleNamespace(**{signal.name: float(signal.start) for signal in PARAMETERS})
AIR, EXHAUST = Gas(P.gamma_a, P.R_a), Gas(P.gamma_e, P.R_e)
OMEGA = 12000.0
TIP = OMEGA / (2.0 * np.pi) * P.D_c  # N D, m/s
T_1, T_2 = 298.0, 340.0


def ratio_at(Psi: float, omega: float = OMEGA) -> float:
    """The pressure ratio of a head coefficient."""
    return (1.0 + Psi * (omega / (2 * np.pi) * P.D_c) ** 2 / (AIR.cp * T_1)) ** (AIR.gamma / (AIR.gamma - 1.0))


def at(Psi: float, omega: float = OMEGA):
    return compressor(1e5, T_1, 1e5 * ratio_at(Psi, omega), T_2, omega, AIR, P)


def slope(function, at: float) -> float:
    x = ca.SX.sym("x")
    found = function(Symbol(x))
    return float(ca.Function("slope", [x], [ca.jacobian(found.sx, x)])(at))


@pytest.mark.parametrize("Psi", [0.1, 0.8, 1.5, 2.1])
@pytest.mark.parametrize("omega", [3000.0, 12000.0, 20000.0])
def test_inside_its_map_the_compressor_is_the_published_one(Psi, omega):
    N, PI = omega / (2 * np.pi), ratio_at(Psi, omega)
    Phi = P.Phi_max * np.sqrt(1.0 - (Psi / P.Psi_max) ** 2)
    eta = max(P.eta_c_max * Phi * (2 * P.Phi_0 - Phi) / P.Phi_0**2, P.eta_c_min)
    wheel = at(Psi, omega)
    assert float(wheel.W) == pytest.approx(Phi * 1e5 * N * P.D_c**3 / (AIR.R * T_1), rel=1e-10)
    T_out = T_1 * (1.0 + (PI ** (0.4 / 1.4) - 1.0) / eta)
    assert float(wheel.T_out) == pytest.approx(T_out, rel=1e-10)
    assert float(wheel.torque) == pytest.approx(float(wheel.W) * AIR.cp * (T_out - T_1) / omega, rel=1e-9)


def test_the_compressors_flow_goes_on_beyond_both_ends_of_its_map_with_the_same_slope_of_its_square():
    # v |v| is the quantity that is joined; the flow itself is proportional to v while it goes forwards.
    def square(p_2):
        wheel = compressor(1e5, T_1, p_2, T_1, OMEGA, AIR, P)
        v = wheel.W / (P.Phi_max * P.D_c**2 * np.where(wheel.W >= 0.0, 1e5, p_2) / (AIR.R * T_1))
        return v * np.abs(v)

    for end in (0.0, P.Psi_max):
        p_2 = 1e5 * ratio_at(end)
        below, above = square(p_2 * (1 - 1e-9)), square(p_2 * (1 + 1e-9))
        # Near v = 0 the root is linear, so v|v| is not joined to rounding but stays below (v_lin/100)^2 there.
        assert float(above) == pytest.approx(float(below), rel=1e-6, abs=(P.v_lin / 100) ** 2)
    kink = [slope(square, 1e5 * (1.0 + side)) for side in (-1e-7, 1e-7)]
    scale = abs(slope(square, 1e5 * ratio_at(1.5)))
    # No slope at PI = 1 from either side: 1e-7 of the pressure times the curvature.
    assert max(abs(one) for one in kink) < 1e-5 * scale


def test_the_compressor_passes_less_the_higher_the_pressure_behind_it():
    flows = [float(at(Psi).W) for Psi in np.linspace(-3.0, 5.0, 400)]
    assert np.all(np.diff(flows) < 0.0)
    assert flows[0] > 0.0 > flows[-1]


def test_a_compressor_that_is_overcome_lets_the_gas_behind_it_back_and_does_no_work():
    wheel = at(1.3 * P.Psi_max)
    hot = compressor(1e5, T_1, 1e5 * ratio_at(1.3 * P.Psi_max), 4 * T_2, OMEGA, AIR, P)
    assert float(wheel.W) < 0.0 and float(wheel.torque) == 0.0
    assert float(hot.W) == pytest.approx(float(wheel.W) / 4.0, rel=1e-14)  # the density is that behind it


def test_a_compressor_that_is_driven_by_the_pressure_throttles():
    wheel = at(-0.5)
    assert float(wheel.W) > float(at(0.0).W) and float(wheel.torque) == 0.0 and float(wheel.T_out) == T_1


@pytest.mark.parametrize("Psi", [-1.0, 0.0, 0.5, 1.5, 2.3, 2.5])
@pytest.mark.parametrize("omega", [0.0, 50.0, 100.0, 12000.0])
def test_the_compressors_work_is_what_heats_the_gas_and_never_less_than_ideal(Psi, omega):
    PI = ratio_at(Psi, max(omega, P.omega_min))
    wheel = compressor(1e5, T_1, 1e5 * PI, T_2, omega, AIR, P)
    heating = max(float(wheel.W), 0.0) * AIR.cp * (float(wheel.T_out) - T_1)
    # The difference of two temperatures of 300 K: 1e-13 K of rounding.
    assert float(wheel.torque) * omega == pytest.approx(heating, rel=1e-9, abs=1e-12)
    if omega >= P.omega_min and 0.0 < Psi < P.Psi_max:
        assert float(wheel.T_out) >= T_1 * PI ** (0.4 / 1.4) * (1.0 - 1e-14)


def test_an_orifice_remains_of_a_compressor_at_rest():
    # omega_min turns it so slowly that v^2 = h/Psi_max is all there is of a head of 0.1 bar.
    head = AIR.cp * T_1 * (1.0 - 0.9 ** (0.4 / 1.4))
    wheel = compressor(1e5, T_1, 0.9e5, T_2, 0.0, AIR, P)
    expected = P.Phi_max * P.D_c**2 * np.sqrt(head / P.Psi_max) * 1e5 / (AIR.R * T_1)
    assert float(wheel.W) == pytest.approx(expected, rel=1e-3)
    assert float(wheel.torque) == 0.0


@pytest.mark.parametrize("PI", [0.3, 0.5, 0.8, 0.95])
@pytest.mark.parametrize("omega", [3000.0, 12000.0, 25000.0])
def test_the_turbine_is_the_published_one(PI, omega):
    p, T = 1.8e5, 1100.0
    drop = EXHAUST.cp * T * (1.0 - PI ** (0.3 / 1.3))
    BSR = P.D_t / 2 * omega / np.sqrt(2.0 * drop)
    eta = max(P.eta_t_max * (1.0 - ((BSR - P.B_0) / P.B_0) ** 2), P.eta_t_min)
    wheel = turbine(p, T, PI * p, 900.0, omega, EXHAUST, P)
    assert float(wheel.W) == pytest.approx(P.k_1 * 180.0 / np.sqrt(T) * np.sqrt(1.0 - PI**P.k_2), rel=1e-12)
    assert float(wheel.T_out) == pytest.approx(T - eta * drop / EXHAUST.cp, rel=1e-12)
    assert float(wheel.torque) * omega == pytest.approx(float(wheel.W) * eta * drop, rel=1e-12)


@pytest.mark.parametrize("PI", [0.5, 0.98, 1.0, 1.2])
@pytest.mark.parametrize("omega", [0.0, 50.0, 12000.0])
def test_the_turbines_work_is_what_cools_the_gas_and_never_more_than_ideal(PI, omega):
    p, T = 1.5e5, 1000.0
    wheel = turbine(p, T, PI * p, 900.0, omega, EXHAUST, P)
    cooling = max(float(wheel.W), 0.0) * EXHAUST.cp * (T - float(wheel.T_out))
    assert float(wheel.torque) * omega == pytest.approx(cooling, rel=1e-9, abs=1e-12)
    assert float(wheel.torque) >= 0.0
    assert float(wheel.T_out) >= T * min(PI, 1.0) ** (0.3 / 1.3)


def test_a_turbine_flows_backwards_as_it_flows_forwards_without_work():
    forward = turbine(1.5e5, 1000.0, 1.2e5, 900.0, OMEGA, EXHAUST, P)
    backward = turbine(1.2e5, 900.0, 1.5e5, 1000.0, OMEGA, EXHAUST, P)
    assert float(backward.W) == -float(forward.W)
    assert float(backward.torque) == 0.0


@pytest.mark.parametrize("wheel", [compressor, turbine])
@pytest.mark.parametrize("ratio", [0.5, 1.0, 1.6, 3.0])
@pytest.mark.parametrize("omega", [0.0, 100.0, 12000.0])
def test_no_derivative_of_a_wheel_is_infinite(wheel, ratio, omega):
    x = ca.SX.sym("x", 5)
    p_1, T_1, p_2, T_2, speed = (Symbol(x[i]) for i in range(5))
    found = wheel(p_1, T_1, p_2, T_2, speed, AIR if wheel is compressor else EXHAUST, P)
    outputs = ca.vertcat(*(value.sx for value in found))
    jacobian = ca.Function("jacobian", [x], [ca.jacobian(outputs, x)])
    assert np.isfinite(jacobian([1e5, 400.0, ratio * 1e5, 500.0, omega]).full()).all()


@pytest.mark.parametrize("k_2", [1.0, 1.4, 1.45, 2.0])
def test_the_pressure_before_the_turbine_is_the_one_at_which_it_passes_the_flow(k_2):
    p = SimpleNamespace(**{**vars(P), "k_2": k_2})
    for W in (0.0, 1e-6, 1e-3, 5e-3, 0.03, 0.12, 0.4):
        p_1 = float(turbine_pressure(W, 900.0, 1.05e5, p))
        # From the tail pipe's pressure to 7 bar, by Newton's method to rounding.
        assert float(turbine_flow(p_1, 900.0, 1.05e5, 900.0, p)) == pytest.approx(W, rel=1e-11, abs=1e-15)
        assert p_1 >= 1.05e5


def test_the_turbines_flow_alone_is_that_of_the_turbine():
    for p_1 in (0.9e5, 1e5, 1.005e5, 1.5e5, 3e5):
        alone = turbine_flow(p_1, 1000.0, 1e5, 900.0, P)
        assert float(alone) == float(turbine(p_1, 1000.0, 1e5, 900.0, OMEGA, EXHAUST, P).W)
