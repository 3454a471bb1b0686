"""The engine with low-pressure EGR: its layout, what is conserved, its equilibria, its trends, its Jacobians."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import root

from fmus.jacobians import Point, jacobians, point
from fmus.model import FlatModel
from fmus.plants import turbo_si
from fmus.plants.turbo_si_egr import (
    ACCURACIES,
    INPUTS,
    LAGS,
    MODEL,
    OUTPUTS,
    PARAMETERS,
    SENSORS,
    STATES,
    cylinder_volume,
)
from fmus.steady import Steady, steady_state
from fmus.tracing import trace
from fmus.units import parse_unit
from harness.operating import Operation, operate
from selection.observability import Measured, Options, observe

ENGINE = jacobians(MODEL)
STATE_NAMES = [signal.name for signal in STATES]
INPUT_NAMES = [signal.name for signal in INPUTS]
OUTPUT_NAMES = [signal.name for signal in OUTPUTS]
NOMINAL = np.array([signal.nominal for signal in STATES])
# Of Figure 3 of the paper, which is lost, the text has the range: 2400 to 4000 rpm, EGR of 1.5 to 11 %.
OPERATION = [
    {},
    {"N": 2400.0, "wastegate": 14.0, "egr_valve": 8.0},
    {"N": 4000.0, "wastegate": 10.0, "egr_valve": 20.0},
    {"N": 2000.0, "throttle": 20.0, "wastegate": 0.0, "egr_valve": 0.0},
    {"N": 3200.0, "n_firing": 2.0, "IVC": 250.0, "EVC": -10.0, "EVO": -200.0, "lambda": 1.1},
]


def settled(values: dict[str, float]) -> Steady:
    """The equilibrium at the inputs and parameters given, found once."""
    return _settled(tuple(sorted(values.items())))


@cache
def _settled(values: tuple[tuple[str, float], ...]) -> Steady:
    return steady_state(ENGINE, point(MODEL, dict(values)))


def named(found: Steady, name: str) -> float:
    return {**found.states, **found.outputs}[name]


def test_its_layout_is_that_of_the_paper():
    # 20 states with x1 p_boost, x3 p_em, x7 omega_tc (Figures 5 to 7), x14 to x20 actuators and sensors; 8 inputs, and
    # the engine's speed as the one disturbance.
    assert len(STATES) == 20 and [STATE_NAMES[i] for i in (0, 2, 6)] == ["p_boost", "p_em", "omega_tc"]
    assert STATE_NAMES[13:] == list(LAGS) and STATE_NAMES[16:] == list(SENSORS) == ["EGR_DP", "MAFa", "MAFh", "MAF"]
    assert [name[0] for name in STATE_NAMES[7:13]] == ["F"] * 6 and STATE_NAMES[9] == "F_im"
    assert len(INPUTS) == 9 and INPUT_NAMES[-1] == "N" and "W_cyl" in OUTPUT_NAMES
    assert set(ACCURACIES) == set(SENSORS)


def test_every_parameter_has_a_unit_and_the_tag_of_its_source():
    for signal in PARAMETERS:
        parse_unit(signal.unit)
        assert any(tag in signal.description for tag in ("[R]", "[C]", "[I]")), signal.name


def test_the_start_values_are_the_equilibrium():
    found = settled({})
    for signal in (*STATES, *OUTPUTS):
        # Written with ten and seven digits.
        rel = 1e-9 if signal in STATES else 1e-6
        assert float(signal.start) == pytest.approx(named(found, signal.name), rel=rel, abs=1e-15), signal.name


def parameters(at: Point) -> dict[str, float]:
    return dict(zip([signal.name for signal in PARAMETERS], at.p, strict=True))


def random_points(count: int) -> list[Point]:
    """States far from equilibrium, with flows in both directions, and valves anywhere."""
    generator = np.random.default_rng(3)
    found = []
    for _ in range(count):
        x = np.empty(20)
        x[:3] = generator.uniform(0.4e5, 2.5e5, 3)
        x[3:6] = [*generator.uniform(270.0, 400.0, 2), generator.uniform(700.0, 1300.0)]
        x[6] = generator.choice([0.0, generator.uniform(0.0, 2e4)], p=[0.1, 0.9])
        x[7:13] = generator.uniform(0.0, 1.0, 6)
        x[13:16] = generator.uniform(0.0, [90.0, 90.0, 30.0])
        x[16:] = generator.uniform(-0.1, 0.1, 4)
        u = [generator.uniform(0.0, high) for high in (90.0, 30.0, 90.0, 4.0)]
        u += [generator.uniform(*span) for span in ((-30, 20), (180, 260), (-250, -190), (-20, 30), (0, 6000))]
        values = {"lambda": generator.uniform(0.8, 1.3), "p_a": generator.uniform(0.8e5, 1.1e5)}
        found.append(point(MODEL, values)._replace(x=x, u=np.array(u)))
    return found


def conserved(at: Point) -> dict[str, tuple[float, float]]:
    """What is stored, by the derivatives, and what is supplied: mass [kg/s], burnt mass [kg/s], energy [W]."""
    x, p = dict(zip(STATE_NAMES, at.x, strict=True)), parameters(at)
    u = dict(zip(INPUT_NAMES, at.u, strict=True))
    derivatives, outputs = ENGINE.values(at)
    dx, y = dict(zip(STATE_NAMES, derivatives, strict=True)), dict(zip(OUTPUT_NAMES, outputs, strict=True))
    cp = {k: p[f"gamma_{k}"] * p[f"R_{k}"] / (p[f"gamma_{k}"] - 1.0) for k in "ae"}
    mass, stored, energy, burnt = {}, {}, {}, 0.0
    for place, k in (("boost", "a"), ("im", "a"), ("em", "e")):
        V, pressure, T = p[f"V_{place}"], x[f"p_{place}"], x[f"T_{place}"]
        mass[place] = pressure * V / (p[f"R_{k}"] * T)
        stored[place] = mass[place] * (dx[f"p_{place}"] / pressure - dx[f"T_{place}"] / T)
        energy[place] = V / (p[f"gamma_{k}"] - 1.0) * dx[f"p_{place}"]
        burnt += mass[place] * dx[f"F_{place}"] + x[f"F_{place}"] * stored[place]
    for place, k in (("mix", "a"), ("t", "e"), ("egr", "e")):  # these hold as much as flows through them allows
        pressure = y["p_mix"] if place == "mix" else y["p_t"]
        burnt += pressure * p[f"V_{place}"] / (p[f"R_{k}"] * y[f"T_{place}"]) * dx[f"F_{place}"]
    turned = y["W_turbine"] + y["W_wg"]
    tail = turned - y["W_egr"]
    excess = max(p["lambda"] - 1.0, 0.0)
    # Of the air that goes in with the fuel the excess stays unburnt.
    made = y["W_exh"] - y["W_fuel"] * p["AF_s"] * excess - y["W_cyl"] * x["F_im"]
    leaves = max(tail, 0.0) * x["F_t"] - min(y["W_a"], 0.0) * x["F_mix"]
    work = y["torque_compressor"] * x["omega_tc"]
    if y["W_mix"] >= 0.0:
        hot = y["W_mix"] * cp["a"] * (y["T_mix"] - p["T_cac_cool"]) + work
        compressed = y["W_mix"] * cp["a"] * y["T_mix"] + work - p["eps_cac"] * hot
    else:
        compressed = y["W_mix"] * cp["a"] * x["T_boost"]
    v, v_0 = (cylinder_volume(angle, p["r_c"], p["rod_ratio"]) for angle in (u["EVO"], p["EVO_0"]))
    T_exh = (p["T_0"] + p["K_s"] * np.sqrt(y["W_exh"])) * (v_0 / v) ** (0.3 / 1.3)
    drag = p["f_tc"] * x["omega_tc"] ** 2
    return {
        "mass of air": (stored["boost"] + stored["im"], y["W_mix"] - y["W_cyl"]),
        "mass of exhaust": (stored["em"], y["W_exh"] - turned),
        "burnt mass": (burnt, made - leaves),
        "energy of air": (energy["boost"] + energy["im"], compressed - y["W_cyl"] * cp["a"] * x["T_im"]),
        "energy of exhaust": (energy["em"], cp["e"] * (y["W_exh"] * T_exh - turned * x["T_em"])),
        "energy over turbine": (
            max(turned, p["W_least"]) * cp["e"] * (x["T_em"] - y["T_t"]), y["torque_turbine"] * x["omega_tc"],
        ),
        "shaft": (
            p["J_tc"] * x["omega_tc"] * dx["omega_tc"],
            (y["torque_turbine"] - y["torque_compressor"]) * x["omega_tc"] - drag,
        ),
    }  # fmt: skip


def test_mass_burnt_mass_and_energy_are_conserved_in_every_state_whichever_way_the_gas_flows():
    backwards = set()
    for at in random_points(300):
        outputs = dict(zip(OUTPUT_NAMES, ENGINE.values(at)[1], strict=True))
        backwards |= {name for name, W in outputs.items() if name.startswith("W_") and W < 0.0}
        if 0.0 < outputs["W_exh"] < 1e-4:
            continue  # there the root in the exhaust's temperature is a line
        for name, (stored, supplied) in conserved(at).items():
            # Sums of a dozen flows of up to 1 kg/s and powers of up to 1 MW, to 1e-13 of the largest.
            size = 1e-13 if "mass" in name else 1e-7
            assert stored == pytest.approx(supplied, rel=1e-10, abs=size), name
    # EGR has the pressure behind the turbine before it, never below the ambient's, and one below that behind it.
    assert backwards == {"W_a", "W_mix", "W_cac", "W_th", "W_turbine", "W_wg"}


def test_every_derivative_is_finite_in_every_state():
    equations = trace(MODEL).equations
    t, x, m, u, p = equations.sx_in()
    everything = ca.jacobian(ca.vertcat(*equations.call([t, x, m, u, p])), ca.vertcat(x, u, p))
    slopes = ca.Function("everything", [x, u, p], [everything])
    for at in random_points(200):
        assert np.isfinite(slopes(at.x, at.u, at.p).full()).all()


def plain(at: Point) -> np.ndarray:
    """x' and y of the Python source itself, without CasADi."""
    dx, y = FlatModel(MODEL).derivatives_and_outputs(0.0, list(at.x), [], list(at.u), list(at.p))
    return np.array([*dx, *y], dtype=float)


