"""Torque imbalance by the variance of the speed: each stroke's own value, the cylinder named, as often as demanded."""

from __future__ import annotations

import numpy as np
import pytest
from filtered import Filter, TwinFilter
from scipy.stats import binom

from fmus.component import ConfigurationError
from observers import torque_imbalance
from observers.torque_imbalance import variance_of

ORDER = (1, 3, 4, 2)


def coefficients(variances: dict[int, float], angle: float) -> dict[str, float]:
    """c_1 and c_2 as they are during the stroke at an angle: V_i of the cylinder whose stroke it is, turned anyhow."""
    cylinder = ORDER[int((angle - 1e-9) % 720.0 // 180.0)]  # at its end a stroke is still the cylinder's own
    size, turn = np.sqrt(variances[cylinder] / 2.0), 0.01 * angle
    one, two = size * np.cos(0.3) * np.exp(1j * turn), size * np.sin(0.3) * np.exp(-2j * turn)
    return {"c_1_re": one.real, "c_1_im": one.imag, "c_2_re": two.real, "c_2_im": two.imag}


def run(model, angles, variances) -> list[dict[str, float]]:
    estimator = Filter(model, 1e-3)
    rows = [estimator(angle=angle, **coefficients(variances, angle)) for angle in angles]
    estimator.component.close()
    return rows


def test_the_variance_of_a_signal_is_that_of_its_harmonics():
    generator = np.random.default_rng(1)
    c = generator.normal(size=2) + 1j * generator.normal(size=2)
    angle = np.arange(0.0, 180.0, 1.0)
    phase = np.exp(2j * np.pi * np.multiply.outer(angle, [1, 2]) / 180.0)
    x = 157.0 + 2.0 * np.real(phase @ c)
    assert variance_of(c.real, c.imag) == pytest.approx(np.var(x), rel=1e-12)


@pytest.mark.parametrize("step", [6.0, 1.0, 7.7])
def test_each_stroke_gives_its_own_variance_and_the_balance_its_distance_from_the_mean(step):
    variances = {1: 4.4, 2: 3.6, 3: 4.1, 4: 3.9}
    # Steps that do not divide the stroke are sampled at the first instant from its end on, in the next stroke.
    angles = np.arange(step, 2200.0, step)
    rows = run(torque_imbalance.make(relative_scatter=0.01), angles, variances)
    if step != 7.7:
        for i, value in variances.items():
            assert rows[-1][f"V_{i}"] == pytest.approx(value, rel=1e-12)
            assert rows[-1][f"balance_{i}"] == pytest.approx(value - 4.0, abs=1e-12)
    seen = [rows[-1][f"V_{i}"] for i in (1, 2, 3, 4)]
    assert sum(rows[-1][f"balance_{i}"] for i in (1, 2, 3, 4)) == pytest.approx(0.0, abs=1e-12)
    statistic = sum((v - np.mean(seen)) ** 2 for v in seen) / (0.01 * np.mean(seen)) ** 2
    assert rows[-1]["statistic"] == pytest.approx(statistic, rel=1e-9)
    # Nothing is said before four strokes in a row, and then once a cycle.
    first = next(k for k, row in enumerate(rows) if row["cycles"])
    assert 720.0 <= angles[first] < 720.0 + step
    assert all(row["balance_1"] == 0.0 for row in rows[:first])


@pytest.mark.parametrize("cylinder", [1, 2, 3, 4])
@pytest.mark.parametrize("error", [0.25, -0.1])
def test_the_cylinder_that_works_more_or_less_is_named_with_its_torque(cylinder, error):
    variances = dict.fromkeys((1, 2, 3, 4), 4.0)
    variances[cylinder] *= (1.0 + error) ** 2
    row = run(torque_imbalance.make(relative_scatter=0.02), np.arange(6.0, 1441.0, 6.0), variances)[-1]
    assert row["verdict"] == np.sign(error) * cylinder
    assert row["amount"] == pytest.approx(error, rel=1e-9)
    assert row["statistic"] > row["threshold"]


def test_strokes_that_were_left_out_are_not_taken_for_a_cycle():
    variances = {1: 4.4, 2: 3.6, 3: 4.1, 4: 3.9}
    angles = np.concatenate([np.arange(6.0, 1000.0, 6.0), np.arange(1300.0, 2200.0, 5.0)])
    rows = run(torque_imbalance.make(relative_scatter=0.01), angles, variances)
    after = [row for angle, row in zip(angles, rows, strict=True) if 1300.0 <= angle < 1980.0]
    assert {row["cycles"] for row in after} == {1.0}
    assert rows[-1]["cycles"] == 2.0  # 1440, 1620, 1800, 1980 deg left: the fourth is not the last in order until 2160


def test_scatter_raises_as_many_false_alarms_as_demanded():
    rate, cycles = 0.05, 1500
    model = torque_imbalance.make(scatter=0.2, relative_scatter=0.0, false_alarm_rate=rate)
    estimator, generator = Filter(model, 1e-3), np.random.default_rng(2)
    alarms, diagnosed = 0, 0
    for k in range(1, 4 * cycles + 1):
        for angle in (180.0 * k - 60.0, 180.0 * k):
            variance = 4.0 + generator.normal(scale=0.2)
            row = estimator(angle=angle, c_1_re=np.sqrt(variance / 2.0))
        if row["cycles"] > diagnosed:
            diagnosed += 1
            alarms += row["verdict"] != 0
    estimator.component.close()
    assert diagnosed >= cycles - 1
    low, high = binom.interval(1.0 - 1e-4, diagnosed, rate)
    assert low <= alarms <= high


def test_the_fmu_is_its_python_source():
    model = torque_imbalance.make(scatter=0.1, persistence=2)
    exported, twin = Filter(model, 1e-3), TwinFilter(model, 1e-3, lambda x, u, h: x)
    generator = np.random.default_rng(3)
    for angle in np.cumsum(generator.uniform(5.0, 40.0, size=300)):
        inputs = {"angle": angle, **{name: generator.normal() for name in ("c_1_re", "c_1_im", "c_2_re", "c_2_im")}}
        row, source = exported(**inputs), twin(**inputs)
        shared = [name for name in row if name in source]
        np.testing.assert_allclose([row[n] for n in shared], [source[n] for n in shared], rtol=1e-9, atol=1e-12)
    exported.component.close()


def test_all_that_is_wrong_with_the_arguments_is_told_at_once():
    with pytest.raises(ConfigurationError) as told:
        torque_imbalance.make(scatter=-1.0, relative_scatter=-0.1, false_alarm_rate=0.0, firing_order=[1, 3, 4])
    for part in ("scatter wants 0 or more", "relative_scatter wants", "false_alarm_rate wants", "firing_order wants"):
        assert part in str(told.value)
