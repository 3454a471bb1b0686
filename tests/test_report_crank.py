"""Figures over crank angle: where rows lie, which cycles are laid over each other, and what a campaign may ask for."""

import math
import re
import textwrap

import numpy as np
import plotly.graph_objects as go
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_report import page_of

from fmus.component import ConfigurationError, Signal
from harness.campaign import read_campaign
from harness.cases import execute
from harness.preflight import preflight
from harness.record import Record, write_signals
from harness.signalsfile import GroupSize
from reports.along import Cycles, Ends, read_along
from reports.axis import MOST_MARKS, Engine, axis_over
from reports.folder import Case, Run, read_run
from reports.interactive import interactive
from reports.traces import declared_figures

ON_CRANK = """\
campaign: turning
clock: {crank: {step: 6 deg, stop: 8 rev, speed: engine.omega, firing_order: [1, 3, 4, 2]}}
parts:
  engine: {use: 'crank_parts:ENGINE', with: {rate: 50 rad/s2}}
  crank: {use: crank}
  gauge:
    use: sensor
    of: engine.omega
    noise: {std: 1 rpm}
    faults: [{bias: 30 rpm, from: 0.2 s, to: 0.3 s}]
metrics:
  speed: {rmse: [engine.omega, gauge.value], unit: rpm}
report:
  figures:
    - {title: Angle, traces: [[crank.angle]], over: crank, unit: deg}
    - {title: Cycles, traces: [[crank.angle]], over: cycles, unit: deg}
    - {title: Laid over, traces: [[crank.phase], [engine.omega, gauge.value]], over: cycle, last: 3, unit: deg}
    - {title: Window, traces: [[crank.phase]], over: cycle, from: 700 deg, to: 2170 deg}
    - {title: Part, traces: [[engine.omega]], from: 720 deg, to: 1440 deg}
"""
# Rows are 6.06 deg apart, 1 s is 8.4 cycles: no row but the first lies at an end of a cycle.
ON_TIME = """\
campaign: turning
clock: {time: {step: 1 ms, stop: 1 s}}
parts:
  engine: {use: 'crank_parts:ENGINE', with: {omega: 1010 rpm}}
  crank: {use: crank, of: engine.theta, firing_order: [1, 3, 4, 2], tdc: [10 deg, 190 deg, 370 deg, 550 deg]}
report:
  figures:
    - {title: Laid over, traces: [[crank.phase]], over: cycle, angle: crank.angle, last: 2, unit: deg}
    - {title: From the phase, traces: [[crank.angle]], over: crank, angle: crank.phase, unit: deg}
"""


def read(tmp_path, text):
    path = tmp_path / "turning.yaml"
    path.write_text(textwrap.dedent(text))
    return read_campaign(path)


def ran(tmp_path, text):
    execute(read(tmp_path, text), tmp_path / "run", 1, lambda ended: None)
    return read_run(tmp_path / "run")


@pytest.fixture(scope="module")
def on_crank(tmp_path_factory):
    return ran(tmp_path_factory.mktemp("crank"), ON_CRANK)


@pytest.fixture(scope="module")
def on_time(tmp_path_factory):
    return ran(tmp_path_factory.mktemp("time"), ON_TIME)


def test_over_crank_angle_every_row_lies_at_its_angle(on_crank):
    angle, cycles, *_ = declared_figures(on_crank)
    (trace,) = angle.panels[0].traces
    np.testing.assert_array_equal(trace.along, 6.0 * np.arange(481))
    np.testing.assert_allclose(trace.values, trace.along, atol=1e-9)  # the signal goes through rad
    assert angle.axis.label == "crank angle [deg]"
    np.testing.assert_array_equal(cycles.panels[0].traces[0].along, 6.0 * np.arange(481) / 720.0)


def test_the_last_cycles_are_laid_over_each_other_from_zero_to_720_deg(on_crank):
    figure = declared_figures(on_crank)[2]
    phase, speeds = figure.panels
    assert figure.cycles == 3 and len(phase.traces) == 3 and len(speeds.traces) == 6
    for trace in phase.traces:
        np.testing.assert_array_equal(trace.along, 6.0 * np.arange(121))
        # The row that ends a cycle begins the next: there the phase is 0 again.
        np.testing.assert_allclose(trace.values[:-1], trace.along[:-1], atol=1e-9)
    # 8 revolutions are four cycles; at a growing speed each is faster than the one before.
    first = [trace.values[0] for trace in speeds.traces if trace.name == "engine.omega"]
    frame = on_crank.signals(figure.case, ["engine.omega", "crank"])
    expected = [frame["engine.omega"][np.isclose(frame["crank"], 720.0 * cycle)].item() for cycle in (1, 2, 3)]
    np.testing.assert_array_equal(first, expected)
    assert [trace.strength for trace in phase.traces] == sorted(trace.strength for trace in phase.traces)
    assert [trace.strength == 1.0 for trace in phase.traces] == [False, False, True]