@pytest.mark.parametrize("values", OPERATION, ids=str)
def test_the_exact_jacobians_match_differences_of_the_python_source(values):
    # Off the equilibrium, so that no kink is near; the throttle's own is at equal pressures.
    rest = settled(values).point
    x = rest.x * (1.0 + 1e-2 * np.random.default_rng(2).normal(size=20))
    x[9], x[13:16] = x[9] + 1e-3, x[13:16] + 1e-2  # burnt gas and valves of zero are kinks, too
    at = rest._replace(x=x)
    linear = ENGINE.at(at)
    exact = np.block([[linear.A, linear.B], [linear.C, linear.D]])
    scale = np.concatenate([NOMINAL, [signal.nominal for signal in INPUTS]])
    found = np.empty_like(exact)
    for j, size in enumerate(scale):
        step = 1e-5 * size
        moved = [plain(_moved(at, j, sign * step)) for sign in (1.0, -1.0)]
        found[:, j] = (moved[0] - moved[1]) / (2.0 * step)
    # Central differences over 1e-5: 1e-10 by the cube, 1e-11 by rounding of a row that is large before it cancels.
    rows = np.abs(exact * scale).max(axis=1)
    off = np.abs(found - exact) * scale / np.where(rows > 0.0, rows, 1.0)[:, None]
    assert off.max() < 1e-6, np.unravel_index(off.argmax(), off.shape)


