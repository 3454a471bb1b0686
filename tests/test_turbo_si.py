"""The turbocharged engine: the paper's structure, what is conserved, and its equilibria by independent solvers."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from engine_at_rest import (
    ENGINE,
    INPUT_NAMES,
    NOMINAL,
    OPERATION,
    OUTPUT_NAMES,
    SETS,
    STATE_NAMES,
    parameters,
    settled,
)
from scipy.integrate import solve_ivp
from scipy.optimize import root

from fmus.interface import dependence
from fmus.jacobians import Point, jacobians, point
from fmus.model import FlatModel
from fmus.plants import turbo_si_speed
from fmus.plants.turbo_si import MODEL, OUTPUTS, PARAMETER_SETS, PARAMETERS, STATES
from fmus.steady import SteadyError, steady_state
from fmus.tracing import trace
from fmus.units import parse_unit

PLACES = ("af", "comp", "ic", "im", "em", "t")
CRITICAL = (2.0 / 2.4) ** 3.5

# e1 to e13 of the paper, Section 2.2, and the flows of Section 2.2.
_AROUND = {
    "af": "p_af T_af p_comp omega_tc p_a T_a",
    "comp": "p_af T_af p_comp T_comp p_ic omega_tc",
    "ic": "p_comp T_comp p_ic T_ic p_im alpha",
    "im": "p_ic T_ic T_im p_im p_em N alpha lambda",
    "em": "p_im T_im p_em T_em p_t N lambda u_wg T_a",
    "t": "p_em T_em p_t T_t omega_tc u_wg p_a",
}
PAPER = {f"{quantity}_{place}": set(on.split()) for place, on in _AROUND.items() for quantity in ("p", "T")}
PAPER["omega_tc"] = {"p_af", "T_af", "p_comp", "p_em", "T_em", "p_t", "omega_tc"}
PAPER_FLOWS = {
    "W_af": {"p_af", "p_a", "T_a"},
    "W_comp": {"p_af", "T_af", "p_comp", "omega_tc"},
    "W_ic": {"p_comp", "T_comp", "p_ic"},
    "W_th": {"p_im", "p_ic", "T_ic", "alpha"},
}


def dependences(pattern: np.ndarray, more: np.ndarray) -> list[set[str]]:
    names = [*STATE_NAMES, *INPUT_NAMES]
    return [{names[i] for i in np.flatnonzero(row)} for row in np.hstack([pattern, more])]


def operating_points(parameter_set: str | None, choked: bool, wanted: int = 8) -> list[Point]:
    """Random points a little off the equilibria, every flow forwards and the compressor's outlet above its inlet."""
    generator = np.random.default_rng(7)
    found: list[Point] = []
    while len(found) < wanted:
        values = {
            "N": generator.uniform(1000.0, 5500.0),
            "alpha": generator.uniform(0.05, 0.12) if choked else generator.uniform(0.2, 1.0),
            "lambda": generator.uniform(0.8, 1.2),
            "u_wg": generator.uniform(0.05, 0.3),
            "p_a": generator.uniform(9e4, 1.03e5),
            "T_a": generator.uniform(270.0, 310.0),
        }
        at = settled(values, parameter_set).point
        at = at._replace(x=at.x * (1.0 + 1e-4 * generator.normal(size=13)))
        x = dict(zip(STATE_NAMES, at.x, strict=True))
        flows = ENGINE.values(at)[1][:10]
        if (x["p_im"] / x["p_ic"] < CRITICAL) == choked and (flows > 0.0).all() and x["p_comp"] > x["p_af"]:
            found.append(at)
    return found


@pytest.mark.parametrize("choked", [False, True], ids=["open", "choked"])
@pytest.mark.parametrize("parameter_set", SETS)
def test_every_equation_depends_on_what_the_paper_lists_and_on_nothing_else(parameter_set, choked):
    points = operating_points(parameter_set, choked)
    expected = {name: set(on) for name, on in {**PAPER, **PAPER_FLOWS}.items()}
    if choked:  # the elements in parentheses
        for name in ("p_ic", "T_ic", "W_th"):
            expected[name].remove("p_im")
    if parameter_set == "B":  # its exhaust pipes lose no heat to the ambient
        for name in ("p_em", "T_em"):
            expected[name].remove("T_a")
    for at in [*([one] for one in points), points]:
        structure = ENGINE.structure(at)
        found = dict(zip(STATE_NAMES, dependences(structure.A, structure.B), strict=True))
        flows = dict(zip(OUTPUT_NAMES, dependences(structure.C, structure.D), strict=True))
        found |= {name: flows[name] for name in PAPER_FLOWS}
        assert found == expected


