"""Parts are taken back within an instant: what each kind can, what is refused with its evidence, and what is freed.

That what can be taken back makes the same steps again bit for bit is a law in lawbook.py, kept by every kind of part.
"""

from __future__ import annotations

import ctypes
import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from deceiver import deceiver, faults
from exchange_fmu import exchange_fmu
from hypothesis import given, settings
from hypothesis import strategies as st
from lawbook import Course, Step, check_component, inputs_at, move
from models import BALL, EVERY_KIND, FILTER, LAG
from oracle import SensorTwin
from scipy.integrate import solve_ivp
from test_clocks import clock_fmu
from third_party import OPENMODELICA, reference_fmu, third_party_fmu

from fmus.component import ERROR, FATAL, OK, Reversal, Reversible, Signal, StepError, Vector
from fmus.description import FmuKind
from fmus.exchange import Stepping
from fmus.export import cached_fmu
from fmus.fmu import FmuComponent, load_fmu
from fmus.model import Model
from fmus.plants.driveline import MODEL as DRIVELINE
from harness import sensor as sensor_module
from harness.clock import CrankGrid
from harness.crank import CrankComponent
from harness.faults import ActingFault, Window
from harness.held import HeldComponent
from harness.reversal import reversal_of
from harness.sensor import REVERSIBLE, Errors, SensorComponent

Move = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)
Derive = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


def derivative(way: Reversal, du: Sequence[float], outputs: int) -> Vector:
    """The directional derivative of the outputs along du."""
    seed, found = np.array(du, dtype=float), np.full(outputs, np.nan)
    assert Derive(way.derivative)(way.self, seed.ctypes.data, found.ctypes.data) == OK
    return found


def started(component: FmuComponent, t0: float = 0.0) -> Reversal:
    """A started component's way back, which it must have."""
    component.start(t0, inputs_at(component, Course(), 0))
    way = component.reversal()
    assert way is not None, component.proof().evidence
    return way


# ---- FMUs ----


@pytest.mark.parametrize("kind", ["cs", "me"])
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("model", [DRIVELINE, BALL, FILTER, EVERY_KIND], ids=lambda model: model.name)
def test_every_exported_model_can_be_taken_back(model: Model, fmi: int, kind: FmuKind):
    component = load_fmu(cached_fmu(model, fmi), kind=kind)
    assert started(component).keep and isinstance(component, Reversible)
    component.close()


@pytest.mark.parametrize("kind", ["cs", "me"])
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("model", ["VanDerPol", "Dahlquist", "BouncingBall", "Feedthrough", "Stair"])
def test_the_reference_fmus_can_be_taken_back(model: str, fmi: int, kind: FmuKind):
    component = load_fmu(reference_fmu(model, fmi), kind=kind)
    started(component)
    component.close()


@pytest.mark.parametrize("kind", ["cs", "me"])
def test_a_ball_goes_back_over_its_impacts(kind: FmuKind):
    check_component(lambda: load_fmu(cached_fmu(BALL, 3), kind=kind), Course(h=0.05, steps=40))


