"""Systems of other tools as campaigns: what runs is what the SSP says, as FMPy's calls and closed forms have it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as parquet
import pytest
from numpy.typing import NDArray
from side_by_side import side_by_side
from ssp_files import binding, component, connection, connector, description, mapping, package, system, unit, values
from third_party import OPENMODELICA, reference_fmu, third_party_fmu

from fmus.component import Signal
from fmus.export import cached_fmu
from fmus.model import Model
from fmus.toolchain import native_platform
from fmus.units import parse_unit
from harness.campaign import read_campaign
from harness.places import read_yaml
from harness.run import run
from harness.ssp.importing import Clock, import_system
from harness.wiring import wire

RPM = parse_unit("rpm").factor
pytestmark = pytest.mark.skipif(native_platform() != "linux64", reason="the FMUs of gemseo-fmu are for 64-bit Linux")


def crankbench(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "harness", *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, check=False)


def signals_of(folder: Path) -> dict[str, NDArray[np.float64]]:
    """The signals of the one case in a run folder."""
    (file,) = folder.glob("cases/*/case.json")
    assert json.loads(file.read_text())["outcome"] == "ok", file.read_text()
    table = parquet.read_table(file.with_name("signals.parquet"))
    return {name: table[name].to_numpy() for name in table.column_names}


def imported(path: Path, variant: str = "", **clock: str) -> dict[str, Any]:
    """The campaign of an SSP as plain data."""
    document, _ = read_yaml(import_system(path, variant, Clock(**clock)).text)
    assert isinstance(document, dict)
    return document


def ran(path: Path, overrides: Sequence[str] = (), **clock: str) -> dict[str, NDArray[np.float64]]:
    """The signals of an SSP that is imported, wired and run in this process, in SI."""
    file = import_system(path, clock=Clock(**clock)).write(path.with_suffix(""))
    (case,) = read_campaign(file, overrides).cases
    with wire(case.scenario, case.places) as made:
        record = run(made)
    assert record.outcome == "ok", record.message
    return {signal.name: record.values[:, j] for j, signal in enumerate(record.signals)}


def fmu(
    name: str,
    inputs: Mapping[str, str] | None = None,
    outputs: Mapping[str, str] | None = None,
    parameters: Mapping[str, tuple[float, str]] | None = None,
) -> Path:
    """An FMU that gives each output the sum of its inputs' numbers and its parameters', in the units named."""

    def total(t: Any, x: Any, m: Any, u: Any, p: Any) -> Any:
        every = sum((u[one] for one in inputs or {}), 0.0 * t) + sum((p[one] for one in parameters or {}), 0.0)
        return {}, {one: every for one in outputs or {}}

    return cached_fmu(
        Model(
            name=name,
            description="sums",
            equations=total,
            inputs=tuple(Signal(one, of) for one, of in (inputs or {}).items()),
            outputs=tuple(Signal(one, of) for one, of in (outputs or {}).items()),
            parameters=tuple(Signal(one, of, value) for one, (value, of) in (parameters or {}).items()),
        )
    )


# Two FMUs of OpenModelica, coupled: each mass feels the spring to the other.
HALVES = system(
    elements=component(
        "left", "resources/left.fmu", connector("x1", "output") + connector("x2", "input") + connector("k2", "input")
    )
    + component(
        "right", "resources/right.fmu", connector("x2", "output") + connector("x1", "input") + connector("k2", "input")
    ),
    connections=connection("left.x1", "right.x1")
    + connection("left.x2", "right.x2")
    + connection("stiffness", "left.k2")
    + connection("stiffness", "right.k2"),
    connectors=connector("stiffness", "input"),
    bindings=binding(values("stiffness=Real:2.5", "left.k1=Real:1.5")),
)


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    files = {
        f"resources/{place}.fmu": third_party_fmu(f"MassSpringSubSystem{number}.fmu", OPENMODELICA)
        for number, place in enumerate(("left", "right"), start=1)
    }
    return package(tmp_path_factory.mktemp("halves") / "halves.ssp", description(HALVES, name="halves"), files)


def test_two_coupled_fmus_of_openmodelica_run_as_fmpy_steps_them_side_by_side(halves: Path, tmp_path: Path):
    """The same calls at the same times: the same bytes, the wires held a step as Jacobi's method holds them."""
    made = crankbench(tmp_path, "ssp", "import", halves, "--out", "in", "--step", "10 ms")
    assert (made.returncode, made.stderr) == (0, "")
    assert made.stdout.splitlines()[-1] == "in/halves.yaml"
    ended = crankbench(
        tmp_path, "run", "in/halves.yaml", "--out", "out", "--jobs", 1, "--set", "coupling.method=jacobi"
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    ours = signals_of(tmp_path / "out")
    fmus = {name: tmp_path / "in" / "resources" / f"{name}.fmu" for name in ("left", "right")}
    starts = {"left": {"k1": 1.5, "k2": 2.5}, "right": {"k2": 2.5}}
    wires = [("left", "x1", "right", "x1"), ("right", "x2", "left", "x2")]
    theirs = side_by_side(fmus, wires, 0.01, 100, starts)
    for name, column in theirs.items():
        assert np.ptp(column) > 0.01, "it moves"
        assert np.array_equal(ours[name], column)


def test_an_ssp_is_run_as_it_is_where_its_fmus_say_a_step(tmp_path: Path):
    elements = component("ball", "resources/ball.fmu", connector("h", "output"))
    files = {"resources/ball.fmu": reference_fmu("BouncingBall")}
    package(tmp_path / "ball.ssp", description(system(elements), extra=""), files)
    ended = crankbench(tmp_path, "run", "ball.ssp", "--out", "out", "--jobs", 1)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    found = signals_of(tmp_path / "out")
    assert (found["time"][1], found["time"][-1]) == (0.01, 3.0)  # its default experiment
    again = crankbench(tmp_path, "run", "ball.ssp", "--out", "out", "--jobs", 1)
    assert "kept" in again.stdout, "the same SSP gives the same case"


def test_halves_coupled_step_by_step_come_to_the_whole_as_the_step_falls(halves: Path):
    """Coupling holds an input for a step: its error is of first order, so a tenth of the step leaves a tenth of it."""
    whole = third_party_fmu("MassSpringSystem.fmu", OPENMODELICA)
    errors = []
    for step, steps in ((0.01, 100), (0.001, 1000)):
        settings = {"all": {"k1": 1.5, "k2": 2.5}}
        theirs = side_by_side({"all": whole}, [], step, steps, settings, watched=[("all", "x1")])
        errors.append(np.abs(ran(halves, step=f"{step} s")["left.x1"] - theirs["all.x1"]).max())
    assert 1e-4 < errors[0] < 0.05
    assert errors[1] == pytest.approx(0.1 * errors[0], rel=0.2)


# ---- connections ----


def one_way(path: Path, source: Path, target: Path, inside: str = "", attributes: str = "", **given: str) -> Path:
    """An SSP in which `a.y` feeds `b.u`; `given` are the connectors' types, and what follows the system."""
    elements = component("a", "resources/a.fmu", connector("y", "output", given.get("y", "<ssc:Real/>")))
    elements += component("b", "resources/b.fmu", connector("u", "input", given.get("u", "<ssc:Real/>")))
    top = system(elements, connection("a.y", "b.u", inside, attributes))
    extra = given.get("units", "") + '<ssd:DefaultExperiment stopTime="1"/>'
    files = {"resources/a.fmu": source, "resources/b.fmu": target}
    return package(path, description(top, extra=extra), files)


SPEED = {"parameters": {"level": (30.0, "rpm")}, "outputs": {"y": "rpm"}}


def test_units_are_converted_by_themselves(tmp_path: Path):
    path = one_way(tmp_path / "a.ssp", fmu("rpm_out", **SPEED), fmu("rad_in", {"u": "rad/s"}, {"y": "rad/s"}))
    assert imported(path, step="0.1 s")["parts"]["b"]["wires"] == {"u": "a.y"}
    assert ran(path, step="0.1 s")["b.y"] == pytest.approx(30.0 * RPM, rel=1e-15)


def test_a_number_passes_as_it_is_where_conversion_is_suppressed(tmp_path: Path):
    source, target = fmu("rpm_out", **SPEED), fmu("rad_in", {"u": "rad/s"}, {"y": "rad/s"})
    path = one_way(tmp_path / "a.ssp", source, target, attributes='suppressUnitConversion="true"')
    assert ran(path, step="0.1 s")["b.y"] == pytest.approx(30.0, rel=1e-15)


def test_a_linear_transformation_acts_after_the_conversion_in_the_units_of_the_target(tmp_path: Path):
    source = fmu("celsius_out", parameters={"level": (20.0, "degC")}, outputs={"y": "degC"})
    target = fmu("kelvin_in", {"u": "K"}, {"y": "K"})
    inside = '<ssc:LinearTransformation factor="2" offset="-100"/>'
    path = one_way(tmp_path / "a.ssp", source, target, inside)
    parts = imported(path, step="0.1 s")["parts"]
    assert parts["b"]["wires"] == {"u": "b_u"}
    assert parts["b_u"] == {"use": "sensor", "of": "a.y", "gain": 2.0, "bias": "-100.0 K"}
    assert ran(path, step="0.1 s")["b.y"] == pytest.approx(2.0 * 293.15 - 100.0, rel=1e-15)


def test_a_suppressed_conversion_with_a_linear_one_of_the_same_meaning_is_a_plain_wire(tmp_path: Path):
    source, target = fmu("rpm_out", **SPEED), fmu("rad_in", {"u": "rad/s"}, {"y": "rad/s"})
    inside = f'<ssc:LinearTransformation factor="{RPM!r}"/>'
    path = one_way(tmp_path / "a.ssp", source, target, inside, 'suppressUnitConversion="true"')
    assert imported(path, step="0.1 s")["parts"]["b"]["wires"] == {"u": "a.y"}


def test_a_transformation_between_dimensions_is_a_part_of_its_own(tmp_path: Path):
    source, target = fmu("rpm_out", **SPEED), fmu("torque_in", {"u": "N.m"}, {"y": "N.m"})
    inside = '<ssc:LinearTransformation factor="0.5" offset="1"/>'
    path = one_way(tmp_path / "a.ssp", source, target, inside, 'suppressUnitConversion="true"')
    assert imported(path, step="0.1 s")["parts"]["b_u"]["use"] == "harness.ssp.transformations:linear"
    # 30 rpm is the number 30, half of it and one are 16 N.m: up to the rounding of rpm to rad/s and back
    assert ran(path, step="0.1 s")["b.y"] == pytest.approx(16.0, rel=1e-15)


def test_the_unit_of_a_connector_is_bound_to_a_variable_that_declares_none(tmp_path: Path):
    target = fmu("newton_in", {"u": "kN"}, {"y": "N"})
    path = one_way(
        tmp_path / "a.ssp",
        reference_fmu("Dahlquist"),
        target,
        y='<ssc:Real unit="N"/>',
        units=f"<ssd:Units>{unit('N', kg=1, m=1, s=-2)}</ssd:Units>",
    ).rename(tmp_path / "b.ssp")
    made = description(
        system(
            component("a", "resources/a.fmu", connector("x", "output", '<ssc:Real unit="N"/>'))
            + component("b", "resources/b.fmu", connector("u", "input")),
            connection("a.x", "b.u"),
        ),
        extra=f"<ssd:Units>{unit('N', kg=1, m=1, s=-2)}</ssd:Units>",
    )
    path = package(path, made, {"resources/a.fmu": reference_fmu("Dahlquist"), "resources/b.fmu": target})
    assert imported(path)["parts"]["a"]["units"] == {"x": "N"}
    found = ran(path)
    assert np.array_equal(found["b.y"], found["a.x"] / 1e3), "the sum is of numbers in kN"


def test_a_unit_that_a_campaign_has_no_name_for_is_scaled_by_a_part(tmp_path: Path):
    """A pound is no unit here: what is bound is kg, and the number is multiplied."""
    made = description(
        system(
            component("a", "resources/a.fmu", connector("x", "output", '<ssc:Real unit="lb"/>'))
            + component("b", "resources/b.fmu", connector("u", "input")),
            connection("a.x", "b.u"),
        ),
        extra=f"<ssd:Units>{unit('lb', kg=1, factor=0.45359237)}</ssd:Units>",
    )
    files = {"resources/a.fmu": reference_fmu("Dahlquist"), "resources/b.fmu": fmu("kilo", {"u": "kg"}, {"y": "kg"})}
    path = package(tmp_path / "a.ssp", made, files)
    assert imported(path)["parts"]["a"]["units"] == {"x": "kg"}
    found = ran(path)
    assert found["b.y"] == pytest.approx(0.45359237 * found["a.x"], rel=1e-15)


def test_whole_numbers_booleans_and_enumerations_go_through_their_tables(tmp_path: Path):
    inside = {
        "Boolean": '<ssc:MapEntry source="false" target="true"/><ssc:MapEntry source="true" target="false"/>',
        "Integer": '<ssc:MapEntry source="0" target="7"/><ssc:MapEntry source="1" target="-2"/>',
        "Enumeration": '<ssc:MapEntry source="Option 1" target="Option 2"/>',
    }
    types = {"Boolean": "Boolean", "Integer": "Int32", "Enumeration": "Enumeration"}
    connections = "".join(
        connection(
            f"a.{types[kind]}_output", f"b.{types[kind]}_input", f"<ssc:{kind}MappingTransformation>{entries}"
            f"</ssc:{kind}MappingTransformation>"
        )
        for kind, entries in inside.items()
    )  # fmt: skip
    ends = {
        part: "".join(connector(f"{name}_{side}", side, "") for name in types.values())
        for part, side in (("a", "output"), ("b", "input"))
    }
    elements = "".join(component(part, "resources/f.fmu", ends[part]) for part in ("a", "b"))
    path = package(
        tmp_path / "a.ssp",
        description(system(elements, connections)),
        {"resources/f.fmu": reference_fmu("Feedthrough")},
    )
    found = ran(path, step="0.1 s")
    shown = {name: found[f"b.{name}_output"] for name in ("Boolean", "Int32", "Enumeration")}
    assert {name: set(column) for name, column in shown.items()} == {
        "Boolean": {1.0}, "Int32": {7.0}, "Enumeration": {2.0}
    }  # fmt: skip


def test_a_value_that_a_table_lacks_ends_the_run_with_the_value(tmp_path: Path):
    entries = (
        '<ssc:IntegerMappingTransformation><ssc:MapEntry source="3" target="7"/></ssc:IntegerMappingTransformation>'
    )
    elements = "".join(
        component(part, "resources/f.fmu", connector(f"Int32_{side}", side, "<ssc:Integer/>"))
        for part, side in (("a", "output"), ("b", "input"))
    )
    top = system(elements, connection("a.Int32_output", "b.Int32_input", entries))
    path = package(tmp_path / "a.ssp", description(top), {"resources/f.fmu": reference_fmu("Feedthrough")})
    (case,) = read_campaign(import_system(path, clock=Clock(step="0.1 s")).write(tmp_path)).cases
    with wire(case.scenario, case.places) as made:
        record = run(made)
    assert (record.outcome, record.part) == ("error", "b_Int32_input")
    assert "has no entry for 0; there are 3" in record.message


# ---- structure ----


def test_nested_systems_become_parts_named_by_their_path_and_connectors_between_are_followed(tmp_path: Path):
    inner = system(
        component("gain", "resources/g.fmu", connector("u", "input") + connector("y", "output")),
        connection("in", "gain.u") + connection("gain.y", "out", '<ssc:LinearTransformation factor="10"/>'),
        connector("in", "input") + connector("out", "output"),
        name="inner box",
    )
    elements = inner + component("end", "resources/g.fmu", connector("u", "input"))
    top = system(
        elements,
        connection("level", "inner box.in")
        + connection("inner box.out", "end.u")
        + connection("inner box.out", "seen"),
        connector("level", "input") + connector("seen", "output"),
        binding(values("level=Real:3")),
    )
    path = package(tmp_path / "a.ssp", description(top), {"resources/g.fmu": fmu("same", {"u": "1"}, {"y": "1"})})
    parts = imported(path, step="0.1 s")["parts"]
    assert parts["level"] == {"use": "source", "unit": "1", "constant": 3.0}
    assert parts["inner_box_gain"]["wires"] == {"u": "level"}
    assert parts["seen"] == {"use": "sensor", "of": "inner_box_gain.y", "gain": 10.0}
    found = ran(path, step="0.1 s")
    assert set(found["end.y"]) == {30.0} and set(found["seen.value"]) == {30.0}


def test_inputs_that_nothing_feeds_become_sources_of_what_they_start_with(tmp_path: Path):
    elements = component("b", "resources/b.fmu", bindings=binding(values("b=Real:4")))
    target = cached_fmu(
        Model(
            name="two_inputs",
            description="a + b",
            equations=lambda t, x, m, u, p: ({}, {"y": u.a + u.b}),
            inputs=(Signal("a", "bar", 1.5), Signal("b", "bar", 2.0)),
            outputs=(Signal("y", "bar"),),
        )
    )
    path = package(tmp_path / "a.ssp", description(system(elements)), {"resources/b.fmu": target})
    parts = imported(path, step="0.1 s")["parts"]
    assert parts["b_a"] == {"use": "source", "unit": "bar", "constant": "1.5 bar"}
    assert parts["b_b"] == {"use": "source", "unit": "bar", "constant": "4.0 bar"}
    assert ran(path, step="0.1 s")["b.y"] == pytest.approx(5.5e5, rel=1e-15)


def test_an_input_of_the_system_that_is_given_no_value_starts_as_the_fmu_behind_it_does(tmp_path: Path):
    target = cached_fmu(
        Model(
            name="one_input",
            description="u",
            equations=lambda t, x, m, u, p: ({}, {"y": u.u}),
            inputs=(Signal("u", "K", 300.0),),
            outputs=(Signal("y", "K"),),
        )
    )
    top = system(
        component("b", "resources/b.fmu", connector("u", "input")),
        connection("ambient", "b.u", '<ssc:LinearTransformation factor="2"/>'),
        connector("ambient", "input", '<ssc:Real unit="degC"/>'),
    )
    extra = f"<ssd:Units>{unit('degC', K=1, offset=273.15)}</ssd:Units>" + '<ssd:DefaultExperiment stopTime="1"/>'
    path = package(tmp_path / "a.ssp", description(top, extra=extra), {"resources/b.fmu": target})
    source = imported(path, step="0.1 s")["parts"]["ambient"]
    assert source["unit"] == "degC"
    assert float(source["constant"].removesuffix(" degC")) == pytest.approx(150.0 - 273.15, abs=1e-12)
    assert ran(path, step="0.1 s")["b.y"] == pytest.approx(300.0, rel=1e-15)


def test_signals_of_a_dictionary_are_one_wherever_it_is_referred_to(tmp_path: Path):
    dictionary = (
        '<ssd:SignalDictionaries><ssd:SignalDictionary name="bus" source="resources/bus.ssb"/></ssd:SignalDictionaries>'
    )
    bus = (
        f'<ssb:SignalDictionary xmlns:ssb="http://ssp-standard.org/SSP1/SystemStructureSignalDictionary" '
        f'xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon" version="1.0">'
        f'<ssb:DictionaryEntry name="speed"><ssc:Real unit="rad/s"/></ssb:DictionaryEntry>'
        f"<ssb:Units>{unit('rad/s', rad=1, s=-1)}</ssb:Units></ssb:SignalDictionary>"
    )
    reference = (
        '<ssd:SignalDictionaryReference name="{name}" dictionary="bus"><ssd:Connectors>'
        '<ssd:Connector name="speed" kind="inout"/></ssd:Connectors></ssd:SignalDictionaryReference>'
    )
    inner = system(
        component("b", "resources/b.fmu", connector("u", "input")) + reference.format(name="down"),
        connection("down.speed", "b.u"),
        name="inner",
    )
    elements = component("a", "resources/a.fmu", connector("y", "output")) + reference.format(name="up") + inner
    top = system(elements, connection("a.y", "up.speed"), rest=dictionary)
    source, target = fmu("rpm_out", **SPEED), fmu("rad_in", {"u": "rad/s"}, {"y": "rad/s"})
    files = {"resources/a.fmu": source, "resources/b.fmu": target, "resources/bus.ssb": bus}
    path = package(tmp_path / "a.ssp", description(top), files)
    assert imported(path, step="0.1 s")["parts"]["inner_b"]["wires"] == {"u": "a.y"}
    assert ran(path, step="0.1 s")["inner_b.y"] == pytest.approx(30.0 * RPM, rel=1e-15)


@pytest.mark.parametrize("media", ["package", "definition", "same document"])
def test_a_component_that_refers_to_a_system_stands_for_it_with_its_own_values_on_top(media: str, tmp_path: Path):
    inner = system(
        component("g", "resources/g.fmu", connector("u", "input") + connector("y", "output")),
        connection("in", "g.u") + connection("g.y", "out"),
        connector("in", "input") + connector("out", "output"),
        binding(values("g.p=Real:1")),
        name="inner",
    ).replace("<ssd:System ", '<ssd:System id="here" ', 1)
    model = fmu("with_p", {"u": "1"}, {"y": "1"}, {"p": (0.0, "1")})
    types = {"package": "application/x-ssp-package", "definition": "application/x-ssp-definition"}
    sources = {"package": "resources/inner.ssp", "definition": "inner.ssd", "same document": "#here"}
    ends = connector("in", "input") + connector("out", "output")
    given = binding(values("g.p=Real:5"))
    elements = component(
        "twin", sources[media], ends, given, f'type="{types.get(media, "application/x-ssp-definition")}"'
    )
    elements += inner if media == "same document" else ""
    path = package(
        tmp_path / "a.ssp",
        description(system(elements)),
        {
            "resources/g.fmu": model,
            "inner.ssd": description(inner, name="inner"),
            "resources/inner.ssp": package(
                tmp_path / "inner.ssp", description(inner, name="inner"), {"resources/g.fmu": model}
            ),
        },
    )
    found = ran(path, step="0.1 s")
    assert set(found["twin_g.y"]) == {5.0}
    if media == "same document":
        assert set(found["inner_g.y"]) == {1.0}


def test_a_variant_is_chosen_by_name_and_the_others_are_told_of(tmp_path: Path):
    files = {"resources/f.fmu": reference_fmu("VanDerPol")}
    plain = description(system(component("a", "resources/f.fmu")), name="plain")
    stiff = description(system(component("a", "resources/f.fmu", bindings=binding(values("mu=Real:9")))), name="stiff")
    path = package(tmp_path / "a.ssp", plain, {**files, "Stiff.ssd": stiff})
    assert "with" not in imported(path)["parts"]["a"]
    assert imported(path, "Stiff")["parts"]["a"]["with"] == {"mu": 9}
    assert "it holds variants, which --variant takes: Stiff" in import_system(path).notes


def test_the_step_is_that_of_a_master_in_annotations_of_other_tools(tmp_path: Path):
    annotation = (
        '<ssd:Annotations><ssc:Annotation type="org.openmodelica"><oms:Annotations xmlns:oms="urn:oms">'
        '<oms:SimulationInformation><oms:FixedStepMaster description="oms-ma" stepSize="0.025"/>'
        "</oms:SimulationInformation></oms:Annotations></ssc:Annotation></ssd:Annotations>"
    )
    top = system(component("a", "resources/a.fmu"), rest=annotation)
    path = package(tmp_path / "a.ssp", description(top), {"resources/a.fmu": reference_fmu("Dahlquist")})
    assert imported(path)["clock"]["time"] == {"step": "0.025 s", "stop": "1.0 s", "start": "0.0 s"}
    assert import_system(path).notes == (
        "the step is that of a master in its annotations, 0.025 s: an SSP gives none itself",
    )


# ---- parameters ----


def two_parameters() -> Path:
    return fmu("two_parameters", {"u": "1"}, {"y": "1"}, {"p": (1.0, "N.m/rad"), "q": (2.0, "N.m/rad")})


UNITS = unit("N.m/rad", kg=1, m=2, s=-2, rad=-1) + unit("Nm/deg", kg=1, m=2, s=-2, rad=-1, factor=180.0 / np.pi)


def given(path: Path, bindings: str, own: str = "", files: Mapping[str, Any] | None = None, more: str = "") -> Any:
    """What stands under `with` of a component `a` whose system, and which itself, has these bindings."""
    top = system(component("a", "resources/a.fmu", bindings=own) + more, bindings=bindings)
    package(path, description(top), {"resources/a.fmu": two_parameters(), **(files or {})})
    return imported(path, step="0.1 s")["parts"]["a"].get("with")


def test_the_outer_binding_stands_above_the_inner_and_the_later_above_the_earlier(tmp_path: Path):
    own = binding(values("p=Real:5", "q=Real:6")) + binding(values("q=Real:7"))
    assert given(tmp_path / "a.ssp", "", own) == {"p": "5.0 N.m/rad", "q": "7.0 N.m/rad"}
    assert given(tmp_path / "b.ssp", binding(values("a.p=Real:8")), own) == {"p": "8.0 N.m/rad", "q": "7.0 N.m/rad"}


def test_a_prefix_stands_before_all_names_of_a_set_beside_the_description(tmp_path: Path):
    files = {"resources/a.ssv": values("p=Real:5", "q=Real:6")}
    found = given(tmp_path / "a.ssp", binding(source="resources/a.ssv", prefix="a."), files=files)
    assert found == {"p": "5.0 N.m/rad", "q": "6.0 N.m/rad"}


def test_a_mapping_takes_what_it_names_alone_all_at_once_and_transforms_it(tmp_path: Path):
    """p and q change places: a mapping is no sequence of renamings."""
    half = '<ssc:LinearTransformation factor="0.5" offset="1"/>'
    swapped = mapping(p="q", q=f"p {half}")
    own = binding(values("p=Real:10", "q=Real:20", "u=Real:30"), mapping=swapped)
    assert given(tmp_path / "a.ssp", "", own) == {"q": "6.0 N.m/rad", "p": "20.0 N.m/rad"}
    files = {"resources/m.ssm": mapping(**{"a.p": "k"})}
    outer = binding(values("k=Real:3", "a.q=Real:4"), mapping='"resources/m.ssm"')
    assert given(tmp_path / "b.ssp", outer, files=files) == {"p": "3.0 N.m/rad"}


def test_values_are_converted_from_the_unit_they_have(tmp_path: Path):
    own = binding(values("p=Real:5 Nm/deg", "q=Real:6", units=UNITS))
    found = given(tmp_path / "a.ssp", "", own)
    assert float(found["p"].removesuffix(" N.m/rad")) == pytest.approx(5.0 * 180.0 / np.pi, rel=1e-15)
    assert found["q"] == "6.0 N.m/rad"


def test_a_value_in_another_unit_than_si_reaches_the_fmu_to_the_last_digit(tmp_path: Path):
    """A number of rpm that a number in SI stands for is written so that it comes back as it was."""
    turning = fmu("turning", {"u": "1"}, {"y": "1"}, {"p": (1.0, "rpm")})
    for seed in range(30):
        value = float(np.random.default_rng(seed).uniform(1.0, 900.0)) / RPM
        top = system(component("a", "resources/a.fmu", bindings=binding(values(f"p=Real:{value!r}"))))
        path = package(tmp_path / f"{seed}.ssp", description(top), {"resources/a.fmu": turning})
        assert set(ran(path, step="0.5 s")["a.y"]) == {value}


def test_a_parameter_of_a_system_goes_along_its_connections_the_outermost_value_first(tmp_path: Path):
    def nested(outer: str, inner: str) -> str:
        box = system(
            component("a", "resources/a.fmu", connector("p", "parameter")),
            connection("stiffness", "a.p", '<ssc:LinearTransformation factor="2"/>'),
            connector("stiffness", "parameter"),
            inner,
            name="box",
        )
        return system(box, connection("k", "box.stiffness"), connector("k", "parameter"), outer)

    values_of = {"outer": binding(values("k=Real:4")), "inner": binding(values("stiffness=Real:9", "a.p=Real:1"))}
    for name, top, wanted in (
        ("both", nested(**values_of), 8.0),
        ("inner", nested("", values_of["inner"]), 18.0),
        ("own", nested("", binding(values("a.p=Real:1"))), 1.0),
    ):
        path = package(tmp_path / f"{name}.ssp", description(top), {"resources/a.fmu": two_parameters()})
        assert imported(path, step="0.1 s")["parts"]["box_a"]["with"] == {"p": f"{wanted} N.m/rad"}


def test_text_truth_whole_numbers_and_items_are_given_as_they_are(tmp_path: Path):
    own = binding(
        values("String_input=String:a b", "Boolean_input=Boolean:true", "Int32_input=Integer:-3")
        .replace('value="-3"/>', 'value="-3"/></ssv:Parameter><ssv:Parameter name="Enumeration_input">'
                 '<ssv:Enumeration value="Option 2"/>')
    )  # fmt: skip
    path = package(
        tmp_path / "a.ssp",
        description(system(component("a", "resources/f.fmu", bindings=own))),
        {"resources/f.fmu": reference_fmu("Feedthrough")},
    )
    parts = imported(path, step="0.1 s")["parts"]
    assert parts["a"]["with"] == {"String_input": "a b"}
    constants = {name: parts[f"a_{name}_input"]["constant"] for name in ("Boolean", "Int32", "Enumeration")}
    assert constants == {"Boolean": 1, "Int32": -3, "Enumeration": 2}
    found = ran(path, step="0.1 s")
    assert (set(found["a.Boolean_output"]), set(found["a.Int32_output"])) == ({1.0}, {-3.0})


def test_a_set_inside_of_the_fmu_is_found_from_the_component(tmp_path: Path):
    import zipfile

    inside = tmp_path / "a.fmu"
    inside.write_bytes(two_parameters().read_bytes())
    with zipfile.ZipFile(inside, "a") as archive:
        archive.writestr("extra/a.ssv", values("p=Real:5"))
    own = binding(source="extra/a.ssv").replace("source=", 'sourceBase="component" source=')
    assert given(tmp_path / "a.ssp", "", own, {"resources/a.fmu": inside}) == {"p": "5.0 N.m/rad"}


def test_what_is_left_out_is_told_with_its_line(tmp_path: Path):
    bindings = binding(values("a.p=Real:5", "b.p=Real:1"))
    given(tmp_path / "a.ssp", bindings)
    notes = import_system(tmp_path / "a.ssp", clock=Clock(step="1 s")).notes
    assert notes == ("a.ssp/SystemStructure.ssd:3: b.p is nothing in top, and is left out",)
    assert f"# {notes[0]}\n" in import_system(tmp_path / "a.ssp", clock=Clock(step="1 s")).text


# ---- SSP 2.0 ----


def test_arrays_of_ssp_2_are_wired_whole_and_by_their_places(tmp_path: Path):
    """y = D u with D = 1 and no other influence: B = 0 and x0 = 0."""
    three = '<ssc:Float64/><ssc:Dimension size="3"/>'
    zeros = " ".join(["0"] * 9)
    silent = binding(values(f"B=Float64:{zeros}", "u=Float64:4 5 6", version="2.0"))
    elements = "".join(
        component(part, "resources/s.fmu", connector("u", "input", three) + connector("y", "output", three), silent)
        for part in ("a", "b", "c")
    )
    connections = connection("a.y", "b.u") + "".join(
        connection("b.y", "c.u", attributes=f'startIndices="{4 - index}" endIndices="{index}"') for index in (1, 2, 3)
    )
    made = description(system(elements, connections), version="2.0")
    path = package(tmp_path / "a.ssp", made, {"resources/s.fmu": reference_fmu("StateSpace", 3)})
    parts = imported(path, step="0.1 s")["parts"]
    assert parts["b"]["wires"] == {"u": "a.y"}
    assert parts["c"]["wires"] == {"u[1]": "b.y[3]", "u[2]": "b.y[2]", "u[3]": "b.y[1]"}
    found = ran(path, step="0.1 s")
    assert [set(found[f"c.y[{index}]"]) for index in (1, 2, 3)] == [{6.0}, {5.0}, {4.0}]


def test_model_exchange_is_taken_where_the_ssp_asks_for_it(tmp_path: Path):
    element = component("a", "resources/a.fmu", attributes='implementation="ModelExchange"')
    path = package(tmp_path / "a.ssp", description(system(element)), {"resources/a.fmu": reference_fmu("Dahlquist")})
    assert imported(path)["parts"]["a"]["kind"] == "me"
    time = np.arange(11) * 0.1
    # relative tolerance of the solver, 1e-6 by default, over a second
    assert ran(path)["a.x"] == pytest.approx(np.exp(-time), rel=1e-4)
