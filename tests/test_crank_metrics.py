"""Crank-synchronous averages and harmonics against closed forms, numpy's FFT and sums over rows picked by hand."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import ValidationError
from records import measured, on_crank, record, values_of

from fmus.component import Signal
from harness.definitions import Definition, misfits, results
from harness.metrics import KINDS
from harness.places import Places

PAIR = ["plant.p", "observer.p"]
# Ten cycles and a third of one at 6 deg, from 30 deg on.
CRANK = 30.0 + 6.0 * np.arange(1240)
RNG = np.random.default_rng(7)
NOISE = RNG.normal(size=1240)


def wave(crank, per_cycle, phase=0.0, cycle=720.0):
    return np.cos(2 * np.pi * per_cycle * crank / cycle + math.radians(phase))


def turning(signal, unit="bar", crank=CRANK, estimate=None):
    columns = {"plant.p": (signal, unit)} | ({"observer.p": (estimate, unit)} if estimate is not None else {})
    return on_crank(columns, crank)


@pytest.mark.parametrize("per_cycle", [1, 2, 4, 59])
def test_a_harmonic_is_found_with_its_amplitude_and_phase_whatever_the_window_starts_at(per_cycle):
    signal = 1e5 * (3.0 + 0.7 * wave(CRANK, per_cycle, -130.0) + 0.2 * wave(CRANK, 3, 20.0) + 0.1 * wave(CRANK, 60))
    for after in ("0 deg", "2 rev", "1001 deg"):
        found = measured({"harmonic": {"signal": "plant.p", "per_cycle": per_cycle}, "after": after}, turning(signal))
        # 120 rows a cycle: harmonics of a discrete Fourier transform are orthogonal up to rounding.
        assert found.values["m"] == (pytest.approx(0.7, rel=1e-10), "bar")
        assert found.values["m.phase"] == (pytest.approx(-130.0, abs=1e-8), "deg")


def test_a_harmonic_of_noise_is_what_an_fft_over_the_whole_cycles_gives():
    spectrum = np.fft.rfft(NOISE[:1200]) / 600  # ten cycles: the harmonic k a cycle stands at 10 k
    for per_cycle in (1, 2, 7, 30):
        found = values_of({"harmonic": {"signal": "plant.p", "per_cycle": per_cycle}}, turning(NOISE, "rad"))
        assert found[""] == pytest.approx(abs(spectrum[10 * per_cycle]), rel=1e-10)
        # The transform counts from the first row, the phase from crank angle 0.
        at_zero = spectrum[10 * per_cycle] * np.exp(-2j * np.pi * per_cycle * 30.0 / 720.0)
        assert found["phase"] == pytest.approx(math.degrees(np.angle(at_zero)), abs=1e-8)


def test_a_harmonic_says_how_many_cycles_it_took_and_what_it_dropped():
    found = measured({"harmonic": {"signal": "plant.p", "per_cycle": 1}}, turning(NOISE)).values
    assert (found["m.cycles"], found["m.dropped"]) == ((10.0, "1"), (pytest.approx(40 * 6.0), "deg"))
    short = values_of({"harmonic": {"signal": "plant.p", "per_cycle": 1}, "until": "730 deg"}, turning(NOISE))
    assert (short["cycles"], short["dropped"]) == (0.0, pytest.approx(117 * 6.0)) and math.isnan(short[""])


def test_the_unit_of_a_metric_of_an_angle_is_not_that_of_its_phase():
    found = measured({"harmonic": {"signal": "plant.p", "per_cycle": 2}, "unit": "mrad"}, turning(NOISE, "rad")).values
    assert [found[name].unit for name in ("m", "m.phase", "m.cycles", "m.dropped")] == ["mrad", "deg", "1", "deg"]


def test_a_two_stroke_engine_has_its_cycle_in_one_revolution():
    signal = 5.0 * wave(CRANK, 3, 45.0, cycle=360.0)
    found = values_of({"harmonic": {"signal": "plant.p", "per_cycle": 3, "cycle": "360 deg"}}, turning(signal, "N"))
    assert (found[""], found["phase"], found["cycles"]) == (pytest.approx(5.0), pytest.approx(45.0), 20.0)


def test_the_error_of_a_harmonic_is_the_distance_of_two_phasors():
    truth, estimate = 3.0 * wave(CRANK, 4, 170.0) + wave(CRANK, 1), 4.0 * wave(CRANK, 4, -100.0) - wave(CRANK, 2)
    arguments = {"harmonic_error": {"error": PAIR, "per_cycle": 4}}
    found = values_of(arguments, turning(truth, "N.m", estimate=estimate))
    assert found[""] == pytest.approx(5.0)  # 90 deg apart: 3-4-5
    assert (found["amplitude"], found["phase"]) == (pytest.approx(1.0), pytest.approx(90.0))
    swapped = values_of(arguments, turning(estimate, "N.m", estimate=truth))
    assert (swapped["amplitude"], swapped["phase"]) == (pytest.approx(-1.0), pytest.approx(-90.0))


def test_the_error_of_a_harmonic_is_the_harmonic_of_the_error():
    estimate = NOISE[::-1].copy()
    found = values_of({"harmonic_error": {"error": PAIR, "per_cycle": 5}}, turning(NOISE, "N", estimate=estimate))
    alone = values_of({"harmonic": {"signal": "plant.p", "per_cycle": 5}}, turning(estimate - NOISE, "N"))
    assert found[""] == pytest.approx(alone[""], rel=1e-10)


@settings(max_examples=50, deadline=None)
@given(arrays(float, 360, elements=st.floats(-10, 10)), st.integers(0, 119))
def test_the_energy_of_a_cycle_is_the_sum_of_its_harmonics(signal, first):
    crank = 6.0 * (first + np.arange(360))
    found = [
        values_of({"harmonic": {"signal": "plant.p", "per_cycle": k}}, turning(signal, "N", crank))[""]
        for k in range(1, 60)
    ]
    cycle = signal.reshape(3, 120).mean(axis=0)
    nyquist = np.mean(cycle * (-1.0) ** np.arange(120))
    # Parseval: the variance of the mean cycle is half the sum of the squares of the amplitudes, and that of row by row.
    assert np.sum(np.square(found)) / 2 + nyquist**2 == pytest.approx(np.var(cycle), rel=1e-9, abs=1e-12)


def picked(signal, start, stop, cycle=720.0, crank=CRANK):
    """Means of the rows with start <= crank angle < stop in each cycle, for the windows that lie whole in the rows."""
    means = []
    for number in range(-3, 20):
        low, high = start + number * cycle, stop + number * cycle
        if low >= crank[0] and high <= crank[-1] + (crank[1] - crank[0]):
            means.append(signal[(crank >= low - 1e-6) & (crank < high - 1e-6)].mean())
    return np.array(means)


@pytest.mark.parametrize(("start", "stop"), [(0, 180), (100, 280), (-60, 60), (700, 900), (0, 720), (3, 9)])
def test_a_crank_average_is_over_the_rows_of_its_window_in_every_cycle(start, stop):
    means = picked(NOISE, start, stop)
    arguments = {"signal": "plant.p", "from": f"{start} deg", "to": f"{stop} deg"}
    found = measured({"crank_average": arguments}, turning(NOISE, "bar")).values
    assert found["m.windows"].value == len(means) >= 9
    assert found["m"] == (pytest.approx(means.mean() * 1e-5, rel=1e-10), "bar")
    assert found["m.std"] == (pytest.approx(np.std(means, ddof=1) * 1e-5, rel=1e-10), "bar")
    assert found["m.cov"] == (pytest.approx(np.std(means, ddof=1) / abs(means.mean()), rel=1e-10), "1")
    assert set(found) == {"m", "m.std", "m.cov", "m.windows"}


def test_a_mean_temperature_has_the_offset_of_its_unit_and_its_spread_over_the_cycles_has_not():
    temperature = 300.0 + np.repeat(np.tile([0.0, 2.0], 6), 120)[5 : 5 + 1240]  # two degrees more in every other cycle
    values = measured({"crank_average": {"signal": "plant.p"}, "after": "720 deg"}, turning(temperature, "degC")).values
    assert values["m.windows"].value == 9
    assert values["m"] == (pytest.approx(300.0 - 273.15 + 2 * 5 / 9), "degC")
    assert values["m.std"] == (pytest.approx(2 * math.sqrt(5 / 9 * 4 / 9 * 9 / 8)), "degC")


def test_each_cylinder_has_its_window_from_its_own_top_dead_centre():
    # A pulse of 90 deg from each firing top dead centre, as high as the cylinder's number.
    order = [1, 3, 4, 2]
    phase = np.mod(CRANK, 720.0)
    signal = sum(np.where((phase >= 180 * n) & (phase < 180 * n + 90), float(k), 0.0) for n, k in enumerate(order))
    arguments = {"signal": "plant.p", "from": "0 deg", "to": "90 deg", "firing_order": order}
    found = values_of({"crank_average": arguments}, turning(signal, "N.m"))
    assert [found[f"cylinder_{k}"] for k in (1, 2, 3, 4)] == pytest.approx([1.0, 2.0, 3.0, 4.0], rel=1e-12)
    assert found["spread"] == pytest.approx(3.0)
    # Rows from 30 deg to 7464 deg: ten whole windows of each, and an eleventh of the first at 7200 deg.
    firings = [1.0] * 10 + [3.0] * 11 + [4.0] * 10 + [2.0] * 10
    assert found["windows"] == 41
    assert found[""] == pytest.approx(np.mean(firings)) and found["std"] == pytest.approx(np.std(firings, ddof=1))


def test_cylinders_that_fire_unevenly_have_their_top_dead_centres_given():
    signal = np.where(np.mod(CRANK, 720.0) < 300, 1.0, 2.0)
    arguments = {"signal": "plant.p", "to": "60 deg", "firing_order": [2, 1], "tdc": ["0 deg", "300 deg"]}
    found = values_of({"crank_average": arguments}, turning(signal, "N.m"))
    assert (found["cylinder_2"], found["cylinder_1"]) == (1.0, 2.0)


@settings(max_examples=50, deadline=None)
@given(arrays(float, (4, 12), elements=st.floats(-10, 10)), st.integers(0, 11))
def test_what_repeats_and_what_scatters_make_up_the_whole_error(error, rest):
    crank = 60.0 * np.arange(48 + rest)
    estimate = np.concatenate([error.ravel(), np.full(rest, 99.0)])
    recorded = turning(np.zeros(48 + rest), "N", crank, estimate)
    found = values_of({"crank_error": {"error": PAIR}}, recorded)
    whole = values_of({"rmse": PAIR, "until": "2820 deg"}, recorded)[""]
    assert math.hypot(found[""], found["scatter"]) == pytest.approx(whole, rel=1e-9, abs=1e-12)
    assert found[""] == pytest.approx(np.sqrt(np.mean(error.mean(axis=0) ** 2)), rel=1e-12, abs=1e-15)
    assert found["max"] == np.max(np.abs(error.mean(axis=0)))
    assert (found["cycles"], found["dropped"]) == (4, 60.0 * rest)


def in_time(signal, degrees, wrapped=None):
    """A record in time whose rows stand at the crank angles `degrees`, told by a signal in rad."""
    told = degrees if wrapped is None else np.mod(degrees, wrapped)
    columns = {"plant.p": (signal, "N.m"), "crank.angle": (np.radians(told), "rad")}
    return record(columns, 1e-3 * np.arange(len(degrees)))


# A crankshaft at 12 deg a millisecond with a ripple: rows at uneven angles.
UNEVEN = 12.0 * np.arange(800) + 4.0 * np.sin(0.7 * np.arange(800))


@pytest.mark.parametrize("wrapped", [None, 360.0, 720.0])
def test_on_a_time_clock_signals_are_interpolated_over_the_angle_that_is_named(wrapped):
    corners = np.arange(-1, 29) * 360.0
    triangle = np.interp(UNEVEN, corners, np.arange(30) % 2)  # 1 at 0 deg and 0 at 360 deg of every cycle
    definition = {"crank_average": {"signal": "plant.p", "to": "360 deg", "step": "2 deg"}, "angle": "crank.angle"}
    found = values_of(definition, in_time(triangle, UNEVEN, wrapped))
    assert found["windows"] == 13
    # Of 180 rows from 0 to 358 deg, 1 falling to 2/360: 1/2 + 1/360. A corner between two rows is cut off by at most
    # half their distance of 16 deg, which the row there is too low or too high by: 8/360 over a few of 180 rows.
    assert found[""] == pytest.approx(0.5 + 1 / 360, abs=8 / 360 * 8 / 180)
    assert found["std"] < 8 / 360 * 8 / 180


def test_interpolated_rows_between_straight_lines_are_exact():
    definition = {"crank_error": {"error": PAIR, "step": "1 deg"}, "angle": "crank.angle"}
    columns = {
        "plant.p": (UNEVEN, "N.m"),
        "observer.p": (1.5 * UNEVEN + 2, "N.m"),
        "crank.angle": (np.radians(UNEVEN), "rad"),
    }
    found = values_of({**definition, "after": "0 deg", "until": "719 deg"}, record(columns, np.arange(800.0)))
    # One row short of a cycle: from 719 deg downwards the window ends with the last row at or before it.
    assert found["cycles"] == 0
    found = values_of({**definition, "until": "750 deg"}, record(columns, np.arange(800.0)))
    assert found["cycles"] == 1
    expected = 0.5 * np.arange(720) + 2
    assert found[""] == pytest.approx(np.sqrt(np.mean(expected**2)), rel=1e-12)
    assert found["scatter"] == pytest.approx(0.0, abs=1e-12)


def test_a_crankshaft_that_turns_back_within_the_window_gives_no_value():
    back = np.concatenate([UNEVEN, UNEVEN[-1] - np.arange(1, 100.0)])
    definition = {"harmonic": {"signal": "plant.p", "per_cycle": 2, "step": "2 deg"}, "angle": "crank.angle"}
    signal = wave(back, 2)
    found = values_of(definition, in_time(signal, back))
    assert math.isnan(found[""]) and found["cycles"] == 0
    before = values_of({**definition, "until": "9000 deg"}, in_time(signal, back))
    # Linear between rows up to 16 deg apart, 16 deg of the oscillation being 32 deg of phase, cuts less than
    # (32 deg)^2/8 off where it bends most.
    assert before[""] == pytest.approx(1.0, abs=math.radians(32) ** 2 / 8)


def test_rows_that_do_not_divide_the_cycle_want_a_step():
    crank = 7.0 * np.arange(1000)
    recorded = turning(3.0 * wave(crank, 1, 10.0), "N", crank)
    assert math.isnan(values_of({"harmonic": {"signal": "plant.p", "per_cycle": 1}}, recorded)[""])
    found = values_of({"harmonic": {"signal": "plant.p", "per_cycle": 1, "step": "0.5 deg"}}, recorded)
    # Linear between rows 7 deg apart: short by at most (7 deg)^2/8 of the amplitude, 0.2 %.
    assert (found[""], found["phase"]) == (pytest.approx(3.0, rel=2e-3), pytest.approx(10.0, abs=0.1))


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 40), st.integers(1, 12), st.integers(0, 200))
def test_a_record_of_one_instant_in_some_gives_the_harmonics_of_the_rows_it_has(per_cycle, every, first):
    assume(120 % every == 0 and 2 * per_cycle < 120 // every)
    signal = 2.0 * wave(CRANK, per_cycle, 77.0)
    kept = turning(signal[first::every], "N", CRANK[first::every])
    found = values_of({"harmonic": {"signal": "plant.p", "per_cycle": per_cycle}}, kept)
    assert (found[""], found["phase"]) == (pytest.approx(2.0, rel=1e-9), pytest.approx(77.0, abs=1e-6))


SIGNALS = {
    name: Signal(name, unit) for name, unit in {"plant.p": "bar", "crank.angle": "rad", "crank.w": "rpm"}.items()
}


@pytest.mark.parametrize(
    ("definition", "apart", "message"),
    [
        ({"harmonic": {"signal": "plant.p", "per_cycle": 1}}, None, "wants the crank angle of the rows"),
        ({"mean": "plant.p", "after": "720 deg"}, None, "after 720.0 deg wants the crank angle of the rows"),
        (
            {"harmonic": {"signal": "plant.p", "per_cycle": 1}, "angle": "crank.angle"},
            None,
            "wants the `step` that the signals are interpolated at over crank.angle",
        ),
        ({"mean": "plant.p", "angle": "crank.angel"}, None, "no recorded signal is named 'crank.angel'"),
        ({"mean": "plant.p", "angle": "crank.w"}, None, "angle wants a signal in rad, got crank.w in rpm"),
        (
            {"harmonic": {"signal": "plant.p", "per_cycle": 1}},
            7.0,
            "rows 7 deg apart do not divide the cycle 720.0 deg",
        ),
        ({"harmonic": {"signal": "plant.p", "per_cycle": 60}}, 6.0, "less than half of the 120 rows a cycle, got 60"),
        (
            {"crank_average": {"signal": "plant.p", "from": "0 deg", "to": "5 deg"}},
            6.0,
            "wants a window as wide as its rows are apart, 6 deg, got 5 deg",
        ),
    ],
)
def test_what_crank_metrics_want_is_said_before_the_run(definition, apart, message):
    (problem,) = misfits("m", Definition.model_validate(definition), SIGNALS, Places("c.yaml"), apart)
    assert message in problem.message


@pytest.mark.parametrize(
    ("definition", "message"),
    [
        ({"crank_average": {"signal": "plant.p", "from": "180 deg", "to": "0 deg"}}, r"wants from < to <= from \+ 720"),
        ({"crank_average": {"signal": "plant.p", "to": "800 deg"}}, r"wants from < to <= from \+ 720"),
        ({"crank_average": {"signal": "plant.p", "firing_order": [1, 1]}}, "wants each cylinder once"),
        (
            {"crank_average": {"signal": "plant.p", "firing_order": [1, 2], "tdc": ["0 deg"]}},
            "wants one angle a cylinder",
        ),
        ({"crank_error": {"error": PAIR, "step": "7 deg"}}, "step wants to divide the cycle of 720.0 deg, got 7.0 deg"),
        ({"crank_error": {"error": PAIR, "cycle": "0 deg"}}, "cycle wants a crank angle above 0 deg"),
        ({"harmonic": {"signal": "plant.p", "per_cycle": 0}}, "per_cycle"),
        (
            {"mean": "plant.p", "after": "3 rpm"},
            "after wants a time or a crank angle, like 0.5 s or 720 deg, got 3.0 rpm",
        ),
    ],
)
def test_crank_metrics_that_mean_nothing_are_refused(definition, message):
    with pytest.raises(ValidationError, match=message):
        Definition.model_validate(definition)


def test_criteria_may_name_the_cylinders_of_the_firing_order():
    definition = Definition.model_validate({"crank_average": {"signal": "plant.p", "firing_order": [1, 2]}})
    known = results({"m": definition})
    assert list(known) == ["m", "m.std", "m.cov", "m.windows", "m.spread", "m.cylinder_1", "m.cylinder_2"]
    assert [known[name][1].of for name in ("m.cylinder_1", "m.spread")] == ["signal", "error"]


def test_every_kind_has_a_version_and_says_what_it_is():
    for kind in KINDS.values():
        assert kind.version >= 1
        assert kind.meaning.split(".")[0]
