"""`crankbench select`: the ranked table, its JSON and CSV, what narrows it, its page, and what it refuses."""

from __future__ import annotations

import csv
import io
import json
import re
import shlex
import sys
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from engine_sensors import ESTIMATE, TABLE_1, WANTED, measured, paper_structure, places, sets_of

from fmus.component import Signal
from fmus.export import cached_fmu
from fmus.model import Model
from fmus.plants import turbo_si
from harness.selectiontext import sets_told
from reports.selection import SelectionError, write_page
from reports.setfigures import index_histogram, number_matrix
from selection.observability import observe
from selection.ranking import Limits, count_sets, sets_within

ENGINE = ("select", "turbo_si", "--estimate", ",".join(ESTIMATE))
# Two lags, the second of which drives nothing: it is never seen from the first.
APART = Model(
    name="apart",
    description="Two lags beside each other",
    equations=lambda t, x, m, u, p: ({"a": u.u - x.a, "b": u.u - 2.0 * x.b}, {"both": x.a + x.b}),
    states=(Signal("a", "bar", 0.0), Signal("b", "degC", -273.15)),
    inputs=(Signal("u"),),
    outputs=(Signal("both"),),
)


@pytest.fixture
def apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a module with the model of that name."""
    module = tmp_path / "apart_module.py"
    module.write_text("from test_select import APART as MODEL\n", encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    return "apart_module"


@pytest.mark.parametrize("method", ["structural", "numerical", "exact", "coupled"])
def test_the_ranking_of_the_engine_begins_with_the_states_themselves_by_every_method(crankbench, method):
    code, out, _ = crankbench(*ENGINE, "--method", method, "--settle", "--json")
    found = json.loads(out)
    assert code == 0 and found["estimate"] == list(ESTIMATE) and found["method"] == method
    assert found["considered"] == 833 and len(found["sets"]) == found["shown"] == 20
    best = found["sets"][0]
    assert set(best["sensors"]) == set(ESTIMATE) and (best["index"], best["cost"]) == (2, 3.0)
    assert {"sensors", "index", "cost", "error"} <= set(best)
    assert found["sets"][1]["index"] == 3
    assert [row["index"] for row in found["sets"]] == sorted(row["index"] for row in found["sets"])
    assert sum(sum(counts.values()) for counts in found["counts"].values()) == 833


def test_all_sets_are_printed_on_request_and_written_as_a_table(crankbench, tmp_path: Path):
    table = tmp_path / "table.csv"
    code, out, err = crankbench(*ENGINE, "--method", "exact", "--settle", "--all", "--json", "--out", table)
    found = json.loads(out)
    assert code == 0 and str(table) in err and len(found["sets"]) == 833
    rows = list(csv.DictReader(io.StringIO(table.read_text(encoding="utf-8"))))
    assert [row["sensors"].split() for row in rows] == [row["sensors"] for row in found["sets"]]
    assert [int(row["index"]) for row in rows] == [row["index"] for row in found["sets"]]
    assert float(rows[0]["error_p_im"]) == pytest.approx(found["sets"][0]["errors"]["p_im"])
    by_sensors = {frozenset(row["sensors"]): row["index"] for row in found["sets"]}
    published = {names: by_sensors[frozenset(names)] for names in TABLE_1}
    assert list(published.values()) == [2, 3, 3, 3, 5, 3]


def test_the_table_for_people_has_the_same_order_and_says_what_it_stands_on(crankbench):
    code, out, _ = crankbench(*ENGINE, "--settle")
    lines = out.splitlines()
    assert code == 0 and lines[0].split()[:3] == ["sensors", "index", "whole"]
    assert lines[1].split()[:6] == ["1", "p_im", "T_im", "p_em", "2", "5"]
    assert "20 of 833 sets shown, by index, error, cost; index by the method structural" in out
    assert "error probability" in out and "process noise 0.01 of a size in a second" in out


def test_must_forbid_costs_and_the_order_narrow_and_rank(crankbench):
    narrowed = (*ENGINE, "--max-sensors", "2", "--must", "p_im", "--forbid", "T_*", "--all", "--json")
    code, out, _ = crankbench(*narrowed, "--cost", "p_em=500,W_*=20", "--by", "cost,index")
    found = json.loads(out)
    assert code == 0
    sets = [row["sensors"] for row in found["sets"]]
    # p_im alone, and with each of the five other pressures, the speed and the four flows.
    assert len(sets) == 1 + 10 and all("p_im" in names for names in sets)
    assert not any(name.startswith("T_") for names in sets for name in names)
    assert sets[0] == ["p_im"] and sets[-1] == ["p_im", "p_em"]
    assert [row["cost"] for row in found["sets"]] == [1.0, *[2.0] * 5, *[21.0] * 4, 501.0]
    assert found["must"] == ["p_im"] and len(found["forbid"]) == 6


def test_noise_lags_and_process_count(crankbench):
    def errors(*more):
        code, out, _ = crankbench(*ENGINE, "--settle", "--max-sensors", "1", "--sensors", "T_im,p_im", "--json", *more)
        assert code == 0
        return {row["sensors"][0]: row for row in json.loads(out)["sets"]}

    usual = errors()
    assert errors("--noise", "p_im=1 Pa")["p_im"]["error"] < usual["p_im"]["error"]
    assert errors("--process", "0.1")["p_im"]["error"] > usual["p_im"]["error"]
    assert errors("--period", "1 s")["p_im"]["error"] > usual["p_im"]["error"]
    fast = errors("--lag", "T_im=0 s")
    assert (usual["T_im"]["index"], fast["T_im"]["index"]) == (14, 13)
    assert fast["T_im"]["error"] < usual["T_im"]["error"]


def test_an_fmu_is_ranked_as_its_source_is_where_numbers_suffice(crankbench):
    sensors = ",".join(turbo_si.SENSORS)
    for method in ("structural", "numerical"):
        tables = []
        for target in ("turbo_si", cached_fmu(turbo_si.MODEL)):
            asked = ("--sensors", sensors, "--method", method, "--settle", "--all", "--json")
            code, out, err = crankbench("select", target, "--estimate", ",".join(ESTIMATE), *asked)
            assert (code, err) == (0, "")
            tables.append({tuple(row["sensors"]): row["index"] for row in json.loads(out)["sets"]})
        assert tables[0] == tables[1]
    code, _, err = crankbench("select", cached_fmu(turbo_si.MODEL), "--estimate", "p_im", "--method", "exact")
    assert code == 2 and "the method exact wants the equations of a model; an FMU gives numbers only" in err


def test_every_name_that_is_not_known_is_told_at_once_with_the_nearest(crankbench):
    code, out, err = crankbench(
        *("select", "turbo_si", "--estimate", "p_in,T_im", "--must", "p_xm", "--forbid", "W_thr", "--cost", "pim=3"),
        *("--lag", "T_im=-1 s", "--noise", "p_im=3,T_im=0 K", "--by", "prize", "--measures", "grammar"),
    )
    assert code == 2 and out == ""
    assert set(err.splitlines()) == {
        "--estimate p_in: no state is named 'p_in'; did you mean 'p_im'?",
        "--must p_xm: no sensor is named 'p_xm'; did you mean 'p_im'?",
        "--forbid W_thr: no sensor is named 'W_thr'; did you mean 'W_th'?",
        "--cost pim=3: no sensor is named 'pim'; did you mean 'p_im'?",
        "--noise p_im=3: wants Pa, got the bare number 3: write '3 Pa'",
        "--lag T_im: wants 0 s or more, got -1 s",
        "--noise T_im: wants more than 0, got 0",
        "--by prize: no measure is named 'prize'; did you mean 'index'?",
        "--measures grammar: no measure is named 'grammar'; did you mean 'gramian'?",
    }


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--must", "p_im", "--forbid", "p_*"), "--must and --forbid both name p_im"),
        (("--max-sensors", "0"), "--max-sensors wants 1 or more, got 0"),
        (("--max-sensors", "1", "--must", "p_im,p_em"), "--max-sensors wants 2 or more to hold all of --must, got 1"),
        (("--forbid", "*"), "that makes 0 sets, wants 1 to 2000000: there is no sensor left"),
        (("--out", "table.txt"), "--out wants a file that ends in .csv, got table.txt"),
        (("--report", "page"), "--report wants a file that ends in .html, got page"),
        (("--tolerance", "2"), "--tolerance wants a number between 0 and 1, got 2"),
        (("--process", "-1"), "--process wants 0 or more, got -1"),
        (("--period", "3 m"), "--period: wants s, got 3 m"),
        (("--method", "best"), "is not one of 'structural', 'coupled', 'exact'"),
        (("--set", "C"), "--set: no parameter set is named 'C'; did you mean 'B'?"),
        (("--set", "B", "--lag", "T_im"), "--lag T_im: wants sensor=value"),
    ],
)
def test_what_cannot_be_is_refused_in_words(crankbench, arguments, told):
    code, out, err = crankbench(*ENGINE, *arguments)
    assert (code, out) == (2, "")
    assert told in re.sub(r"\s+", " ", err.replace("│", ""))


@pytest.mark.parametrize("method", ["numerical", "exact"])
def test_a_point_that_is_no_equilibrium_is_refused_with_its_residual_and_settling_offered(crankbench, method):
    code, _, err = crankbench(*ENGINE, "--method", method, "--at", "alpha=0.5")
    assert code == 2
    assert re.search(r"the point is no equilibrium: p_im changes by [\d.e+]+ Pa each second; --settle finds one", err)
    assert crankbench(*ENGINE, "--method", method, "--at", "alpha=0.5", "--settle", "--max-sensors", "2")[0] == 0


def test_a_structure_needs_no_equilibrium_but_the_measures_do_and_say_so(crankbench):
    code, out, _ = crankbench(*ENGINE, "--at", "alpha=0.5", "--json")
    found = json.loads(out)
    assert code == 0 and found["measures"] == [] and found["sets"][0]["error"] is None
    assert "no gramian and kalman: the point is no equilibrium, p_im changes by" in found["notes"][0]


def test_measures_of_many_sets_are_left_out_unless_asked_for(crankbench):
    code, out, err = crankbench("select", "turbo_si", "--max-sensors", "6", "--json", "--estimate", "p_im")
    found = json.loads(out)
    assert code == 0 and found["considered"] == 21777
    assert found["notes"] == ["no gramian and kalman of 21777 sets unless asked for: --measures gramian,kalman"]
    assert err.splitlines()[-1] == "structural index: 21777 of 21777 sets", "plain lines in a pipe"


def test_sensors_that_do_not_see_the_estimate_are_told_of_with_the_states_unseen(crankbench, apart):
    code, _, err = crankbench("select", apart, "--sensors", "a", "--estimate", "b")
    assert code == 2
    assert err == "no set of these sensors sees b of the estimate: a leaves b unseen; allow more sensors, or others\n"
    code, out, _ = crankbench("select", apart, "--sensors", "a,both", "--estimate", "a,b", "--json", "--settle")
    found = json.loads(out)
    assert code == 0
    hidden = {tuple(row["sensors"]): (row["index"], row["hidden"]) for row in found["sets"]}
    assert hidden == {("a", "both"): (1, []), ("both",): (2, []), ("a",): (None, ["b"])}
    assert found["sets"][-1]["sensors"] == ["a"], "what sees least comes last"
    assert found["counts"] == {"1": {"2": 1, "never": 1}, "2": {"1": 1}}


def test_without_an_estimate_the_whole_state_is_meant_and_sensors_are_all_states_and_outputs(crankbench, apart):
    code, out, _ = crankbench("select", apart, "--json", "--all", "--settle")
    found = json.loads(out)
    assert code == 0 and found["estimate"] == ["a", "b"]
    assert [sensor["name"] for sensor in found["sensors"]] == ["a", "b", "both"]
    # A temperature has 3 s, a bar is 1e5 Pa.
    assert [sensor["lag"] for sensor in found["sensors"]] == [0.0, 3.0, 0.0]
    assert [sensor["noise"] for sensor in found["sensors"]] == pytest.approx([1e3, 0.01, 0.01])
    assert [state["size"] for state in found["states"]] == [1e5, 1.0]


def test_sets_are_counted_as_they_are_made():
    for limits in (
        Limits(3),
        Limits(2, frozenset([1])),
        Limits(4, frozenset([0, 2]), frozenset([3, 5])),
        Limits(9, forbid=frozenset([1])),
        Limits(2, frozenset([0, 1])),
    ):
        made = sets_within(7, limits)
        assert len(made) == len(set(made)) == count_sets(7, limits)
        assert all(limits.must <= set(m) and not limits.forbid & set(m) and 0 < len(m) <= limits.most for m in made)


class _Tags(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.opened: list[str] = []
        self.sources: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.opened.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href") and value]


def test_the_page_stands_alone_and_shows_structure_pairs_counts_and_ways(crankbench, tmp_path: Path):
    page = tmp_path / "page.html"
    code, _, _ = crankbench(*ENGINE, "--settle", "--also-at", "alpha=0.08,N=1500 rpm", "--report", page)
    content = json.loads(page.with_suffix(".json").read_text(encoding="utf-8"))
    assert write_page(page.with_suffix(".json"), page) == page
    assert code == 0
    text = page.read_text(encoding="utf-8")
    tags = _Tags(text)
    assert tags.opened.count("svg") == 5
    assert all(source.startswith(("#", "data:")) for source in tags.sources), "it opens without a network"
    assert "p_im, T_im, p_em: index 2, the only set of 833" in text
    # The paper's structure, the two elements in parentheses and with them the flow that is choked.
    (A, C), (choked_A, choked_C) = paper_structure(choked=False), paper_structure(choked=True)
    structure = content["structure"]
    assert (structure["A"], structure["C"]) == (A.astype(int).tolist(), C.astype(int).tolist())
    (other,) = structure["others"]
    assert (other["A"], other["C"]) == (choked_A.astype(int).tolist(), choked_C.astype(int).tolist())
    assert text.count(">(X)<") == 3
    assert content["pairs"][3][3] == 14 and content["pairs"][0] == [row[0] for row in content["pairs"]]
    way = {sensor["name"]: sensor["reaches"] for sensor in content["sensors"]}
    # p_im is in the value of W_th; p_em drives it, so is in the first derivative; T_em is one further.
    assert (way["W_th"]["p_im"], way["W_th"]["p_em"], way["W_th"]["T_em"]) == (0, 1, 2)
    assert way["T_im"]["T_im"] == 1 and all(sensor["structurally_observable"] for sensor in content["sensors"])


def test_the_page_has_the_same_bytes_every_time(crankbench, tmp_path: Path):
    page = tmp_path / "page.html"
    crankbench(*ENGINE, "--report", page, "--max-sensors", "2")
    kept = page.with_suffix(".json")
    first = write_page(kept, tmp_path / "one.html").read_bytes()
    assert write_page(kept, tmp_path / "two.html").read_bytes() == first


def test_a_file_that_is_no_selection_is_refused(tmp_path: Path):
    file = tmp_path / "page.json"
    for text, told in (("{", "wants the JSON of a selection"), ("{}", "wants an object with the list 'sets'")):
        file.write_text(text)
        with pytest.raises(SelectionError, match=told):
            write_page(file, tmp_path / "page.html")


def test_drawings_take_what_is_never_and_nothing_at_all():
    drawing = number_matrix(["a"], ["b", "c"], np.array([[1.0, float("nan")]]), "n")
    assert ">1<" in drawing and ">-<" in drawing
    bars = index_histogram({"1": {"never": 3}, "2": {"2": 1, "10": 2}}, "h")
    labels = re.findall(r">(never|\d+)</text>", bars)
    assert [label for label in labels if label in ("2", "10", "never")][:3] == ["2", "10", "never"]


def test_progress_is_told_in_tenths_of_long_work_only(capsys):
    with sets_told(sys.stdout) as tell:
        for done in range(0, 101):
            tell("short", done, 100)
            tell("long", done * 100, 10_000)
    lines = capsys.readouterr().out.splitlines()
    assert lines == [f"long: {tenth * 1000} of 10000 sets" for tenth in range(1, 11)]


DOCUMENT = (Path(__file__).parent.parent / "docs" / "selection.md").read_text(encoding="utf-8")
COMMANDS = [shlex.split(line)[1:] for line in re.findall(r"^crankbench .*$", DOCUMENT, re.MULTILINE)]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_the_commands_of_the_documentation_run(crankbench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command):
    monkeypatch.chdir(tmp_path)
    code, out, err = crankbench(*command)
    assert (code, err) == (0, "") and out


def rows_of(heading: str) -> list[list[str]]:
    """The cells of the table in the documentation whose first line begins so."""
    lines = DOCUMENT[DOCUMENT.index(heading) :].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_table_1_in_the_documentation_is_what_comes_out():
    rows = rows_of("| sensors | published | numerical | structural | coupled | exact |")
    assert [tuple(row[0].split()) for row in rows] == list(TABLE_1)
    for names, row in zip(TABLE_1, rows, strict=True):
        assert int(row[1]) == TABLE_1[names]
        for cell, method in zip(row[2:], ("numerical", "structural", "coupled", "exact"), strict=True):
            found = {int(observe(measured(t), WANTED, [places(names)], method).index[0]) for t in ("open", "choked")}
            assert found == {int(cell)}


def test_the_numbers_of_sets_in_the_documentation_are_what_comes_out():
    rows = rows_of("| throttle | method | 1 sensor | 2 sensors | 3 sensors |")
    assert len(rows) == 7
    for throttle, method, *cells in rows:
        for size, cell in enumerate(cells, start=1):
            index = observe(measured(throttle), WANTED, sets_of(size), method).index
            counted = Counter("never" if not value else str(value) for value in index.tolist())
            assert counted == {name: int(count) for name, count in re.findall(r"(\w+): (\d+)", cell)}
