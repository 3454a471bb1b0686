"""PI balancing of injected fuel: it converges as its poles say, keeps mean and limits, and goes off and on."""

from __future__ import annotations

import numpy as np
import pyarrow.parquet as pq
import pytest
from filtered import Filter, TwinFilter
from hypothesis import given, settings
from hypothesis import strategies as st

from fmus.component import ConfigurationError
from fmus.controllers import balancing
from fmus.controllers.balancing import largest_reset, loop_poles
from harness.campaign import read_campaign
from harness.cases import execute

M_F = 2e-5
OFFSETS = np.array([0.12, -0.05, 0.02, -0.09])  # injectors' relative errors, zero sum


class Engine:
    """The controller's FMU and the static model of a cycle: e(n) = -g (r(n - delay) + o), in AFR deviations."""

    def __init__(self, gain: float = 1.0, delay: int = 1, **arguments: float) -> None:
        self.controller = Filter(balancing.make(delay=delay, **arguments), 1e-3)
        self.gain, self.afr = gain, arguments.get("afr", 20.0)
        self.corrections = [np.zeros(4)] * delay
        self.angle = 6.0
        self.row = self.controller(angle=self.angle, m_f=M_F)

    def cycle(self, offsets: np.ndarray, enable: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """The deviations at the end of a cycle, relative (4,), and the corrections made of them."""
        e = -self.gain * (self.corrections.pop(0) + offsets - offsets.mean())
        self.angle += 720.0 - self.angle % 720.0
        inputs = {f"deviation_{i}": self.afr * value for i, value in enumerate(e, start=1)}
        self.row = self.controller(angle=self.angle, m_f=M_F, enable=enable, **inputs)
        r = np.array([self.row[f"correction_{i}"] for i in (1, 2, 3, 4)])
        self.corrections.append(r)
        # Within the cycle nothing changes, whatever comes in.
        within = self.controller(angle=self.angle + 300.0, m_f=M_F, enable=1.0 - enable, deviation_1=5.0)
        assert all(within[f"correction_{i}"] == self.row[f"correction_{i}"] for i in (1, 2, 3, 4))
        return e, r


LOOPS = [(0.0, 0.3, 1.0, 1), (0.1, 0.2, 1.5, 1), (0.1, 0.15, 1.0, 2)]


@pytest.mark.parametrize(("k_p", "k_i", "gain", "delay"), LOOPS)
def test_the_loop_converges_as_its_poles_say(k_p, k_i, gain, delay):
    engine = Engine(gain, delay, k_p=k_p, k_i=k_i)
    errors = np.array([engine.cycle(OFFSETS)[0] for _ in range(40)])
    # e(n) is a sum of the powers of the poles, whose weights the first ones give.
    poles = loop_poles(k_p, k_i, gain, delay)
    powers = poles[None, :] ** np.arange(40)[:, None]
    first = len(poles)
    weights = np.linalg.solve(powers[:first], errors[:first])
    # Weights of poles that lie apart by a tenth lose two digits of sixteen.
    np.testing.assert_allclose(errors, np.real(powers @ weights), rtol=0, atol=1e-11)
    assert np.abs(errors[-1]).max() < 1e-2 * np.abs(errors[0]).max()
    assert np.abs(errors.sum(axis=1)).max() < 1e-14


def test_without_proportional_part_the_error_is_a_geometric_series():
    engine = Engine(1.2, 1, k_p=0.0, k_i=0.3)
    for n in range(20):
        e, _ = engine.cycle(OFFSETS)
        np.testing.assert_allclose(e, -1.2 * OFFSETS * (1.0 - 1.2 * 0.3) ** n, atol=1e-14)


@settings(max_examples=300, deadline=None)
@given(st.floats(-2.0, 2.0), st.floats(-0.5, 4.0), st.floats(0.1, 3.0))
def test_the_stability_region_of_delay_one_is_the_closed_form(k_p, k_i, gain):
    size = np.max(np.abs(loop_poles(k_p, k_i, gain, 1)))
    margins = [gain * k_i, gain * k_p + 1.0, 2.0 - gain * (2.0 * k_p + k_i)]
    if min(map(abs, margins)) > 1e-3:  # on the edge rounding decides
        assert (size < 1.0) == all(margin > 0.0 for margin in margins)


@pytest.mark.parametrize("delay", [1, 2, 3, 6])
def test_the_largest_reset_is_where_a_pole_leaves_the_unit_circle(delay):
    edge = largest_reset(delay)
    sizes = [np.max(np.abs(loop_poles(0.0, factor * edge, 1.0, delay))) for factor in (0.999, 1.0, 1.001)]
    assert sizes[0] < 1.0 < sizes[2] and sizes[1] == pytest.approx(1.0, abs=1e-9)


@settings(max_examples=100, deadline=None)
@given(st.floats(0.0, 0.5), st.floats(0.01, 0.5), st.integers(1, 4))
def test_smaller_gains_of_a_stable_loop_are_stable(k_p, k_i, delay):
    sizes = [np.max(np.abs(loop_poles(k_p, k_i, g, delay))) for g in (0.1, 0.25, 0.5, 0.75, 1.0)]
    if sizes[-1] < 1.0:
        assert max(sizes) < 1.0 + 1e-9


def test_the_mean_fuel_is_kept_and_no_correction_exceeds_the_limit():
    engine = Engine(k_p=0.1, k_i=0.3, limit=0.05)
    for _ in range(30):
        _, r = engine.cycle(OFFSETS)
        assert np.abs(r).max() <= 0.05 * (1.0 + 1e-12) and abs(r.sum()) < 1e-15
        fuel = np.array([engine.row[f"m_f_{i}"] for i in (1, 2, 3, 4)])
        np.testing.assert_allclose(fuel, M_F * (1.0 + r), rtol=1e-15)
        assert fuel.mean() == pytest.approx(M_F, rel=1e-14)
    # All scaled alike: the largest at the limit, the others in proportion to what they lack.
    np.testing.assert_allclose(r, -0.05 * OFFSETS / np.abs(OFFSETS).max(), rtol=1e-9)


def test_what_could_not_be_corrected_does_not_wind_up():
    limited = Engine(k_p=0.1, k_i=0.3, limit=0.05)
    for _ in range(200):
        limited.cycle(3.0 * OFFSETS)
    # The injectors are exchanged for ones that are off the other way. An integrator that had grown for 200 cycles, to
    # 200 k_i 0.3 = 18 and more, would take as long to come back; this one is off the limit at the first cycle.
    seen = [limited.cycle(-0.2 * OFFSETS) for _ in range(25)]
    _, r = seen[1]
    assert np.abs(r).max() < 0.05
    assert np.abs(seen[-1][0]).max() < 1e-3 * np.abs(OFFSETS).max()


def test_off_the_natural_imbalance_returns_at_once_and_on_it_begins_without_a_bump():
    k_p, k_i = 0.1, 0.2
    engine = Engine(k_p=k_p, k_i=k_i)
    for _ in range(60):
        engine.cycle(OFFSETS)
    e, r = engine.cycle(OFFSETS)
    np.testing.assert_allclose(r, -OFFSETS, atol=1e-6)
    e, r = engine.cycle(OFFSETS, enable=0.0)
    assert np.all(r == 0.0) and all(engine.row[f"m_f_{i}"] == M_F for i in (1, 2, 3, 4))
    e, r = engine.cycle(OFFSETS, enable=0.0)
    np.testing.assert_allclose(e, -OFFSETS, atol=1e-15)
    worse = OFFSETS + np.array([-0.05, 0.2, -0.1, -0.05])
    for _ in range(50):  # nothing is learnt and nothing winds up while it is off
        before, _ = engine.cycle(worse, enable=0.0)
    e, r = engine.cycle(worse)
    np.testing.assert_allclose(r, k_i * e + k_p * (e - before), atol=1e-15)
    for _ in range(60):
        e, r = engine.cycle(worse)
    np.testing.assert_allclose(e, 0.0, atol=1e-5)


def test_injectors_are_balanced_on_the_air_fuel_ratio_itself_which_is_not_linear():
    controller = Filter(balancing.make(k_p=0.1, k_i=0.2, afr=18.0), 1e-3)
    offsets, fuel, angle = np.array([0.25, 0.0, -0.1, 0.0]), np.full(4, M_F), 0.0
    controller(angle=angle, m_f=M_F)
    for _ in range(80):
        afr = 20.0 * M_F / (fuel * (1.0 + offsets))
        angle += 720.0
        row = controller(angle=angle, m_f=M_F, **{f"deviation_{i}": a - afr.mean() for i, a in enumerate(afr, start=1)})
        fuel = np.array([row[f"m_f_{i}"] for i in (1, 2, 3, 4)])
    injected = fuel * (1.0 + offsets)
    np.testing.assert_allclose(injected, injected.mean(), rtol=1e-6)
    assert fuel.mean() == pytest.approx(M_F, rel=1e-12)


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_fmu_is_its_python_source(fmi):
    model = balancing.make(limit=0.1)
    exported, twin = Filter(model, 1e-3, fmi), TwinFilter(model, 1e-3, lambda x, u, h: x)
    generator = np.random.default_rng(3)
    for angle in np.cumsum(generator.uniform(5.0, 300.0, size=300)):
        inputs = {f"deviation_{i}": generator.normal() for i in (1, 2, 3, 4)}
        inputs |= {"angle": angle, "m_f": M_F, "enable": float(generator.uniform() > 0.3)}
        row, source = exported(**inputs), twin(**inputs)
        corrections = [f"correction_{i}" for i in (1, 2, 3, 4)]
        np.testing.assert_allclose([row[n] for n in corrections], [source[n] for n in corrections], rtol=0, atol=1e-14)
        for i in (1, 2, 3, 4):
            assert row[f"m_f_{i}"] == pytest.approx(M_F * (1.0 + row[f"correction_{i}"]), rel=1e-15)
    exported.component.close()


def test_it_is_found_by_its_short_name_and_built(tmp_path, crankbench):
    code, _, said = crankbench("build", "balancing", "--out", tmp_path / "b.fmu", "--with", "k_i=0.2")
    assert (code, (tmp_path / "b.fmu").is_file()) == (0, True), said


def test_all_that_is_wrong_with_the_arguments_is_told_at_once():
    with pytest.raises(ConfigurationError) as told:
        balancing.make(afr=0.0, limit=1.5, gain_margin=-1.0, delay=0, sample_time=-1.0)
    for part in ("afr wants more than 0", "limit wants more than 0 and less than 1", "gain_margin wants",
                 "delay wants 1 cycle or more", "sample_time wants"):  # fmt: skip
        assert part in str(told.value)
    with pytest.raises(ConfigurationError, match=r"k_i may be up to 0\.5"):
        balancing.make(k_p=0.0, k_i=0.7, delay=2)
    assert balancing.make(k_p=0.0, k_i=0.7, delay=2, gain_margin=1.0).name == "balancing"


CLOSED = """\
campaign: closed
clock: {CLOCK}
parts:
  engine:
    use: imbalanced_exhaust
    with: {offset_1: 0.1, offset_2: 0.25, offset_3: -0.05}
    wires: {m_f_1: pi.m_f_1, m_f_2: pi.m_f_2, m_f_3: pi.m_f_3, m_f_4: pi.m_f_4}
  crank: {CRANK}
  uego: {use: sensor, of: engine.afr, noise: {std: 0.01}}
  speed: {use: source, unit: rad/s, constant: 1500 rpm}
  m_f: {use: source, unit: kg, constant: 2e-5 kg}
  enable: {use: source, unit: "1", table: {time: [0 s, 3 s, 5 s], value: [1, 0, 1]}}
  diagnosis:
    use: observers.diagnosis
    with: {noise: 0.01, scatter: 0.1, pulse: 180 deg, centre: 225 deg, mixing_time: 30 ms}
    wires: {w: uego, angle: crank.angle, omega: speed}
  pi:
    use: fmus.controllers.balancing
    with: {k_p: 0.1, k_i: 0.1}
    wires:
      deviation_1: diagnosis.deviation_1
      deviation_2: diagnosis.deviation_2
      deviation_3: diagnosis.deviation_3
      deviation_4: diagnosis.deviation_4
      m_f: m_f
      enable: enable
      angle: crank.angle
"""
CLOCKS = {
    "crank": ("{crank: {step: 6 deg, stop: 8 s, speed: speed}}", "{use: crank}"),
    "time": ("{time: {step: 1 ms, stop: 8 s}}", "{use: crank, of: engine.angle}"),
}


@pytest.mark.parametrize("kind", CLOCKS)
def test_on_either_clock_diagnosis_and_balancing_bring_an_engine_together_and_let_it_go(tmp_path, kind):
    clock, crank = CLOCKS[kind]
    file = tmp_path / "closed.yaml"
    file.write_text(CLOSED.replace("{CLOCK}", clock).replace("{CRANK}", crank))
    execute(read_campaign(file), tmp_path / "run", 1, lambda ended: None)
    (path,) = tmp_path.glob("run/cases/*/signals.parquet")
    table = pq.read_table(path).to_pandas()
    time, fuel = table["time"].to_numpy(), table[[f"pi.m_f_{i}" for i in (1, 2, 3, 4)]].to_numpy()
    afr = 4e-4 / (fuel * (1.0 + np.array([0.1, 0.25, -0.05, 0.0])))
    spread = np.ptp(afr, axis=1)
    natural = 20.0 / 0.95 - 20.0 / 1.25

    def at(instant: float) -> float:
        return float(spread[np.searchsorted(time, instant)])

    assert at(0.05) == pytest.approx(natural)
    # The mean of the corrections is zero, so all come to one AFR, but for what the noise of 0.01 becomes of the path.
    assert at(2.9) < 0.25 and at(7.9) < 0.25
    # It is off at the end of the cycle of 80 ms in which it is switched.
    assert at(3.2) == pytest.approx(natural, rel=1e-9) and at(4.9) == pytest.approx(natural, rel=1e-9)
    np.testing.assert_allclose(fuel.mean(axis=1), M_F, rtol=1e-12)
    # Begun again without a bump: in the first cycle after 5 s no correction moves by more than k_i e + k_p times noise.
    first = np.searchsorted(time, 5.09)
    assert 0.0 < np.abs(fuel[first] / M_F - 1.0).max() < 0.1 * 0.2 + 0.01
    # Once a cycle and no more often.
    moves = np.flatnonzero(np.any(np.diff(fuel, axis=0) != 0.0, axis=1))
    assert len(moves) <= 101 and np.diff(time[moves]).min() > 0.078
