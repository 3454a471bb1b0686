"""`crankbench select --method h2` and `optimal`: the contract's JSON, proofs, refusals, the table and the page."""

from __future__ import annotations

import csv
import io
import json
import math
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from fmus.component import Signal
from fmus.export import cached_fmu
from fmus.model import Model
from harness import optimaltext
from harness.optimaltext import stages_told
from reports.selection import write_page

# A chain of tanks, each filled by the one before; the last one leaks by itself and `idle` stands beside them.
CHAIN = Model(
    name="chain",
    description="Three tanks in a row and one that nothing flows into",
    equations=lambda t, x, m, u, p: (
        {"a": u.u - x.a, "b": x.a - 2.0 * x.b, "c": x.b - 0.5 * x.c, "idle": -x.idle},
        {"flow": 2.0 * x.b, "both": x.a + x.c},
    ),
    states=(
        Signal("a", "bar", 0.0),
        Signal("b", "1", 0.0),
        Signal("c", "1", 0.0, nominal=2.0),
        Signal("idle", "1", 0.0),
    ),
    inputs=(Signal("u"),),
    outputs=(Signal("flow"), Signal("both")),
)
# One tank that fills for ever, one that leaks: only a sensor on the first sees that it fills.
FILLING = Model(
    name="filling",
    description="A tank that fills for ever beside one that leaks",
    equations=lambda t, x, m, u, p: ({"full": u.u, "leak": -x.leak}, {}),
    states=(Signal("full", "1", 0.0), Signal("leak", "1", 0.0)),
    inputs=(Signal("u"),),
)


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The modules `chain_module` and `filling_module` with the models of these names."""
    for name in ("chain", "filling"):
        source = f"from test_select_by_error import {name.upper()} as MODEL\n"
        (tmp_path / f"{name}_module.py").write_text(source, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.syspath_prepend(str(Path(__file__).parent))


BY_ERROR = ("select", "chain_module", "--estimate", "c", "--sensors", "a,b,c,flow,both", "--settle")


def selected(crankbench, *more: str, at: tuple[str, ...] = BY_ERROR) -> dict:
    code, out, err = crankbench(*at, "--json", *more)
    assert code == 0, err
    return json.loads(out)


@pytest.mark.parametrize("method", ["h2", "optimal"])
def test_sets_come_best_first_in_the_shape_of_the_contract(crankbench, models, method):
    found = selected(crankbench, "--method", method)
    assert list(found)[:3] == ["estimate", "method", "sets"]
    assert (found["estimate"], found["method"]) == (["c"], method)
    for row in found["sets"]:
        assert {"sensors", "index", "cost", "error"} <= set(row)
        assert row["index"] is None and row["cost"] == len(row["sensors"])
        # One state of size 2: the expected root mean square error is its share of that.
        assert row["error"] == pytest.approx(math.sqrt(row["trace"]))
        assert row["errors"] == {"c": pytest.approx(2.0 * row["error"])}
    errors = [row["error"] for row in found["sets"]]
    assert errors == sorted(errors)
    assert all(found["with_all_sensors"] <= error <= found["without_sensors"] for error in errors)


def test_the_optimum_of_each_size_is_the_first_of_its_size_among_all_sets_with_its_proof(crankbench, models):
    found = selected(crankbench, "--method", "optimal", "--all")
    assert found["considered"] == len(found["sets"]) == 5 + 10 + 10
    for size in found["by_size"]:
        first = next(row for row in found["sets"] if len(row["sensors"]) == size["size"])
        assert size["error"] == pytest.approx(first["error"], rel=1e-9) and first["gap"] == 0.0
        proof, certificate = size["proof"], size["certificate"]
        assert proof["proven"] and proof["bound"] == pytest.approx(size["trace"], rel=2e-9)
        assert certificate["trace"] == pytest.approx(size["trace"], rel=1e-6)
        assert certificate["trace_of_error_system"] == pytest.approx(size["trace"], rel=1e-6)
        assert certificate["residual"] < 1e-7 and certificate["slowest_decay"] > 0.0
        assert 0.0 <= size["greedy"]["gap"] <= size["greedy"]["guaranteed_gap"] + 1e-9
        if size["safest"] is not None:
            after = [row["error_after_loss"] for row in found["sets"] if len(row["sensors"]) == size["size"]]
            assert size["safest"]["error_after_loss"] == pytest.approx(min(after), rel=1e-9)


def test_the_program_gives_the_trace_of_the_riccati_equation_and_its_gap_to_the_optimum(crankbench, models):
    found = selected(crankbench, "--method", "h2")
    assert found["sets"]
    least = {size["size"]: size["trace"] for size in found["by_size"]}
    for row in found["sets"]:
        assert row["trace_T"] == pytest.approx(row["trace"], rel=1e-4)
        assert row["status"] == "optimal" and max(abs(value) for value in row["residuals"].values()) < 1e-4
        assert row["gap"] == pytest.approx(row["trace"] / least[len(row["sensors"])] - 1.0, abs=2e-9)
        assert row["alphas"]
    for point in found["curve"]:
        assert point["status"] == "optimal" and point["number"] == pytest.approx(sum(point["used"].values()))
    everything = selected(crankbench, "--method", "h2", "--all")
    assert len(everything["sets"]) == 25
    assert [row["sensors"] for row in everything["sets"] if row["status"]] == [row["sensors"] for row in found["sets"]]


def test_must_forbid_and_budget_hold_for_both_methods(crankbench, models):
    asked = ("--must", "a", "--forbid", "c", "--cost", "flow=7,both=2", "--budget", "4")
    for method in ("optimal", "h2"):
        found = selected(crankbench, "--method", method, *asked)
        assert (found["must"], found["forbid"], found["budget"]) == (["a"], ["c"], 4.0)
        assert found["sets"] and all("a" in row["sensors"] and row["cost"] <= 4.0 for row in found["sets"])
        assert not {"c", "flow"} & {name for row in found["sets"] for name in row["sensors"]}
    largest = found["by_size"][-1]
    assert largest["size"] == 3 and largest["sensors"] == ["a", "b", "both"]


def test_the_budget_holds_for_the_index_too(crankbench, models):
    found = selected(crankbench, "--cost", "flow=7", "--budget", "2", "--all")
    assert found["sets"] and all(row["cost"] <= 2.0 for row in found["sets"])
    code, _, err = crankbench(*BY_ERROR, "--budget", "0.5")
    assert code == 2 and err == "--budget 0.5: no set costs as little; the cheapest costs 1\n"


def test_what_disturbs_single_states_counts_in_their_units_and_what_nothing_disturbs_is_left_out(crankbench, models):
    disturbed = ("--process", "0", "--disturbance", "a=1000 Pa")
    found = selected(crankbench, "--method", "optimal", *disturbed)
    assert found["disturbances"] == {"a": pytest.approx(1000.0)}
    assert found["notes"] == ["no noise moves idle: left out, a filter knows them without error"]
    # The chain of lags by hand: the variance of c with a driven by white noise of intensity q = (0.01 bar)^2/s is the
    # integral of the square of its impulse response, here by its partial fractions with the rates 1, 2 and 1/2.
    rates = np.array([1.0, 2.0, 0.5])
    residues = np.array([1.0 / np.prod([other - rate for other in rates if other != rate]) for rate in rates])
    variance = 1e-4 * float((np.outer(residues, residues) / np.add.outer(rates, rates)).sum())
    assert found["without_sensors"] == pytest.approx(math.sqrt(variance) / 2.0, rel=1e-6)
    twice = selected(crankbench, "--method", "optimal", "--process", "0", "--disturbance", "a=2000 Pa")
    assert twice["without_sensors"] == pytest.approx(2.0 * found["without_sensors"], rel=1e-9)


def test_an_fmu_is_ranked_as_its_source_is(crankbench, models):
    tables = []
    for target in ("chain_module", cached_fmu(CHAIN)):
        found = selected(crankbench, "--method", "optimal", "--all", at=("select", target, *BY_ERROR[2:]))
        tables.append({tuple(row["sensors"]): row["error"] for row in found["sets"]})
    assert tables[0].keys() == tables[1].keys()
    assert list(tables[0].values()) == pytest.approx([tables[1][names] for names in tables[0]], rel=1e-6)


def test_sets_that_do_not_see_what_grows_rank_last_and_say_what_they_do_not_see(crankbench, models):
    at = ("select", "filling_module", "--estimate", "leak")
    found = selected(crankbench, "--method", "optimal", "--all", at=at)
    assert [row["sensors"] for row in found["sets"]] == [["full", "leak"], ["full"], ["leak"]]
    last = found["sets"][-1]
    assert last["error"] is None and last["trace"] is None
    assert last["why"] == "undetectable: it does not see the mode at 0 1/s in full"
    assert found["without_sensors"] is None
    # The program leaves alone what is not wanted, and so the mode that grows beside it: no filter, and it is said.
    (row,) = selected(crankbench, "--method", "h2", at=at)["sets"]
    assert row["sensors"] == ["leak"] and row["error"] is None and row["status"] == "failed"
    assert row["why"] == "undetectable: leak does not see the mode at 0 1/s in full"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--forbid", "full"), "undetectable: all sensors allowed together do not see the mode at 0 1/s in full"),
        (("--sensors", "leak"), "no sensor sees the mode at 0 1/s in full: it does not die out by itself"),
        (("--disturbance", "full=0"), "no process noise moves the mode at 0 1/s in full: its gain would end at zero"),
        (("--process", "0", "--disturbance", "full=1"), "no noise reaches what is wanted"),
        (("--disturbance", "ful=1"), "--disturbance ful=1: no state is named 'ful'; did you mean 'full'?"),
        (("--disturbance", "leak=-1"), "--disturbance leak: wants 0 or more, got -1"),
        (("--budget", "-1"), "--budget wants 0 or more, got -1"),
        (("--scaling", "none"), "is not one of 'deviation', 'nominal'"),
    ],
)
@pytest.mark.parametrize("method", ["optimal", "h2"])
def test_an_estimation_without_an_answer_is_refused_by_name(crankbench, models, method, arguments, told):
    code, out, err = crankbench("select", "filling_module", "--estimate", "leak", "--method", method, *arguments)
    assert (code, out) == (2, "") and told in " ".join(err.replace("│", " ").split())


def test_a_nominal_value_of_zero_is_refused_by_name(crankbench, models, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("harness.selectionsystem.scales", lambda signals: np.array([1.0, 0.0, 1.0, 1.0]))
    code, _, err = crankbench(*BY_ERROR, "--method", "optimal")
    assert code == 2 and "the scaling is singular: b has the nominal value" in err


def test_a_point_that_is_no_equilibrium_is_refused(crankbench, models):
    code, _, err = crankbench(*BY_ERROR[:-1], "--method", "optimal", "--at", "u=1")
    assert code == 2 and "the point is no equilibrium" in err and "--settle" in err


def test_where_a_reference_rests_counts_as_rest(crankbench, models):
    there = ("select", "chain_module", "--estimate", "c", "--sensors", "a,b,c", "--at", "u=1,a=2 bar")
    code, _, err = crankbench(*there, "--method", "optimal", "--json")
    assert code == 2 and "no equilibrium" in err
    found = selected(crankbench, "--about", "a=3 bar,flow=7", "--method", "optimal", at=there)
    assert found["point"]["a"] == 3e5 and found["imbalance"] == 0.0
    # The chain is linear: its matrices are the same everywhere.
    at_rest = ("select", "chain_module", "--estimate", "c", "--sensors", "a,b,c", "--settle")
    wanted = selected(crankbench, "--method", "optimal", at=at_rest)
    assert [row["error"] for row in found["sets"]] == [row["error"] for row in wanted["sets"]]
    code, _, err = crankbench(*there, "--about", "flw=7,a=1 K", "--method", "optimal")
    assert code == 2 and "--about flw=7" in err and "flow" in err and "--about a" in err


def test_the_noise_of_a_file_is_overridden_state_by_state(crankbench, models, tmp_path: Path):
    file = tmp_path / "noise.json"
    file.write_text(json.dumps({"process": {"a": "1000 Pa", "b": "0.02", "c": "0.03", "idle": "0"}}))
    found = selected(
        crankbench, "--method", "optimal", "--process", str(file), "--disturbance", "b=0.5", "--measures", "none"
    )
    written = "a=1000 Pa,b=0.5,c=0.03,idle=0"
    wanted = selected(crankbench, "--method", "optimal", "--disturbance", written)
    assert [row["error"] for row in found["sets"]] == [row["error"] for row in wanted["sets"]]
    assert found["disturbances"] == pytest.approx({"a": 1000.0, "b": 0.5, "c": 0.03, "idle": 0.0})


def test_a_solver_that_fails_is_told_in_its_words_and_nothing_is_ranked(
    crankbench, models, monkeypatch: pytest.MonkeyPatch
):
    import cvxpy

    monkeypatch.setattr(cvxpy.Problem, "status", "optimal_inaccurate")
    code, out, err = crankbench(*BY_ERROR, "--method", "h2")
    assert (code, out) == (2, "")
    assert err == "chain_module: alpha 0: CLARABEL ended with the status optimal_inaccurate, wants optimal\n"


def test_the_tables_for_people_say_proof_greed_and_safety(crankbench, models, tmp_path: Path):
    table = tmp_path / "table.csv"
    code, out, _ = crankbench(*BY_ERROR, "--method", "optimal", "--out", table)
    lines = out.splitlines()
    assert code == 0 and lines[0].split()[:4] == ["sensors", "cost", "error", "c"]
    assert any(line.startswith("2 sensors: best ") and "proven in" in line and "safest" in line for line in lines)
    rows = list(csv.DictReader(io.StringIO(table.read_text(encoding="utf-8"))))
    assert len(rows) == 25 and float(rows[0]["error_c"]) == pytest.approx(2.0 * float(rows[0]["error"]))
    code, out, _ = crankbench(*BY_ERROR, "--method", "h2", "--scaling", "nominal")
    assert code == 0 and "optimal" in out and "status" in out.splitlines()[0]


class _Tags(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.opened: list[str] = []
        self.sources: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.opened.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href") and value]


@pytest.mark.parametrize(("method", "drawings"), [("h2", 2), ("optimal", 1)])
def test_the_page_stands_alone_and_draws_the_trade_off(crankbench, models, tmp_path: Path, method, drawings):
    page = tmp_path / "page.html"
    assert crankbench(*BY_ERROR, "--method", method, "--report", page)[0] == 0
    text = page.read_text(encoding="utf-8")
    tags = _Tags(text)
    assert tags.opened.count("svg") == drawings
    assert all(source.startswith(("#", "data:")) for source in tags.sources), "it opens without a network"
    assert "best of 1, 2 and 3: " in text and "safest" in text
    again = write_page(page.with_suffix(".json"), tmp_path / "again.html")
    assert again.read_bytes() == page.read_bytes()


def test_progress_is_told_now_and_then_in_a_pipe(capsys, monkeypatch: pytest.MonkeyPatch):
    clock = iter([0.0, 1.0, 6.0, 6.0, 7.0, 12.0, 12.0])
    monkeypatch.setattr(optimaltext.time, "monotonic", lambda: next(clock))
    with stages_told(sys.stdout) as tell:
        for done in range(1, 5):
            tell("values of alpha", done, 16)
    assert capsys.readouterr().out.splitlines() == ["values of alpha: 2 of 16", "values of alpha: 4 of 16"]


def test_other_commands_do_not_wait_for_what_solves_the_program():
    import subprocess

    code = "import sys; import harness.cli, harness.selecting, harness.optimising; sys.exit('cvxpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