def test_the_symbolic_structure_adds_only_what_flows_backwards_would_carry():
    traced = trace(MODEL)
    found = dependences(dependence(traced.equations, 0, "x"), dependence(traced.equations, 0, "u"))
    more = {name: on - PAPER[name] for name, on in zip(STATE_NAMES, found, strict=True)}
    assert all(on >= PAPER[name] for name, on in zip(STATE_NAMES, found, strict=True))
    # Through each restriction the temperature behind it, and from the tail pipe the ambient's.
    behind = {"af": {"T_comp"}, "comp": {"T_ic"}, "ic": {"T_im"}, "im": set(), "em": {"T_t"}, "t": {"T_a"}}
    expected = {f"{quantity}_{place}": on for place, on in behind.items() for quantity in ("p", "T")}
    assert more == {**expected, "omega_tc": {"T_comp", "T_t"}}


def test_at_lambda_one_the_manifold_pressure_does_not_feel_its_temperature():
    i, j = STATE_NAMES.index("p_im"), STATE_NAMES.index("T_im")
    element = {}
    for richness in (1.0, 0.95):
        A = ENGINE.at(settled({"lambda": richness}).point).A
        element[richness] = abs(A[i, j]) * NOMINAL[j] / np.abs(A[i] * NOMINAL).max()
    # W_c T_im has no T_im left at lambda = 1 but for rounding; otherwise some thousandths of the row's largest element.
    assert element[1.0] < 1e-14 and element[0.95] > 1e-4


def conserved(at: Point, parameter_set: str | None) -> dict[str, tuple[float, float]]:
    """Mass [kg/s] and energy [W] stored, by the derivatives, and supplied, by what goes in and out.

    Air side: ambient to cylinders. Exhaust side: cylinders to ambient. Shaft: kinetic energy.
    """
    x = dict(zip(STATE_NAMES, at.x, strict=True))
    u = dict(zip(INPUT_NAMES, at.u, strict=True))
    p = parameters(parameter_set)
    derivatives, outputs = ENGINE.values(at)
    dx, y = dict(zip(STATE_NAMES, derivatives, strict=True)), dict(zip(OUTPUT_NAMES, outputs, strict=True))
    gas = {place: ("a" if place in PLACES[:4] else "e") for place in PLACES}
    mass, energy = {"a": 0.0, "e": 0.0}, {"a": 0.0, "e": 0.0}
    for place in PLACES:
        V, pressure, T = p[f"V_{place}"], x[f"p_{place}"], x[f"T_{place}"]
        R, gamma = p[f"R_{gas[place]}"], p[f"gamma_{gas[place]}"]
        mass[gas[place]] += V / (R * T) * (dx[f"p_{place}"] - pressure / T * dx[f"T_{place}"])
        energy[gas[place]] += V / (gamma - 1.0) * dx[f"p_{place}"]
    cp = {kind: p[f"gamma_{kind}"] * p[f"R_{kind}"] / (p[f"gamma_{kind}"] - 1.0) for kind in "ae"}

    def upwind(flow: str, ahead: float, behind: float) -> float:
        return ahead if y[flow] >= 0.0 else behind

    through_cooler = upwind("W_ic", x["T_comp"], x["T_ic"])
    heat = abs(y["W_ic"]) * cp["a"] * p["eps_ic"] * (through_cooler - p["T_cool"])
    air = y["W_af"] * cp["a"] * upwind("W_af", u["T_a"], x["T_af"]) - y["W_c"] * cp["a"] * x["T_im"] - heat
    exhaust = y["W_exh"] * cp["e"] * y["T_pipe"] - y["W_es"] * cp["e"] * upwind("W_es", x["T_t"], u["T_a"])
    speed = x["omega_tc"]
    drag = p["f_tc"] * speed**2
    return {
        "air mass": (mass["a"], y["W_af"] - y["W_c"]),
        "exhaust mass": (mass["e"], y["W_exh"] - y["W_es"]),
        "air energy": (energy["a"], air + y["torque_compressor"] * speed),
        "exhaust energy": (energy["e"], exhaust - y["torque_turbine"] * speed),
        "shaft": (p["J_tc"] * speed * dx["omega_tc"], (y["torque_turbine"] - y["torque_compressor"]) * speed - drag),
    }


