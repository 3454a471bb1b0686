"""FMUs as parts of a campaign: what they stand for, in which units they speak, and where they are looked for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from third_party import reference_fmu

from fmus.component import ConfigurationError
from harness.building import Export, build_with_python
from harness.campaign import find_campaign, read_campaign
from harness.cases import execute
from harness.places import Places
from harness.scenario import Scenario
from harness.wiring import System, wire


def system(parts: dict[str, Any]) -> System:
    clock = {"time": {"step": "10 ms", "stop": "0.1 s"}}
    return wire(Scenario.model_validate({"clock": clock, "parts": parts}))


def problems(parts: dict[str, Any]) -> list[str]:
    with pytest.raises(ConfigurationError) as caught:
        system(parts)
    return [problem.message for problem in caught.value.problems]


def ball(**keys: Any) -> dict[str, Any]:
    return {"use": str(reference_fmu("BouncingBall")), **keys}


def oscillator(**keys: Any) -> dict[str, Any]:
    return {"use": str(reference_fmu("VanDerPol")), **keys}


def feedthrough(source: str, **keys: Any) -> dict[str, Any]:
    names = ("Float64_continuous_input", "Float64_discrete_input", "Int32_input", "Boolean_input", "Enumeration_input")
    wires = {name: source if name == names[0] else "zero" for name in names}
    return {"use": str(reference_fmu("Feedthrough")), "wires": wires, **keys}


ZERO = {"use": "source", "unit": "1", "constant": 0}


def test_an_fmu_is_a_plant_unless_it_is_said_to_be_something_else():
    with system({"ball": ball(), "estimator": oscillator(role="observer")}) as found:
        assert {name: part.role for name, part in found.components.items()} == {
            "ball": "plant",
            "estimator": "observer",
        }


def test_an_fmu_that_is_an_observer_may_not_read_the_truth():
    found = problems({"zero": ZERO, "plant": oscillator(), "estimator": feedthrough("plant.x0", role="observer")})
    assert len(found) == 1
    assert "estimator.Float64_continuous_input reads the truth, plant.x0: put a sensor between" in found[0]
    measured = {"use": "sensor", "of": "plant.x0"}
    parts = {
        "zero": ZERO,
        "plant": oscillator(),
        "measured": measured,
        "estimator": feedthrough("measured", role="observer"),
    }
    system(parts).close()


def test_what_only_an_fmu_is_told_is_refused_for_a_module():
    found = problems({"plant": {"use": "loop_parts:truth", "role": "observer", "kind": "me", "units": {"y": "rpm"}}})
    assert [text.partition(" wants")[0] for text in found] == ["plant.role", "plant.kind", "plant.units"]


def test_a_unit_that_an_fmu_does_not_declare_is_bound_where_it_is_wired_to_one():
    (told,) = problems({"zero": ZERO, "ball": ball(), "echo": feedthrough("ball.h")})
    assert "echo.Float64_continuous_input wants no unit, got m from ball" in told
    assert told.endswith("bind it, like `echo: {units: {Float64_continuous_input: m}}`")
    bound = feedthrough("ball.h", units={"Float64_continuous_input": "mm", "Float64_continuous_output": "mm"})
    with system({"zero": ZERO, "ball": ball(), "echo": bound}) as found:
        assert {signal.name: signal.unit for signal in found.bus}["echo.Float64_continuous_output"] == "mm"


def test_the_side_without_a_unit_is_named_through_a_sensor_too():
    sensor = {"use": "sensor", "of": "plant.x0"}
    known = {"use": "fmus.plants.driveline", "wires": {"T_eng": "seen"}}
    (told,) = problems({"plant": oscillator(), "seen": sensor, "driveline": known})
    assert told.endswith("plant does not declare the unit of x0: bind it, like `plant: {units: {x0: N.m}}`")


def test_a_unit_bound_to_a_variable_that_declares_another_is_refused_with_both():
    (told,) = problems({"ball": ball(units={"h": "rpm"})})
    assert told == "ball.h declares the unit m, and rpm is bound to it: leave one out"
    system({"ball": ball(units={"h": "m"})}).close()


def test_units_of_nothing_are_refused_with_the_nearest_name():
    found = problems({"plant": oscillator(units={"x00": "m", "x1": "furlong/week"})})
    assert "did you mean 'x0'?" in found[0]
    assert found[1].startswith("plant.x1: unknown unit")


def test_a_kind_that_an_fmu_does_not_offer_is_refused(tmp_path: Path):
    plant = build_with_python("driveline", Export(tmp_path / "plant.fmu"))
    torque = {"use": "source", "unit": "N.m", "constant": "0 N.m"}
    found = problems({"torque": torque, "plant": {"use": str(plant), "kind": "me", "wires": {"T_eng": "torque"}}})
    assert any("it offers cs, not me" in text for text in found)


def test_relative_paths_start_at_the_campaign_and_on_the_command_line_where_it_was_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "typed").mkdir()
    file = tmp_path / "rig.yaml"
    document = {"campaign": "rig", "clock": {"time": {"step": "1 ms", "stop": "1 s"}}, "parts": {"p": {"use": "a.fmu"}}}
    file.write_text(json.dumps(document))
    monkeypatch.chdir(tmp_path / "typed")

    def use(*overrides: str) -> str:
        (case,) = read_campaign(file, overrides).cases
        return case.scenario.parts["p"].use

    assert use() == "a.fmu"
    assert use("p.use=b.fmu") == use("parts.p.use=b.fmu") == str(tmp_path / "typed" / "b.fmu")
    assert Places(str(file)).file == str(file)


def test_the_driveline_campaign_runs_unchanged_with_its_plant_exported_by_pythonfmu(tmp_path: Path):
    plant = build_with_python("driveline", Export(tmp_path / "plant.fmu"))
    overrides = [
        "clock.time.stop=2.1 s",
        "experiments.step_size.vary.torque.step.to='[-30] N.m'",
        "experiments.noise.vary.seed=1..1",
        "experiments.mismatch.vary.seed=1..1",
        "report.figures=[]",
    ]
    tables = []
    for name, more in (("native", []), ("python", [f"parts.plant.use={plant}"])):
        campaign = read_campaign(find_campaign("driveline"), [*overrides, *more])
        wanted = [case for case in campaign.cases if case.experiment == "hidden"]
        reduced = type(campaign)(**{**vars(campaign), "cases": tuple(wanted)})
        result = execute(reduced, tmp_path / name, 1, lambda ended: None)
        assert set(result.outcomes.values()) == {"ok"}
        rows = (tmp_path / name / "metrics.csv").read_text().splitlines()
        tables.append([row.split(",")[1:] for row in rows])
    # The same method and expressions; a compiler may order a sum otherwise, and did not.
    assert tables[0] == tables[1]
    described = json.loads((tmp_path / "python" / "campaign.json").read_text())
    assert described["fmus"]["plant"]["tool"].endswith("with PythonFMU")
    case = json.loads(next((tmp_path / "python").glob("cases/*/case.json")).read_text())
    assert any("needs the tool it was made with" in warning["text"] for warning in case["warnings"])
