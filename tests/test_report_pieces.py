"""A report is the same whether a record lies in one row group or in many, and holds no more than one at a time."""

from __future__ import annotations

import itertools
import tempfile
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_report_folder import build_run

from fmus.component import Signal
from harness.record import Record, write_signals
from harness.signalsfile import GroupSize
from reports import errors
from reports.envelope import Envelope, envelope
from reports.errors import pool
from reports.folder import Case, Run, read_run
from reports.html import render
from reports.signals import TELLS_FAULTS, read_fault_signals
from reports.traces import POINTS, declared_figures


def regroup(folder: Path, rows: int) -> None:
    """Write all records anew in row groups of so many rows."""
    for path in folder.glob("cases/*/signals.parquet"):
        pq.write_table(pq.read_table(path), path, row_group_size=rows)


@given(
    count=st.integers(1, 400),
    points=st.integers(2, 60),
    cuts=st.lists(st.integers(0, 400), max_size=8),
    seed=st.integers(0, 99),
)
def test_thinning_in_pieces_is_thinning_at_once(count: int, points: int, cuts: list[int], seed: int) -> None:
    time, values = np.arange(count) * 0.1, np.random.default_rng(seed).integers(-3, 4, count).astype(float)
    kept = Envelope(count, points)
    edges = sorted({0, count, *(cut for cut in cuts if cut < count)})
    for start, stop in itertools.pairwise(edges):
        kept.add(time[start:stop], values[start:stop])
    whole = envelope(time, values, points)
    assert np.array_equal(kept.samples(), whole)
    assert whole[0][0] == time[0] and whole[0][-1] == time[-1]
    assert (whole[1].min(), whole[1].max()) == (values.min(), values.max())
    assert len(whole[0]) <= (points + 2 if count > points else count)


def plainly_thinned(time: np.ndarray, values: np.ndarray, points: int) -> tuple[np.ndarray, np.ndarray]:
    """The least and the greatest of each stretch, by a sentence of Python."""
    edges = np.linspace(0, len(time), points // 2 + 1).astype(int)
    keep = {0, len(time) - 1}
    for start, stop in itertools.pairwise(edges):
        stretch = range(start, stop)
        keep |= {min(stretch, key=lambda row: values[row]), max(stretch, key=lambda row: values[row])}
    return time[sorted(keep)], values[sorted(keep)]


@given(count=st.integers(40, 400), seed=st.integers(0, 99))
def test_thinning_keeps_the_least_and_the_greatest_of_each_stretch(count: int, seed: int) -> None:
    time, values = np.arange(count) * 0.1, np.random.default_rng(seed).integers(-3, 4, count).astype(float)
    assert np.array_equal(envelope(time, values, 30), plainly_thinned(time, values, 30))


def test_the_page_is_the_same_from_one_row_group_and_from_many(tmp_path: Path) -> None:
    at_once = render(read_run(build_run(tmp_path)))
    regroup(tmp_path, 77)
    assert pq.read_metadata(next(tmp_path.glob("cases/*/signals.parquet"))).num_row_groups == 26
    assert render(read_run(tmp_path)) == at_once


@pytest.mark.parametrize("kept", [500, 20_000])
def test_errors_are_every_nth_of_each_case_across_row_groups(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept: int
) -> None:
    monkeypatch.setattr(errors, "SAMPLES_KEPT", kept)
    run = read_run(build_run(tmp_path, rows=2001))
    regroup(tmp_path, 77)
    pooled, _ = pool(run)
    one = next(errors for errors in pooled if errors.pair[:2] == ("plant.theta_e", "hybrid.theta_e"))
    stride = -(-2001 * len(run.cases) // kept)
    assert one.stride == stride
    expected = []
    for case in run.cases:
        frame = run.signals(case, ["plant.theta_e", "hybrid.theta_e"])
        frame = frame[frame.index >= 0.5]
        expected.append((frame["hybrid.theta_e"] - frame["plant.theta_e"]).to_numpy()[::stride])
    assert np.array_equal(one.values, np.concatenate(expected))


def test_a_trace_of_many_rows_is_thinned_and_says_of_how_many(tmp_path: Path) -> None:
    folder = build_run(tmp_path, rows=40_001)
    regroup(folder, 1000)
    run = read_run(folder)
    (figure,) = declared_figures(run)
    assert figure.rows == 40_001
    whole = run.signals(figure.case.key, ["hybrid.theta_e"])["hybrid.theta_e"]  # type: ignore[union-attr]
    trace = next(one for panel in figure.panels for one in panel.traces if one.name == "hybrid.theta_e")
    assert len(trace.along) <= POINTS + 2
    expected = plainly_thinned(whole.index.to_numpy(), whole.to_numpy(), POINTS)
    assert np.array_equal((trace.along, trace.values), expected)
    assert f"thinned from {figure.rows} to about" in render(run)


@given(codes=st.lists(st.integers(0, 2), min_size=1, max_size=40), rows=st.integers(1, 9))
def test_a_fault_signal_is_read_as_the_stretches_in_which_it_keeps_its_code(codes: list[int], rows: int) -> None:
    signal = Signal("gauge.fault", kind="integer", description=f"{TELLS_FAULTS}; 1: bias; 2: gain")
    time = np.arange(len(codes)) * 0.1
    case = Case("key", "as declared")
    with tempfile.TemporaryDirectory() as folder:
        run = Run(Path(folder), {}, (case,), None)
        path = run.path / "cases" / case.key / "signals.parquet"
        write_signals(Record((signal,), time, np.array(codes, dtype=float)[:, None]), path, GroupSize(0, rows))
        (steps,) = read_fault_signals(run, case).values()
    firsts = [row for row, code in enumerate(codes) if row == 0 or codes[row - 1] != code]
    assert steps.column.values.tolist() == [codes[row] for row in firsts]
    assert steps.edges.tolist() == [*time[firsts], time[-1]]