def random_states(count: int) -> list[Point]:
    """States far from equilibrium: flows in both directions, equal pressures, a turbocharger at rest."""
    generator = np.random.default_rng(11)
    found = []
    for k in range(count):
        x = np.empty(13)
        x[0:12:2] = generator.uniform(0.3e5, 2.5e5, 6)
        x[1:12:2] = [*generator.uniform(250.0, 450.0, 4), *generator.uniform(500.0, 1300.0, 2)]
        x[12] = generator.choice([0.0, generator.uniform(0.0, 25000.0)], p=[0.1, 0.9])
        p_a = generator.uniform(0.7e5, 1.1e5)
        if k % 4 == 0:  # a pair of neighbours, or all of them, at one pressure
            pair = generator.integers(0, 6)
            x[0:12:2] = np.where(np.isin(np.arange(6), [pair, pair + 1]) | (k % 8 == 0), p_a, x[0:12:2])
        richness, alpha = generator.uniform(0.7, 1.4), generator.uniform(0.0, 1.0)
        u = np.array([generator.uniform(0.0, 6500.0), alpha, richness, generator.uniform(), p_a, 290.0])
        found.append(point(MODEL)._replace(x=x, u=u))
    return found


def test_mass_and_energy_are_conserved_in_every_state_whichever_way_the_gas_flows():
    backwards = set()
    for parameter_set in SETS:
        for at in random_states(150):
            at = at._replace(p=point(MODEL, None, parameter_set).p)
            backwards |= {name for name, W in zip(OUTPUT_NAMES[:10], ENGINE.values(at)[1], strict=False) if W < 0.0}
            for name, (stored, supplied) in conserved(at, parameter_set).items():
                # Sums of up to a dozen flows of 1 kg/s and powers of 1 MW, to 1e-13 of the largest.
                size = 1e-13 if "mass" in name else 1e-7
                assert stored == pytest.approx(supplied, rel=1e-10, abs=size), (name, parameter_set)
    assert backwards == {"W_af", "W_comp", "W_ic", "W_th", "W_turbine", "W_wg", "W_es"}


def test_every_derivative_is_finite_in_every_state():
    inputs = trace(MODEL).equations
    t, x, m, u, p = inputs.sx_in()
    dx, y = inputs.call([t, x, m, u, p])
    everything = ca.Function("everything", [x, u, p], [ca.jacobian(ca.vertcat(dx, y), ca.vertcat(x, u, p))])
    for parameter_set in SETS:
        for at in random_states(100):
            assert np.isfinite(everything(at.x, at.u, point(MODEL, None, parameter_set).p).full()).all()


@pytest.mark.parametrize("parameter_set", SETS)
@pytest.mark.parametrize("values", OPERATION, ids=lambda values: f"{values['N']:.0f} rpm")
def test_at_rest_mass_and_energy_balance_from_the_flows_alone(values, parameter_set):
    found = settled(values, parameter_set)
    x, y, p = found.states, found.outputs, parameters(parameter_set)
    u = dict(zip(INPUT_NAMES, found.point.u, strict=True))
    cp_a, cp_e = (p[f"gamma_{k}"] * p[f"R_{k}"] / (p[f"gamma_{k}"] - 1.0) for k in "ae")
    W, burnt, speed = y["W_c"], y["W_exh"], x["omega_tc"]
    assert W > 0.0 and speed > 0.0
    balances = {
        **{f"mass {name}": (y[name], W) for name in ("W_af", "W_comp", "W_ic", "W_th")},
        "mass exhaust": (y["W_turbine"] + y["W_wg"], burnt),
        "mass tail pipe": (y["W_es"], burnt),
        "fuel": (burnt - W, W / (u["lambda"] * p["AF_s"])),
        "filter": (x["T_af"], u["T_a"]),
        "compressor": (W * cp_a * (x["T_comp"] - x["T_af"]), y["torque_compressor"] * speed),
        "intercooler": (x["T_ic"], x["T_comp"] - p["eps_ic"] * (x["T_comp"] - p["T_cool"])),
        "throttle": (x["T_im"], x["T_ic"]),
        "manifold": (x["T_em"], y["T_pipe"]),
        "turbine": (burnt * cp_e * (x["T_em"] - x["T_t"]), y["torque_turbine"] * speed),
        "shaft": (y["torque_turbine"] * speed, y["torque_compressor"] * speed + p["f_tc"] * speed**2),
    }
    for name, (one, other) in balances.items():
        # Newton's method leaves 1e-14; the difference of two temperatures, 0.1 K of 300 K at idle, 1e-11 of it.
        assert one == pytest.approx(other, rel=1e-8), name