def test_a_window_holds_the_cycles_that_lie_whole_in_it(on_crank):
    figure = declared_figures(on_crank)[3]
    # 700 to 2170 deg hold the cycles 720..1440 and 1440..2160.
    assert figure.cycles == 2 and figure.rows == 2 * 121


def test_a_figure_over_time_may_be_cut_at_crank_angles(on_crank):
    (trace,) = declared_figures(on_crank)[4].panels[0].traces
    frame = on_crank.signals(on_crank.cases[0], ["crank"])["crank"]
    inside = frame[(frame >= 720.0) & (frame <= 1440.0)]
    np.testing.assert_array_equal(trace.along, inside.index.to_numpy())


def test_firing_top_dead_centres_are_marked_where_the_clock_knows_them(on_crank):
    angle, cycles, over, *_ = declared_figures(on_crank)
    assert over.axis.marks == ((0.0, "1"), (180.0, "3"), (360.0, "4"), (540.0, "2"))
    assert over.axis.reach == (0.0, 720.0)
    assert [name for _, name in angle.axis.marks] == ["1", "3", "4", "2"] * 4 + ["1"]
    assert [at for at, _ in cycles.axis.marks] == [quarter / 4 for quarter in range(17)]


def test_faults_are_shaded_where_they_act_along_the_crank_angle(on_crank):
    angle, cycles, over, *_ = declared_figures(on_crank)
    frame = on_crank.signals(on_crank.cases[0], ["crank", "gauge.fault"])
    acting = frame["crank"][frame["gauge.fault"] > 0]
    (window,) = angle.windows
    # From the first row with the fault to the first without.
    assert (window.since, window.until) == pytest.approx((acting.iloc[0], acting.iloc[-1] + 6.0))
    assert cycles.windows[0].since == pytest.approx(acting.iloc[0] / 720.0)
    assert over.windows == ()


def test_on_a_clock_in_time_a_signal_gives_the_angle_and_its_part_the_engine(on_time):
    figure = declared_figures(on_time)[0]
    older, newer = figure.panels[0].traces
    assert figure.axis.marks == ((10.0, "1"), (190.0, "3"), (370.0, "4"), (550.0, "2"))
    for trace in (older, newer):
        np.testing.assert_allclose(trace.values, trace.along, atol=1e-6)
        assert 0.0 <= trace.along[0] < 6.1 and 713.9 < trace.along[-1] <= 720.0
    frame = on_time.signals(figure.case, ["crank.angle"])["crank.angle"]
    seventh = np.degrees(frame[(frame >= 28 * math.pi) & (frame <= 32 * math.pi)].to_numpy()) - 7 * 720.0
    np.testing.assert_allclose(newer.along, seventh, atol=1e-9)


def test_an_angle_that_begins_anew_every_cycle_is_unwound(on_time):
    (trace,) = declared_figures(on_time)[1].panels[0].traces
    np.testing.assert_allclose(trace.along, trace.values, atol=1e-6)
    assert trace.along[-1] > 5900.0


