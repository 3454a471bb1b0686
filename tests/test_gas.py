"""Flows and volumes of gas against the published equations, textbook nozzles, and what must be conserved."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fmus.gas import Gas, Stream, between, critical_ratio, filling, isentropic_flow, signed_root, turbulent_flow
from fmus.tracing import Symbol

AIR = Gas(1.4, 287.2)
AREA, PI_LIN = 2e-4, 0.99


def slope(function, at: float) -> float:
    """The derivative of a scalar function by automatic differentiation."""
    x = ca.SX.sym("x")
    found = function(Symbol(x))
    return float(ca.Function("slope", [x], [ca.jacobian(found.sx, x)])(at))


def test_the_signed_root_is_the_root_beyond_its_line_odd_and_continuous():
    for value in (4.0, 1e-2, 1.0001e-4):
        assert float(signed_root(value, 1e-4)) == pytest.approx(np.sqrt(value), rel=1e-15)
        assert float(signed_root(-value, 1e-4)) == -float(signed_root(value, 1e-4))
    assert float(signed_root(0.0, 1e-4)) == 0.0
    below, above = float(signed_root(1e-4 * (1 - 1e-12), 1e-4)), float(signed_root(1e-4 * (1 + 1e-12), 1e-4))
    assert above == pytest.approx(below, rel=1e-11)


@pytest.mark.parametrize("value", [0.0, 1e-300, -1e-300, 1e-4, -1e-4])
def test_the_signed_root_has_a_finite_slope_where_the_root_has_none(value):
    assert 0.0 < slope(lambda v: signed_root(v, 1e-4), value) <= 1e2 * (1 + 1e-12)


def test_the_flow_through_a_filter_is_the_papers():
    # W_af = sqrt(p_a (p_a - p_af)/(H_af T_a)), paper 000, Section 2.2.
    p_a, T_a, H = 101300.0, 298.0, 2e8
    for p_af in (99000.0, 95000.0, 80000.0):
        expected = np.sqrt(p_a * (p_a - p_af) / (H * T_a))
        assert float(turbulent_flow(p_a, T_a, p_af, 350.0, H, 2000.0)) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    "flow",
    [
        lambda p_1, T_1, p_2, T_2: turbulent_flow(p_1, T_1, p_2, T_2, 2e8, 2000.0),
        lambda p_1, T_1, p_2, T_2: isentropic_flow(p_1, T_1, p_2, T_2, AREA, AIR, PI_LIN),
    ],
    ids=["turbulent", "isentropic"],
)
class TestEitherRestriction:
    @pytest.mark.parametrize("drop", [0.0, 1.0, 500.0, 5e3, 9e4])
    def test_turned_round_it_carries_as_much_the_other_way(self, flow, drop):
        forward, backward = flow(1e5 + drop, 300.0, 1e5, 900.0), flow(1e5, 900.0, 1e5 + drop, 300.0)
        assert float(forward) == -float(backward)
        assert (float(forward) > 0.0) == (drop > 0.0)

    @pytest.mark.parametrize("drop", [0.0, 1.0, -1.0, 2000.0, -2000.0])
    def test_every_slope_is_finite_and_the_flow_grows_with_the_drop(self, flow, drop):
        upstream = slope(lambda p: flow(p, 300.0, 1e5, 900.0), 1e5 + drop)
        downstream = slope(lambda p: flow(1e5 + drop, 300.0, p, 900.0), 1e5)
        assert 0.0 < upstream < 1e-3 and -1e-3 < downstream < 0.0
        for T in (slope(lambda T: flow(1e5 + drop, T, 1e5, 900.0), 300.0),
                  slope(lambda T: flow(1e5 + drop, 300.0, 1e5, T), 900.0)):  # fmt: skip
            assert np.isfinite(T)

    def test_the_temperature_downstream_has_no_part_in_it(self, flow):
        assert slope(lambda T: flow(1.2e5, 300.0, 1e5, T), 900.0) == 0.0
        assert slope(lambda T: flow(1.0e5, T, 1.2e5, 900.0), 300.0) == 0.0


@pytest.mark.parametrize("gamma", [1.3, 1.4])
@pytest.mark.parametrize("ratio", [0.98, 0.9, 0.7, 0.56])
def test_an_orifice_is_the_textbook_nozzle_by_mach_number(gamma, ratio):
    # m' = A p0 sqrt(gamma/(R T0)) M (1 + (gamma-1)/2 M^2)^(-(gamma+1)/(2 (gamma-1))), M from the isentropic ratio.
    gas, p, T = Gas(gamma, 287.2), 1.5e5, 320.0
    M = np.sqrt(2.0 / (gamma - 1.0) * (ratio ** ((1.0 - gamma) / gamma) - 1.0))
    body = (1.0 + (gamma - 1.0) / 2.0 * M**2) ** (-(gamma + 1.0) / (2.0 * (gamma - 1.0)))
    expected = AREA * p * np.sqrt(gamma / (gas.R * T)) * M * body
    assert float(isentropic_flow(p, T, ratio * p, 300.0, AREA, gas, PI_LIN)) == pytest.approx(expected, rel=1e-12)


def test_a_choked_flow_is_the_sonic_one_and_depends_on_nothing_downstream():
    p, T, gamma = 1.5e5, 320.0, AIR.gamma
    sonic = (
        AREA * p / np.sqrt(AIR.R * T) * np.sqrt(gamma) * (2.0 / (gamma + 1.0)) ** ((gamma + 1.0) / (2 * (gamma - 1.0)))
    )
    for ratio in (0.5, 0.2, 0.01):
        assert float(isentropic_flow(p, T, ratio * p, 300.0, AREA, AIR, PI_LIN)) == pytest.approx(sonic, rel=1e-13)
        assert slope(lambda p_2: isentropic_flow(p, T, p_2, 300.0, AREA, AIR, PI_LIN), ratio * p) == 0.0
    assert critical_ratio(1.4) == pytest.approx(0.528282, abs=1e-6)  # any table of compressible flow


@pytest.mark.parametrize("ratio", [PI_LIN, critical_ratio(1.4)])
def test_an_orifices_pieces_meet(ratio):
    below, above = (
        float(isentropic_flow(1e5, 300.0, 1e5 * ratio * (1.0 + side), 300.0, AREA, AIR, PI_LIN))
        for side in (-1e-12, 1e-12)
    )
    assert above == pytest.approx(below, rel=1e-9)


def test_a_volume_with_one_stream_in_and_one_out_has_the_published_derivatives():
    # dm/dt = Win - Wout, dT/dt = (Win cv (Tin - T) + R (Tin Win - T Wout))/(m cv), p = m R T/V.
    p, T, V, W_in, T_in, W_out = 1.1e5, 320.0, 5e-3, 0.03, 450.0, 0.022
    cv, m = AIR.R / (AIR.gamma - 1.0), p * V / (AIR.R * T)
    dm = W_in - W_out
    dT = (W_in * cv * (T_in - T) + AIR.R * (T_in * W_in - T * W_out)) / (m * cv)
    found = filling(p, T, V, AIR, [Stream(W_in, T_in), Stream(-W_out, T)])
    assert found[1] == pytest.approx(dT, rel=1e-13)
    assert found[0] == pytest.approx(AIR.R / V * (dm * T + m * dT), rel=1e-13)


def test_a_stream_carries_what_is_upstream_and_arrives_as_it_was_changed_on_its_way():
    from_1, into_2 = between(0.02, True, 300.0, 900.0)
    assert (from_1, into_2) == (Stream(-0.02, 300.0), Stream(0.02, 300.0))
    from_1, into_2 = between(-0.02, False, 300.0, 900.0)
    assert (from_1, into_2) == (Stream(0.02, 900.0), Stream(-0.02, 900.0))
    from_1, into_2 = between(0.02, True, 300.0, 900.0, forward=310.0, backward=850.0)
    assert (from_1.T, into_2.T) == (300.0, 310.0)
    from_1, into_2 = between(-0.02, False, 300.0, 900.0, forward=310.0, backward=850.0)
    assert (from_1.T, into_2.T) == (850.0, 900.0)


@pytest.mark.parametrize("higher", [0, 1])
def test_two_volumes_keep_their_mass_and_energy_and_come_to_one_pressure(higher):
    V = np.array([5e-3, 2e-3])
    p0, T0 = np.array([1e5, 1e5]), np.array([300.0, 700.0])
    p0[higher] = 3e5

    def rates(t, x):
        p, T = x[:2], x[2:]
        W = isentropic_flow(p[0], T[0], p[1], T[1], AREA, AIR, PI_LIN)
        streams = between(W, p[0] >= p[1], T[0], T[1])
        filled = [filling(p[i], T[i], V[i], AIR, [streams[i]]) for i in range(2)]
        return [filled[0][0], filled[1][0], filled[0][1], filled[1][1]]

    end = solve_ivp(rates, (0.0, 1.0), [*p0, *T0], method="Radau", rtol=1e-10, atol=1e-8).y[:, -1]
    mass, energy = (p0 * V / T0).sum(), (p0 * V).sum()
    # The integrator's 1e-10 a step, over some hundred steps.
    assert (end[:2] * V / end[2:]).sum() == pytest.approx(mass, rel=1e-8)
    assert (end[:2] * V).sum() == pytest.approx(energy, rel=1e-8)
    np.testing.assert_allclose(end[:2], energy / V.sum(), rtol=1e-7)
