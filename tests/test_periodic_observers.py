"""Periodic-input observers as FMUs: they converge as their multipliers say, to the truth, with the noise they say."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from filtered import Filter, TwinFilter
from lawbook import check_component
from periodic_runs import RPM, STEP, T720, at_rest, lag, periods, rod, told, two_lags
from scipy.integrate import solve_ivp

from fmus.component import ConfigurationError
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.tracing import trace
from harness.campaign import read_campaign
from harness.cases import execute
from observers import fourier_least_squares, lag_inversion, periodic_input, periodic_schedule, rod_inversion
from observers.periodic import input_row, responses, sampled_error, sampled_monodromy, sampled_multipliers
from observers.periodic_schedule import Schedule

WR = 2.0 * np.pi * 125.0
SPEED = "[1000, 4000] rpm"
LAG = {"A": [[-40.0]], "A0": [[40.0]], "C": [[1.0]], "speed": SPEED}
CHAIN = {"A": [[-40.0, 0.0], [50.0, -50.0]], "A0": [[40.0], [0.0]], "C": [[0.0, 1.0]], "speed": SPEED}
ROD = {"speed": SPEED, "frequency": "125 Hz"}
C3 = np.array([14.7, 0.4 - 0.3j, -0.2 + 0.1j, 0.05 + 0.1j])
C2 = np.array([157.0, 3.0 - 1.0j, 0.5 + 0.4j])


def published(per: str, sign: str, square: str = "square"):
    gains = {"published": {"per": per, "sign": sign, "input": square}}
    return lambda: rod_inversion.make(gains, **ROD, allow_unstable=True)


def designed(multiplier: float, **setting):
    return lambda: periodic_input.make(**setting, gains={"design": {"multiplier": multiplier}})


# The model, its plant, and the speed in rpm.
SETTINGS = {
    "lag, published per sample, 1500 rpm": (lambda: lags("sample"), lag(0.025), 1500.0),
    "lag, published per sample, 3000 rpm": (lambda: lags("sample"), lag(0.025), 3000.0),
    "lag, published per rad, 1500 rpm": (lambda: lags("rad"), lag(0.025), 1500.0),
    "two lags, published per sample, 2000 rpm": (lambda: lags("sample", "[25, 20] ms"), two_lags(0.025, 0.02), 2000.0),
    "lag, designed, 1000 rpm": (designed(0.3, **LAG), lag(0.025), 1000.0),
    "lag, designed, 2777 rpm": (designed(0.6, **LAG), lag(0.025), 2777.0),
    "two lags at once, designed, 1500 rpm": (designed(0.5, **CHAIN), two_lags(0.025, 0.02), 1500.0),
    "rod, published plus per sample, 1500 rpm": (published("sample", "plus"), rod(), 1500.0),
    "rod, published plus per rad, 1500 rpm": (published("rad", "plus"), rod(), 1500.0),
    "rod, published plus per rad, 4000 rpm": (published("rad", "plus"), rod(), 4000.0),
    "rod, published minus per rad, 1500 rpm": (published("rad", "minus"), rod(), 1500.0),
    "rod, published minus per sample, 1500 rpm": (published("sample", "minus"), rod(), 1500.0),
    "rod, published minus per rad, 4000 rpm": (published("rad", "minus"), rod(), 4000.0),
    "rod, designed, 1000 rpm": (lambda: rod_inversion.make({"design": {"multiplier": 0.4}}, **ROD), rod(), 1000.0),
    "rod, designed, 2500 rpm": (lambda: rod_inversion.make({"design": {"multiplier": 0.4}}, **ROD), rod(), 2500.0),
}


def lags(per: str, taus: str = "25 ms"):
    return lag_inversion.make(taus, {"published": {"per": per}}, speed=SPEED)


def certified(model, system, omega: float) -> float:
    """The largest multiplier at a speed, from the tables that the FMU reads: of all stages."""
    tables = {signal.name: np.asarray(signal.start) for signal in model.parameters}
    if model.name == "lag_inversion":
        one = lag(1.0)
        taus = [float(tables[name]) for name in ("tau_2", "tau_1") if name in tables]
    else:
        one, taus = system, [1.0]
    found = []
    for j, tau in enumerate(taus, start=1):
        nodes, table = tables[f"gain_nodes_{j}"], tables[f"gain_table_{j}"]
        variable = "interval" if model.name == "lag_inversion" else "speed"
        gain = Schedule(variable, nodes, table).gain(omega * tau)
        found.append(abs(sampled_multipliers(one, gain, omega * tau, STEP)[0]))
    return max(found)


@pytest.mark.parametrize("name", SETTINGS)
def test_measured_convergence_per_period_is_the_largest_multiplier(name):
    make, system, rpm = SETTINGS[name]
    model, omega = make(), rpm * RPM
    wanted = certified(model, system, omega)
    truth = C3 if system.harmonics == 3 else C2
    # So many periods that the largest alone is left of the error, but not so many that only rounding is.
    count = int(np.clip(abs(np.log(1e-9) / np.log(wanted)), 12, 400))
    found = periods(model, at_rest(system, truth, omega), omega, system.period, count, system.harmonics)
    size = np.log(np.linalg.norm(found - truth, axis=1))
    late = np.arange(count // 2, count)
    slope = np.polyfit(late, size[late], 1)[0]
    assert np.exp(slope) == pytest.approx(wanted, rel=0.05)
    if not name.startswith("two lags, published"):
        # 5 % of the rate, too: pairs of multipliers turn, and their error beats around the line. In a cascade two
        # stages have nearly the same multipliers, and its error shrinks as cycles times mu^cycles for long.
        assert slope == pytest.approx(np.log(wanted), rel=0.05)


@pytest.mark.parametrize("rpm", [1000.0, 1700.0, 4000.0])
@pytest.mark.parametrize("taus", ["25 ms", "[25, 20] ms"])
def test_without_noise_the_input_is_reconstructed_as_far_as_the_multiplier_lets(taus, rpm):
    model = lag_inversion.make(taus, {"design": {"multiplier": 0.2}}, speed=SPEED)
    system, omega = (lag(0.025) if taus == "25 ms" else two_lags(0.025, 0.02)), rpm * RPM
    cycles = 25
    found = periods(model, at_rest(system, C3, omega), omega, T720, cycles, 3)
    first = np.linalg.norm(found[0] - C3)
    # mu^cycles of the error, times cycles^2 since the modes of two stages may be equal; the floor is rounding of c_0.
    for cycle in (5, 10, cycles):
        bound = 10.0 * cycle**2 * 0.2 ** (cycle - 1) * max(first, 1.0) + 1e-11
        assert np.abs(found[cycle - 1] - C3).max() < bound


def test_the_signal_is_that_of_its_coefficients_at_the_sampling_instant():
    omega = 1500.0 * RPM
    model, y = periodic_input.make(**LAG, gains={"design": {"multiplier": 0.2}}), at_rest(lag(0.025), C3, omega)
    estimator = Filter(model, STEP / omega)
    for k in range(20 * 120):
        row = estimator(y=y(k * STEP), angle=6.0 * k, omega=omega)
        if k > 15 * 120:
            turned = C3 * np.exp(0.5j * np.arange(4) * k * STEP)
            assert row["w"] == pytest.approx(turned[0].real + 2.0 * turned[1:].real.sum(), abs=1e-8)
    for k in (1, 2, 3):
        assert row[f"E_{k}"] == pytest.approx(np.sqrt(2.0) * abs(C3[k]), abs=1e-8)
    estimator.component.close()


@pytest.mark.parametrize("step", ["1 ms", "0.4 ms"])
def test_on_a_clock_in_time_it_converges_as_well(step):
    # Neither step divides a period: the map does not depend on the angle, and the power may be broken.
    h, omega = float(step.split()[0]) * 1e-3, 1700.0 * RPM
    model = periodic_input.make(**LAG, gains={"design": {"multiplier": 0.4}}, step=step)
    estimator, y = Filter(model, h), at_rest(lag(0.025), C3, omega)
    samples = T720 / (omega * h)
    errors = []
    for k in range(round(16 * samples)):
        row = estimator(y=y(k * h * omega), angle=np.degrees(k * h * omega), omega=omega)
        errors.append(np.linalg.norm(told(row, 3) - C3))
    estimator.component.close()
    late = np.arange(len(errors) // 2, len(errors))
    slope = np.polyfit(late / samples, np.log(errors)[late], 1)[0]
    # The gains lie on lines between nodes, which keep the demand to half a per cent.
    assert slope == pytest.approx(np.log(0.4), rel=0.02)


@pytest.mark.parametrize("system", [lag(0.025), rod()], ids=["lag", "rod"])
def test_over_a_varying_speed_the_source_does_to_its_state_what_the_monodromy_says(system):
    # With y = 0 the estimate is the error, turned round. Column by column, over one period.
    if len(system.A) == 1:
        model = periodic_input.make(**LAG, gains={"design": {"multiplier": 0.5}})
    else:
        model = rod_inversion.make({"design": {"multiplier": 0.5}}, **ROD)

    def speed(alpha: float) -> float:
        return 2000.0 * RPM * (1.0 + 0.1 * np.sin(2.0 * np.pi * alpha / system.period))

    tables = {signal.name: np.asarray(signal.start) for signal in model.parameters}
    scheduled = Schedule("speed", tables["gain_nodes_1"], tables["gain_table_1"])
    wanted = sampled_monodromy(system, scheduled.gain, speed, STEP)
    n, samples = len(system.A), round(system.period / STEP)
    names = [signal.name for signal in model.discrete]
    columns = []
    for column in np.eye(system.size):
        twin = TwinFilter(model, 1e-3, lambda x, u, h: x)
        values = dict(zip(names, model.discrete, strict=True))
        flat = []
        for name in names:
            start = np.asarray(values[name].start, dtype=float)
            start = {"state_1": column[:n], "coefficients_1": column[n:], "begun": 1.0, "omega_before": speed(0.0)}.get(
                name, start
            )
            flat.append(np.broadcast_to(start, values[name].shape).ravel())
        twin.m = np.concatenate(flat)
        for k in range(1, samples + 1):
            row = twin(y=0.0, angle=6.0 * k, omega=speed(k * STEP))
        columns.append([*(row[f"state_1[{i + 1}]"] for i in range(n)),
                        *(row[f"coefficients_1[{i + 1}]"] for i in range(system.size - n))])  # fmt: skip
    found = np.array(columns).T
    # Taylor's series to 1e-13 and polynomials to 1e-9, over some tens of steps; rows in their own units.
    np.testing.assert_allclose(found, wanted, rtol=1e-7, atol=1e-7 * np.abs(wanted).max(axis=1, keepdims=True).max())


@pytest.mark.parametrize("name", ["lag", "rod"])
def test_on_a_plant_whose_speed_varies_it_ends_near_the_truth(name):
    # The plant moves with the speed itself, the observer with the mean over each step: of order two in the step.
    system, truth = (lag(0.025), C3) if name == "lag" else (rod(), C2)
    if name == "lag":
        model = periodic_input.make(**LAG, gains={"design": {"multiplier": 0.3}})
    else:
        model = rod_inversion.make({"design": {"multiplier": 0.3}}, **ROD)
    orders = system.order * np.arange(len(truth))

    def speed(alpha: float) -> float:
        return 2000.0 * RPM * (1.0 + 0.05 * np.sin(2.0 * np.pi * alpha / system.period))

    def w(alpha: float) -> float:
        turned = truth * np.exp(1j * orders * alpha)
        return float(turned[0].real + 2.0 * turned[1:].real.sum())

    samples, cycles = round(system.period / STEP), 20
    x0 = (responses(system, 2000.0 * RPM)[0].real @ truth[:1].real).ravel()
    run = solve_ivp(
        lambda a, x: (system.A @ x + system.A0[:, 0] * w(a)) / speed(a),
        (0.0, cycles * system.period), x0, t_eval=STEP * np.arange(cycles * samples), rtol=1e-9, atol=1e-9,
    )  # fmt: skip
    estimator = Filter(model, 1e-3)
    for k, x in enumerate(run.y.T):
        row = estimator(y=float(system.C[0] @ x), angle=6.0 * k, omega=speed(k * STEP))
    estimator.component.close()
    # 5 % of speed over 30 or 120 steps a period; measured 2e-4 of the largest harmonic and less.
    assert np.abs(told(row, system.harmonics) - truth).max() < 1e-3 * np.abs(truth[1:]).max()


def test_a_delay_turns_each_harmonic_forward():
    omega, delay = 1500.0 * RPM, 0.011
    orders = 0.5 * np.arange(4)
    upstream = C3 * np.exp(1j * orders * omega * delay)
    model = lag_inversion.make("25 ms", {"design": {"multiplier": 0.2}}, speed=SPEED, delay="11 ms")
    found = periods(model, at_rest(lag(0.025), C3, omega), omega, T720, 15, 3)
    np.testing.assert_allclose(found[-1], upstream, atol=1e-8)


def test_a_time_constant_may_be_an_input():
    omega, tau = 2000.0 * RPM, 0.033
    taus = [{"input": "tau_mixing", "range": "[20, 60] ms"}, "25 ms", "20 ms"]
    model = lag_inversion.make(taus, {"design": {"multiplier": 0.3}}, speed="[1500, 2500] rpm")
    chain = two_lags(0.025, 0.02)
    passed = C3 * 1.0 / (1.0 + 0.5j * np.arange(4) * omega * tau)
    estimator, y = Filter(model, STEP / omega), at_rest(chain, passed, omega)
    for k in range(40 * 120):
        row = estimator(y=y(k * STEP), angle=6.0 * k, omega=omega, tau_mixing=tau)
    np.testing.assert_allclose(told(row, 3), C3, atol=1e-7)
    estimator.component.close()


def test_of_a_rod_the_speed_at_the_cylinders_is_told():
    omega, mu = 1500.0 * RPM, 0.3
    model = rod_inversion.make({"design": {"multiplier": mu}}, **ROD)
    frequency = 2.0 * np.arange(3) * omega
    x2 = C2 / (1.0 + 0.3j * frequency / WR)
    estimator, y = Filter(model, STEP / omega), at_rest(rod(), C2, omega)
    for k in range(30 * 30):
        row = estimator(y=y(k * STEP), angle=6.0 * k, omega=omega)
    turned = x2 * np.exp(2j * np.arange(3) * k * STEP)
    assert row["omega_cylinder"] == pytest.approx(turned[0].real + 2.0 * turned[1:].real.sum(), abs=1e-8)
    for k in (1, 2):
        assert row[f"cylinder_{k}_re"] + 1j * row[f"cylinder_{k}_im"] == pytest.approx(x2[k], abs=1e-8)
        assert row[f"cylinder_E_{k}"] == pytest.approx(np.sqrt(2.0) * abs(x2[k]), abs=1e-8)
    estimator.component.close()


def test_the_printed_matrix_gives_back_what_was_measured():
    omega = 1500.0 * RPM
    X = responses(rod(), omega)
    for k in (1, 2):
        found = rod_inversion.printed_cylinder(WR**2 * C2[k], WR, 0.15, k * 2.0 * omega)
        assert found == pytest.approx(X[k, 0, 0] * C2[k], rel=1e-12)
        assert abs(found - C2[k] / (1.0 + 0.3j * k * 2.0 * omega / WR)) > 0.1 * abs(C2[k])


NOISY = {
    "lag": (lambda: periodic_input.make(**LAG, gains={"design": {"multiplier": 0.3}}), lag(0.025), 1500.0),
    "rod": (lambda: rod_inversion.make({"design": {"multiplier": 0.5}}, **ROD), rod(), 2000.0),
    "lag as published": (lambda: lags("sample"), lag(1.0), 1500.0 * 0.025),
}


@pytest.mark.parametrize("name", NOISY)
def test_noise_comes_through_as_the_lyapunov_equation_says(name):
    make, system, rpm = NOISY[name]
    model, sigma = make(), rpm * RPM
    tables = {signal.name: np.asarray(signal.start) for signal in model.parameters}
    variable = "interval" if name == "lag as published" else "speed"
    K = Schedule(variable, tables["gain_nodes_1"], tables["gain_table_1"]).gain(sigma)
    moved, H = sampled_error(system, K, sigma, STEP), input_row(system)
    P, power = np.zeros_like(moved), K @ K.T
    for _ in range(5000):
        P, power = P + power, moved @ power @ moved.T
    wanted = (H @ P @ H.T).item()
    # The mean square of n samples has the variance 2 wanted^2/n sum_j r_j^2, r_j the correlations.
    correlation, j = 1.0, moved.copy()
    for _ in range(3000):
        correlation += 2.0 * ((H @ j @ P @ H.T).item() / wanted) ** 2
        j = moved @ j
    omega = 1500.0 * RPM if name == "lag as published" else sigma
    n, generator = 24_000, np.random.default_rng(4)
    estimator = Filter(model, STEP / omega)
    w = np.array([estimator(y=v, angle=6.0 * k, omega=omega)["w"] for k, v in enumerate(generator.normal(size=n))])
    estimator.component.close()
    spread = np.sqrt(2.0 * correlation / n)
    # Four standard deviations: once in sixteen thousand seeds.
    assert np.mean(w[4000:] ** 2) / wanted == pytest.approx(1.0, abs=4.0 * spread * np.sqrt(n / (n - 4000)))


MODELS = {
    "periodic_input": lambda: periodic_input.make(**CHAIN, gains={"design": {"multiplier": 0.5}}, start=14.7),
    "lag_inversion": lambda: lag_inversion.make(
        [{"input": "tau", "range": "[20, 60] ms"}, "20 ms"], {"published": {"per": "rad"}}, delay="5 ms", speed=SPEED
    ),
    "rod_inversion": lambda: rod_inversion.make({"design": {"multiplier": 0.5}}, **ROD, harmonics=3),
    "rod in angle": lambda: rod_inversion.make({"published": {"per": "sample"}}, speed=SPEED, order=5.0),
    "fourier_least_squares": lambda: fourier_least_squares.make(0.5, "[25, 20] ms", speed=SPEED, delay="5 ms"),
    "two inputs": lambda: periodic_input.make(
        A=[[-40, 5, 0], [0, -60, 3], [2, 0, -30]], A0=[[40, 0], [0, 60], [0, 1]], C=[[1, 0, 0], [0, 1, 0.5]],
        gains={"design": {"multiplier": 0.5, "noise": [1.0, 2.0]}}, harmonics=2, speed=SPEED,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_a_periodic_observers_fmu_is_its_python_source(name):
    model = MODELS[name]()
    omega = 1800.0 * RPM
    twin, estimator = TwinFilter(model, STEP / omega, lambda x, u, h: x), Filter(model, STEP / omega)
    traced, flat = trace(model).sample, TwinFilter(model, STEP / omega, lambda x, u, h: x)
    generator = np.random.default_rng(3)
    for k in range(50):
        speed = omega * (1.0 + 0.05 * np.sin(0.1 * k))
        seen = {s.name: generator.normal(14.0) for s in model.inputs if s.name.startswith("y")}
        seen |= {"angle": 6.0 * k, "omega": speed}
        if name == "lag_inversion":
            seen["tau"] = 0.03 + 0.005 * np.sin(k)
        u = [seen[signal.name] for signal in model.inputs]
        wanted, row = twin(**seen), estimator(**seen)
        _, m = traced(0.0, flat.x, flat.m, u, flat.p)
        flat.m = m.full().ravel()
        for key, value in row.items():
            # Sums may be in another order, and sines from another library: a rounding a step, of the size of y.
            assert value == pytest.approx(wanted[key], rel=1e-9, abs=1e-9), (k, key)
        np.testing.assert_allclose(m.full().ravel(), twin.m, rtol=1e-9, atol=1e-9 * max(1.0, np.abs(twin.m).max()))
    estimator.component.close()


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("name", MODELS)
def test_periodic_observers_keep_the_laws_of_components(name, fmi):
    model = MODELS[name]()
    path = cached_fmu(model, fmi)
    check_component(lambda: load_fmu(path, role="observer"))


def test_two_inputs_are_reconstructed_from_two_outputs():
    model = MODELS["two inputs"]()
    A, A0 = np.array([[-40, 5, 0], [0, -60, 3], [2, 0, -30.0]]), np.array([[40, 0], [0, 60], [0, 1.0]])
    C = np.array([[1, 0, 0], [0, 1, 0.5]])
    omega, c = 1500.0 * RPM, np.array([[10.0, 5.0], [0.5 - 0.2j, -0.3j], [0.1, 0.2 + 0.1j]])
    G = [C @ np.linalg.solve(1j * 0.5 * k * omega * np.eye(3) - A, A0) @ c[k] for k in range(3)]
    estimator = Filter(model, STEP / omega)
    for k in range(40 * 120):
        y = G[0].real + 2.0 * sum((G[j] * np.exp(0.5j * j * k * STEP)).real for j in (1, 2))
        row = estimator(y_1=y[0], y_2=y[1], angle=6.0 * k, omega=omega)
    for j in (1, 2):
        assert row[f"c_0_{j}"] == pytest.approx(c[0, j - 1].real, abs=1e-8)
        for k in (1, 2):
            assert row[f"c_{k}_re_{j}"] + 1j * row[f"c_{k}_im_{j}"] == pytest.approx(c[k, j - 1], abs=1e-8)
    estimator.component.close()


def test_the_baseline_converges_to_the_same_input():
    omega = 1500.0 * RPM
    model = fourier_least_squares.make(0.3, "[25, 20] ms", speed=SPEED, delay="4 ms")
    found = periods(model, at_rest(two_lags(0.025, 0.02), C3, omega), omega, T720, 30, 3)
    upstream = C3 * np.exp(0.5j * np.arange(4) * omega * 0.004)
    # What it knew at first is worth 1e-6 of a sample, and is forgotten by 0.3 a period.
    np.testing.assert_allclose(found[-1], upstream, atol=1e-9)
    # Nearly all is known after one period: least squares want 2h + 1 samples.
    assert np.abs(found[0] - upstream).max() < 1e-4


@pytest.mark.parametrize("system", [two_lags(0.025, 0.02), rod()], ids=["two lags", "rod"])
def test_at_a_constant_speed_the_designed_observer_is_the_settled_baseline_beside_a_free_response(system):
    # Their gains on the periodic modes are the same. With y in step from the first sample on they tell the same w.
    omega, mu = 2000.0 * RPM, 0.5
    setting = {"A": system.A.tolist(), "A0": system.A0.tolist(), "C": system.C.tolist(), "speed": SPEED,
               "harmonics": system.harmonics, "period": f"{np.degrees(system.period)} deg"}  # fmt: skip
    one = periodic_input.make(**setting, gains={"design": {"multiplier": mu}})
    other = fourier_least_squares.make(mu, **setting)
    truth = C3 if system.harmonics == 3 else C2
    y, samples = at_rest(system, truth, omega), round(system.period / STEP)
    generator = np.random.default_rng(8)
    rows = []
    first, second = Filter(one, STEP / omega), Filter(other, STEP / omega)
    for k in range(60 * samples):
        seen = {"y": y(k * STEP) + generator.normal(), "angle": 6.0 * k, "omega": omega}
        rows.append((first(**seen)["w"], second(**seen)["w"]))
    a, b = np.array(rows)[40 * samples :].T
    first.component.close()
    second.component.close()
    # The tables of one lie on lines between nodes; alike to some per cent of what the noise does.
    assert np.std(a - b) < 0.05 * np.std(a - np.mean(a))
    tables = [{s.name: s.start for s in model.discrete}["variance_gain"] for model in (one, other)]
    assert tables[0] == pytest.approx(tables[1], rel=0.05)


BAD = {
    "period wants a whole number of steps, got 100 deg in steps of 6 deg": {"period": "100 deg"},
    "harmonics wants 59 or fewer: 70 harmonics want 141 samples in a period": {"harmonics": 70},
    r"at 4000 rpm there are 15; sample more often": {"harmonics": 8, "step": "2 ms"},
    "step wants a crank angle or a time above 0": {"step": "6 m"},
    "speed wants the lowest and the highest speed": {"speed": "[4000, 1000] rpm"},
    r"A0 wants independent columns \(Hypothesis 1\), got the rank 0 of 1": {"A0": [[0.0]]},
    r"C wants independent rows \(Hypothesis 1\), got the rank 0 of 1": {"C": [[0.0]]},
    r"A0 wants the shape \(1, m\) and finite numbers, got \(2, 1\)": {"A0": [[1.0], [2.0]]},
    "wants inputs <= outputs <= states, got A0 with 2": {"A0": [[1.0, 2.0]]},
    "harmonic k = 0 of the input is not observable at 1000 rpm: A has an eigenvalue": {"A": [[0.0]]},
    "design: a multiplier of 0.3 has the variance gain .*, above 0.1; 0.1 is kept with 0.9": {
        "gains": {"design": {"multiplier": 0.3, "variance_gain": 0.1}}
    },
    "no multiplier up to 0.999 keeps a variance_gain of 1e-09; the least is": {
        "gains": {"design": {"variance_gain": 1e-9}}
    },
    "design wants a multiplier, a variance_gain, or both": {"gains": {"design": {}}},
    "gains: no kind is named 'desing'; did you mean 'design'": {"gains": {"desing": {}}},
    "alpha_squared wants 4 values above 0": {
        "gains": {"full": {"L_tilde": [[-160]], "alpha_squared": [4], "per": "rad"}}
    },
    "L_tilde wants eigenvalues in the left half-plane": {
        "gains": {"full": {"L_tilde": [[160]], "alpha_squared": [4, 2, 1, 1], "per": "rad"}}
    },
    "periodic_input: the gains do not converge: at .* rpm the largest Floquet multiplier over a period is": {
        "gains": {"partial": {"L": [[120]], "epsilon": 0.5, "sign": "minus", "per": "sample"}}
    },
    "start wants one value an input, 1": {"start": [1, 2]},
}  # fmt: skip


@pytest.mark.parametrize("message", BAD)
def test_what_cannot_work_is_refused_by_name(message):
    setting = {**LAG, "gains": {"design": {"multiplier": 0.3}}, **BAD[message]}
    with pytest.raises(ConfigurationError, match=message):
        periodic_input.make(**setting)


def test_a_design_that_no_table_keeps_is_refused(monkeypatch):
    monkeypatch.setattr(periodic_schedule, "MOST_NODES", 3)
    with pytest.raises(ConfigurationError, match=r"multiplier of 0\.3.* is 0\.3\d+ between the nodes at .* rpm"):
        rod_inversion.make({"design": {"multiplier": 0.3}}, **ROD, nodes=3)


def test_a_harmonic_that_a_zero_of_the_plant_takes_away_is_named():
    # C (s - A)^-1 A0 = (s^2 + z^2)/((s + 40) (s + 60) (s + 80)) with z the second harmonic at 1500 rpm.
    z = 2.0 * 0.5 * 1500.0 * RPM
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-192000.0, -10400.0, -180.0]])
    with pytest.raises(ConfigurationError, match="harmonic k = 2 of the input is not observable at 1500 rpm"):
        periodic_input.make(
            A=A.tolist(), A0=[[0.0], [0.0], [1.0]], C=[[z**2, 0.0, 1.0]], speed="[1500, 1500] rpm",
            gains={"design": {"multiplier": 0.3}},
        )  # fmt: skip


def test_all_that_is_wrong_is_told_at_once():
    with pytest.raises(ConfigurationError) as told_at_once:
        periodic_input.make(**{**LAG, "period": "x", "step": "1 K"}, gains={}, harmonics=-1)
    assert len(told_at_once.value.problems) >= 3


def test_gains_that_do_not_converge_are_run_where_that_is_allowed():
    with pytest.raises(
        ConfigurationError, match=r"at 1500 rpm the largest Floquet multiplier over a period is 1\.05259"
    ):
        rod_inversion.make({"published": {"per": "rad", "sign": "minus"}}, speed="[1500, 1500] rpm")
    model = rod_inversion.make(
        {"published": {"per": "rad", "sign": "minus"}}, speed="[1500, 1500] rpm", allow_unstable=True
    )
    starts = {signal.name: signal.start for signal in model.discrete}
    assert starts["multiplier"] == pytest.approx(1.05259, rel=1e-5)


def test_the_baseline_refuses_what_it_cannot_do():
    for setting, message in (
        ({"multiplier": 0.3}, "wants time_constants, or A, A0 and C"),
        ({"multiplier": 1.5, "time_constants": "25 ms"}, "multiplier wants a value from"),
        ({"multiplier": 0.3, "time_constants": "[25, 0] ms"}, "time_constants wants times above 0 s"),
        ({"multiplier": 0.3, "A": [[0]], "A0": [[1]], "C": [[1]]}, "harmonic k = 0 of the input is not observable"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            fourier_least_squares.make(**setting)


PAGE = (Path(__file__).parent.parent / "docs" / "periodic.md").read_text(encoding="utf-8")


def test_the_example_of_the_page_runs_and_passes(tmp_path):
    for name, language in (("pulsating.py", "python"), ("pulsating.yaml", "yaml")):
        (text,) = re.findall(rf"```{language}\n(.*?)```", PAGE, re.S)
        (tmp_path / name).write_text(text)
    execute(read_campaign(tmp_path / "pulsating.yaml"), tmp_path / "run", 1, lambda ended: None)
    criteria = json.loads((tmp_path / "run" / "acceptance.json").read_text())
    assert len(criteria) == 5 and all(one["passed"] for one in criteria), criteria


def test_the_published_settings_of_the_page_have_the_multipliers_it_tells():
    table = re.split(r"multiplier\s+over\s+180\s+deg", PAGE, maxsplit=1)[1]
    lines = [line for line in table.partition("With [0; 1] per s")[0].splitlines() if line.startswith("| ")][1:]
    assert len(lines) == 10
    for line in lines:
        sign, square, per, *values = (cell.strip() for cell in line.strip("|").split("|"))
        for rpm, value in zip((1000, 1500, 3000, 6000), values, strict=True):
            gains = {"published": {
                "per": per, "sign": sign.partition(",")[0], "input": "one" if square == "[0; 1]" else "square",
            }}  # fmt: skip
            model = rod_inversion.make(gains, speed=f"[{rpm}, {rpm}] rpm", frequency="125 Hz", allow_unstable=True)
            found = next(s.start for s in model.discrete if s.name == "multiplier")
            digits = len(value.partition(".")[2]) if "e" not in value else 0
            if "e" in value:
                assert found == pytest.approx(float(value), rel=0.15), (line, rpm)
            else:
                assert round(found, digits) == pytest.approx(float(value), abs=1.01 * 10.0**-digits), (line, rpm)


def test_lags_are_refused_by_their_place():
    for raw, message in {
        "[25, -20] ms": "lag 2 wants times above 0 s",
        "25 K": "time_constants wants s, got 25 K",
    }.items():
        with pytest.raises(ConfigurationError, match=message):
            lag_inversion.make(raw, {"published": {"per": "sample"}})
    with pytest.raises(ConfigurationError, match="lag 1, an input, wants a step in crank angle"):
        lag_inversion.make([{"input": "tau", "range": "[1, 2] ms"}], {"design": {"multiplier": 0.3}}, step="1 ms")
    with pytest.raises(ConfigurationError, match="per wants sample or rad where a time constant is an input"):
        lag_inversion.make([{"input": "tau", "range": "[1, 2] ms"}], {"published": {"per": "s"}})