def _moved(at: Point, j: int, by: float) -> Point:
    both = np.concatenate([at.x, at.u])
    both[j] += by
    return at._replace(x=both[:20], u=both[20:])


@pytest.mark.parametrize("values", OPERATION, ids=str)
def test_at_rest_the_balances_hold_from_the_flows_alone(values):
    found = settled(values)
    x, y, p = found.states, found.outputs, parameters(found.point)
    cp_e = p["gamma_e"] * p["R_e"] / (p["gamma_e"] - 1.0)
    assert y["W_cyl"] > 0.0 and x["omega_tc"] > 0.0
    egr = y["W_egr"] * x["F_t"]
    balances = {
        "mixing": (y["W_a"] + y["W_egr"], y["W_mix"]),
        **{f"mass {name}": (y[name], y["W_cyl"]) for name in ("W_mix", "W_cac", "W_th")},
        "mass exhaust": (y["W_turbine"] + y["W_wg"], y["W_exh"]),
        "fuel": (y["W_exh"] - y["W_cyl"], y["W_cyl"] * (1.0 - x["F_im"]) / (p["lambda"] * p["AF_s"])),
        "burnt": (x["F_im"] * y["W_mix"], egr),
        "burnt boost": (x["F_boost"], x["F_mix"]),
        "egr": (y["egr_rate"], y["W_egr"] / y["W_cyl"]),
        "throttle": (x["T_im"], x["T_boost"]),
        "turbine": (y["W_exh"] * cp_e * (x["T_em"] - y["T_t"]), y["torque_turbine"] * x["omega_tc"]),
        "shaft": (y["torque_turbine"], y["torque_compressor"] + p["f_tc"] * x["omega_tc"]),
        **{f"sensor {s}": (x[s], y[w]) for s, w in zip(SENSORS, ("W_egr", "W_a", "W_cac", "W_mix"), strict=True)},
    }
    for name, (one, other) in balances.items():
        # Newton's method leaves 1e-14 of the states; flows of small pressure drops amplify it.
        assert one == pytest.approx(other, rel=1e-8), name
    if p["lambda"] == 1.0:
        # Of stoichiometric fuel nothing but burnt gas comes back, and the intake has the EGR's share of it.
        assert x["F_em"] == pytest.approx(1.0, rel=1e-12) and x["F_im"] == pytest.approx(y["egr_rate"], rel=1e-9)
    else:
        # Of lambda - 1 of the fresh air, only the fuel's share is burnt: F = ((1 + AF) W_f + W F_im)/W_exh.
        burnt = (1.0 + p["AF_s"]) * y["W_fuel"] + y["W_cyl"] * x["F_im"]
        assert x["F_em"] == pytest.approx(burnt / y["W_exh"], rel=1e-9) and x["F_em"] < 1.0


