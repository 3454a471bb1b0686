"""`crankbench inspect --like`: which variable of an FMU is which signal of a model."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from fmus.component import Signal
from fmus.export import build_fmu, cached_fmu
from fmus.model import Model
from fmus.plants import turbo_si, turbo_si_egr
from fmus.units import parse_unit
from fmus.variable import Variable
from harness.likeness import ALIKE, likeness, name_score


def variable(name: str, causality: str, unit: str = "") -> Variable:
    quantity = parse_unit(unit) if unit else None
    return Variable(name, 0, "Real", causality, "continuous", "", unit=unit, quantity=quantity)


def lag(*outputs: Signal) -> Model:
    return Model(
        "lag", "", lambda t, x, m, u, p: ({}, {s.name: u.p_in for s in outputs}),
        inputs=(Signal("p_in", "Pa"),), outputs=outputs,
    )  # fmt: skip


def test_a_model_finds_all_of_its_own_signals_in_its_fmu(crankbench):
    path = cached_fmu(turbo_si_egr.MODEL)
    code, out, _ = crankbench("inspect", path, "--like", "turbo_si_egr", "--json")
    like = json.loads(out)["like"]
    model = turbo_si_egr.MODEL
    names = [s.name for s in (*model.inputs, *model.states, *model.outputs)]
    assert code == 0 and [m["signal"] for m in like["matched"]] == names
    assert all(m["signal"] == m["variable"] and m["score"] == 1.0 for m in like["matched"])
    assert like["unmatched"] == [] and like["left_over"] == []


def test_of_another_engine_it_finds_what_is_alike_and_says_why_the_rest_is_not(crankbench):
    code, out, _ = crankbench("inspect", cached_fmu(turbo_si.MODEL), "--like", "turbo_si_egr", "--json")
    like = json.loads(out)["like"]
    found = {m["signal"]: m["variable"] for m in like["matched"]}
    same = {"p_im", "T_im", "p_em", "T_em", "omega_tc", "N", "W_th", "W_exh", "W_turbine", "W_wg", "p_t", "T_t"}
    assert code == 0 and all(found[name] == name for name in same)
    unmatched = {u["signal"]: u for u in like["unmatched"]}
    assert {"throttle", "egr_valve", "F_im"} <= set(unmatched)
    text = crankbench("inspect", cached_fmu(turbo_si.MODEL), "--like", "turbo_si_egr")[1]
    assert f"no match for the input throttle [deg]: {unmatched['throttle']['why']}" in text
    assert "left over of the FMU: " in text and "alpha" in text.rpartition("left over of the FMU: ")[2]


def test_names_of_other_habits_are_found(tmp_path: Path, crankbench):
    # As another tool may write the same engine: dots, camel case, other units of the same dimension.
    renamed = {"p_im": "pIm", "F_im": "F_IM", "omega_tc": "tc.omega"}
    model = turbo_si_egr.MODEL

    def equations(t, x, m, u, p):
        derivatives, outputs = model.equations(t, _Renamed(x, renamed), m, u, p)
        return {renamed.get(name, name): value for name, value in derivatives.items()}, outputs

    other = replace(
        model, name="other", equations=equations,
        states=tuple(replace(s, name=renamed.get(s.name, s.name)) for s in model.states),
    )  # fmt: skip
    path = build_fmu(other, tmp_path / "other.fmu")
    like = json.loads(crankbench("inspect", path, "--like", "turbo_si_egr", "--json")[1])["like"]
    found = {m["signal"]: m["variable"] for m in like["matched"]}
    assert {name: found[name] for name in renamed} == renamed


class _Renamed:
    def __init__(self, values, names):
        self._values, self._names = values, names

    def __getitem__(self, name):
        return self._values[self._names.get(name, name)]

    def __getattr__(self, name):
        return self[name]


def test_a_signal_gets_one_variable_and_a_variable_one_signal_for_the_best_pairing():
    # Both are like it; W_egr alone would take it.
    model = lag(Signal("W_egr", "kg/s"), Signal("W_egr2", "kg/s"))
    found = likeness(model, [variable("p_in", "input", "bar"), variable("W_egr2", "output", "kg/h")])
    assert {m.signal: m.variable for m in found.matched} == {"p_in": "p_in", "W_egr2": "W_egr2"}
    (left,) = found.unmatched
    assert left.signal == "W_egr" and left.why == "W_egr2 is taken by W_egr2"


@pytest.mark.parametrize(
    ("offered", "why"),
    [
        (variable("p_in", "output", "Pa"), "p_in is its output"),
        (variable("p_in", "input", "K"), "p_in is in K"),
        (variable("zeta", "input", "Pa"), "no variable has a name like it"),
    ],
)
def test_what_does_not_fit_is_no_match_and_says_why(offered, why):
    found = likeness(lag(), [offered])
    assert not found.matched and found.unmatched[0].why == why


def test_an_unknown_unit_and_a_local_variable_count_for_less():
    model = lag(Signal("p_im", "Pa"))
    exact, bare, inside = (
        likeness(model, [variable("p_im", causality, unit)]).matched[0].score
        for causality, unit in (("output", "Pa"), ("output", ""), ("local", "Pa"))
    )
    assert exact == 1.0 and bare == pytest.approx(0.9) and inside == pytest.approx(0.95)


def test_names_are_compared_by_words_and_letters():
    assert name_score("p_im", "pIm") == name_score("EGR_DP", "egr.dp") == 1.0
    assert name_score("p_im", "engine.p_im") == pytest.approx(0.98)
    assert ALIKE < name_score("throttle", "throttle_angle") < 0.99
    assert name_score("T_im", "omega") < ALIKE


def test_a_function_that_makes_models_is_no_model_to_be_like(crankbench):
    code, _, err = crankbench("inspect", cached_fmu(turbo_si.MODEL), "--like", "ekf")
    assert code == 2 and "--like wants a Model, like turbo_si_egr, got the function ekf" in err