def test_the_start_values_are_the_equilibrium_of_the_default_set():
    found = settled({})
    for signal in (*STATES, *OUTPUTS):
        value = {**found.states, **found.outputs}[signal.name]
        # Written with ten and seven digits.
        assert float(signal.start) == pytest.approx(value, rel=1e-9 if signal in STATES else 1e-6, abs=1e-15)


def plain_rates(x: np.ndarray, at: Point) -> np.ndarray:
    """x' of the Python source itself, without CasADi."""
    flat = FlatModel(MODEL)
    return np.array(flat.derivatives_and_outputs(0.0, list(x), [], list(at.u), list(at.p))[0], dtype=float)


@pytest.mark.parametrize("parameter_set", SETS)
@pytest.mark.parametrize("values", OPERATION[1:], ids=lambda values: f"{values['N']:.0f} rpm")
def test_the_equilibrium_is_found_by_powells_method_without_a_jacobian_too(values, parameter_set):
    found = settled(values, parameter_set)
    start = found.point.x * (1.0 + 2e-3 * np.random.default_rng(5).normal(size=13))
    other = root(lambda z: plain_rates(z * NOMINAL, found.point) / NOMINAL, start / NOMINAL, method="hybr", tol=1e-13)
    # Its own differences make it stop where 1e-8 of a slow rate is left.
    np.testing.assert_allclose(other.x * NOMINAL, found.point.x, rtol=1e-7)


@pytest.mark.parametrize("parameter_set", SETS)
def test_the_equilibrium_is_where_a_long_simulation_ends(parameter_set):
    found = settled(OPERATION[2], parameter_set)
    start = point(MODEL).x
    run = solve_ivp(
        lambda t, z: plain_rates(z * NOMINAL, found.point) / NOMINAL, (0.0, 150.0), start / NOMINAL,
        method="LSODA", rtol=1e-9, atol=1e-11,
    )  # fmt: skip
    # 150 s are above thirty times the slowest time constant here; LSODA's own tolerance remains.
    np.testing.assert_allclose(run.y[:, -1] * NOMINAL, found.point.x, rtol=1e-6)


def test_an_engine_that_stands_still_has_no_single_equilibrium():
    with pytest.raises(SteadyError, match=r"turbo_si has no single equilibrium here: T_\w+ is free"):
        settled({"N": 0.0})


def test_the_air_charge_is_the_cylinders_flow_over_a_cycle():
    for values in OPERATION:
        y = settled(values).outputs
        assert y["cac_cycle"] == pytest.approx(y["W_c"] * 120.0 / values["N"], rel=1e-13)
        assert y["cac_stroke"] == pytest.approx(y["cac_cycle"] / 4.0, rel=1e-15)
    x, u, p = settled(OPERATION[3]).states, OPERATION[3], parameters(None)
    T_i = x["T_im"] - p["C_2"] * (1.0 / u["lambda"] - 1.0)
    ratio = (p["r_c"] - (x["p_em"] / x["p_im"]) ** (1.0 / 1.3)) / (p["r_c"] - 1.0)
    expected = p["C_c"] * ratio * x["p_im"] * p["V_d"] * (u["N"] / 60.0) / (2.0 * p["R_a"] * T_i)
    assert settled(OPERATION[3]).outputs["W_c"] == pytest.approx(expected, rel=1e-13)