@pytest.mark.parametrize("values", OPERATION[:3], ids=str)
def test_the_equilibrium_is_found_by_powells_method_without_a_jacobian_too(values):
    found = settled(values).point
    start = found.x / NOMINAL * (1.0 + 2e-3 * np.random.default_rng(5).normal(size=20))
    other = root(lambda z: plain(found._replace(x=z * NOMINAL))[:20] / NOMINAL, start, method="hybr", tol=1e-13)
    # Its own differences make it stop where 1e-8 of a slow rate is left.
    np.testing.assert_allclose(other.x * NOMINAL, found.x, rtol=1e-6)


def test_at_the_papers_point_egr_is_two_to_three_percent_and_ten_in_its_cycle():
    assert 0.02 < settled({}).outputs["egr_rate"] < 0.03
    wide = settled({"N": 2400.0, "egr_valve": 20.0}).outputs["egr_rate"]
    narrow = settled({"N": 4000.0, "egr_valve": 7.0}).outputs["egr_rate"]
    # The paper's range is 1.5 to 11 %.
    assert narrow < 0.02 and 0.09 < wide < 0.12


@pytest.mark.parametrize(
    ("name", "values", "rising", "falling"),
    [
        ("throttle", (15.0, 25.0, 60.0), ["W_cyl", "p_im"], []),
        ("wastegate", (8.0, 11.6, 15.0), ["W_wg"], ["p_boost", "omega_tc", "W_cyl", "p_em"]),
        ("egr_valve", (2.0, 10.0, 25.0), ["F_im", "EGR_DP", "T_mix"], ["MAFa"]),
        ("N", (2400.0, 3200.0, 4000.0), ["W_cyl", "MAF", "T_em"], []),
        ("n_firing", (2.0, 3.0, 4.0), ["W_cyl", "omega_tc"], []),
        ("IVC", (200.0, 220.0, 250.0), [], ["W_cyl"]),
        ("EVC", (0.0, 15.0, 40.0), [], ["W_cyl"]),
        ("EVO", (-240.0, -225.0, -200.0), [], ["T_em"]),
    ],
)
def test_what_an_input_does_at_rest_has_the_sign_that_engines_have(name, values, rising, falling):
    rests = [settled({name: value}) for value in values]
    for signal in rising + falling:
        sign = 1.0 if signal in rising else -1.0
        series = [sign * named(rest, signal) for rest in rests]
        assert series == sorted(series) and series[0] < series[-1], (signal, series)