@pytest.mark.parametrize("kind", ["cs", "me"])
def test_clocks_are_taken_back_with_the_instance_that_they_tick_in(tmp_path: Path, kind: FmuKind):
    path = clock_fmu(tmp_path)
    component = load_fmu(path, kind=kind)
    way = started(component)
    h = 0.07

    def onward() -> Vector:
        return np.array([component.step(k * h, h, np.array([0.4 + 0.1 * (k // 5)])) for k in range(7, 40)])

    for k in range(7):
        component.step(k * h, h, np.array([0.4]))
    assert Move(way.keep)(way.self) == OK
    went = onward()
    assert Move(way.restore)(way.self) == OK
    names = [signal.name for signal in component.outputs]
    assert went[-1, names.index("ticks")] > went[0, names.index("ticks")] + 5
    assert went.tobytes() == onward().tobytes()
    component.close()


def test_events_of_all_sorts_in_model_exchange_are_gone_back_over(tmp_path: Path):
    path = exchange_fmu(tmp_path, 2)
    # Of x, the integral of u, a step of no length is no change; the lengths leave no event on a communication point.
    check_component(lambda: load_fmu(path), Course(h=0.071, steps=30))
    component = load_fmu(path)
    started(component)
    rows = np.array([component.step(0.071 * k, 0.071, np.zeros(1)) for k in range(30)])
    names = [signal.name for signal in component.outputs]
    assert rows[-1, names.index("ticks")] >= 8 and rows[-1, names.index("switches")] >= 1
    component.close()


# x follows u and crosses a threshold; once it did, the indicator of `once` lies at zero for ever.
CROSSING = Model(
    name="crossing",
    description="x' = 2 (u - x) + sin 9t, which crosses 0.5",
    equations=lambda t, x, m, u, p: ({"x": 2.0 * (u.u - x.x) + np.sin(9.0 * t)}, {}),
    inputs=(Signal("u", start=1.0),),
    states=(Signal("x"),),
    discrete=(Signal("above"), Signal("once")),
    indicator_names=("crossed", "frozen"),
    indicators=lambda t, x, m, u, p: {"crossed": x.x - 0.5, "frozen": np.where(m.once > 0.5, 0.0, x.x - 0.6)},
    transition=lambda t, x, m, u, p, above: {
        "above": np.where(above.crossed, 1.0, 0.0),
        "once": np.where(above.frozen, 1.0, m.once),
    },
)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("kept", range(30))
def test_a_solver_goes_back_over_an_event_wherever_it_was_kept(fmi: int, kept: int):
    component = load_fmu(cached_fmu(CROSSING, fmi), kind="me")
    way, h, u = started(component), 0.01, np.ones(1)
    for k in range(kept):
        component.step(k * h, h, u)
    assert Move(way.keep)(way.self) == OK

    def onward() -> Vector:
        return np.array([component.step(k * h, h, u) for k in range(kept, kept + 40)])

    went = onward()
    assert went[-1, 1] == went[-1, 2] == 1.0
    assert Move(way.restore)(way.self) == OK
    assert went.tobytes() == onward().tobytes()
    component.close()


@pytest.mark.parametrize("before", [1e-6, 3e-6, 1e-5, 1e-4])
def test_an_event_just_after_the_kept_state_is_found_again_though_its_indicator_came_to_rest(before: float):
    def passed(t: float, x: Vector) -> float:
        return float(x[0]) - 0.6

    def rates(t: float, x: Vector) -> Vector:
        return 2.0 * (1.0 - x) + np.sin(9.0 * t)

    when = solve_ivp(rates, (0.0, 1.0), [0.0], events=passed, rtol=1e-10, atol=1e-10).t_events[0][0]
    component = load_fmu(cached_fmu(CROSSING, 2), kind="me", stepping=Stepping(tolerance=1e-9))
    way, h, u = started(component), when - before, np.ones(1)
    component.step(0.0, h, u)
    assert Move(way.keep)(way.self) == OK
    went = np.array([component.step(h + 0.02 * k, 0.02, u) for k in range(20)])
    assert went[0, 2] == 1.0
    assert Move(way.restore)(way.self) == OK
    assert went.tobytes() == np.array([component.step(h + 0.02 * k, 0.02, u) for k in range(20)]).tobytes()
    component.close()


def test_an_input_that_changed_after_the_state_was_kept_changes_again(tmp_path: Path):
    for component in (load_fmu(cached_fmu(CROSSING, 2), kind="me"), load_fmu(clock_fmu(tmp_path))):
        way = started(component)
        component.step(0.0, 0.1, np.array([0.25]))
        assert Move(way.keep)(way.self) == OK
        went = component.step(0.1, 0.1, np.array([2.0]))
        assert Move(way.restore)(way.self) == OK
        assert component.step(0.1, 0.1, np.array([2.0])).tobytes() == went.tobytes()
        component.close()


def test_a_solver_that_starts_anew_at_each_instant_is_as_exact():
    component = load_fmu(reference_fmu("Dahlquist"), kind="me")
    way = started(component)
    x = []
    for k in range(50):
        assert Move(way.keep)(way.self) == OK
        x.append(component.step(0.1 * k, 0.1, np.empty(0))[0])
    # 50 starts of a solver whose local error is 1e-6; the equation damps what went before.
    assert np.abs(np.array(x) - np.exp(-0.1 * np.arange(1, 51))).max() < 1e-5
    component.close()


@pytest.mark.parametrize("kind", ["cs", "me"])
def test_what_declares_no_states_to_keep_is_refused_unasked(kind: FmuKind):
    component = load_fmu(third_party_fmu("Mass_Damper.fmu", OPENMODELICA), kind=kind)
    component.start(0.0, np.zeros(1))
    assert component.reversal() is None
    assert reversal_of(component).reason == "it does not declare canGetAndSetFMUstate"
    component.close()


def test_fmi_1_cannot_be_taken_back(tmp_path: Path):
    component = load_fmu(exchange_fmu(tmp_path, 1))
    component.start(0.0, np.zeros(1))
    assert reversal_of(component) == (None, "there is no such thing in FMI 1.0", None)
    component.close()


REFUSED = {
    "FORGETS_WHEN_TAKEN_BACK": "10 steps and the same after going back twice differ: y",
    "LENDS_WHAT_IT_KEEPS": "10 steps and the same after going back twice differ: y",
    "CANNOT_BE_KEPT": "keeping its state: the FMU gave no message",
}
# What does not come to an end at once, or ends the process.
OUT_OF_HAND = {"HANGS_IN_INSTANTIATE", "EXITS_IN_STEP"}


@pytest.mark.parametrize("fault", sorted(set(faults()) - OUT_OF_HAND))
def test_a_declared_capability_counts_only_where_it_is_proved(tmp_path: Path, fault: str):
    component = load_fmu(deceiver(tmp_path, fault))
    component.start(0.0, np.ones(1))
    found = reversal_of(component)
    assert (found.reversal is None) == (fault in REFUSED)
    assert found.reason.startswith(REFUSED.get(fault, "")) and bool(found.reason) == (fault in REFUSED)
    component.close()


def test_a_refused_fmu_is_run_as_if_nobody_had_asked(tmp_path: Path):
    component = load_fmu(deceiver(tmp_path, "FORGETS_WHEN_TAKEN_BACK"))
    plain = [component.start(0.0, np.ones(1)), *(component.step(0.1 * k, 0.1, np.ones(1)) for k in range(5))]
    component.start(0.0, np.ones(1))
    assert component.reversal() is None
    rows = [component.step(0.1 * k, 0.1, np.ones(1)) for k in range(5)]
    assert np.array(rows).tobytes() == np.array(plain[1:]).tobytes()
    component.close()


def test_an_fmu_with_one_state_for_all_instances_is_not_disturbed_by_its_proof(tmp_path: Path):
    path = deceiver(tmp_path, "SHARES_ITS_STATE")
    component = load_fmu(path)
    first = component.start(0.0, np.ones(1))
    plain = [component.step(0.1 * k, 0.1, np.ones(1)) for k in range(5)]
    assert component.start(0.0, np.ones(1)).tobytes() == first.tobytes()
    assert component.reversal() is not None
    assert np.array([component.step(0.1 * k, 0.1, np.ones(1)) for k in range(5)]).tobytes() == np.array(plain).tobytes()
    component.close()


def test_a_question_after_a_step_comes_too_late():
    unproved = dataclasses.replace(LAG, description="x' = -a x + sin t + u, which nobody asked before")
    component = load_fmu(cached_fmu(unproved, 2))
    component.start(0.0, np.ones(1))
    for k in range(2):
        component.step(0.1 * k, 0.1, np.ones(1))
    with pytest.raises(StepError, match="to be asked before its first step"):
        component.reversal()
    # Once it is known there is nothing to try.
    component.start(0.0, np.ones(1))
    assert component.reversal() is not None
    component.step(0.0, 0.1, np.ones(1))
    component.step(0.1, 0.1, np.ones(1))
    assert component.reversal() is not None
    component.close()


def test_the_fmu_is_told_that_steps_may_be_taken_back_and_only_then(tmp_path: Path):
    component = load_fmu(deceiver(tmp_path, "BELIEVES_WHAT_IT_IS_TOLD"))
    component.start(0.0, np.ones(1))
    component.step(0.0, 0.1, np.ones(1))
    assert final(component) == 1
    way = started(component)
    Move(way.keep)(way.self)
    component.step(0.0, 0.1, np.ones(1))
    assert final(component) == 0
    assert Move(way.restore)(way.self) == OK
    component.close()


class DeceiverState(ctypes.Structure):
    """The struct State of deceiver.c."""

    _fields_ = (
        *((name, ctypes.c_double) for name in ("x", "u", "time", "drift")),
        ("steps", ctypes.c_long),
        ("final", ctypes.c_int),
    )


def final(component: FmuComponent) -> int:
    return int(DeceiverState.from_address(component.slave.adapter.table.instance).final)


def test_the_kept_state_is_freed_with_the_instance(tmp_path: Path):
    path = deceiver(tmp_path, "NONE")
    component = load_fmu(path)
    kept = ctypes.c_long.in_dll(ctypes.CDLL(str(component.slave._path)), "states_kept")
    for _ in range(3):
        way = started(component)
        assert kept.value == 0, "the proof left a state behind"
        for _ in range(5):
            assert Move(way.keep)(way.self) == OK
        assert kept.value == 1
    component.start(0.0, np.ones(1))
    assert kept.value == 0
    Move(way.keep)(way.self)
    component.close()
    assert kept.value == 0


def test_no_call_is_made_on_an_instance_that_is_not_there(tmp_path: Path):
    component = load_fmu(deceiver(tmp_path, "NONE"))
    way = started(component)
    component.close()
    assert [Move(move)(way.self) for move in (way.keep, way.restore)] == [ERROR, ERROR]


def test_going_back_to_what_was_never_kept_is_an_error_with_a_name(tmp_path: Path):
    component = load_fmu(deceiver(tmp_path, "NONE"))
    way = started(component)
    status = Move(way.restore)(way.self)
    assert status == ERROR
    assert component.failure(status, 0.0).message == "going back to the state kept: no state was kept"
    component.close()


def test_going_back_mends_an_error(tmp_path: Path):
    component = load_fmu(deceiver(tmp_path, "TAKES_ONE_STEP_LENGTH"))
    way = started(component)
    assert Move(way.keep)(way.self) == OK
    went = component.step(0.0, 0.1, np.ones(1))
    with pytest.raises(StepError, match="doing the step"):
        component.step(0.1, 0.05, np.ones(1))
    assert Move(way.keep)(way.self) == ERROR
    assert Move(way.restore)(way.self) == OK
    assert component.step(0.0, 0.1, np.ones(1)).tobytes() == went.tobytes()
    component.close()


def test_a_start_forgets_what_was_kept_before():
    component = load_fmu(reference_fmu("Dahlquist"))
    way = started(component)
    Move(way.keep)(way.self)
    component.start(0.0, np.empty(0))
    assert Move(way.restore)(way.self) == ERROR
    component.close()


# ---- directional derivatives of FMUs ----

# y1 in deg of u1 in rpm and u2 in 1, y2 in rpm; SI units are rad, rad/s.
UNITS = Model(
    name="units",
    description="Products in units that are not SI's",
    equations=lambda t, x, m, u, p: (
        {"x": -x.x + u.u1},
        {"y1": 3.0 * u.u1 * u.u2 + x.x, "y2": u.u2**2, "y3": u.count + 0.0 * u.u1},
    ),
    states=(Signal("x", "rpm"),),
    inputs=(Signal("u1", "rpm", 60.0), Signal("u2", "1", 2.0), Signal("count", kind="integer")),
    outputs=(Signal("y1", "deg"), Signal("y2", "rpm"), Signal("y3")),
)
DEG, RPM = np.pi / 180.0, np.pi / 30.0


@pytest.mark.parametrize("kind", ["cs", "me"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_derivatives_are_in_si_units_at_the_present_point(fmi: int, kind: FmuKind):
    component = load_fmu(cached_fmu(UNITS, fmi), kind=kind)
    way = started(component)
    # y3 depends on an integer, of which no derivative is asked; a real one is the difference that a change makes.
    u1, u2 = 50.0, 3.0
    component.step(0.0, 0.1, np.array([u1 * RPM, u2, 4.0]))
    names = [signal.name for signal in component.outputs]
    y1, y2, y3, x = (names.index(name) for name in ("y1", "y2", "y3", "x"))
    along_u1, along_u2 = (derivative(way, du, len(names)) for du in ([0.2 * RPM, 0.0, 0.0], [0.0, 0.2, 0.0]))
    # Products and unit factors of about ten roundings.
    np.testing.assert_allclose(along_u1[[y1, y2, y3, x]], [3.0 * u2 * 0.2 * DEG, 0.0, 0.0, 0.0], rtol=1e-14)
    np.testing.assert_allclose(
        along_u2[[y1, y2, y3, x]], [3.0 * u1 * 0.2 * DEG, 2 * u2 * 0.2 * RPM, 0.0, 0.0], rtol=1e-14
    )
    both = derivative(way, [0.2 * RPM, 0.2, 5.0], len(names))
    np.testing.assert_allclose(both, along_u1 + along_u2, rtol=1e-14)
    component.close()


def test_derivatives_follow_what_is_fetched_and_what_is_held():
    component = load_fmu(cached_fmu(UNITS, 2))
    component.select_outputs(["y2", "y3"])
    component.hold_inputs(["u1"])
    way = started(component)
    component.step(0.0, 0.1, np.array([50.0 * RPM, 3.0, 0.0]))
    assert [signal.name for signal in component.outputs] == ["y2", "y3"]
    found = derivative(way, [1e9, 0.5, 0.0], 2)
    np.testing.assert_allclose(found, [2 * 3.0 * 0.5 * RPM, 0.0], rtol=1e-14)
    component.close()


def test_a_derivative_is_what_a_step_makes_of_a_small_change_of_an_input():
    component = load_fmu(cached_fmu(UNITS, 3))
    way = started(component)
    u = np.array([50.0 * RPM, 3.0, 0.0])
    h = 1e-6  # over which x moves by a millionth of what u1 moves
    assert Move(way.keep)(way.self) == OK
    for i, width in ((0, 1e-3), (1, 1e-3)):
        du = np.zeros(3)
        du[i] = width
        ends = []
        for moved in (u + du, u - du):
            assert Move(way.restore)(way.self) == OK
            ends.append(component.step(0.0, h, moved))
        assert Move(way.restore)(way.self) == OK
        component.step(0.0, h, u)
        # The outputs are of second order in the inputs: a central difference is exact but for rounding and h.
        np.testing.assert_allclose((ends[0] - ends[1]) / 2.0, derivative(way, du, len(u) + 1), rtol=1e-5, atol=1e-9)
    component.close()


def test_derivatives_that_differ_from_differences_are_not_used(tmp_path: Path):
    component = load_fmu(deceiver(tmp_path, "DERIVES_WRONGLY"))
    assert started(component).derivative == 0
    assert component.proof().derivatives.evidence == "d der(x) / d x is -1.01, by differences -1"
    component.close()


@pytest.mark.parametrize(
    ("period", "said"),
    [
        # The gain of `estimate[1]` is 0.5 for each rpm: of a change by 1 rad/s a sample makes 0.5 * 30/pi.
        (0.002, "d estimate[1] / d y is 0, but a step of 0.002 s makes 4.77465 of a change"),
        (0.1, "d estimate[1] / d y is 0 where it was tried, between an output and an input that are declared to"),
    ],
)
def test_a_sampled_model_whose_outputs_jump_with_its_inputs_has_no_derivative(period: float, said: str):
    parameters = (*FILTER.parameters[:2], Signal("period", "s", period))
    component = load_fmu(cached_fmu(dataclasses.replace(FILTER, parameters=parameters), 2))
    assert started(component).derivative == 0
    assert component.proof().derivatives.evidence.startswith(said)
    component.close()


# ---- sensors and sources ----

FAULTED = (
    ActingFault("bias", 0.3, Window(0.0, 0.08)),
    ActingFault("gain", 1.1, Window(0.01, 0.09)),
    ActingFault("drift", 2.0, Window(0.02, np.inf)),
    ActingFault("stuck", 0.0, Window(0.03, 0.035)),
    ActingFault("drop_out", 0.4, Window(0.04, 0.14)),
    ActingFault("noise", 0.2, Window(0.05, 0.15)),
    ActingFault("delay", 6.5, Window(0.03, 0.12), code=9),
    ActingFault("drift", 0.5, Window(first=45, last=130)),
)
H = 1e-3


def signal_of(chance: int, k: int) -> float:
    return float(np.sin(0.3 * k + chance) + 0.1 * chance)


class Driven:
    """A sensor driven by C's functions alone, with the plain-Python twin that has made the same samples."""

    def __init__(self, errors: Errors, seed: int) -> None:
        self.sensor = SensorComponent(Signal("y"), errors, H, seed=seed)
        self.errors, self.seed = errors, seed
        self.signal = [signal_of(0, 0)]
        self.sensor.start(0.0, np.array(self.signal))
        self.native, self.way = self.sensor.native(), self.sensor.reversal()
        self.kept: list[float] = []

    def samples(self, chance: int, count: int) -> list[list[float]]:
        """Readings, and the faults that act, of so many more samples of a signal."""
        found, y = [], np.zeros(len(self.sensor.outputs))
        for _ in range(count):
            k = len(self.signal)
            self.signal.append(signal_of(chance, k))
            u = np.array(self.signal[-1:])
            assert Step(self.native.step)(self.native.self, (k - 1) * H, H, u.ctypes.data, y.ctypes.data) == OK
            found.append(y.tolist())
        return found

    def keep(self) -> None:
        assert Move(self.way.keep)(self.way.self) == OK
        self.kept = list(self.signal)

    def restore(self) -> int:
        self.signal = list(self.kept)
        return Move(self.way.restore)(self.way.self)

    def wanted(self, count: int) -> list[list[float]]:
        """The same of a twin that was never taken back."""
        twin = SensorTwin(self.errors, H, self.seed, "sensor", len(self.signal))
        readings = [twin.start(0.0, self.signal[:1])]
        for k in range(1, len(self.signal)):
            readings.append(twin.step((k - 1) * H, H, self.signal[k : k + 1]))
        return readings[len(readings) - count :]


sizes = st.floats(0.0, 2.0)
errors = st.builds(
    Errors,
    lag=st.sampled_from([0.0, 0.004]),
    delay=st.sampled_from([0.0, 0.0003, 0.001, 0.0025, 0.07]),
    gain=sizes,
    bias=sizes,
    noise=st.sampled_from([0.0, 0.1]),
    drop_out=st.sampled_from([0.0, 0.3]),
    resolution=st.sampled_from([0.0, 0.01]),
    lowest=st.just(-1.5),
    highest=st.just(2.5),
    faults=st.sampled_from([(), FAULTED]),
)
# Each: samples before a keep, then ways that are all taken back but the last.
ways = st.lists(st.tuples(st.integers(0, 70), st.lists(st.integers(0, REVERSIBLE), min_size=1, max_size=3)), max_size=4)


@settings(max_examples=150, deadline=None)
@given(errors, st.integers(0, 3), ways)
def test_a_sensor_taken_back_reads_as_one_that_never_went_the_other_way(
    errors: Errors, seed: int, ways: list[tuple[int, list[int]]]
):
    whole, sensor_module.BLOCK = sensor_module.BLOCK, REVERSIBLE + 6  # so that blocks end in nearly every way
    try:
        driven = Driven(errors, seed)
    finally:
        sensor_module.BLOCK = whole
    for before, lengths in ways:
        assert driven.samples(1, before) == driven.wanted(before)
        driven.keep()
        for chance, length in enumerate(lengths):
            assert driven.restore() == OK
            assert driven.samples(chance, length) == driven.wanted(length)


@pytest.mark.parametrize("before", [4030, 4031, 4032, 4033, 4093, 4094, 4095, 4096, 8191])
def test_noise_comes_again_over_the_end_of_a_block(before: int):
    driven = Driven(Errors(noise=1.0, drop_out=0.2), 5)
    driven.samples(0, before)
    driven.keep()
    first = driven.samples(0, REVERSIBLE)
    assert driven.restore() == OK
    assert driven.samples(0, REVERSIBLE) == first == driven.wanted(REVERSIBLE)
    assert driven.samples(0, 300) == driven.wanted(300)


def test_a_sensor_goes_back_over_so_many_samples_and_not_over_one_more():
    driven = Driven(Errors(delay=0.003, noise=1.0), 0)
    assert driven.restore() == ERROR, "nothing was kept"
    driven = Driven(Errors(delay=0.003, noise=1.0), 0)
    driven.keep()
    driven.samples(0, REVERSIBLE)
    assert driven.restore() == OK
    driven.samples(0, REVERSIBLE + 1)
    assert driven.restore() == ERROR
    driven = Driven(Errors(delay=0.003, noise=1.0), 0)
    driven.samples(0, 3)
    driven.keep()
    assert driven.samples(0, 200) == driven.wanted(200), "keeping changes what comes after the samples to go back over"


# ---- cranks and held wires ----


def test_a_crank_goes_back_to_what_it_counted():
    grid = CrankGrid(0.0, 1000, np.inf, 720.0, 120, 0.0, 120, (0.0, 360.0), 0.1)
    check_component(lambda: CrankComponent(grid, None, 720.0, (0.0, 360.0)), Course(steps=200))


def test_a_held_wire_has_nothing_to_go_back_to():
    held = HeldComponent((Signal("a"), Signal("b")))
    found = reversal_of(held)
    for name in ("keep", "restore"):
        move(found, name)


# ---- parts in Python ----


class Counter:
    """y = steps made so far; it can be taken back, unless it is to raise."""

    role = "controller"
    inputs: tuple[Signal, ...] = ()
    outputs = (Signal("y"),)
    feedthrough: frozenset[tuple[str, str]] = frozenset()

    def __init__(self, raises: type[BaseException] | None = None) -> None:
        self.raises, self.count = raises, 0

    def start(self, t0: float, u: Vector) -> Vector:
        self.count = 0
        return np.zeros(1)

    def step(self, t: float, h: float, u: Vector) -> Vector:
        self.count += 1
        return np.array([float(self.count)])

    def native(self) -> None:
        return None

    def close(self) -> None:
        pass

    def keep(self) -> None:
        if self.raises is not None:
            raise self.raises("told so")
        self.kept = self.count

    def restore(self) -> None:
        self.count = self.kept


class Listener:
    """Keeps what was raised."""

    raised: BaseException | None = None


def test_a_part_in_python_is_taken_back_by_its_own_methods():
    part = Counter()
    part.start(0.0, np.empty(0))
    part.step(0.0, 1.0, np.empty(0))
    found = reversal_of(part)
    assert found.reversal is not None and found.reversal.derivative == 0
    move(found, "keep")
    part.step(1.0, 1.0, np.empty(0))
    part.step(2.0, 1.0, np.empty(0))
    for _ in range(2):
        move(found, "restore")
        assert part.step(1.0, 1.0, np.empty(0))[0] == 2.0


@pytest.mark.parametrize("raises", [ZeroDivisionError, KeyboardInterrupt])
def test_what_a_part_raises_as_it_is_kept_is_kept_for_who_listens(raises: type[BaseException]):
    listener = Listener()
    found = reversal_of(Counter(raises), listener)
    assert found.reversal is not None
    assert Move(found.reversal.keep)(found.reversal.self) == FATAL
    assert isinstance(listener.raised, raises)


def test_a_part_in_python_without_a_way_back_is_named():
    class Plain(Counter):
        keep = None  # type: ignore[assignment]

    assert reversal_of(Plain()) == (None, "Plain has no methods keep and restore", None)