@settings(max_examples=40, deadline=None)
@given(
    start=st.floats(0.0, 719.0),
    step=st.floats(0.5, 90.0),
    turn=st.sampled_from([360.0, 720.0]),
    rows=st.integers(2, 9),
    count=st.integers(3, 60),
)
def test_unwinding_row_group_by_row_group_is_unwinding_at_once(tmp_path_factory, start, step, turn, rows, count):
    angle = (start + step * np.arange(count)) % turn
    folder = tmp_path_factory.mktemp("wound")
    case = Case("key", "as declared")
    path = folder / "cases" / "key" / "signals.parquet"
    write_signals(
        Record((Signal("crank.phase", "deg"),), 0.1 * np.arange(count), np.radians(angle)[:, None]),
        path,
        GroupSize(0, rows),
    )
    assert pq.read_metadata(path).num_row_groups == -(-count // rows)
    found = read_along(Run(folder, {}, (case,), None), case, ["crank.phase"], "crank", angle="crank.phase")
    along, _ = found.pieces[0]["crank.phase"]
    expected = np.unwrap(np.degrees(np.radians(angle)), period=360.0)
    # Both add multiples of 360 deg, in another order.
    np.testing.assert_allclose(along, expected if np.any(np.diff(angle) < 0) else angle, atol=1e-9)


def test_many_cycles_are_thinned_with_their_extremes_kept(tmp_path):
    crank = 0.1 * np.arange(72_001)
    values = np.sin(np.radians(crank))
    values[30_000] = 9.0
    case = Case("key", "as declared")
    path = tmp_path / "cases" / "key" / "signals.parquet"
    write_signals(Record((Signal("a.b"),), 1e-4 * np.arange(72_001), values[:, None], crank=crank), path)
    run = Run(tmp_path, {}, (case,), None)
    found = read_along(run, case, ["a.b"], "crank", points=6000, cycles=Cycles(720.0, 100))
    assert len(found.pieces) == found.whole == 10 and found.rows == 10 * 7201
    assert max(len(piece["a.b"][0]) for piece in found.pieces) <= 602
    assert max(piece["a.b"][1].values.max() for piece in found.pieces) == 9.0


def test_a_window_without_a_whole_cycle_says_so(on_crank):
    case = on_crank.cases[0]
    ends = Ends(crank=(10.0, 1400.0))
    assert read_along(on_crank, case, ["crank.phase"], "crank", ends, cycles=Cycles(720.0, 100)).rows == 0


def test_so_many_firings_that_they_would_hide_the_figure_are_not_marked():
    engine = Engine(720.0, {1: 0.0, 2: 360.0})
    assert len(axis_over("crank", engine, 0.0, 720.0 * 19).marks) == 39
    assert len(axis_over("crank", engine, 0.0, 720.0 * MOST_MARKS).marks) == 0


def test_interactive_figures_over_a_cycle_are_valid_plotly_with_one_entry_a_signal(on_crank):
    figure = declared_figures(on_crank)[2]
    drawn = go.Figure(interactive(figure, 500))
    assert [trace.showlegend for trace in drawn.data] == [False, False, True] * 3
    assert (
        drawn.layout.xaxis.range == (0.0, 720.0) and drawn.layout.xaxis.title.text == "crank angle in the cycle [deg]"
    )
    assert [note.text for note in drawn.layout.annotations][:4] == ["1", "3", "4", "2"]


def test_the_page_says_what_is_drawn_over_crank_angle(on_crank):
    text = page_of(on_crank.path).text("figures")
    assert "3 cycles, laid over each other, the earlier the paler (the last of 4 whole ones)." in text
    assert "2 cycles, laid over each other, the earlier the paler." in text
    assert "a cylinder is at firing top dead centre" in text
    assert re.search(r"a fault is active: gauge: bias 30.0 rpm, [\d.]+ to [\d.]+ deg", text)
    assert re.search(r"a fault is active: gauge: bias 30.0 rpm, [\d.]+ to [\d.]+ cycles", text)
    assert "Not drawn" not in text


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("last: 2", "last: 0", "last wants at least 1, got 0"),
        ("over: crank", "over: crank, last: 2", "last wants `over: cycle`, got over: crank"),
        ("over: crank", "over: crnk", "over wants 'time', 'crank', 'cycles' or 'cycle', got 'crnk'"),
        ("last: 2", "from: 3 rpm", "from wants a time or a crank angle, like 0.5 s or 720 deg, got 3.0 rpm"),
        ("last: 2", "cycle: -1 deg", "cycle wants a crank angle above 0 deg, got -1.0 deg"),
    ],
)
def test_what_is_wrong_with_a_figure_is_told_with_its_place(tmp_path, old, new, told):
    assert old in ON_TIME
    with pytest.raises(ConfigurationError) as caught:
        read(tmp_path, ON_TIME.replace(old, new))
    found = [str(problem) for problem in caught.value.problems]
    assert any(told in one and "turning.yaml:" in one for one in found), found


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (", angle: crank.angle", "", r"report: over wants the crank angle of the rows, which a record on a time clock"),
        ("over: cycle, angle: crank.angle, last: 2", "from: 720 deg", r"report: from wants the crank angle"),
        ("angle: crank.angle", "angle: crank.angel", r"no recorded signal is named 'crank.angel'; did you mean"),
        ("angle: crank.angle", "angle: engine.omega", r"angle wants a signal in rad, got engine.omega in rad/s"),
    ],
)  # fmt: skip
def test_an_angle_that_is_not_there_is_told_before_the_run(tmp_path, old, new, told):
    assert old in ON_TIME
    with pytest.raises(ConfigurationError, match=r"turning\.yaml:8:\d+: .*" + told):
        preflight(read(tmp_path, ON_TIME.replace(old, new)))