def test_with_the_valves_at_the_dead_centres_the_filling_is_that_of_turbo_si():
    at = point(MODEL, {"IVO": 0.0, "EVC": 0.0, "IVC": 180.0, "C_c": 0.95, "V_d": 1.8e-3, "N": 2500.0})
    W_cyl = dict(zip(OUTPUT_NAMES, ENGINE.values(at)[1], strict=True))["W_cyl"]
    x = dict(zip(STATE_NAMES, at.x, strict=True))
    same = {name: x[name] for name in ("p_im", "p_em", "T_im")} | {"N": 2500.0, "lambda": 1.0}
    outputs = jacobians(turbo_si.MODEL).values(point(turbo_si.MODEL, same))[1]
    expected = dict(zip([signal.name for signal in turbo_si.OUTPUTS], outputs, strict=True))["W_c"]
    assert W_cyl == pytest.approx(expected, rel=1e-13)


def test_a_cylinders_volume_is_that_of_its_crank():
    # Clearance and displacement at the dead centres; a finite rod leaves less than half the stroke at 90 degrees.
    assert cylinder_volume(0.0, 9.5, 0.31) == pytest.approx(1.0 / 8.5, rel=1e-15)
    assert cylinder_volume(180.0, 9.5, 0.31) == pytest.approx(9.5 / 8.5, rel=1e-15)
    crank, rod = 0.31, 1.0
    a = np.deg2rad(70.0)
    position = crank * np.cos(a) + np.sqrt(rod**2 - (crank * np.sin(a)) ** 2)
    expected = 1.0 / 8.5 + (crank + rod - position) / (2.0 * crank)
    assert cylinder_volume(70.0, 9.5, 0.31) == pytest.approx(expected, rel=1e-14)


def test_the_filling_coefficient_is_that_of_set_b_at_the_closing_angle():
    p = parameters(point(MODEL))
    share = cylinder_volume(180.0, p["r_c"], p["rod_ratio"]) / cylinder_volume(220.0, p["r_c"], p["rod_ratio"])
    assert p["C_c"] == pytest.approx(0.841 * share, abs=0.001)


@pytest.mark.parametrize("values", OPERATION, ids=str)
def test_it_is_stable_at_rest(values):
    rates = np.linalg.eigvals(ENGINE.at(settled(values).point).A)
    assert rates.real.max() < -0.02  # the turbocharger settles in seconds, at the least load in half a minute


def test_its_sensors_see_the_whole_state_together_and_none_alone_for_its_equal_lags():
    operating = operate(Operation("turbo_si_egr", settled=True))
    assert operating.sensors == SENSORS
    lags = (0.0,) * 4
    measured = Measured(operating.space, SENSORS, lags, operating.structure(), operating.model)
    found = observe(measured, tuple(range(20)), [(0, 1, 2, 3), (0,), (1,), (2,), (3,)], "exact", Options())
    # A single sensor cannot tell two actuators of the same time constant, 50 ms, apart: an eigenvalue of two
    # eigenvectors wants two sensors.
    assert found.index[0] == 7 and not found.index[1:].any()
    apart = operate(Operation("turbo_si_egr", ["tau_egr_valve=60 ms"], settled=True))
    measured = Measured(apart.space, SENSORS, lags, apart.structure(), apart.model)
    wanted = tuple(STATE_NAMES.index(name) for name in ("F_im", "F_mix", "p_boost"))
    assert observe(measured, wanted, [(0,)], "exact", Options()).index[0] > 0