def test_the_torque_is_the_fuels_work_less_pumping_and_friction_over_the_cycle():
    for values in OPERATION[1:4]:
        found, p = settled(values), parameters(None)
        x, y = found.states, found.outputs
        cycle = 120.0 / values["N"]  # s
        fuel = y["W_fuel"] * min(values["lambda"], 1.0) * cycle  # what burns, kg
        ideal = 1.0 - 1.0 / p["r_c"] ** 0.3
        krpm = values["N"] / 1000.0
        friction = (1.70e5 - 0.243e5 * krpm + 0.069e5 * krpm**2) * p["V_d"]
        work = 0.803 * ideal * p["q_lhv"] * fuel - (x["p_em"] - x["p_im"]) * p["V_d"] - friction
        assert y["torque"] == pytest.approx(work / (4.0 * np.pi), rel=1e-12)


def test_the_exhaust_pipe_cools_by_its_heat_transfer():
    found, p = settled(OPERATION[3]), parameters(None)
    W, T_a = found.outputs["W_exh"], 298.0
    each = W / 4.0
    Nu = 0.26 * (4.0 * each / (np.pi * 0.04 * 4e-5)) ** 0.6
    h = 1.0 / (1.0 / 95.0 + 1.0 / (Nu * 0.07 / 0.04))
    T_e = 1100.0 + 3000.0 * W
    expected = T_a + (T_e - T_a) * np.exp(-h * np.pi * 0.04 * 0.45 / (each * 1.3 * p["R_e"] / 0.3))
    assert found.outputs["T_pipe"] == pytest.approx(expected, rel=1e-13)
    hot = settled(OPERATION[3], "B").outputs
    assert hot["T_pipe"] == pytest.approx(774.0 + 1401.0 * np.sqrt(hot["W_exh"]), rel=1e-14)


def tip_speed(parameter_set: str | None, values: dict[str, float]) -> float:
    return settled(values, parameter_set).states["omega_tc"] * parameters(parameter_set)["D_c"] / 2.0


def test_the_realistic_set_keeps_the_compressor_within_what_wheels_bear():
    # 5500 rpm, throttle open, wastegate such that PI = 1.7: the point that Phi_max was chosen at.
    full = {"N": 5500.0, "alpha": 1.0, "u_wg": 0.181}
    x = settled(full, "A_realistic").states
    assert x["p_comp"] / x["p_af"] == pytest.approx(1.7, abs=0.01)
    assert 450.0 < tip_speed("A_realistic", full) < 500.0
    assert tip_speed(None, {**full, "u_wg": 0.135}) > 750.0
    assert tip_speed("B", {**full, "u_wg": 0.135}) > 750.0


def test_with_its_speed_as_a_state_the_engine_rests_where_its_load_is_its_torque():
    model, rest = turbo_si_speed.MODEL, settled(OPERATION[1])
    held = {name: value for name, value in OPERATION[1].items() if name != "N"}
    start = {**held, "T_load": rest.outputs["torque"], "N": 1900.0}
    found = steady_state(jacobians(model), point(model, start))
    assert found.states["N"] == pytest.approx(2000.0, rel=1e-9)
    for name, value in rest.states.items():
        assert found.states[name] == pytest.approx(value, rel=1e-9)


def test_with_its_speed_as_a_state_the_engine_turns_faster_by_what_torque_is_left_over():
    model = turbo_si_speed.MODEL
    dx, y = jacobians(model).values(point(model, {"T_load": 20.0}))
    torque = dict(zip([signal.name for signal in model.outputs], y, strict=True))["torque"]
    # J domega/dt = M, in rpm a second.
    assert dx[-1] == pytest.approx((torque - 20.0) / 0.15 * 30.0 / np.pi, rel=1e-14)
    np.testing.assert_array_equal(dx[:-1], ENGINE.values(point(MODEL))[0])


def test_every_parameter_has_a_unit_and_the_tag_of_its_source():
    for signal in PARAMETERS:
        parse_unit(signal.unit)
        assert any(tag in signal.description for tag in ("[R]", "[C]", "[I]")), signal.name
    assert [signal.name for signal in STATES] == list(PAPER)
    assert set(PARAMETER_SETS) == {"A_realistic", "B"}
