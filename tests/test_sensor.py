"""Sensors against closed forms, the statistics of their noise, and their plain-Python oracle bit for bit."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from oracle import SensorTwin

from fmus.component import ConfigurationError, Signal
from harness.clock import Pace, TimeGrid
from harness.faults import FAULTS, ActingFault, Sampling, Timed, Window
from harness.findings import Findings
from harness.places import Places
from harness.scenario import SensorPart
from harness.sensor import Errors, SensorComponent, build_sensor, stream

H = 1e-3
RPM = 2.0 * math.pi / 60.0


def built(unit: str = "1", period: float = H, seed: int = 0, **keys: Any) -> SensorComponent:
    found = Findings(Places(), ("parts", "encoder"))
    spec = SensorPart.model_validate({"use": "sensor", "of": "plant.y", **keys})
    sampling = Sampling(TimeGrid(0.0, period, 1), Pace(step=period))
    sensor = build_sensor(spec, Signal("y", unit), sampling, seed, "encoder", found)
    if found.problems:
        raise ConfigurationError(found.problems)
    return sensor


def outputs(sensor: Any, signal: NDArray[np.float64], t0: float = 0.0, period: float = H) -> NDArray[np.float64]:
    """All outputs for a signal given at every sample, shape (samples, outputs)."""
    values = [sensor.start(t0, signal[:1])]
    for k in range(1, len(signal)):
        values.append(sensor.step(t0 + (k - 1) * period, period, signal[k : k + 1]))
    return np.array(values)


def readings(sensor: Any, signal: NDArray[np.float64], t0: float = 0.0, period: float = H) -> NDArray[np.float64]:
    """All readings of a signal given at every sample."""
    return outputs(sensor, signal, t0, period)[:, 0]


def wave(samples: int) -> NDArray[np.float64]:
    return np.sin(0.1 * np.arange(samples)) + 2.0


def test_a_sensor_without_errors_is_the_identity() -> None:
    assert np.array_equal(readings(built(), wave(100)), wave(100))


def test_the_identity_keeps_the_kind_and_an_error_makes_it_real() -> None:
    location = Signal("location", kind="integer")
    assert SensorComponent(location, Errors(), H).outputs[0].kind == "integer"
    assert SensorComponent(location, Errors(noise=0.1), H).outputs[0].kind == "real"


def test_a_lag_is_exact_for_a_signal_that_is_linear_between_samples() -> None:
    k = np.arange(2000)
    lagged = readings(built(lag="50 ms"), 3.0 * k * H + 1.0)
    t = k * H
    exact = 1.0 + 3.0 * (t - 0.05 + 0.05 * np.exp(-t / 0.05))
    np.testing.assert_allclose(lagged, exact, rtol=1e-12)  # rounding of 2000 steps


@pytest.mark.parametrize("lag", ["1 us", "0.01 ms", "1000 s"])
def test_a_lag_much_shorter_or_longer_than_the_sample_time_is_still_exact(lag: str) -> None:
    tau = float(lag.split()[0]) * {"us": 1e-6, "ms": 1e-3, "s": 1.0}[lag.split()[1]]
    t = np.arange(500) * H
    exact = t - tau * -np.expm1(-t / tau)
    # 1 - r loses digits as H/lag, here 1e-6, so ten digits of the ramp itself remain.
    np.testing.assert_allclose(readings(built(lag=lag), t), exact, atol=1e-10 * t[-1])


def test_a_delay_of_whole_samples_shifts_the_signal_exactly() -> None:
    for samples in (1, 2, 7):
        delayed = readings(built(delay=f"{samples} ms"), wave(50))
        assert np.array_equal(delayed[samples:], wave(50)[:-samples])
        assert np.all(delayed[:samples] == wave(50)[0])


def test_a_delay_between_samples_is_linear_there() -> None:
    ramp = 5.0 * np.arange(50) * H
    delayed = readings(built(delay="3.25 ms"), ramp)
    np.testing.assert_allclose(delayed[4:], ramp[4:] - 5.0 * 3.25e-3, rtol=0, atol=1e-15)
    short = readings(built(delay="0.25 ms"), ramp)
    np.testing.assert_allclose(short[1:], ramp[1:] - 5.0 * 0.25e-3, rtol=0, atol=1e-15)


def test_only_a_delay_of_a_sample_or_more_breaks_direct_feedthrough() -> None:
    assert built(delay="0.9 ms").feedthrough == {("value", "of")}
    assert built(delay="1 ms").feedthrough == frozenset()


def test_the_errors_apply_in_their_order() -> None:
    faults = [{"gain": 2.0, "from": "0 s"}, {"bias": 10, "from": "0 s"}]
    reading = readings(built(gain=3.0, bias=0.5, faults=faults, quantise=0.25), np.array([1.1, 1.1]))
    assert np.array_equal(reading, np.full(2, 0.25 * np.rint(((1.1 * 3.0 + 0.5) * 2.0 + 10.0) / 0.25)))
    assert readings(built(quantise=1, limits=[-0.4, 0.4]), np.array([0.9])).tolist() == [0.4]


def test_faults_act_from_their_begin_up_to_but_not_at_their_end() -> None:
    for fault, changed in (({"bias": 2}, 3.0), ({"gain": -1.0}, -1.0)):
        reading = readings(built(faults=[{**fault, "from": "3 ms", "to": "6 ms"}]), np.ones(10))
        assert reading.tolist() == [1.0] * 3 + [changed] * 3 + [1.0] * 4


@pytest.mark.parametrize("n", range(1, 60, 7))
def test_a_fault_begins_on_its_sample_whatever_the_last_bit(n: int) -> None:
    period = 0.3 * H
    sensor = built(period=period, faults=[{"bias": 1, "from": f"{n * 0.3} ms"}])
    assert np.argmax(readings(sensor, np.zeros(80), period=period)) == n


def test_a_drift_grows_from_its_begin() -> None:
    reading = readings(built(faults=[{"drift": 4, "from": "10 ms", "to": "20 ms"}]), np.zeros(30))
    exact = np.where((np.arange(30) >= 10) & (np.arange(30) < 20), 4.0 * (np.arange(30) - 10) * H, 0.0)
    np.testing.assert_allclose(reading, exact, atol=1e-15)


def test_a_stuck_sensor_repeats_the_last_noisy_reading_and_then_goes_on() -> None:
    noisy = readings(built(noise={"std": 0.1}), wave(30))
    stuck = readings(built(noise={"std": 0.1}, faults=[{"stuck": True, "from": "10 ms", "to": "20 ms"}]), wave(30))
    assert np.all(stuck[10:20] == noisy[9])
    assert np.array_equal(stuck[:10], noisy[:10]) and np.array_equal(stuck[20:], noisy[20:])


def test_the_noise_is_the_parts_stream_however_many_blocks_it_takes() -> None:
    samples = 10_000  # more than two blocks
    noise = readings(built(noise={"std": 0.5}, seed=3), np.zeros(samples))
    assert np.array_equal(noise, 0.0 + 0.5 * stream(3, "encoder", "noise").standard_normal(samples))
    assert noise[0] != 0.0


def test_the_noise_is_white_normal_and_of_the_deviation_asked_for() -> None:
    n = 40_000
    noise = readings(built(noise={"std": 2.0}), np.zeros(n)) / 2.0
    # Each statistic of n independent samples has the standard deviation given; five of them are allowed.
    assert abs(noise.mean()) < 5.0 / math.sqrt(n)
    assert abs(noise.std() - 1.0) < 5.0 / math.sqrt(2 * n)
    assert abs(np.mean(noise[1:] * noise[:-1])) < 5.0 / math.sqrt(n)
    assert abs(np.mean(noise**4) - 3.0) < 5.0 * math.sqrt(96.0 / n)


def test_a_fault_of_noise_adds_in_quadrature_and_keeps_the_numbers() -> None:
    plain = readings(built(noise={"std": 3.0}), np.zeros(20))
    loud = readings(built(noise={"std": 3.0}, faults=[{"noise": 4.0, "from": "10 ms"}]), np.zeros(20))
    assert np.array_equal(loud[:10], plain[:10])
    np.testing.assert_allclose(loud[10:], plain[10:] * 5.0 / 3.0, rtol=1e-14)


def test_a_lost_sample_repeats_the_last_and_so_many_are_lost() -> None:
    n = 20_000
    reading = readings(built(drop_out=0.3), np.arange(float(n)))
    lost = np.diff(reading) == 0.0
    assert abs(lost.mean() - 0.3) < 5.0 * math.sqrt(0.3 * 0.7 / n)
    kept = np.flatnonzero(~lost) + 1
    assert np.array_equal(reading[kept], kept.astype(float))


def test_drop_out_changes_no_number_of_the_noise() -> None:
    noisy = readings(built(noise={"std": 1.0}), np.zeros(100))
    lossy = readings(built(noise={"std": 1.0}, drop_out=0.5), np.zeros(100))
    kept = np.flatnonzero(np.diff(lossy)) + 1
    assert len(kept) > 20 and np.array_equal(lossy[kept], noisy[kept])


def test_the_first_sample_is_never_lost() -> None:
    assert readings(built(drop_out=1.0), np.arange(1.0, 5.0)).tolist() == [1.0] * 4


def test_errors_are_converted_from_any_unit_of_the_signal() -> None:
    errors = built(
        "rad/s", noise={"std": "3 rpm"}, bias="-2 deg/s", quantise="0.1 rad/s", limits=["0 rpm", "9 rpm"]
    ).errors
    assert errors.noise == pytest.approx(3.0 * RPM, rel=1e-15)
    assert errors.bias == pytest.approx(-2.0 * math.pi / 180.0, rel=1e-15)
    assert (errors.resolution, errors.lowest) == (0.1, 0.0)
    assert errors.highest == pytest.approx(9.0 * RPM, rel=1e-15)


def test_differences_of_temperature_have_no_offset_but_limits_do() -> None:
    errors = built("K", bias="1 degC", noise={"std": "0.5 degC"}, limits=["0 degC", "300 K"]).errors
    assert (errors.bias, errors.noise, errors.lowest, errors.highest) == (1.0, 0.5, 273.15, 300.0)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"noise": {"std": "1 N.m"}}, "encoder.noise.std wants rpm, got 1 N.m"),
        ({"noise": {"std": 1}}, "encoder.noise.std wants rpm, got the bare number 1: write '1 rpm'"),
        ({"noise": {"std": "-1 rpm"}}, "encoder.noise.std wants 0 or more, got -1.0 rpm"),
        ({"lag": "1 m"}, "encoder.lag wants s, got 1 m"),
        ({"delay": "-1 ms"}, "encoder.delay wants 0 or more, got -1.0 ms"),
        ({"delay": "1000000 h"}, "encoder.delay wants at most 10000000 samples of 0.001 s"),
        ({"limits": ["2 rpm", "1 rpm"]}, "encoder.limits wants the lower limit first, got 2.0 rpm and 1.0 rpm"),
        ({"faults": [{"bias": "1 V", "from": "1 s"}]}, "encoder.faults[0].bias wants rpm, got 1 V"),
        ({"faults": [{"stuck": True, "from": "2 s", "to": "1 s"}]}, "encoder.faults[0].to wants a time after 2.0 s"),
        ({"faults": [{"drop_out": 1.5, "from": "2 s"}]}, "encoder.faults[0].drop_out wants a probability"),
    ],
)
def test_a_wrong_quantity_is_named_with_what_was_wanted(keys: dict[str, Any], message: str) -> None:
    try:
        built("rpm", **keys)
    except ConfigurationError as error:
        assert str(error).startswith(message)
    else:
        pytest.fail("no problem was found")


_errors = st.builds(
    Errors,
    lag=st.just(0.0) | st.floats(1e-6, 1.0),
    delay=st.just(0.0) | st.floats(0.0, 0.02) | st.integers(1, 20).map(lambda n: n * H),
    gain=st.just(1.0) | st.floats(-2, 2),
    bias=st.just(0.0) | st.floats(-2, 2),
    noise=st.just(0.0) | st.floats(0, 2),
    drop_out=st.just(0.0) | st.floats(0, 1),
    resolution=st.just(0.0) | st.floats(1e-4, 1),
    lowest=st.just(-math.inf) | st.floats(-3, 0),
    highest=st.just(math.inf) | st.floats(0, 3),
    faults=st.lists(
        st.builds(
            ActingFault,
            st.sampled_from(FAULTS),
            st.floats(0, 1) | st.integers(0, 9),
            st.builds(
                lambda begin, length: Window(begin * H, (begin + length) * H), st.integers(-5, 50), st.integers(1, 40)
            )
            | st.builds(
                lambda first, length: Window(first=first, last=first + length), st.integers(0, 50), st.integers(0, 40)
            )
            | st.builds(lambda begin, last: Window(begin * H, last=last), st.integers(-5, 50), st.integers(0, 60)),
            st.integers(1, 9),
        ),
        max_size=5,
    ).map(tuple),
)


@settings(max_examples=200, deadline=None)
@given(errors=_errors, seed=st.integers(0, 2**64), t0=st.floats(-1, 1), timed=st.sampled_from(["begin", "end"]))
def test_a_sensor_matches_its_plain_python_oracle_bit_for_bit(
    errors: Errors, seed: int, t0: float, timed: Timed
) -> None:
    sensor = SensorComponent(Signal("y"), errors, H, seed=seed, part="encoder", timed=timed)
    plain = SensorTwin(errors, H, seed, "encoder", 60, timed)
    assert np.array_equal(outputs(sensor, wave(60), t0), outputs(plain, wave(60), t0))
